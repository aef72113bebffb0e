/** The catheters of one site in the map: a tube through the electrodes, a ball for each electrode, and the name. */
import { catheterColour } from "../shared/catheter-colours.js";
import * as THREE from "../three/three.module.min.js";

/** @typedef {import("../shared/types.js").Point} Point */

const TUBE_MM = 0.7;
const ELECTRODE_MM = 1.15;
const TIP_MM = 1.5;
/** Opacity of parts that lie behind the wall. */
const BEHIND = 0.35;

export class Catheters {
  /** @param {Point[]} points Electrodes of all sites. @param {string[]} names Catheters of the study in its order. */
  constructor(points, names) {
    this.points = points;
    this.names = names;
    this.group = new THREE.Group();
    /** @type {{name: string, at: THREE.Vector3}[]} Where each catheter's name belongs. */
    this.labels = [];
  }

  /** Show the catheters of a site; null shows none. @param {string|null} site */
  show(site) {
    this.close();
    if (site === null) return;
    for (const name of this.names) {
      const own = this.points.filter((each) => each.site === site && each.catheter === name && each.x_mm !== null).sort((a, b) => a.electrode - b.electrode);
      const places = own.map((each) => new THREE.Vector3(each.x_mm ?? 0, each.y_mm ?? 0, each.z_mm ?? 0));
      const last = places.at(-1);
      if (!last) continue;
      /** @type {THREE.BufferGeometry[]} */
      const parts = own.map((each, k) => {
        const place = places[k] ?? last;
        return new THREE.SphereGeometry(each.electrode === 1 ? TIP_MM : ELECTRODE_MM, 16, 12).translate(place.x, place.y, place.z);
      });
      if (places.length > 1) parts.push(new THREE.TubeGeometry(new THREE.CatmullRomCurve3(places), 8 * places.length, TUBE_MM, 10));
      this.#draw(parts, catheterColour(this.names, name));
      this.labels.push({ name, at: last });
    }
  }

  /** @param {THREE.BufferGeometry[]} parts @param {string} colour */
  #draw(parts, colour) {
    const light = { color: new THREE.Color(colour) };
    const inFront = new THREE.MeshLambertMaterial(light);
    const behind = new THREE.MeshBasicMaterial({ ...light, transparent: true, opacity: BEHIND, depthFunc: THREE.GreaterDepth, depthWrite: false });
    for (const part of parts) this.group.add(new THREE.Mesh(part, behind), new THREE.Mesh(part, inFront));
  }

  /** Give the memory of the shapes back. */
  close() {
    for (const child of this.group.children) {
      const mesh = /** @type {THREE.Mesh} */ (child);
      mesh.geometry.dispose();
      /** @type {THREE.Material} */ (mesh.material).dispose();
    }
    this.group.clear();
    this.labels = [];
  }
}
