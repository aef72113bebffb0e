/** The camera of a run: from points of the map to pixels of a frame. */

/** @typedef {{u: number, v: number, depth: number}} Pixel */

/** The ends of the patient's axes (LPS), positive first. */
const ENDS = [["L", "R"], ["P", "A"], ["H", "F"]];
/** Smallest component of a unit vector that gets a letter. */
const LEAST_SHARE = 0.35;

export class Projection {
  /** @param {number[][]} matrix P with w (u, v, 1) = P (x, y, z, 1), world in mm. */
  constructor(matrix) {
    this.rows = matrix;
    const [x, y, z] = this.#solve();
    /** The X-ray source, mm. @type {number[]} */
    this.source = [x ?? 0, y ?? 0, z ?? 0];
  }

  /** @param {number[]} point World, mm. @returns {Pixel} */
  pixel([x = 0, y = 0, z = 0]) {
    const [a = 0, b = 0, depth = 1] = this.rows.map(([p = 0, q = 0, r = 0, s = 0]) => p * x + q * y + r * z + s);
    return { u: a / depth, v: b / depth, depth };
  }

  /** Letters of the patient at the left, the right and the top edge of the picture. A hyphen separates them: R-A is no right atrium. */
  get edges() {
    const [right, down] = [this.#direction(0), this.#direction(1)];
    return { left: letters(right.map((each) => -each)), right: letters(right), top: letters(down.map((each) => -each)) };
  }

  /** World direction in which a pixel's column (0) or row (1) grows at the isocentre. @param {0|1} index */
  #direction(index) {
    const centre = this.pixel([0, 0, 0]);
    const of = index === 0 ? centre.u : centre.v;
    return [0, 1, 2].map((k) => (this.rows[index]?.[k] ?? 0) - of * (this.rows[2]?.[k] ?? 0));
  }

  /** The point that all rays share: Cramer's rule for P (x, y, z, 1) = 0. */
  #solve() {
    const column = (/** @type {number} */ k) => this.rows.map((row) => row[k] ?? 0);
    const [a, b, c, d] = [column(0), column(1), column(2), column(3).map((each) => -each)];
    const whole = determinant(a, b, c);
    return [determinant(d, b, c) / whole, determinant(a, d, c) / whole, determinant(a, b, d) / whole];
  }
}

/** @param {number[]} a @param {number[]} b @param {number[]} c */
function determinant([a = 0, d = 0, g = 0], [b = 0, e = 0, h = 0], [c = 0, f = 0, i = 0]) {
  return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
}

/** @param {number[]} direction */
function letters(direction) {
  const length = Math.hypot(...direction);
  return direction
    .map((each, k) => ({ share: each / length, ends: ENDS[k] ?? [] }))
    .filter(({ share }) => Math.abs(share) >= LEAST_SHARE)
    .sort((a, b) => Math.abs(b.share) - Math.abs(a.share))
    .map(({ share, ends }) => ends[share > 0 ? 0 : 1])
    .join("-");
}
