/** Paints one frame with its contrast, its electrodes and an epipolar line. */
import { catheterColour } from "../shared/catheter-colours.js";

/** @typedef {{catheter: string|null, electrode: number, u_px: number, v_px: number, source?: string}} Mark */

/** Arms of the cross, from the middle on: the pixel in the middle stays visible. */
const CROSS_GAP = 4;
const CROSS_REACH = 16;

export class FramePainter {
  /** @param {import("../shared/types.js").Run} run */
  constructor(run) {
    this.run = run;
    this.picture = new OffscreenCanvas(run.columns, run.rows);
    this.context = /** @type {OffscreenCanvasRenderingContext2D} */ (this.picture.getContext("2d", { willReadFrequently: true }));
    this.image = this.context.createImageData(run.columns, run.rows);
    this.words = new Uint32Array(this.image.data.buffer);
    this.greys = new Uint32Array(256);
    /** Frame in the picture; 0: none, or one of another contrast. */
    this.frame = 0;
    this.setContrast(128, 256);
  }

  /** @param {number} centre @param {number} width Both in displayed grey levels, 0 to 255. */
  setContrast(centre, width) {
    this.centre = centre;
    this.width = width;
    for (let level = 0; level < 256; level += 1) {
      const grey = Math.max(0, Math.min(255, Math.round(((level - centre) / width + 0.5) * 255)));
      this.greys[level] = 0xff000000 | (grey << 16) | (grey << 8) | grey;
    }
    this.frame = 0;
  }

  /** Take the pixels of a frame (from 1). @param {number} frame @param {Uint8Array} pixels @returns {boolean} False: the picture has them already. */
  setPixels(frame, pixels) {
    if (frame === this.frame) return false;
    this.frame = frame;
    for (let k = 0; k < pixels.length; k += 1) this.words[k] = this.greys[/** @type {number} */ (pixels[k])] ?? 0;
    this.context.putImageData(this.image, 0, 0);
    return true;
  }

  /** @param {HTMLCanvasElement} canvas @param {import("./placement.js").Placement} placement */
  paintFrame(canvas, placement) {
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d", { willReadFrequently: true }));
    context.fillStyle = "#000";
    context.fillRect(0, 0, canvas.width, canvas.height);
    const scale = placement.scale(canvas, this.run);
    const origin = placement.origin(canvas, this.run);
    context.imageSmoothingEnabled = scale < 4;
    context.drawImage(this.picture, origin.x, origin.y, scale * this.run.columns, scale * this.run.rows);
  }

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {import("./placement.js").Placement} placement
   * @param {import("../shared/types.js").Study} study
   * @param {Mark[]} electrodes
   * @param {string|null} chosen Key of an electrode.
   */
  paintElectrodes(canvas, placement, study, electrodes, chosen) {
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    const names = study.catheters.map((each) => each.name);
    for (const electrode of electrodes) {
      const { x, y } = placement.toCanvas(canvas, this.run, electrode.u_px, electrode.v_px);
      const next = electrodes.find((each) => each.catheter === electrode.catheter && each.electrode === electrode.electrode + 1);
      // The name is on the side where the catheter is not.
      const isLeft = next !== undefined && next.u_px > electrode.u_px;
      this.#electrode(context, x, y, electrode, catheterColour(names, electrode.catheter), keyOf(electrode) === chosen, isLeft, window.devicePixelRatio || 1);
    }
  }

  /** @param {CanvasRenderingContext2D} context @param {number} x @param {number} y @param {Mark} electrode @param {string} colour @param {boolean} chosen @param {boolean} isLeft @param {number} unit */
  #electrode(context, x, y, electrode, colour, chosen, isLeft, unit) {
    const radius = (electrode.electrode === 1 ? 6.5 : 5) * unit;
    const outline = new Path2D();
    // Set by hand: a square. Detected: a circle. So they differ without colour too.
    if (electrode.source === "manual") outline.rect(x - radius, y - radius, 2 * radius, 2 * radius);
    else outline.arc(x, y, radius, 0, 2 * Math.PI);
    context.lineWidth = 4 * unit;
    context.strokeStyle = "rgba(0,0,0,.75)";
    context.stroke(outline);
    context.lineWidth = (chosen ? 3 : 1.6) * unit;
    context.strokeStyle = chosen ? "#fff" : colour;
    context.stroke(outline);
    if (electrode.electrode === 1 || chosen) {
      context.font = `600 ${12 * unit}px system-ui`;
      const text = chosen ? `${electrode.catheter ?? "unnamed"} ${electrode.electrode}` : (electrode.catheter ?? "?");
      const beside = isLeft ? x - radius - 3 * unit : x + radius + 3 * unit;
      context.textAlign = isLeft ? "right" : "left";
      context.lineWidth = 3 * unit;
      context.strokeStyle = "rgba(0,0,0,.8)";
      context.strokeText(text, beside, y - radius);
      context.fillStyle = colour;
      context.fillText(text, beside, y - radius);
    }
    context.fillStyle = colour;
    context.fillRect(x - unit, y - unit, 2 * unit, 2 * unit);
  }

  /** Paint the place for the next electrode. @param {HTMLCanvasElement} canvas @param {any} placement @param {{u: number, v: number}} cross */
  paintCross(canvas, placement, cross) {
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    const unit = window.devicePixelRatio || 1;
    const { x, y } = placement.toCanvas(canvas, this.run, cross.u, cross.v);
    for (const [colour, width] of /** @type {[string, number][]} */ ([["#000", 4], ["#fff", 1.6]])) {
      context.strokeStyle = colour;
      context.lineWidth = width * unit;
      context.beginPath();
      for (const [dx, dy] of /** @type {[number, number][]} */ ([[1, 0], [-1, 0], [0, 1], [0, -1]])) {
        context.moveTo(x + CROSS_GAP * dx * unit, y + CROSS_GAP * dy * unit);
        context.lineTo(x + CROSS_REACH * dx * unit, y + CROSS_REACH * dy * unit);
      }
      context.stroke();
    }
  }

  /** Paint the line in this view on which an electrode of the other view lies. @param {HTMLCanvasElement} canvas @param {any} placement @param {{start: number[], end: number[], colour: string}} line */
  paintLine(canvas, placement, line) {
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    const unit = window.devicePixelRatio || 1;
    const start = placement.toCanvas(canvas, this.run, line.start[0], line.start[1]);
    const end = placement.toCanvas(canvas, this.run, line.end[0], line.end[1]);
    for (const [colour, width] of /** @type {[string, number][]} */ ([["rgba(0,0,0,.7)", 4], [line.colour, 1.5]])) {
      context.strokeStyle = colour;
      context.lineWidth = width * unit;
      context.beginPath();
      context.moveTo(start.x, start.y);
      context.lineTo(end.x, end.y);
      context.stroke();
    }
  }
}

/** @param {Mark} electrode */
export const keyOf = (electrode) => `${electrode.catheter ?? ""}/${electrode.electrode}`;
