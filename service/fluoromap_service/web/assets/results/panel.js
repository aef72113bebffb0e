/** The fourth step: the map, the sites, the pictures, the downloads, and the comparison of two jobs. */
import { get } from "../shared/api.js";
import { attempt, element, field, select } from "../shared/elements.js";
import { jobLabel, listed, warningWords } from "../shared/words.js";
import { comparison } from "./compare.js";
import { downloads } from "./downloads.js";
import { lostSites, resultSites } from "./sites-table.js";

/** @typedef {import("../study/page.js").StudyState} StudyState */
/** @typedef {import("../shared/types.js").Job} Job */

/** @param {StudyState} state @param {() => void} correct Shows the second step. */
export function resultsPanel(state, correct) {
  const place = element("div", {});
  const choice = select([], "", {});
  const choiceField = field("Show the computation of", choice);
  let shown = "";
  /** The newest job when a person last looked: only a newer one replaces what a person chose. */
  let newestBefore = "";
  let forget = () => {};
  /** Adds what a job gives only at its end. @type {((job: Job) => Promise<void>)|null} */
  let complete = null;

  /** @param {Job} job */
  const show = async (job) => {
    shown = job.id;
    // The library of 3D is large: the page is ready before it arrives.
    const [{ mapPanel }, { MapLook }, points, map, sentences] = await Promise.all([
      import("../map/panel.js"), import("../map/look.js"),
      state.points(job.id), get(`/v1/jobs/${job.id}/map`).catch((error) => error), state.sentences(),
    ]);
    const tips = await state.tips(job.id);
    const hasMap = !(map instanceof Error);
    const earliest = hasMap ? (map.earliest[0]?.site ?? null) : null;
    const correctSite = (/** @type {string} */ site) => { state.choose(site); correct(); };
    const lost = lostSites(tips, sentences, correctSite);
    const table = resultSites(tips, earliest, sentences, (site) => state.choose(site), correctSite);
    const markRow = () => {
      for (const row of table.querySelectorAll("tr[data-site]")) row.classList.toggle("chosen", row.dataset.site === state.chosen);
    };
    const files = element("div", {}, downloads(job, hasMap), comparison(job, state.jobs, state.study.mapping));
    complete = null;
    forget();
    if (!tips.some((/** @type {any} */ tip) => tip.site === state.chosen)) state.chosen = earliest;
    if (!hasMap) {
      state.addEventListener("chosen", markRow);
      forget = () => state.removeEventListener("chosen", markRow);
      place.replaceChildren(element("p", { class: "notice problem" }, map.message), ...lost, table, files);
      place.dataset.job = job.id;
      return markRow();
    }
    const look = new MapLook(map);
    const catheters = state.study.catheters.map((each) => each.name);
    const chamber = mapPanel(look, points, catheters, `${state.study.label}: ${map.simulated ? "simulated data, " : ""}for research`);
    const overFluoroscopy = element("div", {}, element("p", { class: "card" }, "The map over fluoroscopy follows at the end of the computation."));
    /** @type {import("../fused/panel.js").FusedPanel|null} */
    let fused = null;
    const choose = () => {
      chamber.scene?.choose(state.chosen);
      markRow();
      return fused?.follow(state.chosen);
    };
    complete = async (ended) => {
      complete = null;
      const [{ FusedPanel }, { overlays }] = await Promise.all([import("../fused/panel.js"), get(`/v1/jobs/${ended.id}/overlays`).catch(() => ({ overlays: [] }))]);
      if (shown !== ended.id) return;
      fused = new FusedPanel(state, ended.id, overlays, look, tips);
      overFluoroscopy.replaceChildren(fused.element);
      await fused.follow(state.chosen);
    };
    state.addEventListener("chosen", choose);
    forget = () => {
      state.removeEventListener("chosen", choose);
      chamber.scene?.close();
      fused?.close();
    };
    chamber.addEventListener("made", () => {
      chamber.scene.addEventListener("chosen", (/** @type {CustomEvent} */ event) => state.choose(event.detail));
      choose();
    });
    const warnings = map.warnings.map((/** @type {string} */ code) => {
      const where = tips.filter((tip) => tip.reasons.includes(code)).map((tip) => tip.site);
      const sites = where.length === tips.length ? "All sites: " : where.length ? `Site ${listed(where)}: ` : "";
      return element("li", {}, `${sites}${sentences.get(code) ?? warningWords(code)}`);
    });
    place.replaceChildren(...lost, chamber, warnings.length ? element("ul", { class: "notice problem" }, ...warnings) : "", overFluoroscopy, table, files);
    place.dataset.job = job.id;
    choose();
    if (job.state === "succeeded") await complete(job);
  };

  const fill = () => {
    const jobs = state.jobs.filter((job) => job.state === "succeeded" || job.id === state.mapped?.id);
    const [newest] = jobs;
    choiceField.hidden = !newest;
    if (!newest) return place.replaceChildren(element("p", { class: "card" }, "There is no map yet. Start the computation in the third step."));
    choice.replaceChildren(...select(jobs.map((job) => [job.id, jobLabel(job)]), newest.id).children);
    if (newest.id !== newestBefore) {
      newestBefore = newest.id;
      return attempt(() => show(newest));
    }
    choice.value = shown;
    return newest.id === shown && newest.state === "succeeded" && complete ? attempt(() => complete?.(newest) ?? Promise.resolve()) : undefined;
  };
  choice.addEventListener("change", () => {
    const job = state.jobs.find((each) => each.id === choice.value);
    if (job) attempt(() => show(job));
  });
  state.addEventListener("changed", fill);
  state.addEventListener("mapped", fill);
  fill();
  return element("div", {}, choiceField, place);
}
