/** The map over both fluoroscopy views of a site: it follows the frames while they play. */
import { get } from "../shared/api.js";
import { attempt, button, element, field, select } from "../shared/elements.js";
import { drawColourBar } from "../map/colour-bar.js";
import { distanceText } from "../results/tip-distance.js";
import { FusedView } from "./view.js";
import { WallPainter } from "./wall-painter.js";

/** @typedef {{sop_instance_uid: string, site: string, view: string, frame: number, href: string}} Overlay */

export class FusedPanel {
  /**
   * @param {import("../study/page.js").StudyState} state
   * @param {string} jobId
   * @param {Overlay[]} overlays Views of located sites.
   * @param {import("../map/look.js").MapLook} look
   * @param {import("../shared/types.js").Point[]} tips Of all sites.
   */
  constructor(state, jobId, overlays, look, tips) {
    this.state = state;
    this.jobId = jobId;
    this.overlays = overlays;
    this.look = look;
    this.tips = tips;
    /** @type {WallPainter|null} */
    this.wall = null;
    /** @type {FusedView[]} */
    this.views = [];
    this.playing = false;
    /** Whether a choice within the views keeps their runs. */
    this.keeps = false;
    /** @type {string|null} */
    this.site = null;
    const names = [...new Set(overlays.map((each) => each.site))];
    this.choice = select(names.map((name) => [name, name]), "", { onchange: () => this.open(this.choice.value) });
    this.playButton = button("Play", () => this.play(!this.playing), { "aria-label": "Play the map over fluoroscopy" });
    this.electrodes = element("input", { type: "checkbox", onchange: () => this.#showElectrodes() });
    this.distance = element("p", { "aria-live": "polite", class: "distance" });
    this.links = element("p", { class: "row" });
    this.place = element("div", { class: "views" });
    this.element = element("section", {}, element("h2", {}, "The map over fluoroscopy"),
      element("div", { class: "fields" }, field("Runs of site", this.choice), this.playButton, element("label", { class: "row" }, this.electrodes, "found electrodes")),
      this.distance, this.place,
      element("p", { class: "soft" }, "Star: tip of this site. Dot: near wall. Ring: far wall. Dashed: from the tip to the earliest site. A click on a site finds it in every view; the wheel zooms, dragging moves the picture, space plays."),
      this.links);
    this.bar = element("canvas", { class: "bar" });
    this.redraw = () => {
      drawColourBar(this.bar, look.scale, look.uncertainty ? "± SD, ms" : "time, ms");
      this.wall?.update();
      for (const view of this.views) view.draw();
    };
    look.addEventListener("changed", this.redraw);
  }

  /** Show the runs of a site; a site that is not located leaves the runs as they are. @param {string|null} site */
  open(site) {
    const wanted = this.overlays.some((each) => each.site === site) ? site : (this.site ?? this.overlays[0]?.site ?? null);
    if (wanted === null || wanted === this.site) return this.redraw();
    this.site = wanted;
    this.choice.value = wanted;
    return attempt(async () => {
      const own = this.overlays.filter((each) => each.site === wanted);
      const places = await Promise.all(own.map((each) => get(each.href.replace(/\.png$/, "/placement"))));
      if (this.site !== wanted) return;
      this.wall ??= new WallPainter(this.look);
      this.#close();
      const earliest = this.look.map.earliest[0]?.site ?? null;
      const distance = distanceText(this.tips, wanted, earliest);
      this.views = places.flatMap((each) => {
        const run = this.state.runs.find((other) => other.sop_instance_uid === each.sop_instance_uid);
        return run && this.wall ? [new FusedView(this.state, run, each, this.wall, each.view === "b" ? this.bar : null, { earliest, distance: distance?.short ?? "" })] : [];
      });
      for (const view of this.views) {
        view.addEventListener("chosen", (event) => this.#choose(/** @type {CustomEvent} */ (event).detail));
        view.addEventListener("play", () => this.play(!this.playing));
      }
      this.place.replaceChildren(...this.views.map((view) => view.element));
      this.distance.textContent = wanted === earliest ? `The tip at ${wanted} is at the earliest site.` : (distance?.sentence ?? "");
      this.links.replaceChildren(...this.views.flatMap((view, k) => [["png", "picture"], ["gif", "moving picture"]].map(([kind = "", title]) =>
        element("a", { href: own[k]?.href ?? "", target: "_blank", onclick: (/** @type {MouseEvent} */ event) => {
          /** @type {HTMLAnchorElement} */ (event.currentTarget).href = this.#picture(own[k]?.href ?? "", kind, view);
        } }, `View ${view.place.view} as a ${title}`))));
      this.#showElectrodes();
      this.redraw();
    });
  }

  /** Address of a picture that shows what the view shows. @param {string} href @param {string} kind @param {FusedView} view */
  #picture(href, kind, view) {
    return `${href.replace(/png$/, kind)}?frame=${view.frame}&colours=${this.look.palette}&electrodes=${this.electrodes.checked}`;
  }

  /** Follow a choice that a person made elsewhere: show the runs of that site. @param {string|null} site */
  follow(site) {
    if (this.keeps) this.redraw();
    else this.open(site);
  }

  /** @param {string} site */
  #choose(site) {
    this.keeps = true;
    this.state.choose(site);
    this.keeps = false;
  }

  #showElectrodes() {
    for (const view of this.views) view.showElectrodes(this.electrodes.checked);
  }

  /** @param {boolean} playing */
  play(playing) {
    this.playing = playing;
    for (const view of this.views) {
      view.playback.play(playing);
      view.showCount();
    }
    this.playButton.textContent = playing ? "Pause" : "Play";
    this.playButton.setAttribute("aria-label", `${this.playButton.textContent} the map over fluoroscopy`);
  }

  #close() {
    this.play(false);
    for (const view of this.views) view.close();
  }

  close() {
    this.#close();
    this.look.removeEventListener("changed", this.redraw);
    this.wall?.close();
  }
}
