/** The table of sites and pairs, in which people name, change and confirm. */
import { send } from "../shared/api.js";
import { announce, attempt, button, element, select } from "../shared/elements.js";
import { boundByWords, direction, isGuess, listed, missingWords, shortTime, warningWords } from "../shared/words.js";

/** @typedef {import("./page.js").StudyState} StudyState */
/** @typedef {import("../shared/types.js").Site} Site */

/** @param {import("../shared/types.js").Run} run @param {number} index */
export const runLabel = (run, index) => `run ${index + 1}: ${direction(run.gantry)}, ${shortTime(run.acquired)}`;

/** @param {StudyState} state @param {Site|null} site Null for a new site. */
function row(state, site) {
  const name = site?.site ?? (site?.pair ? `pair ${site.pair}` : "new site");
  /** @type {[string, string][]} */
  const runs = [["", "none"], ...state.runs.map((run, index) => /** @type {[string, string]} */ ([run.sop_instance_uid, runLabel(run, index)]))];
  const site_ = element("input", { value: site?.site ?? "", placeholder: "name", maxLength: 64, readOnly: Boolean(site?.site), "aria-label": `Name of ${name}` });
  const lat = element("input", { value: site?.lat_ms ?? "", inputMode: "decimal", placeholder: "ms", "aria-label": `Activation time of ${name} in ms` });
  const a = select(runs, site?.view_a ?? "", { "aria-label": `View a of ${name}` });
  const b = select(runs, site?.view_b ?? "", { "aria-label": `View b of ${name}` });
  const guess = isGuess(site?.bound_by ?? null);

  const save = () => attempt(async () => {
    const title = site_.value.trim();
    if (!title) throw new Error("This row needs a name, for example S01.");
    const time = lat.value.trim().replace("−", "-").replace(",", ".");
    if (time && !Number.isFinite(Number(time))) throw new Error(`"${lat.value}" is no time in ms; give a number, for example 41.5.`);
    await send("PUT", `${state.path}/sites/${encodeURIComponent(title)}`, { lat_ms: time ? Number(time) : null, view_a: a.value || null, view_b: b.value || null });
    announce(`Site ${title} is saved.`);
    await state.load();
  });
  const remarks = [...(site?.missing ?? []).map((code) => `lacks ${missingWords(code)}`), ...(site?.warnings ?? []).map(warningWords)];
  const how = element("span", { class: `badge ${guess ? "guess" : site?.ready ? "ready" : ""}` }, site ? boundByWords(site.bound_by) || "no runs" : "");
  return element("tr", { "data-site": site?.site ?? "" },
    element("td", {}, site_), element("td", {}, lat), element("td", {}, a), element("td", {}, b),
    element("td", { class: "figure" }, site?.angle_deg === null || !site ? "–" : `${site.angle_deg.toFixed(0)}°`),
    element("td", {}, how, " ", element("span", { class: "soft" }, listed(remarks))),
    element("td", {}, button(guess && site?.site ? "Confirm" : "Save", save, { "aria-label": `${guess && site?.site ? "Confirm" : "Save"} ${name}` })));
}

/** @param {StudyState} state */
async function confirmAll(state) {
  for (const site of state.sites.filter((each) => each.site !== null && isGuess(each.bound_by))) {
    await send("PUT", `${state.path}/sites/${encodeURIComponent(site.site ?? "")}`, { view_a: site.view_a, view_b: site.view_b });
  }
  await state.load();
  announce("All pairs are confirmed.");
}

/** @param {StudyState} state */
export function sitesTable(state) {
  const guesses = state.sites.filter((site) => site.site !== null && isGuess(site.bound_by));
  const body = element("tbody", {}, ...state.sites.map((site) => row(state, site)));
  return element("section", { class: "card" },
    element("h2", {}, "Sites"),
    guesses.length ? element("p", {}, element("span", { class: "badge guess" }, "guess"), ` The service guessed the runs of ${guesses.length} sites. Look at them, then `,
      button("Confirm all guesses", () => attempt(() => confirmAll(state)))) : null,
    element("div", { class: "wide", tabIndex: 0, role: "region", "aria-label": "Sites" }, element("table", {},
      element("thead", {}, element("tr", {}, ...["Site", "Time, ms", "View a", "View b", "Angle", "Runs found by", "Action"].map((title) => element("th", { scope: "col" }, title)))),
      body)),
    button("Add a site", () => body.append(row(state, null))));
}
