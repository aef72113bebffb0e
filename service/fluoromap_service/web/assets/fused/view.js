/** One fluoroscopy view with the map over it: it plays, and every site can be found and chosen. */
import { element } from "../shared/elements.js";
import { direction, number } from "../shared/words.js";
import { siteText, timeText } from "../map/site-text.js";
import { FrameView } from "../viewer/frame-view.js";
import { drawLabels } from "./labels.js";
import { Projection } from "./projection.js";

/** @typedef {import("../shared/types.js").Run} Run @typedef {import("../shared/types.js").MapSite} MapSite */
/**
 * @typedef {{site: string, view: string, frame: number, projection: number[][], frames: {frame: number, shift_mm: number[], tip_px: number[]|null,
 *   electrodes: {catheter: string, electrode: number, u_px: number, v_px: number}[]}[]}} MapPlacement
 */

const REACH_PX = 16;
const DOUBTFUL = "#ffb040";

/** The event `chosen` has the name of the site that a person clicked; `play` asks for both views to play or pause. */
export class FusedView extends FrameView {
  /**
   * @param {import("../study/page.js").StudyState} state
   * @param {Run} run
   * @param {MapPlacement} place
   * @param {import("./wall-painter.js").WallPainter} wall
   * @param {HTMLCanvasElement|null} bar Colour bar to show in this view.
   * @param {{earliest: string|null, distance: string}} goal The earliest site, and its distance from the tip of this run in words.
   */
  constructor(state, run, place, wall, bar, goal) {
    const name = `view ${place.view}`;
    const label = `The map over ${name} of site ${place.site}, ${direction(run.gantry)}`;
    super(state, run, { canvas: { role: "img", "aria-label": label }, slider: `Frame of the map over ${name}`, frame: place.frame });
    this.place = place;
    this.wall = wall;
    this.bar = bar;
    this.goal = goal;
    this.map = wall.look.map;
    this.projection = new Projection(place.projection);
    this.edges = this.projection.edges;
    this.showsElectrodes = false;
    this.element.classList.add("fused");
    this.element.dataset.fused = place.view;
    this.element.append(
      element("div", { class: "caption" }, element("strong", {}, `View ${place.view}`), `${direction(run.gantry)} of site ${place.site}`),
      element("div", { class: "picture" }, this.canvas, bar), element("div", { class: "caption" }, this.slider, this.count));
    this.#listen();
    this.show(this.frame);
  }

  get countText() {
    return `${super.countText}${this.frame === this.place.frame ? ", diastole" : ""}`;
  }

  switchPlay() {
    this.dispatchEvent(new Event("play"));
  }

  paintOver() {
    const context = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d"));
    this.wall.paint(context, this.placement, this.run, this.projection, this.shift);
    if (this.showsElectrodes) this.painter.paintElectrodes(this.canvas, this.placement, this.state.study, this.place.frames[this.frame - 1]?.electrodes ?? [], null);
    this.#sites(context);
  }

  /** @param {boolean} shown */
  showElectrodes(shown) {
    this.showsElectrodes = shown;
    this.draw();
  }

  get shift() {
    return this.place.frames[this.frame - 1]?.shift_mm ?? [0, 0, 0];
  }

