/** The outline of the wall as a view sees it: the edges between faces towards the detector and faces away from it. */

export class Outline {
  /** @param {import("../shared/types.js").ChamberMap} map */
  constructor(map) {
    this.points = Float64Array.from(map.vertices_mm.flat());
    this.edges = edgesOf(map);
    this.planes = planesOf(map);
    this.towards = new Uint8Array(map.faces.length);
    /** Canvas pixels of the vertices of a frame. */
    this.places = new Float64Array(2 * map.vertices_mm.length);
  }

  /**
   * Add the outline to the path of a context.
   *
   * @param {CanvasRenderingContext2D} context
   * @param {import("./projection.js").Projection} projection
   * @param {number[]} shift World minus map, mm.
   * @param {{x: number, y: number}} origin Canvas pixel of the top-left corner of the frame.
   * @param {number} scale Canvas pixels for each frame pixel.
   */
  trace(context, projection, [x = 0, y = 0, z = 0], origin, scale) {
    const { points, planes, towards, places, edges } = this;
    const [sx = 0, sy = 0, sz = 0] = projection.source;
    const [fx, fy, fz] = [sx - x, sy - y, sz - z];
    for (let face = 0, k = 0; face < towards.length; face += 1, k += 4) {
      towards[face] = Number(num(planes, k) * fx + num(planes, k + 1) * fy + num(planes, k + 2) * fz < num(planes, k + 3));
    }
    const [a, b, c, d, e, f, g, h, i, j, l, m] = /** @type {[number, number, number, number, number, number, number, number, number, number, number, number]} */ (projection.rows.flat());
    for (let k = 0, at = 0; k < points.length; k += 3, at += 2) {
      const [px, py, pz] = [num(points, k) + x, num(points, k + 1) + y, num(points, k + 2) + z];
      const depth = i * px + j * py + l * pz + m;
      places[at] = origin.x + ((a * px + b * py + c * pz + d) / depth + 0.5) * scale;
      places[at + 1] = origin.y + ((e * px + f * py + g * pz + h) / depth + 0.5) * scale;
    }
    for (let k = 0; k < edges.length; k += 4) {
      if (towards[num(edges, k + 2)] === towards[num(edges, k + 3)]) continue;
      const [start, end] = [2 * num(edges, k), 2 * num(edges, k + 1)];
      context.moveTo(num(places, start), num(places, start + 1));
      context.lineTo(num(places, end), num(places, end + 1));
    }
  }
}

/** @param {Float64Array|Int32Array} values @param {number} k */
const num = (values, k) => /** @type {number} */ (values[k]);

/** Edges as start, end and the two faces that share them, (edges x 4). @param {import("../shared/types.js").ChamberMap} map */
function edgesOf(map) {
  /** @type {Map<number, [number, number, number, number]>} */
  const edges = new Map();
  const count = map.vertices_mm.length;
  map.faces.forEach(([a = 0, b = 0, c = 0], face) => {
    for (const [start, end] of /** @type {[number, number][]} */ ([[a, b], [b, c], [c, a]])) {
      const key = Math.min(start, end) * count + Math.max(start, end);
      const known = edges.get(key);
      if (known) known[3] = face;
      else edges.set(key, [start, end, face, face]);
    }
  });
  return Int32Array.from([...edges.values()].flat());
}

/** Outward normal n (any length) of each face and n · x of its plane, (faces x 4). @param {import("../shared/types.js").ChamberMap} map */
function planesOf(map) {
  return Float64Array.from(map.faces.flatMap((face) => {
    const [a = [], b = [], c = []] = face.map((k) => map.vertices_mm[k] ?? []);
    const way = (/** @type {number[]} */ to) => [0, 1, 2].map((k) => (to[k] ?? 0) - (a[k] ?? 0));
    const [[x = 0, y = 0, z = 0], [u = 0, v = 0, w = 0]] = [way(b), way(c)];
    const normal = [y * w - z * v, z * u - x * w, x * v - y * u];
    return [...normal, normal.reduce((sum, each, k) => sum + each * (a[k] ?? 0), 0)];
  }));
}
