/** Forms of plugins' parameters, made from their JSON schema. */
import { element, field, select } from "../shared/elements.js";

/**
 * @param {any} schema JSON schema of the parameters.
 * @returns {HTMLElement & {value: () => Record<string, unknown>}} `value` returns the parameters that differ from their default.
 */
export function parameterForm(schema) {
  /** @type {[string, any, any][]} */
  const inputs = [];
  const fields = Object.entries(schema?.properties ?? {}).map(([name, given]) => {
    const property = resolved(schema, given);
    const input = control(property);
    inputs.push([name, property, input]);
    return field(property.title ?? name, input, property.description);
  });
  const form = element("div", { class: "fields" }, ...(fields.length ? fields : [element("span", { class: "soft" }, "no parameters")]));
  form.value = () => Object.fromEntries(inputs.filter(([, property, input]) => changed(property, input)).map(([name, property, input]) => [name, read(property, input)]));
  return form;
}

/** A property without reference and without the alternative null. @param {any} schema @param {any} property @returns {any} */
function resolved(schema, property) {
  const parts = property.anyOf?.filter((/** @type {any} */ each) => each.type !== "null") ?? property.allOf ?? [];
  const inner = property.$ref ? schema.$defs?.[property.$ref.split("/").pop()] : parts.length ? resolved(schema, parts[0]) : null;
  return { ...inner, ...property };
}

/** @param {any} property */
function control(property) {
  if (property.enum) return select(property.enum.map((/** @type {any} */ each) => [String(each), String(each)]), String(property.default ?? property.enum[0]));
  if (property.type === "boolean") return element("input", { type: "checkbox", checked: property.default === true });
  const bounds = { min: property.minimum ?? property.exclusiveMinimum, max: property.maximum ?? property.exclusiveMaximum };
  if (property.type === "integer" || property.type === "number") {
    return element("input", { type: "number", step: property.type === "integer" ? 1 : "any", value: property.default ?? "", placeholder: "automatic", ...bounds });
  }
  return element("input", { value: property.default === undefined || property.default === null ? "" : JSON.stringify(property.default) });
}

/** @param {any} property @param {any} input */
function changed(property, input) {
  if (property.type === "boolean") return input.checked !== (property.default === true);
  if (property.type === "integer" || property.type === "number") return input.value !== String(property.default ?? "");
  if (property.enum) return input.value !== String(property.default ?? property.enum[0]);
  return input.value !== (property.default === undefined || property.default === null ? "" : JSON.stringify(property.default));
}

/** @param {any} property @param {any} input */
function read(property, input) {
  if (property.type === "boolean") return input.checked;
  if (property.type === "integer" || property.type === "number") return input.value === "" ? null : Number(input.value);
  if (property.enum) return property.enum.find((/** @type {any} */ each) => String(each) === input.value);
  try {
    return JSON.parse(input.value);
  } catch {
    return input.value;
  }
}
