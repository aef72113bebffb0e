/** Turning the map about its centre, by pointer, wheel and keys; up is the patient's head. */
import * as THREE from "../three/three.module.min.js";

/** Directions from the chamber to the eye, LPS: +X left, +Y back, +Z head. @type {[string, string, number, number][]} Name, title, angle to the patient's left, elevation, degrees. */
export const VIEWS = [["AP", "from the front", 0, 0], ["PA", "from the back", 180, 0], ["LAO", "left anterior oblique 45°", 45, 0], ["RAO", "right anterior oblique 30°", -30, 0], ["LL", "from the left", 90, 0], ["HEAD", "from the head", 0, 89]];

export class Orbit {
  /** @param {HTMLCanvasElement} canvas @param {THREE.Vector3} centre @param {number} radius @param {() => void} onChange */
  constructor(canvas, centre, radius, onChange) {
    this.camera = new THREE.PerspectiveCamera(30, 1, radius / 10, 20 * radius);
    this.camera.up.set(0, 0, 1);
    this.centre = centre;
    this.radius = radius;
    this.onChange = onChange;
    this.azimuth = 0;
    this.elevation = 0;
    this.distance = 4.6 * radius;
    /** @type {{x: number, y: number}|null} */
    let drag = null;
    canvas.addEventListener("pointerdown", (event) => { drag = { x: event.clientX, y: event.clientY }; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointermove", (event) => {
      if (!drag) return;
      this.turn(-(event.clientX - drag.x) * 0.5, (event.clientY - drag.y) * 0.5);
      drag = { x: event.clientX, y: event.clientY };
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => (drag = null));
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(Math.exp(event.deltaY / 500)); }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      /** @type {Record<string, () => void>} */
      const acts = { ArrowLeft: () => this.turn(-10, 0), ArrowRight: () => this.turn(10, 0), ArrowUp: () => this.turn(0, 10), ArrowDown: () => this.turn(0, -10), "+": () => this.zoom(0.85), "-": () => this.zoom(1.18) };
      const act = acts[event.key];
      if (act) { act(); event.preventDefault(); }
    });
    this.place();
  }

  /** @param {number} degrees @param {number} up */
  turn(degrees, up) {
    this.azimuth += degrees;
    this.elevation = Math.min(89, Math.max(-89, this.elevation + up));
    this.place();
  }

  /** @param {number} factor */
  zoom(factor) {
    this.distance = Math.min(12 * this.radius, Math.max(1.4 * this.radius, this.distance * factor));
    this.place();
  }

  /** @param {number} azimuth @param {number} elevation */
  look(azimuth, elevation) {
    [this.azimuth, this.elevation] = [azimuth, elevation];
    this.place();
  }

  place() {
    const [a, e] = [(this.azimuth * Math.PI) / 180, (this.elevation * Math.PI) / 180];
    const eye = new THREE.Vector3(Math.sin(a) * Math.cos(e), -Math.cos(a) * Math.cos(e), Math.sin(e));
    this.camera.position.copy(this.centre).addScaledVector(eye, this.distance);
    this.camera.lookAt(this.centre);
    this.camera.updateMatrixWorld();
    this.onChange();
  }

  /** @param {number} width @param {number} height */
  fit(width, height) {
    this.camera.aspect = width / height;
    // A narrow picture shows the whole chamber too, with space for the labels beside it.
    const narrow = Math.max(1, 1.25 / this.camera.aspect);
    this.camera.fov = (2 * Math.atan(Math.tan(Math.PI / 12) * narrow) * 180) / Math.PI;
    this.camera.updateProjectionMatrix();
  }
}
