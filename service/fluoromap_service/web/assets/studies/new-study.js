/** The form of a new study, with its catheters from the catalogue of types or typed in. */
import { send } from "../shared/api.js";
import { attempt, button, element, field, select } from "../shared/elements.js";

const TYPED_IN = "";
const DEFAULTS = [["reference", "quadripolar-2-5-2"], ["pacing", "quadripolar-2-5-2"], ["mapping", "ablation-4"]];

/** @param {string} text */
const numbers = (text) => text.split(/[\s;]+|,(?!\d)|-/).filter(Boolean).map((each) => Number(each.replace(",", ".")));

/**
 * @param {{name: string, electrodes: number, edge_spacing_mm: number[], tip_mm: number}[]} types
 * @param {string} name
 * @param {string} type
 */
function catheterRow(types, name, type) {
  /** @type {[string, string][]} */
  const choices = types.map((each) => [each.name, `${each.name} (${each.electrodes} electrodes, tip ${each.tip_mm} mm)`]);
  choices.push([TYPED_IN, "other: type it in"]);
  const nameInput = element("input", { value: name, required: true, maxLength: 64 });
  const typeInput = select(choices, type);
  const electrodes = element("input", { type: "number", min: 2, max: 20, value: 4 });
  const gaps = element("input", { placeholder: "2 5 2" });
  const tip = element("input", { type: "number", step: "any", min: 0.1, value: 2 });
  const ring = element("input", { type: "number", step: "any", min: 0.1, value: 1 });
  const lengths = element("div", { class: "fields", hidden: type !== TYPED_IN },
    field("Electrodes", electrodes), field("Gaps from the tip on, mm", gaps, "from edge to edge, for example 2 5 2"),
    field("Tip length, mm", tip), field("Ring length, mm", ring));
  typeInput.addEventListener("change", () => (lengths.hidden = typeInput.value !== TYPED_IN));
  const row = element("fieldset", { class: "catheter" }, element("legend", {}, "Catheter"),
    element("div", { class: "fields" }, field("Name", nameInput), field("Type", typeInput),
      button("Remove", () => row.remove(), { class: "quiet" })), lengths);
  row.value = () =>
    typeInput.value !== TYPED_IN
      ? { name: nameInput.value, type: typeInput.value }
      : { name: nameInput.value, electrodes: Number(electrodes.value), edge_spacing_mm: numbers(gaps.value), tip_mm: Number(tip.value), ring_mm: Number(ring.value) };
  return row;
}

/** @param {any[]} types Answer of `GET /v1/catheter-types`. */
export function newStudyForm(types) {
  const label = element("input", { required: true, maxLength: 200, id: "label" });
  const chamber = element("input", { maxLength: 100 });
  const rows = element("div", {}, ...DEFAULTS.map(([name, type]) => catheterRow(types, name ?? "", type ?? TYPED_IN)));
  const add = button("Add a catheter", () => rows.append(catheterRow(types, "", TYPED_IN)));
  const create = async () => {
    const catheters = [...rows.children].map((row) => row.value());
    const study = await send("POST", "/v1/studies", { label: label.value, chamber: chamber.value || null, catheters });
    location.assign(`/studies/${study.id}`);
  };
  return element(
    "form",
    { onsubmit: (/** @type {Event} */ event) => { event.preventDefault(); attempt(create); } },
    element("div", { class: "fields" }, field("Name of the study", label, "No patient name."), field("Chamber", chamber, "For example right ventricle.")),
    element("p", { class: "soft" }, "The catheter named reference stays where it is; all positions count from it. With one catheter only, positions count from the isocentre and a moved table would not be noticed. The catheter named mapping is the moving tip."),
    rows,
    element("div", { class: "row" }, add, element("button", { type: "submit", class: "main" }, "Create the study")),
  );
}
