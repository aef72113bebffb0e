/** Paints the wall of the map over a fluoroscopy frame: the same colours as the 3D view, and the outline. One graphics context serves all views. */
import { rendererOf, Surface } from "../map/surface.js";
import * as THREE from "../three/three.module.min.js";
import { Outline } from "./outline.js";

/** Space in front of the map and behind it within the depth range, mm. */
const MARGIN_MM = 10;
const OUTLINE = "rgba(140, 225, 255, .9)";

/** @typedef {{left: number, top: number, width: number, height: number}} Part A part of the canvas, in its pixels. */

export class WallPainter {
  /** @param {import("../map/look.js").MapLook} look */
  constructor(look) {
    this.look = look;
    this.canvas = document.createElement("canvas");
    this.canvas.width = this.canvas.height = 1;
    this.renderer = rendererOrNone(this.canvas);
    this.renderer?.setPixelRatio(1);
    this.surface = new Surface(look, true);
    this.surface.mesh.frustumCulled = false;
    this.world = new THREE.Scene();
    this.world.add(this.surface.mesh);
    this.camera = new THREE.Camera();
    this.camera.matrixAutoUpdate = false;
    this.outline = new Outline(look.map);
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
    const scale = placement.scale(context.canvas, run);
    const origin = placement.origin(context.canvas, run);
    const part = this.#partOf(context.canvas, projection, shift, origin, scale);
    if (part.width <= 0 || part.height <= 0) return;
    if (this.renderer) {
      this.#render(this.renderer, part, projection, shift, origin, scale);
      context.drawImage(this.canvas, 0, this.canvas.height - part.height, part.width, part.height, part.left, part.top, part.width, part.height);
    }
    context.beginPath();
    this.outline.trace(context, projection, shift, origin, scale);
    context.strokeStyle = OUTLINE;
    context.lineWidth = 1.5 * (window.devicePixelRatio || 1);
    context.stroke();
  }

  /**
   * Return the part of a canvas that holds the wall. Without a graphics card each pixel costs, so only this part is drawn.
   *
   * @param {HTMLCanvasElement} canvas @param {import("./projection.js").Projection} projection @param {number[]} shift
   * @param {{x: number, y: number}} origin @param {number} scale
   * @returns {Part}
   */
  #partOf(canvas, projection, shift, origin, scale) {
    const { min, max } = /** @type {THREE.Box3} */ (this.surface.mesh.geometry.boundingBox);
    const corners = [min.x, max.x].flatMap((x) => [min.y, max.y].flatMap((y) => [min.z, max.z].map((z) => [x, y, z])));
    const places = corners.map((corner) => projection.pixel(corner.map((each, k) => each + (shift[k] ?? 0))));
    const [x, y] = [places.map(({ u }) => origin.x + (u + 0.5) * scale), places.map(({ v }) => origin.y + (v + 0.5) * scale)];
    const [left, top] = [Math.max(0, Math.floor(Math.min(...x))), Math.max(0, Math.floor(Math.min(...y)))];
    return { left, top, width: Math.min(canvas.width, Math.ceil(Math.max(...x))) - left, height: Math.min(canvas.height, Math.ceil(Math.max(...y))) - top };
  }

  /** Draw the wall in a part of a view, at the bottom left of the own canvas. @param {THREE.WebGLRenderer} renderer @param {Part} part @param {import("./projection.js").Projection} projection @param {number[]} shift @param {{x: number, y: number}} origin @param {number} scale */
  #render(renderer, part, projection, shift, origin, scale) {
    const [x = 0, y = 0, z = 0] = shift;
    // The canvas grows only: another size would cost new memory of the graphics card in each frame.
    const [width, height] = [Math.max(part.width, this.canvas.width), Math.max(part.height, this.canvas.height)];
    if (this.canvas.width !== width || this.canvas.height !== height) renderer.setSize(width, height, false);
    renderer.setViewport(0, 0, part.width, part.height);
    this.surface.mesh.position.set(x, y, z);
    this.#aim(part, projection, shift, { x: origin.x - part.left, y: origin.y - part.top }, scale);
    renderer.render(this.world, this.camera);
  }

  /** Aim the camera so that it maps the world to a part of a view. @param {Part} part @param {import("./projection.js").Projection} projection @param {number[]} shift @param {{x: number, y: number}} origin @param {number} scale */
  #aim(part, projection, shift, origin, scale) {
    const [p = [], q = [], r = []] = projection.rows;
    const { center, radius } = this.surface.sphere;
    const middle = projection.pixel([center.x + (shift[0] ?? 0), center.y + (shift[1] ?? 0), center.z + (shift[2] ?? 0)]).depth;
    const [low, high] = [Math.max(1, middle - radius - MARGIN_MM), middle + radius + MARGIN_MM];
    // The viewer is at the detector: the wall that is farther from the source hides the other one.
    const a = (2 * low * high) / (high - low);
    const b = 1 - (2 * high) / (high - low);
    const at = (/** @type {number[]} */ row, /** @type {number} */ k) => row[k] ?? 0;
    const across = [0, 1, 2, 3].map((k) => (2 / part.width) * (scale * at(p, k) + (origin.x + scale / 2) * at(r, k)) - at(r, k));
    const up = [0, 1, 2, 3].map((k) => at(r, k) - (2 / part.height) * (scale * at(q, k) + (origin.y + scale / 2) * at(r, k)));
    const depth = [0, 1, 2, 3].map((k) => b * at(r, k) + (k === 3 ? a : 0));
    this.camera.projectionMatrix.set(at(across, 0), at(across, 1), at(across, 2), at(across, 3), at(up, 0), at(up, 1), at(up, 2), at(up, 3),
      at(depth, 0), at(depth, 1), at(depth, 2), at(depth, 3), at(r, 0), at(r, 1), at(r, 2), at(r, 3));
    this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
    // Only the faces away from the source are seen, and those hide all others. Their order of corners depends on the handedness of the camera.
    const [[ax = 0, ay = 0, az = 0], [ux = 0, uy = 0, uz = 0], [rx = 0, ry = 0, rz = 0]] = [across, up, r];
    const handedness = ax * (uy * rz - uz * ry) - ay * (ux * rz - uz * rx) + az * (ux * ry - uy * rx);
    this.surface.show(handedness < 0 ? THREE.BackSide : THREE.FrontSide);
  }

  close() {
    this.surface.close();
    this.renderer?.dispose();
    this.renderer?.forceContextLoss();
  }
}

/** Return null where the browser cannot draw in 3D: then a view shows the outline and the sites. @param {HTMLCanvasElement} canvas */
function rendererOrNone(canvas) {
  try {
    return rendererOf(canvas, false);
  } catch {
    return null;
  }
}