  /** Where a point of the map is on the canvas. @param {number[]} point */
  #at([x = 0, y = 0, z = 0]) {
    const [sx = 0, sy = 0, sz = 0] = this.shift;
    const { u, v } = this.projection.pixel([x + sx, y + sy, z + sz]);
    return this.placement.toCanvas(this.canvas, this.run, u, v);
  }

  /** Whether a site lies on the wall towards the detector. @param {MapSite} site */
  #isNear(site) {
    const { center } = this.wall.surface.sphere;
    const outward = [center.x, center.y, center.z].map((each, k) => (site.surface_mm[k] ?? 0) - each);
    const ray = this.projection.source.map((each, k) => (site.surface_mm[k] ?? 0) + (this.shift[k] ?? 0) - each);
    return outward.reduce((sum, each, k) => sum + each * (ray[k] ?? 0), 0) > 0;
  }

  /** @param {CanvasRenderingContext2D} context */
  #sites(context) {
    const unit = window.devicePixelRatio || 1;
    const { scale, uncertainty } = this.wall.look;
    const tip = this.place.frames[this.frame - 1]?.tip_px;
    const star = tip ? this.placement.toCanvas(this.canvas, this.run, tip[0] ?? 0, tip[1] ?? 0) : null;
    const shown = this.map.sites.map((site) => {
      const own = site.site === this.place.site;
      return { site, own, near: this.#isNear(site), chosen: site.site === this.state.chosen, at: own && star ? star : this.#at([site.x_mm, site.y_mm, site.z_mm]) };
    });
    const earliest = shown.find((each) => each.site.site === this.goal.earliest);
    if (star && earliest && !earliest.own) wayTo(context, star, earliest.at, unit);
    for (const { site, own, near, chosen, at } of shown) {
      const band = uncertainty ? "#fff" : bandColour(scale, site.lat_ms);
      const colour = site.reasons.includes("lat_outlier") ? DOUBTFUL : band;
      if (own) drawStar(context, at, (chosen ? 11 : 8) * unit);
      else drawDot(context, at, colour, (chosen ? 6 : 3.5) * unit, near, unit);
      if (chosen && !own) ring(context, at, 10 * unit, unit);
    }
    // On a phone the colour bar is below the picture.
    const right = this.bar && this.bar.offsetTop < this.canvas.clientHeight ? this.bar.offsetLeft * unit : this.canvas.width;
    drawLabels(context, shown.sort((a, b) => Number(b.chosen) - Number(a.chosen) || Number(b.own) - Number(a.own)).map(({ site, own, near, chosen, at }) => ({
      at,
      text: chosen || own || site.site === this.goal.earliest ? `${siteText(site)}${site.site === this.goal.earliest ? ", earliest" : ""}` : timeText(site).replace(" ms", ""),
      chosen, faint: !near && !own && !chosen,
    })), unit, right);
    if (star && earliest && !earliest.own) {
      drawLabels(context, [{ at: { x: (star.x + earliest.at.x) / 2, y: (star.y + earliest.at.y) / 2 }, text: this.goal.distance, chosen: false, faint: false }], unit, right);
    }
    this.#edges(context, unit);
  }

  /** Letters of the patient at the edges, and the kind of data. @param {CanvasRenderingContext2D} context @param {number} unit */
  #edges(context, unit) {
    const { width, height } = this.canvas;
    const { left, right, top } = this.edges;
    const purpose = `${this.map.simulated ? "simulated data, " : ""}for research`;
    context.font = `${12 * unit}px system-ui`;
    context.textBaseline = "middle";
    /** @type {[string, number, number, CanvasTextAlign][]} */
    const words = [[left, 8 * unit, height / 2, "left"], [right, width - 8 * unit, height / 2, "right"], [top, width / 2, 12 * unit, "center"],
      [`${this.place.site}   ${direction(this.run.gantry)}   ${purpose}`, 8 * unit, height - 12 * unit, "left"]];
    for (const [text, x, y, align] of words) {
      context.textAlign = align;
      context.lineWidth = 3 * unit;
      context.strokeStyle = "#000";
      context.strokeText(text, x, y);
      context.fillStyle = "#fff";
      context.fillText(text, x, y);
    }
    context.textAlign = "left";
    this.element.dataset.tip = this.place.frames[this.frame - 1]?.tip_px?.map((each) => number(each, 1)).join(" ") ?? "";
  }

  #listen() {
    /** @type {{x: number, y: number, moved: boolean}|null} */
    let drag = null;
    this.canvas.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
      this.canvas.setPointerCapture(event.pointerId);
      drag = { ...this.at(event), moved: false };
    });
    this.canvas.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => {
      if (!drag) return;
      const { x, y } = this.at(event);
      if (!drag.moved && Math.hypot(x - drag.x, y - drag.y) < 3) return;
      this.pan(x - drag.x, y - drag.y);
      drag = { x, y, moved: true };
    });
    this.canvas.addEventListener("pointerup", () => {
      if (drag && !drag.moved) this.#pick(drag.x, drag.y);
      drag = null;
    });
    this.canvas.addEventListener("pointercancel", () => (drag = null));
    this.canvas.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      if (!event.ctrlKey && !event.altKey && !event.metaKey && this.press(event.key)) event.preventDefault();
    });
  }

  /** @param {number} x @param {number} y */
  #pick(x, y) {
    let [name, nearest] = ["", REACH_PX * (window.devicePixelRatio || 1)];
    for (const site of this.map.sites) {
      const at = this.#at([site.x_mm, site.y_mm, site.z_mm]);
      const distance = Math.hypot(at.x - x, at.y - y);
      if (distance < nearest) [name, nearest] = [site.site, distance];
    }
    if (name) this.dispatchEvent(new CustomEvent("chosen", { detail: name }));
  }
}

