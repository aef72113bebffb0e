/** Two jobs of a study compared: sites moved by how much, times, and the difference of the maps. */
import { get } from "../shared/api.js";
import { attempt, button, element, field, select } from "../shared/elements.js";
import { jobLabel, number } from "../shared/words.js";
import { tipDistance } from "./tip-distance.js";

/** @typedef {import("../shared/types.js").Job} Job */
/** @typedef {import("../shared/types.js").ChamberMap} ChamberMap */

/** RMS difference of the times of two maps in ms, at the vertices of the first, each beside the nearest vertex of the second. @param {ChamberMap} a @param {ChamberMap} b */
function mapDifference(a, b) {
  let [sum, count] = [0, 0];
  a.vertices_mm.forEach(([x = 0, y = 0, z = 0], k) => {
    if (!a.covered[k]) return;
    let [nearest, at] = [Infinity, -1];
    b.vertices_mm.forEach(([u = 0, v = 0, w = 0], other) => {
      const away = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2;
      if (b.covered[other] && away < nearest) [nearest, at] = [away, other];
    });
    if (at >= 0 && nearest < 25) { sum += ((a.lat_ms[k] ?? 0) - (b.lat_ms[at] ?? 0)) ** 2; count += 1; }
  });
  return count ? Math.sqrt(sum / count) : null;
}

/** @param {ChamberMap} map */
const earliest = (map) => map.earliest[0]?.site ?? "none";

/** @param {Job} job @param {Job[]} others @param {string} mapping Name of the mapping catheter. */
export function comparison(job, others, mapping) {
  const choices = others.filter((each) => each.id !== job.id && each.state === "succeeded");
  if (!choices.length) return element("p", { class: "soft" }, "After a second computation you can compare both here: after a correction, or with the activation times of another rhythm.");
  const other = select(choices.map((each) => [each.id, jobLabel(each)]), choices[0]?.id ?? "");
  const place = element("div", { "aria-live": "polite" });
  const compare = async () => {
    const [now, before, mapNow, mapBefore] = await Promise.all([job.id, other.value].flatMap((id) => [get(`/v1/jobs/${id}/points`)]).concat([job.id, other.value].map((id) => get(`/v1/jobs/${id}/map`).catch(() => null))));
    const tips = (/** @type {any} */ points) => points.points.filter((/** @type {any} */ each) => each.catheter === mapping && each.electrode === 1);
    const old = new Map(tips(before).map((/** @type {any} */ tip) => [tip.site, tip]));
    const rows = tips(now).map((/** @type {any} */ tip) => {
      const former = /** @type {any} */ (old.get(tip.site));
      const moved = former ? tipDistance(former, tip) : null;
      const shift = former && tip.lat_ms !== null && former.lat_ms !== null ? tip.lat_ms - former.lat_ms : null;
      return element("tr", {}, element("td", {}, tip.site), element("td", { class: "figure" }, number(moved?.mm, 2)),
        element("td", { class: "figure" }, number(shift, 1)), element("td", { class: "figure" }, `${number(former?.lat_ms, 0)} → ${number(tip.lat_ms, 0)}`), element("td", {}, `${former?.grade ?? "–"} → ${tip.grade}`));
    });
    const difference = mapNow && mapBefore ? mapDifference(mapNow, mapBefore) : null;
    place.replaceChildren(
      element("p", {}, difference === null ? "One of the computations has no map." : `The maps differ by ${number(difference, 1)} ms (root mean square over the covered wall).`),
      mapNow && mapBefore ? element("p", {}, `Earliest site: ${earliest(mapBefore)} before, ${earliest(mapNow)} now. Whole activation: ${number(mapBefore.total_activation_time_ms, 0)} ms before, ${number(mapNow.total_activation_time_ms, 0)} ms now.`) : "",
      element("div", { class: "wide", tabIndex: 0, role: "region", "aria-label": "Sites of both computations" }, element("table", { class: "comparison" }, element("thead", {}, element("tr", {}, ...["Site", "Moved, mm", "Time changed, ms", "Times, ms", "Grade"].map((title) => element("th", { scope: "col" }, title)))), element("tbody", {}, ...rows))));
  };
  return element("section", {}, element("h2", {}, "Compare with another computation"),
    element("div", { class: "fields" }, field("Compare with the computation of", other), button("Compare", () => attempt(compare))), place);
}
