/** The fourth step: the map, the sites, the pictures, the downloads, and the comparison of two jobs. */
import { get } from "../shared/api.js";
import { attempt, element, field, select } from "../shared/elements.js";
import { warningWords } from "../shared/words.js";
import { comparison } from "./compare.js";
import { downloads } from "./downloads.js";
import { fusedViews } from "./fused-views.js";
import { resultSites } from "./sites-table.js";

/** @typedef {import("../study/page.js").StudyState} StudyState */
/** @typedef {import("../shared/types.js").Job} Job */

/** @param {StudyState} state @param {() => void} correct Shows the second step. */
export function resultsPanel(state, correct) {
  const place = element("div", {});
  const choice = select([], "", {});
  let shown = "";
  let forget = () => {};

  /** @param {Job} job */
  const show = async (job) => {
    // The library of 3D is large: the page is ready before it arrives.
    const [{ mapPanel }, points, map, overlays, reasons] = await Promise.all([
      import("../map/panel.js"),
      get(`/v1/jobs/${job.id}/points`), get(`/v1/jobs/${job.id}/map`).catch((error) => error),
      get(`/v1/jobs/${job.id}/overlays`).catch(() => ({ overlays: [] })), get("/v1/reasons"),
    ]);
    const sentences = new Map(reasons.map((/** @type {any} */ each) => [each.code, each.sentence]));
    const tips = points.points.filter((/** @type {any} */ each) => each.catheter === state.study.mapping && each.electrode === 1);
    const hasMap = !(map instanceof Error);
    const chamber = hasMap ? mapPanel(map, state.study.label) : element("p", { class: "notice problem" }, map.message);
    const fused = element("div", {});
    const frames = new Map(state.runs.map((run) => [run.sop_instance_uid, run.frames]));
    const table = resultSites(tips, hasMap ? (map.earliest[0]?.site ?? null) : null, sentences, (site) => state.choose(site), (site) => { state.choose(site); correct(); });
    const choose = () => {
      if (chamber.scene) chamber.scene.choose(state.chosen);
      for (const row of table.querySelectorAll("tr[data-site]")) row.classList.toggle("chosen", row.dataset.site === state.chosen);
      const own = overlays.overlays.filter((/** @type {any} */ each) => each.site === state.chosen);
      fused.replaceChildren(own.length ? fusedViews(job.id, own, frames) : element("p", { class: "soft" }, "Choose a located site in the table to see the map over its fluoroscopy."));
    };
    forget();
    state.addEventListener("chosen", choose);
    forget = () => {
      state.removeEventListener("chosen", choose);
      chamber.scene?.close();
    };
    chamber.addEventListener("made", () => {
      chamber.scene.addEventListener("chosen", (/** @type {CustomEvent} */ event) => state.choose(event.detail));
      choose();
    });
    if (!tips.some((/** @type {any} */ tip) => tip.site === state.chosen)) state.chosen = hasMap ? (map.earliest[0]?.site ?? null) : null;
    choose();
    const warnings = hasMap ? map.warnings.map((/** @type {string} */ code) => element("li", {}, sentences.get(code) ?? warningWords(code))) : [];
    place.replaceChildren(chamber, warnings.length ? element("ul", { class: "notice problem" }, ...warnings) : "",
      table, element("h2", {}, "The map over fluoroscopy"), fused, downloads(job), comparison(job, state.jobs, state.study.mapping));
    place.dataset.job = job.id;
  };

  const fill = () => {
    const jobs = state.jobs.filter((job) => job.state === "succeeded");
    choice.replaceChildren(...select(jobs.map((job) => [job.id, new Date(job.created).toLocaleString()]), jobs[0]?.id ?? "").children);
    const newest = jobs[0];
    if (!newest) return place.replaceChildren(element("p", { class: "card" }, "There is no map yet. Start the computation in the third step."));
    if (newest.id === shown) return undefined;
    shown = newest.id;
    choice.value = newest.id;
    return attempt(() => show(newest));
  };
  choice.addEventListener("change", () => {
    const job = state.jobs.find((each) => each.id === choice.value);
    if (job) attempt(() => show(job));
  });
  state.addEventListener("changed", fill);
  fill();
  return element("div", {}, field("Computation of", choice), place);
}
