/** One view: a run that plays, with electrodes that can be moved, deleted and added by pointer or keyboard. */
import { announce, attempt, button, element } from "../shared/elements.js";
import { direction } from "../shared/words.js";
import { keyOf } from "./frame-painter.js";
import { FrameView } from "./frame-view.js";
import { Marks } from "./marks.js";

/** @typedef {import("../shared/types.js").Electrode} Electrode */

const REACH = 14;

export class View extends FrameView {
  /**
   * @param {string} letter
   * @param {import("../study/page.js").StudyState} state
   * @param {import("../shared/types.js").Run} run
   * @param {import("./pen.js").Pen} pen The marking that goes on in all views.
   */
  constructor(letter, state, run, pen) {
    const label = `View ${letter}, ${direction(run.gantry)}: frames and electrodes; press H for the keys`;
    super(state, run, { canvas: { role: "application", "aria-label": label }, slider: `Frame of view ${letter}`, frame: 1 });
    this.letter = letter;
    this.pen = pen;
    /** @type {number|null} The frame that the newest map uses. */
    this.mapFrame = null;
    /** Whether a person has not gone to a frame yet. */
    this.isUntouched = true;
    /** @type {string|null} */
    this.chosen = null;
    /** @type {{start: number[], end: number[], colour: string}|null} */
    this.line = null;
    /** Whether only the pointer above the electrode chose it. */
    this.isPointed = false;
    /** @type {{frame: number, electrode: Electrode}|null} The electrode that moves, where it is now. */
    this.carried = null;
    /** @type {{u: number, v: number}|null} Place for the next electrode, frame pixels: for people without a pointer. */
    this.cross = null;
    this.marks = new Marks(state, run);
    this.playButton = button("Play", () => this.switchPlay(), { "aria-label": `Play view ${letter}` });
    this.status = element("span", { class: "status", "aria-live": "polite" });
    this.element.dataset.view = letter;
    this.element.append(
      element("div", { class: "caption" }, element("strong", {}, `View ${letter}`), `${direction(run.gantry)}${run.simulated ? ", simulated data" : ""}`, element("span", { class: "grow" }), this.status),
      this.canvas, element("div", { class: "caption" }, this.playButton, this.slider, this.count));
    this.marks.addEventListener("changed", () => this.draw());
    this.followPen = () => {
      if (!this.sets) this.cross = null;
      else if (this.canvas.matches(":focus-visible")) this.beginCross();
      this.draw();
    };
    pen.addEventListener("changed", this.followPen);
    this.canvas.addEventListener("focus", this.followPen);
    this.marks.addEventListener("stored", () => (this.status.textContent = "stored"));
    this.marks.addEventListener("refused", () => (this.status.textContent = "not stored"));
    super.show(1);
    attempt(() => this.marks.load());
  }

  close() {
    super.close();
    this.pen.removeEventListener("changed", this.followPen);
  }

  /** @param {number} frame */
  show(frame) {
    this.isUntouched = false;
    super.show(frame);
  }

  get countText() {
    return `${super.countText}${this.frame === this.mapFrame ? ", used for the map" : ""}`;
  }

  /** Say which frame the newest map uses, and begin there: a correction in it changes the map most. @param {number|null} frame */
  setMapFrame(frame) {
    this.mapFrame = frame;
    if (frame !== null && this.isUntouched) this.show(frame);
    else this.showCount();
  }

  get playing() {
    return this.playback.playing;
  }

  switchPlay() {
    this.playback.play(!this.playing);
    this.showCount();
    this.playButton.textContent = this.playing ? "Pause" : "Play";
    this.playButton.setAttribute("aria-label", `${this.playButton.textContent} view ${this.letter}`);
  }

  get electrodes() {
    const { carried } = this;
    const stored = this.marks.of(this.frame);
    if (carried?.frame !== this.frame) return stored;
    return stored.map((each) => (keyOf(each) === keyOf(carried.electrode) ? carried.electrode : each));
  }

  paintOver() {
    if (this.line) this.painter.paintLine(this.canvas, this.placement, this.line);
    this.painter.paintElectrodes(this.canvas, this.placement, this.state.study, this.electrodes, this.chosen);
    if (this.cross) this.painter.paintCross(this.canvas, this.placement, this.cross);
    this.element.dataset.electrodes = String(this.electrodes.length);
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
    this.isPointed = false;
    this.#choose(electrode);
    if (electrode === null) return;
    this.status.textContent = `${electrode.catheter ?? "unnamed"} ${electrode.electrode}, ${electrode.source === "manual" ? "set by hand" : "found by the service"}`;
    // A person who chooses an electrode works on its catheter.
    if (electrode.catheter !== null && electrode.catheter !== this.pen.catheter && !this.sets) this.pen.take({ catheter: electrode.catheter });
  }

  /** Choose the electrode under the pointer for as long as the pointer is there. @param {Electrode|null} electrode */
  point(electrode) {
    if (electrode === null && !this.isPointed) return;
    if (electrode !== null && keyOf(electrode) === this.chosen) return;
    this.isPointed = electrode !== null;
    this.#choose(electrode);
  }

