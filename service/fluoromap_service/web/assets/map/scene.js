/** The map in 3D: wall, sites with name and time, orientation, colour bar. The study page and the report use it. */
import * as THREE from "../three/three.module.min.js";
import { drawColourBar } from "./colour-bar.js";
import { deviationsOf, timesOf } from "./colour-scale.js";
import { Orbit } from "./orbit.js";
import { drawOrientation } from "./orientation.js";
import { surfaceOf } from "./surface.js";

/** @typedef {import("../shared/types.js").ChamberMap} ChamberMap */

/** Reasons that put a site's time, position or catheter in doubt: its name gets a question mark, as in the pictures. */
const DOUBTS = ["extra_catheter", "geometry_doubtful", "identity_uncertain", "pairing_failed", "spacing_mismatch", "table_moved", "view_mirrored", "lat_outlier"];

export class MapScene extends EventTarget {
  /** @param {HTMLElement} place An element of class `scene`. @param {ChamberMap} map */
  constructor(place, map) {
    super();
    this.map = map;
    /** @type {"safe"|"red-early"} */
    this.palette = "safe";
    this.uncertainty = false;
    /** @type {string|null} */
    this.chosen = null;
    const made = (/** @type {string} */ tag, /** @type {string} */ name) => {
      const each = document.createElement(tag);
      each.className = name;
      place.append(each);
      return each;
    };
    this.canvas = /** @type {HTMLCanvasElement} */ (made("canvas", "wall"));
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", "The map in 3D. Arrow keys turn it, plus and minus zoom.");
    this.labels = made("div", "labels");
    this.figure = /** @type {HTMLCanvasElement} */ (made("canvas", "figure"));
    this.bar = /** @type {HTMLCanvasElement} */ (made("canvas", "bar"));
    THREE.ColorManagement.enabled = false;
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.world = new THREE.Scene();
    this.surface = surfaceOf(map);
    this.world.add(this.surface.mesh);
    this.surface.mesh.geometry.computeBoundingSphere();
    const sphere = /** @type {THREE.Sphere} */ (this.surface.mesh.geometry.boundingSphere);
    this.dots = map.sites.map((site) => this.#dot(site, sphere.radius));
    this.names = map.sites.map((site) => this.#name(site));
    this.orbit = new Orbit(this.canvas, sphere.center.clone(), sphere.radius, () => this.draw());
    this.canvas.addEventListener("click", (event) => this.#pick(event));
    this.recolour();
    new ResizeObserver(() => this.fit()).observe(place);
    this.fit();
  }

  /** @param {import("../shared/types.js").MapSite} site @param {number} radius */
  #dot(site, radius) {
    const doubtful = site.reasons.includes("lat_outlier");
    const dot = new THREE.Mesh(new THREE.SphereGeometry(radius / 32, 20, 14), new THREE.MeshBasicMaterial({ color: doubtful ? 0xe69f00 : 0x16181c }));
    dot.position.set(site.x_mm, site.y_mm, site.z_mm);
    const toWall = new THREE.BufferGeometry().setFromPoints([dot.position, new THREE.Vector3(...site.surface_mm)]);
    this.world.add(dot, new THREE.Line(toWall, new THREE.LineBasicMaterial({ color: 0x16181c })));
    return dot;
  }

  /** @param {import("../shared/types.js").MapSite} site */
  #name(site) {
    const name = document.createElement("span");
    name.textContent = `${site.site} ${Math.round(site.lat_ms)} ms${site.reasons.some((code) => DOUBTS.includes(code)) ? " ?" : ""}`.replace("-", "−");
    this.labels.append(name);
    return name;
  }

  /** Give the memory of the graphics card back; a browser has few such contexts. */
  close() {
    this.surface.mesh.geometry.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  /** Choose the colours again. */
  recolour() {
    const scale = this.uncertainty ? deviationsOf(this.map) : timesOf(this.map, this.palette);
    this.surface.show(scale, this.uncertainty ? this.map.lat_sd_ms : this.map.lat_ms);
    drawColourBar(this.bar, scale, this.uncertainty ? "± SD, ms" : "time, ms");
    this.draw();
  }

  /** Colour the wall only where it is activated by a time; null colours all. @param {number|null} ms */
  showUntil(ms) {
    this.surface.setUntil(ms ?? 1e9);
    this.draw();
  }

  /** @param {string|null} site */
  choose(site) {
    this.chosen = site;
    this.draw();
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(window.devicePixelRatio || 1);
    this.renderer.setSize(width, height, false);
    this.orbit.fit(width, height);
    this.draw();
  }

  draw() {
    if (!this.orbit) return;
    const { camera } = this.orbit;
    this.renderer.render(this.world, camera);
    drawOrientation(this.figure, camera);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    /** @type {number[][]} */
    const taken = [];
    const nearFirst = this.map.sites.map((site, k) => ({ site, k, far: this.#isBehind(site) })).sort((a, b) => Number(a.far) - Number(b.far));
    nearFirst.forEach(({ site, k, far }) => {
      const label = this.names[k];
      const dot = this.dots[k];
      if (!label || !dot) return;
      const at = dot.position.clone().project(camera);
      const chosen = site.site === this.chosen;
      label.className = chosen ? "chosen" : far ? "far" : "";
      const x = ((at.x + 1) / 2) * width + 8;
      let y = ((1 - at.y) / 2) * height - 8;
      while (taken.some(([otherX, otherY]) => Math.abs((otherX ?? 0) - x) < 70 && Math.abs((otherY ?? 0) - y) < 13)) y += 13;
      taken.push([x, y]);
      label.style.transform = `translate(${x.toFixed(0)}px, ${y.toFixed(0)}px)`;
      dot.scale.setScalar(chosen ? 1.6 : 1);
    });
    this.canvas.dataset["drawn"] = "yes";
  }

  /** Choose the site under the pointer: the event `chosen` has its name. @param {MouseEvent} event */
  #pick(event) {
    const box = this.canvas.getBoundingClientRect();
    let [name, nearest] = ["", 16];
    this.map.sites.forEach((site, k) => {
      const at = this.dots[k]?.position.clone().project(this.orbit.camera);
      if (!at || this.#isBehind(site)) return;
      const distance = Math.hypot(((at.x + 1) / 2) * box.width - (event.clientX - box.left), ((1 - at.y) / 2) * box.height - (event.clientY - box.top));
      if (distance < nearest) [name, nearest] = [site.site, distance];
    });
    if (!name) return;
    this.choose(name);
    this.dispatchEvent(new CustomEvent("chosen", { detail: name }));
  }

  /** Whether the wall hides a site. @param {import("../shared/types.js").MapSite} site */
  #isBehind(site) {
    const wall = new THREE.Vector3(...site.surface_mm);
    const outward = wall.clone().sub(this.orbit.centre);
    return outward.dot(this.orbit.camera.position.clone().sub(wall)) < 0;
  }
}
