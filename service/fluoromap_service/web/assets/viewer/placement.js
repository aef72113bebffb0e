/** Where a frame lies in its canvas: zoom and pan. Pixel (0, 0) of a frame is the centre of its top-left pixel. */
export class Placement {
  constructor() {
    this.zoom = 1;
    this.shift = { x: 0, y: 0 };
  }

  /** Canvas pixels for each frame pixel. @param {HTMLCanvasElement} canvas @param {{rows: number, columns: number}} run */
  scale(canvas, run) {
    return this.zoom * Math.min(canvas.width / run.columns, canvas.height / run.rows);
  }

  /** @param {HTMLCanvasElement} canvas @param {{rows: number, columns: number}} run */
  origin(canvas, run) {
    const scale = this.scale(canvas, run);
    return { x: canvas.width / 2 + this.shift.x - (scale * run.columns) / 2, y: canvas.height / 2 + this.shift.y - (scale * run.rows) / 2 };
  }

  /** @param {HTMLCanvasElement} canvas @param {any} run @param {number} u @param {number} v */
  toCanvas(canvas, run, u, v) {
    const scale = this.scale(canvas, run);
    const origin = this.origin(canvas, run);
    return { x: origin.x + (u + 0.5) * scale, y: origin.y + (v + 0.5) * scale };
  }

  /** @param {HTMLCanvasElement} canvas @param {any} run @param {number} x @param {number} y */
  toFrame(canvas, run, x, y) {
    const scale = this.scale(canvas, run);
    const origin = this.origin(canvas, run);
    return { u: (x - origin.x) / scale - 0.5, v: (y - origin.y) / scale - 0.5 };
  }

  /** Zoom about a point of the canvas. @param {HTMLCanvasElement} canvas @param {number} factor @param {number} x @param {number} y */
  zoomAt(canvas, factor, x, y) {
    const before = this.zoom;
    this.zoom = Math.min(16, Math.max(1, this.zoom * factor));
    const change = this.zoom / before;
    this.shift.x = (this.shift.x - (x - canvas.width / 2)) * change + (x - canvas.width / 2);
    this.shift.y = (this.shift.y - (y - canvas.height / 2)) * change + (y - canvas.height / 2);
    if (this.zoom === 1) this.shift = { x: 0, y: 0 };
  }

  reset() {
    this.zoom = 1;
    this.shift = { x: 0, y: 0 };
  }
}