/** @param {import("../map/colour-scale.js").Scale} scale @param {number} ms */
function bandColour(scale, ms) {
  const band = Math.min(scale.bands - 1, Math.max(0, Math.floor((ms - scale.start) / scale.step)));
  return `rgb(${(scale.colours[band] ?? [255, 255, 255]).join(",")})`;
}

/** @typedef {{x: number, y: number}} Place */

/** A dot on the wall towards the detector, a ring on the far wall. @param {CanvasRenderingContext2D} context @param {Place} at @param {string} colour @param {number} radius @param {boolean} near @param {number} unit */
function drawDot(context, at, colour, radius, near, unit) {
  context.beginPath();
  context.arc(at.x, at.y, radius, 0, 2 * Math.PI);
  if (near) {
    context.fillStyle = colour;
    context.fill();
    context.lineWidth = 1.5 * unit;
    context.strokeStyle = "#000";
  } else {
    context.lineWidth = 4 * unit;
    context.strokeStyle = "#000";
    context.stroke();
    context.lineWidth = 2 * unit;
    context.strokeStyle = colour;
  }
  context.stroke();
}

/** @param {CanvasRenderingContext2D} context @param {Place} at @param {number} radius */
function drawStar(context, at, radius) {
  context.beginPath();
  for (let k = 0; k < 10; k += 1) {
    const reach = k % 2 ? 0.45 * radius : radius;
    const angle = (-90 + 36 * k) * (Math.PI / 180);
    context.lineTo(at.x + reach * Math.cos(angle), at.y + reach * Math.sin(angle));
  }
  context.closePath();
  context.lineWidth = radius / 3;
  context.strokeStyle = "#000";
  context.stroke();
  context.fillStyle = "#fff";
  context.fill();
}

/** @param {CanvasRenderingContext2D} context @param {Place} at @param {number} radius @param {number} unit */
function ring(context, at, radius, unit) {
  for (const [colour, width] of /** @type {[string, number][]} */ ([["#000", 4], ["#fff", 2]])) {
    context.beginPath();
    context.arc(at.x, at.y, radius, 0, 2 * Math.PI);
    context.strokeStyle = colour;
    context.lineWidth = width * unit;
    context.stroke();
  }
}

/** The way from the tip to the earliest site, dashed. @param {CanvasRenderingContext2D} context @param {Place} from @param {Place} to @param {number} unit */
function wayTo(context, from, to, unit) {
  for (const [colour, width] of /** @type {[string, number][]} */ ([["rgba(0,0,0,.7)", 4], ["#fff", 1.6]])) {
    context.beginPath();
    context.setLineDash([7 * unit, 5 * unit]);
    context.moveTo(from.x, from.y);
    context.lineTo(to.x, to.y);
    context.strokeStyle = colour;
    context.lineWidth = width * unit;
    context.stroke();
  }
  context.setLineDash([]);
}