  /** @param {Electrode|null} electrode */
  #choose(electrode) {
    const key = electrode ? keyOf(electrode) : null;
    if (key === this.chosen) return;
    this.chosen = key;
    this.dispatchEvent(new CustomEvent("chosen", { detail: electrode }));
    this.draw();
  }

  get chosenElectrode() {
    return this.electrodes.find((each) => keyOf(each) === this.chosen) ?? null;
  }

  /** Whether the tool sets electrodes. */
  get sets() {
    return this.pen.tool === "add" || this.pen.tool === "mark";
  }

  /** Show the cross: at the chosen electrode, else at the catheter, else in the middle of the picture. */
  beginCross() {
    if (this.cross) return;
    const { width, height } = this.canvas;
    const chosen = this.chosenElectrode ?? this.electrodes.findLast((each) => each.catheter === this.pen.catheter);
    this.cross = chosen ? { u: chosen.u_px, v: chosen.v_px } : this.#inside(this.placement.toFrame(this.canvas, this.run, width / 2, height / 2));
  }

  /** @param {number} u @param {number} v Both in frame pixels. */
  moveCross(u, v) {
    if (this.cross) this.cross = this.#inside({ u: this.cross.u + u, v: this.cross.v + v });
    this.draw();
  }

  /** Move an electrode without storing it yet. @param {Electrode} electrode @param {number} u @param {number} v */
  carry(electrode, u, v) {
    if (this.playing) this.switchPlay();
    this.isUntouched = false;
    const place = this.#inside({ u, v });
    this.carried = { frame: this.frame, electrode: { ...electrode, u_px: place.u, v_px: place.v, sd_px: 1, source: "manual" } };
    this.draw();
  }

  /** Store the electrode that moved. */
  drop() {
    const { carried } = this;
    this.carried = null;
    if (carried?.electrode.catheter) this.#set(carried.frame, carried.electrode.catheter, carried.electrode.electrode, carried.electrode.u_px, carried.electrode.v_px);
  }

  forgetMove() {
    this.carried = null;
    this.draw();
  }

  /** Set the next electrode of the pen's catheter at a place of the frame. @param {number} u @param {number} v */
  place(u, v) {
    const { catheter, count, next, tool } = this.pen;
    if (tool === "mark") {
      this.#set(this.frame, catheter, next, u, v, next === 1);
      return this.pen.advance();
    }
    const present = this.marks.of(this.frame).filter((each) => each.catheter === catheter).map((each) => each.electrode);
    const [number, further] = Array.from({ length: count }, (_, k) => k + 1).filter((each) => !present.includes(each));
    if (number === undefined) return announce(`The catheter "${catheter}" has all its ${count} electrodes in this frame. Move one of them, or choose another catheter.`, "problem");
    this.#set(this.frame, catheter, number, u, v);
    return this.pen.take({ tool: further === undefined ? "edit" : "add" });
  }

  /** @param {number} frame @param {string} catheter @param {number} electrode @param {number} u @param {number} v @param {boolean} [anew] Whether the catheter's other electrodes go. */
  #set(frame, catheter, electrode, u, v, anew = false) {
    const kept = this.marks.of(frame).filter((each) => !anew && each.catheter === catheter && each.electrode !== electrode);
    const place = this.#inside({ u, v });
    return this.#change(frame, catheter, [...kept, { catheter, electrode, u_px: place.u, v_px: place.v, sd_px: 1, source: "manual" }]);
  }

  /** @param {{u: number, v: number}} place */
  #inside({ u, v }) {
    return { u: Math.min(this.run.columns - 0.5, Math.max(-0.5, u)), v: Math.min(this.run.rows - 0.5, Math.max(-0.5, v)) };
  }

  /** @param {number} frame @param {string} catheter @param {Electrode[]} electrodes */
  #change(frame, catheter, electrodes) {
    return this.#store(() => this.marks.change(frame, catheter, electrodes));
  }

  /** Take the electrodes of the pen's catheter in this frame as right: the next computation tracks the run from here. @returns {Promise<boolean>} Whether there are any, and the service has them. */
  async confirm() {
    const { frame, pen: { catheter } } = this;
    const shown = () => this.marks.of(frame).filter((each) => each.catheter === catheter);
    if (!shown().length) {
      announce(`Frame ${frame} of view ${this.letter} shows no electrode of the catheter "${catheter}". Mark it from its tip on first.`, "problem");
      return false;
    }
    if (shown().some((each) => each.source !== "manual")) await this.#change(frame, catheter, shown());
    await this.state.stored;
    // A refused change is taken back.
    return shown().every((each) => each.source === "manual");
  }

  /** @param {Electrode} electrode */
  remove(electrode) {
    const { catheter } = electrode;
    if (catheter === null) return undefined;
    const kept = this.marks.of(this.frame).filter((each) => each.catheter === catheter && each.electrode !== electrode.electrode);
    this.choose(null);
    return this.#change(this.frame, catheter, kept);
  }

  removeChosen() {
    const chosen = this.chosenElectrode;
    if (chosen) return this.remove(chosen);
    return announce("No electrode is chosen. Click one, or press N in the picture.", "problem");
  }

  resetFrame() {
    return this.#store(() => this.marks.reset(this.frame));
  }

  /** @param {1|-1} way */
  async step(way) {
    const frame = await this.#store(() => (way < 0 ? this.marks.undo() : this.marks.redo()));
    if (typeof frame === "number") this.show(frame);
    else if (frame === null) this.status.textContent = way < 0 ? "nothing to undo" : "nothing to redo";
  }

  /** @template T @param {() => Promise<T>} act */
  #store(act) {
    this.status.textContent = "storing";
    return attempt(act);
  }
}
