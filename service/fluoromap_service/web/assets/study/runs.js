/** The first step: runs, sites, activation times, and the values that are missing. */
import { attempt, button, element } from "../shared/elements.js";
import { KEYWORDS, listed, missingWords } from "../shared/words.js";
import { geometryForm } from "./geometry.js";
import { sitesTable } from "./sites.js";
import { uploadZone } from "./uploads.js";

/** @typedef {import("./page.js").StudyState} StudyState */

/** Say in words what a computation still lacks. @param {StudyState} state */
function sentences(state) {
  if (!state.runs.length) return ["This study has no runs yet. Drop its DICOM files and the table of its activation times into the box.",
    "To try it without data, type ./run fluoromap simulate study in a second terminal, in the folder of the program. Then drop the new folder study into the box."];
  const ready = state.sites.filter((site) => site.ready && site.site !== null).length;
  const lines = [state.sites.length ? `${ready} of ${state.sites.length} sites are ready for the computation.`
    : "No runs are paired to a site yet. Complete their angles, or add a site and choose its two runs."];
  if (state.sites.length && state.sites.every((site) => site.lat_ms === null)) {
    lines.push("The activation times are missing. Drop their table into the box, or type names and times below.");
  }
  const open = state.runs.filter((run) => run.missing.length);
  if (open.length) {
    const values = [...new Set(open.flatMap((run) => run.missing))].map((keyword) => KEYWORDS[keyword] ?? keyword);
    lines.push(`${open.length} of ${state.runs.length} runs lack geometry: ${listed(values)}. Complete it under "Geometry".`);
  }
  for (const site of state.sites.filter((each) => each.missing.length).slice(0, 8)) {
    const own = site.missing.filter((code) => !code.startsWith("gantry"));
    if (own.length) lines.push(`${site.site === null ? `Pair ${site.pair}` : `Site ${site.site}`} lacks ${listed(own.map(missingWords))}.`);
  }
  return lines;
}

/** Make a part anew, but not under the fingers of a person who types; the focus stays on the same control. @param {HTMLElement} place @param {() => Node} make */
function refill(place, make) {
  const focused = place.contains(document.activeElement) ? document.activeElement : null;
  if (focused instanceof HTMLInputElement && place.children.length) return;
  const name = focused?.getAttribute("aria-label") ?? focused?.textContent;
  place.replaceChildren(make());
  if (!name) return;
  const again = [...place.querySelectorAll("button, select")].find((each) => (each.getAttribute("aria-label") ?? each.textContent) === name);
  if (again instanceof HTMLElement) again.focus();
}

/** @param {StudyState} state @param {() => void} look @param {() => void} compute */
export function runsPanel(state, look, compute) {
  const summary = element("ul", { "aria-live": "polite" });
  const table = element("div", {});
  const geometry = element("div", {});
  let loading = false;
  const reload = () => {
    if (loading) return;
    loading = true;
    attempt(async () => {
      // Files often arrive together: one reload serves all of them.
      await new Promise((resolve) => setTimeout(resolve, 150));
      loading = false;
      await state.load();
    });
  };
  const goOn = button("Go on to the computation", compute, { class: "main" });
  const show = () => {
    goOn.disabled = !state.sites.some((site) => site.ready && site.site !== null);
    const isEmpty = !state.runs.length && !state.sites.length;
    table.hidden = geometry.hidden = isEmpty;
    summary.replaceChildren(...sentences(state).map((line) => element("li", {}, line)));
    refill(table, () => sitesTable(state));
    refill(geometry, () => geometryForm(state));
  };
  state.addEventListener("changed", show);
  show();
  return element("div", {},
    uploadZone(state.path, reload), element("h2", {}, "What is missing"), summary,
    element("div", { class: "row" }, button("Look at the runs", look), goOn),
    table, geometry);
}
