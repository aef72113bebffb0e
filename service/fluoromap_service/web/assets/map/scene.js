/** The map in 3D: wall, sites with name and time, catheters, orientation, colour bar. The study page and the report use it. */
import * as THREE from "../three/three.module.min.js";
import { Catheters } from "./catheters.js";
import { drawColourBar } from "./colour-bar.js";
import { Orbit } from "./orbit.js";
import { drawOrientation } from "./orientation.js";
import { siteText } from "./site-text.js";
import { rendererOf, Surface } from "./surface.js";

const LINE_PX = 15;
const BESIDE_PX = 8;
const REACH_PX = 16;

/** The event `chosen` has the name of the site that a person clicked. */
export class MapScene extends EventTarget {
  /**
   * @param {HTMLElement} place An element of class `scene`.
   * @param {import("./look.js").MapLook} look
   * @param {import("../shared/types.js").Point[]} points Electrodes of all sites.
   * @param {string[]} catheters Names in the order of the study.
   */
  constructor(place, look, points, catheters) {
    super();
    this.look = look;
    this.map = look.map;
    /** @type {string|null} */
    this.chosen = null;
    /** The drawing that the browser was asked for; 0: none. */
    this.asked = 0;
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
    this.renderer = rendererOf(this.canvas, true);
    this.world = new THREE.Scene();
    this.surface = new Surface(look, false);
    const { sphere } = this.surface;
    this.catheters = new Catheters(points, catheters);
    this.showsCatheters = true;
    this.sun = new THREE.DirectionalLight(0xffffff, 2);
    this.world.add(this.surface.mesh, this.catheters.group, this.sun, new THREE.AmbientLight(0xffffff, 1.1));
    this.dots = this.map.sites.map((site) => this.#dot(site, sphere.radius));
    const earliest = this.map.earliest[0]?.site;
    this.names = this.map.sites.map((site) => this.#label(`${siteText(site)}${site.site === earliest ? ", earliest" : ""}`));
    /** @type {HTMLElement[]} */
    this.catheterNames = [];
    this.orbit = new Orbit(this.canvas, sphere.center.clone(), sphere.radius, () => this.draw());
    this.canvas.addEventListener("click", (event) => this.#pick(event));
    this.recolour = () => {
      this.surface.update();
      drawColourBar(this.bar, look.scale, look.uncertainty ? "± SD, ms" : "time, ms");
      this.draw();
    };
    look.addEventListener("changed", this.recolour);
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

  /** @param {string} text @param {string} kind Class of the label: a site's changes with each drawing. */
  #label(text, kind = "") {
    const label = document.createElement("span");
    label.className = kind;
    label.textContent = text;
    this.labels.append(label);
    return label;
  }

  /** Give the memory of the graphics card back; a browser has few such contexts. */
  close() {
    cancelAnimationFrame(this.asked);
    this.look.removeEventListener("changed", this.recolour);
    this.surface.close();
    this.catheters.close();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  /** @param {string|null} site */
  choose(site) {
    this.chosen = site;
    this.#showCatheters();
  }

  /** @param {boolean} shown */
  showCatheters(shown) {
    this.showsCatheters = shown;
    this.#showCatheters();
  }

  #showCatheters() {
    this.catheters.show(this.showsCatheters ? this.chosen : null);
    for (const each of this.catheterNames) each.remove();
    this.catheterNames = this.catheters.labels.map(({ name }) => this.#label(name, "catheter"));
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

  /** Draw once before the browser shows its next picture, however many changes ask for it: without a graphics card each drawing takes a tenth of a second. */
  draw() {
    this.asked ||= requestAnimationFrame(() => {
      this.asked = 0;
      this.#paint();
    });
  }

  #paint() {
    const { camera } = this.orbit;
    this.sun.position.copy(camera.position);
    this.renderer.render(this.world, camera);
    drawOrientation(this.figure, camera);
    /** @type {number[][]} */
    const taken = [];
    const sites = this.map.sites.map((site, k) => ({ site, k, far: this.#isBehind(site) }));
    // Labels of the near side keep their places; those of the far side give way. The chosen site comes first.
    const rank = (/** @type {{site: {site: string}, far: boolean}} */ each) => (each.site.site === this.chosen ? 0 : each.far ? 2 : 1);
    for (const { site, k, far } of sites.sort((a, b) => rank(a) - rank(b))) {
      const [label, dot] = [this.names[k], this.dots[k]];
      if (!label || !dot) continue;
      const chosen = site.site === this.chosen;
      label.className = chosen ? "chosen" : far ? "far" : "";
      dot.scale.setScalar(chosen ? 1.6 : 1);
      this.#put(label, dot.position, taken);
    }
    this.catheters.labels.forEach(({ at }, k) => {
      const label = this.catheterNames[k];
      if (label) this.#put(label, at, taken);
    });
    this.canvas.dataset["drawn"] = "yes";
  }

  /** Put a label beside a point, below the labels that are there already. @param {HTMLElement} label @param {THREE.Vector3} point @param {number[][]} taken Left, top and width of each. */
  #put(label, point, taken) {
    const at = point.clone().project(this.orbit.camera);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const own = label.offsetWidth;
    const beside = ((at.x + 1) / 2) * width;
    const x = beside + BESIDE_PX + own > width ? beside - BESIDE_PX - own : beside + BESIDE_PX;
    let y = ((1 - at.y) / 2) * height - BESIDE_PX;
    // A label that nobody sees takes no space.
    while (own && taken.some(([otherX = 0, otherY = 0, other = 0]) => otherX < x + own && x < otherX + other && Math.abs(otherY - y) < LINE_PX)) y += LINE_PX;
    if (own) taken.push([x, y, own]);
    label.style.transform = `translate(${x.toFixed(0)}px, ${y.toFixed(0)}px)`;
  }

  /** Choose the site under the pointer. @param {MouseEvent} event */
  #pick(event) {
    const box = this.canvas.getBoundingClientRect();
    let [name, nearest] = ["", REACH_PX];
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
