/** One run in a canvas: it plays, zooms and moves. Each kind of view paints its own things over the frame. */
import { element } from "../shared/elements.js";
import { Cine } from "./cine.js";
import { FramePainter } from "./frame-painter.js";
import { Placement } from "./placement.js";
import { FRAME_MS, Playback } from "./playback.js";

/** Nobody reads a number that changes with each frame, and a browser lays the page out again for each change. */
const COUNT_MS = 200;
const ZOOM = 1.25;

/** A subclass gives `paintOver` and `switchPlay`. The element of the page is filled by the subclass. */
export class FrameView extends EventTarget {
  /**
   * @param {import("../study/page.js").StudyState} state
   * @param {import("../shared/types.js").Run} run
   * @param {{canvas: Record<string, any>, slider: string, frame: number}} look Properties of the canvas, name of the slider, first frame.
   */
  constructor(state, run, { canvas, slider, frame }) {
    super();
    this.state = state;
    this.run = run;
    this.frame = frame;
    this.shownFrames = 0;
    this.countedMs = 0;
    this.painter = new FramePainter(run);
    this.placement = new Placement();
    this.cine = new Cine(state.path, run, () => this.draw());
    this.playback = new Playback(run.frame_time_ms ?? FRAME_MS, (frames) => this.show(this.frame + frames));
    this.canvas = element("canvas", { tabIndex: 0, ...canvas });
    this.slider = element("input", { type: "range", min: 1, max: run.frames, value: frame, "aria-label": slider, oninput: () => this.show(Number(this.slider.value)) });
    this.count = element("span", { class: "count" });
    this.element = element("div", { class: "view" });
    this.canvas.addEventListener("wheel", (/** @type {WheelEvent} */ event) => {
      event.preventDefault();
      const { x, y } = this.at(event);
      this.placement.zoomAt(this.canvas, Math.exp(-event.deltaY / 400), x, y);
      this.draw();
    }, { passive: false });
    new ResizeObserver(() => this.#fit()).observe(this.canvas);
  }

  /** Paint what this kind of view shows over the frame. @abstract */
  paintOver() {}

  /** Play, or pause. @abstract */
  switchPlay() {}

  close() {
    this.playback.play(false);
    this.cine.close();
  }

  #fit() {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [Math.round(this.canvas.clientWidth * ratio), Math.round(this.canvas.clientHeight * ratio)];
    if (width === this.canvas.width && height === this.canvas.height) return;
    this.canvas.width = width;
    this.canvas.height = height;
    this.draw();
  }

  /** @param {number} frame From 1; past the end it begins again. */
  show(frame) {
    this.frame = ((frame - 1 + this.run.frames) % this.run.frames) + 1;
    this.showCount();
    this.draw();
  }

  /** Words beside the slider. */
  get countText() {
    return `${this.frame} / ${this.run.frames}`;
  }

  showCount() {
    const now = performance.now();
    if (this.playback.playing && now - this.countedMs < COUNT_MS) return;
    this.countedMs = now;
    this.slider.value = String(this.frame);
    this.count.textContent = this.countText;
  }

  draw() {
    // A hidden tab has no size.
    if (!this.canvas.width || !this.canvas.clientWidth) return;
    const pixels = this.cine.pixels(this.frame);
    if (pixels && this.painter.setPixels(this.frame, pixels)) {
      this.shownFrames += 1;
      this.element.dataset.frames = String(this.shownFrames);
    }
    this.painter.paintFrame(this.canvas, this.placement);
    this.paintOver();
  }

  /** Place of the pointer on the canvas. @param {MouseEvent} event */
  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return { x: ((event.clientX - box.left) * this.canvas.width) / box.width, y: ((event.clientY - box.top) * this.canvas.height) / box.height };
  }

  /** Move the picture. @param {number} x @param {number} y Both in pixels of the canvas. */
  pan(x, y) {
    this.placement.shift.x += x;
    this.placement.shift.y += y;
    this.draw();
  }

  /** Zoom about the middle. @param {number} factor */
  #zoom(factor) {
    this.placement.zoomAt(this.canvas, factor, this.canvas.width / 2, this.canvas.height / 2);
    this.draw();
  }

  /** Do what a key asks for in each view. @param {string} key @returns {boolean} False: the key means nothing here. */
  press(key) {
    /** @type {Record<string, () => void>} */
    const acts = {
      ArrowRight: () => this.show(this.frame + 1), ArrowLeft: () => this.show(this.frame - 1), Home: () => this.show(1), End: () => this.show(this.run.frames),
      "+": () => this.#zoom(ZOOM), "-": () => this.#zoom(1 / ZOOM), " ": () => this.switchPlay(),
      0: () => { this.placement.reset(); this.painter.setContrast(128, 256); this.draw(); },
    };
    acts[key]?.();
    return key in acts;
  }
}
