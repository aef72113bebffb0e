/**
 * The electrodes of one run: detected, or set by hand; each change is stored at once and can be undone. `changed` fires after each
 * change, `stored` when the service has stored the last one, `refused` when it has not.
 */
import { get, send } from "../shared/api.js";

/** @typedef {import("../shared/types.js").Electrode} Electrode */
/** @typedef {import("../study/page.js").StudyState} StudyState */

export class Marks extends EventTarget {
  /** @param {StudyState} state @param {import("../shared/types.js").Run} run */
  constructor(state, run) {
    super();
    this.state = state;
    this.run = run;
    this.path = `${state.path}/instances/${run.sop_instance_uid}`;
    /** @type {Map<number, Electrode[]>} Frame (from 1) -> electrodes. */
    this.frames = new Map();
    /** @type {{frame: number, before: Electrode[], after: Electrode[]}[]} */
    this.done = [];
    /** @type {{frame: number, before: Electrode[], after: Electrode[]}[]} */
    this.undone = [];
    /** Changes that the service has not answered yet. */
    this.waiting = 0;
  }

  async load() {
    const frames = await get(`${this.path}/electrodes`);
    this.frames = new Map(frames.map((/** @type {any} */ each) => [each.frame, each.electrodes]));
    this.dispatchEvent(new Event("changed"));
  }

  /** @param {number} frame @returns {Electrode[]} */
  of(frame) {
    return this.frames.get(frame) ?? [];
  }

  /**
   * Replace one catheter's electrodes in a frame. The other catheters stay as they are, so that a wrong name that nobody looked
   * at is not taken for a person's word.
   *
   * @param {number} frame
   * @param {string} catheter
   * @param {Electrode[]} electrodes Of this catheter.
   */
  change(frame, catheter, electrodes) {
    const others = this.of(frame).filter((each) => each.catheter !== catheter);
    const after = [...others, ...electrodes.map((each) => ({ ...each, catheter, source: /** @type {const} */ ("manual") }))];
    this.done.push({ frame, before: this.of(frame), after });
    this.undone = [];
    return this.#put(frame, after);
  }

  /** Return a frame to the automatic electrodes. @param {number} frame */
  reset(frame) {
    this.done.push({ frame, before: this.of(frame), after: [] });
    this.undone = [];
    return this.#put(frame, []);
  }

  undo() {
    const step = this.done.pop();
    if (!step) return Promise.resolve(null);
    this.undone.push(step);
    return this.#put(step.frame, step.before).then(() => step.frame);
  }

  redo() {
    const step = this.undone.pop();
    if (!step) return Promise.resolve(null);
    this.done.push(step);
    return this.#put(step.frame, step.after).then(() => step.frame);
  }

  /** @param {number} frame @param {Electrode[]} electrodes */
  #put(frame, electrodes) {
    this.frames.set(frame, electrodes);
    this.dispatchEvent(new Event("changed"));
    const manual = electrodes.filter((each) => each.source === "manual");
    const address = `${this.path}/frames/${frame}/electrodes`;
    this.waiting += 1;
    // One request after the other: the last change has to be the last that the service stores.
    const stored = this.state.stored.then(async () => {
      try {
        if (manual.length) await send("PUT", address, manual);
        else this.frames.set(frame, await send("DELETE", address));
      } catch (error) {
        this.waiting -= 1;
        this.dispatchEvent(new Event("refused"));
        // The view must not show a change that the service refused.
        await this.load();
        throw error;
      }
      this.waiting -= 1;
      this.dispatchEvent(new Event("changed"));
      if (!this.waiting) this.dispatchEvent(new Event("stored"));
    });
    this.state.stored = stored.catch(() => undefined);
    return stored;
  }
}
