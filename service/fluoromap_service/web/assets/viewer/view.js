/** One view: a run that plays, with electrodes that can be moved, deleted and added by pointer or keyboard. */
import { attempt, button, element } from "../shared/elements.js";
import { direction } from "../shared/words.js";
import { Cine } from "./cine.js";
import { FramePainter, keyOf } from "./frame-painter.js";
import { Marks } from "./marks.js";
import { Placement } from "./placement.js";
import { FRAME_MS, Playback } from "./playback.js";

/** @typedef {import("../shared/types.js").Electrode} Electrode */

const REACH = 14;

export class View extends EventTarget {
  /**
   * @param {string} letter
   * @param {import("../study/page.js").StudyState} state
   * @param {import("../shared/types.js").Run} run
   * @param {{catheter: string, tool: string, next: number}} pen The marking that goes on in all views.
   */
  constructor(letter, state, run, pen) {
    super();
    this.letter = letter;
    this.state = state;
    this.run = run;
    this.pen = pen;
    this.frame = 1;
    this.playback = new Playback(run.frame_time_ms ?? FRAME_MS, (frames) => this.show(this.frame + frames));
    /** @type {string|null} */
    this.chosen = null;
    /** @type {{start: number[], end: number[], colour: string}|null} */
    this.line = null;
    /** @type {Electrode[]|null} Electrodes during a drag. */
    this.moving = null;
    this.shownFrames = 0;
    this.painter = new FramePainter(run);
    this.placement = new Placement();
    this.marks = new Marks(state.path, run);
    this.cine = new Cine(state.path, run, () => this.draw());
    this.canvas = element("canvas", { tabIndex: 0, role: "application", "aria-label": `View ${letter}, ${direction(run.gantry)}: frames and electrodes; press H for the keys` });
    this.slider = element("input", { type: "range", min: 1, max: run.frames, value: 1, "aria-label": `Frame of view ${letter}`, oninput: () => this.show(Number(this.slider.value)) });
    this.count = element("span", {}, `1 / ${run.frames}`);
    this.playButton = button("Play", () => this.play(!this.playing), { "aria-label": `Play view ${letter}` });
    this.status = element("span", { class: "status", "aria-live": "polite" });
    this.element = element("div", { class: "view", "data-view": letter },
      element("div", { class: "caption" }, element("strong", {}, `View ${letter}`), `${direction(run.gantry)}${run.simulated ? ", simulated data" : ""}`, element("span", { class: "grow" }), this.status),
      this.canvas, element("div", { class: "caption" }, this.playButton, this.slider, this.count));
    this.marks.addEventListener("changed", () => this.draw());
    this.marks.addEventListener("stored", () => (this.status.textContent = "stored"));
    new ResizeObserver(() => this.#fit()).observe(this.canvas);
    attempt(() => this.marks.load());
  }

  close() {
    this.play(false);
    this.cine.close();
  }

  #fit() {
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(this.canvas.clientWidth * ratio);
    this.canvas.height = Math.round(this.canvas.clientHeight * ratio);
    this.draw();
  }

  /** @param {number} frame */
  show(frame) {
    this.frame = ((frame - 1 + this.run.frames) % this.run.frames) + 1;
    this.slider.value = String(this.frame);
    this.count.textContent = `${this.frame} / ${this.run.frames}`;
    this.draw();
  }

  get playing() {
    return this.playback.playing;
  }

  /** @param {boolean} playing */
  play(playing) {
    this.playback.play(playing);
    this.playButton.textContent = playing ? "Pause" : "Play";
    this.playButton.setAttribute("aria-label", `${this.playButton.textContent} view ${this.letter}`);
  }

  get electrodes() {
    return this.moving ?? this.marks.of(this.frame);
  }

  draw() {
    const pixels = this.cine.pixels(this.frame);
    if (pixels) {
      this.painter.setPixels(pixels);
      this.shownFrames += 1;
      this.element.dataset.frames = String(this.shownFrames);
    }
    this.painter.paintFrame(this.canvas, this.placement);
    if (this.line) this.painter.paintLine(this.canvas, this.placement, this.line);
    this.painter.paintElectrodes(this.canvas, this.placement, this.state.study, this.electrodes, this.chosen);
    this.element.dataset.electrodes = String(this.electrodes.length);
  }

  /** @param {PointerEvent|WheelEvent} event */
  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return { x: ((event.clientX - box.left) * this.canvas.width) / box.width, y: ((event.clientY - box.top) * this.canvas.height) / box.height };
  }

  /** The electrode under a point of the canvas. @param {number} x @param {number} y */
  hit(x, y) {
    const reach = REACH * (window.devicePixelRatio || 1);
    let best = null;
    let nearest = reach;
    for (const each of this.electrodes) {
      const place = this.placement.toCanvas(this.canvas, this.run, each.u_px, each.v_px);
      const distance = Math.hypot(place.x - x, place.y - y);
      if (distance < nearest) [best, nearest] = [each, distance];
    }
    return best;
  }

  /** Choose an electrode and let the other view draw its line. @param {Electrode|null} electrode */
  choose(electrode) {
    const key = electrode ? keyOf(electrode) : null;
    if (key === this.chosen) return;
    this.chosen = key;
    this.dispatchEvent(new CustomEvent("chosen", { detail: electrode }));
    this.draw();
  }

  get chosenElectrode() {
    return this.electrodes.find((each) => keyOf(each) === this.chosen) ?? null;
  }

  /** Set or move an electrode. @param {string} catheter @param {number} electrode @param {number} u @param {number} v */
  set(catheter, electrode, u, v) {
    const kept = this.marks.of(this.frame).filter((each) => each.catheter === catheter && each.electrode !== electrode);
    const u_px = Math.min(this.run.columns - 0.5, Math.max(-0.5, u));
    const v_px = Math.min(this.run.rows - 0.5, Math.max(-0.5, v));
    return this.#store(() => this.marks.change(this.frame, catheter, [...kept, { catheter, electrode, u_px, v_px, sd_px: 1, source: "manual" }]));
  }

  /** Begin a catheter anew with its first electrode. @param {string} catheter @param {number} u @param {number} v */
  begin(catheter, u, v) {
    return this.#store(() => this.marks.change(this.frame, catheter, [{ catheter, electrode: 1, u_px: u, v_px: v, sd_px: 1, source: "manual" }]));
  }

  /** @param {Electrode} electrode */
  remove(electrode) {
    const { catheter } = electrode;
    if (catheter === null) return undefined;
    const kept = this.marks.of(this.frame).filter((each) => each.catheter === catheter && each.electrode !== electrode.electrode);
    this.chosen = null;
    return this.#store(() => this.marks.change(this.frame, catheter, kept));
  }

  resetFrame() {
    return this.#store(() => this.marks.reset(this.frame));
  }

  /** @param {1|-1} way */
  async step(way) {
    const frame = await this.#store(() => (way < 0 ? this.marks.undo() : this.marks.redo()));
    if (typeof frame === "number") this.show(frame);
  }

  /** @template T @param {() => Promise<T>} act */
  #store(act) {
    this.status.textContent = "storing";
    return attempt(act);
  }
}
