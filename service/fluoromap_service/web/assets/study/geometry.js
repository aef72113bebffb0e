/** The form of the gantry's geometry, for the whole study or for one run. */
import { send } from "../shared/api.js";
import { announce, attempt, element, field, select } from "../shared/elements.js";
import { KEYWORDS, listed, tableWords } from "../shared/words.js";
import { runLabel } from "./sites.js";

/** @typedef {import("./page.js").StudyState} StudyState */

const STUDY = "";
/** @type {[string, string, string][]} Field, label, hint. */
const FIELDS = [
  ["primary_deg", "Primary angle, °", "LAO positive, RAO negative"],
  ["secondary_deg", "Secondary angle, °", "cranial positive, caudal negative"],
  ["source_detector_mm", "Source to detector, mm", "SID, often 900 to 1200"],
  ["source_isocentre_mm", "Source to isocentre, mm", "SOD, often 700 to 800"],
  ["pixel_spacing_mm", "Pixel spacing at the detector, mm", "for example 0.3"],
];

/** @param {StudyState} state */
export function geometryForm(state) {
  const open = state.runs.filter((run) => run.missing.length);
  /** @type {[string, string][]} */
  const targets = [[STUDY, "the whole study: runs whose files lack the value"]];
  state.runs.forEach((run, index) => targets.push([run.sop_instance_uid, `${runLabel(run, index)}${run.missing.length ? " (incomplete)" : ""}`]));
  const target = select(targets, STUDY, { id: "geometry-of" });
  const inputs = FIELDS.map(([name]) => element("input", { name, inputMode: "decimal" }));
  const lacks = element("p", { class: "soft" });
  const table = element("p", { class: "soft" });

  const fill = () => {
    const run = state.runs.find((each) => each.sop_instance_uid === target.value);
    /** @type {any} */
    const gantry = run?.gantry ?? state.study.gantry;
    FIELDS.forEach(([name], index) => {
      const value = gantry[name];
      inputs[index].value = value === null || value === undefined ? "" : Array.isArray(value) ? value[0] : value;
    });
    table.hidden = !run;
    table.textContent = run ? tableWords(run.gantry) : "";
    const missing = run ? run.missing : [...new Set(open.flatMap((each) => each.missing))];
    lacks.textContent = missing.length ? `Missing: ${listed(missing.map((keyword) => KEYWORDS[keyword] ?? keyword))}.` : "Nothing is missing.";
  };
  const save = async () => {
    /** @type {Record<string, number|number[]>} */
    const gantry = {};
    const run = state.runs.find((each) => each.sop_instance_uid === target.value);
    FIELDS.forEach(([name, label], index) => {
      const text = inputs[index].value.trim().replace("−", "-").replace(",", ".");
      if (!text) return;
      const value = Number(text);
      if (!Number.isFinite(value)) throw new Error(`${label}: "${text}" is no number.`);
      const before = /** @type {any} */ (run?.gantry ?? {})[name];
      // A value of the header that nobody changed stays the header's.
      if ((Array.isArray(before) ? before[0] : before) !== value) gantry[name] = name === "pixel_spacing_mm" ? [value, value] : value;
    });
    await send("PATCH", run ? `${state.path}/instances/${run.sop_instance_uid}` : state.path, { gantry });
    announce("The geometry is saved.");
    await state.load();
  };
  target.addEventListener("change", fill);
  fill();
  return element("details", { class: "card", open: open.length > 0 }, element("summary", {}, "Geometry"),
    element("form", { onsubmit: (/** @type {Event} */ event) => { event.preventDefault(); attempt(save); } },
      element("p", {}, "The position of source and detector. The service reads it from the files; complete what they lack. It is on the console of the X-ray system."),
      field("Geometry of", target), lacks,
      element("div", { class: "fields" }, ...FIELDS.map(([, label, hint], index) => field(label, inputs[index], hint))),
      table,
      element("button", { type: "submit", class: "main" }, "Save the geometry")));
}
