/** Paints the wall of the map over a fluoroscopy frame: the same colours as the 3D view, and the outline. One graphics context serves all views. */
import { rendererOf, Surface } from "../map/surface.js";
import * as THREE from "../three/three.module.min.js";

/** Space in front of the map and behind it within the depth range, mm. */
const MARGIN_MM = 10;
const OUTLINE = "rgba(140, 225, 255, .9)";

export class WallPainter {
  /** @param {import("../map/look.js").MapLook} look */
  constructor(look) {
    this.look = look;
    this.canvas = document.createElement("canvas");
    this.renderer = rendererOf(this.canvas, false);
    this.renderer.setPixelRatio(1);
    this.surface = new Surface(look, true);
    this.surface.mesh.frustumCulled = false;
    this.world = new THREE.Scene();
    this.world.add(this.surface.mesh);
    this.camera = new THREE.Camera();
    this.camera.matrixAutoUpdate = false;
    this.edges = edgesOf(look.map);
    this.normals = look.map.faces.map((face) => faceOf(look.map, face));
  }

  /** Take the colours and the time of the look. */
  update() {
    this.surface.update();
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {import("../viewer/placement.js").Placement} placement
   * @param {{rows: number, columns: number}} run
   * @param {import("./projection.js").Projection} projection
   * @param {number[]} shift World minus map, mm.
   */
  paint(context, placement, run, projection, shift) {
    const { width, height } = context.canvas;
    if (!width || !height) return;
    if (this.canvas.width !== width || this.canvas.height !== height) this.renderer.setSize(width, height, false);
    const [x = 0, y = 0, z = 0] = shift;
    this.surface.mesh.position.set(x, y, z);
    this.#aim(context.canvas, placement, run, projection, shift);
    this.renderer.render(this.world, this.camera);
    context.drawImage(this.canvas, 0, 0);
    this.#outline(context, placement, run, projection, shift);
  }

  /** Aim the camera so that it maps the world to this canvas. @param {HTMLCanvasElement} canvas @param {import("../viewer/placement.js").Placement} placement @param {any} run @param {import("./projection.js").Projection} projection @param {number[]} shift */
  #aim(canvas, placement, run, projection, shift) {
    const [p = [], q = [], r = []] = projection.rows;
    const scale = placement.scale(canvas, run);
    const origin = placement.origin(canvas, run);
    const { center, radius } = this.surface.sphere;
    const middle = projection.pixel([center.x + (shift[0] ?? 0), center.y + (shift[1] ?? 0), center.z + (shift[2] ?? 0)]).depth;
    const [low, high] = [Math.max(1, middle - radius - MARGIN_MM), middle + radius + MARGIN_MM];
    // The viewer is at the detector: the wall that is farther from the source hides the other one.
    const a = (2 * low * high) / (high - low);
    const b = 1 - (2 * high) / (high - low);
    const at = (/** @type {number[]} */ row, /** @type {number} */ k) => row[k] ?? 0;
    const across = [0, 1, 2, 3].map((k) => (2 / canvas.width) * (scale * at(p, k) + (origin.x + scale / 2) * at(r, k)) - at(r, k));
    const up = [0, 1, 2, 3].map((k) => at(r, k) - (2 / canvas.height) * (scale * at(q, k) + (origin.y + scale / 2) * at(r, k)));
    const depth = [0, 1, 2, 3].map((k) => b * at(r, k) + (k === 3 ? a : 0));
    this.camera.projectionMatrix.set(at(across, 0), at(across, 1), at(across, 2), at(across, 3), at(up, 0), at(up, 1), at(up, 2), at(up, 3),
      at(depth, 0), at(depth, 1), at(depth, 2), at(depth, 3), at(r, 0), at(r, 1), at(r, 2), at(r, 3));
    this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
  }

  /** Draw the edges between faces towards the detector and faces away from it. @param {CanvasRenderingContext2D} context @param {import("../viewer/placement.js").Placement} placement @param {any} run @param {import("./projection.js").Projection} projection @param {number[]} shift */
  #outline(context, placement, run, projection, shift) {
    const [x = 0, y = 0, z = 0] = shift;
    const from = [(projection.source[0] ?? 0) - x, (projection.source[1] ?? 0) - y, (projection.source[2] ?? 0) - z];
    const faces = this.normals.map(({ normal, middle }) => normal.reduce((sum, each, k) => sum + each * ((middle[k] ?? 0) - (from[k] ?? 0)), 0) > 0);
    context.beginPath();
    for (const { start, end, left, right } of this.edges) {
      if (faces[left] === faces[right]) continue;
      for (const [k, vertex] of [start, end].entries()) {
        const [px = 0, py = 0, pz = 0] = this.look.map.vertices_mm[vertex] ?? [];
        const { u, v } = projection.pixel([px + x, py + y, pz + z]);
        const at = placement.toCanvas(context.canvas, run, u, v);
        if (k === 0) context.moveTo(at.x, at.y);
        else context.lineTo(at.x, at.y);
      }
    }
    context.strokeStyle = OUTLINE;
    context.lineWidth = 1.5 * (window.devicePixelRatio || 1);
    context.stroke();
  }

  close() {
    this.surface.close();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }
}

/** Edges with the two faces that share them. @param {import("../shared/types.js").ChamberMap} map */
function edgesOf(map) {
  /** @type {Map<string, {start: number, end: number, left: number, right: number}>} */
  const edges = new Map();
  map.faces.forEach(([a = 0, b = 0, c = 0], face) => {
    for (const [start, end] of /** @type {[number, number][]} */ ([[a, b], [b, c], [c, a]])) {
      const key = start < end ? `${start}/${end}` : `${end}/${start}`;
      const known = edges.get(key);
      if (known) known.right = face;
      else edges.set(key, { start, end, left: face, right: face });
    }
  });
  return [...edges.values()];
}

/** Outward normal (any length) and middle of a face. @param {import("../shared/types.js").ChamberMap} map @param {number[]} face */
function faceOf(map, face) {
  const [a = [], b = [], c = []] = face.map((k) => map.vertices_mm[k] ?? []);
  const way = (/** @type {number[]} */ from, /** @type {number[]} */ to) => [0, 1, 2].map((k) => (to[k] ?? 0) - (from[k] ?? 0));
  const [[x = 0, y = 0, z = 0], [u = 0, v = 0, w = 0]] = [way(a, b), way(a, c)];
  return { normal: [y * w - z * v, z * u - x * w, x * v - y * u], middle: [0, 1, 2].map((k) => ((a[k] ?? 0) + (b[k] ?? 0) + (c[k] ?? 0)) / 3) };
}
