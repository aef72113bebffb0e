/** The API's own page, made from the OpenAPI document of the service; it needs no network. */
import { get } from "../shared/api.js";
import { attempt, byId, element } from "../shared/elements.js";
import { header } from "../shared/header.js";

/** @param {any} schema @returns {string} */
function typeOf(schema) {
  if (!schema) return "";
  if (schema.$ref) return schema.$ref.split("/").pop();
  if (schema.enum) return schema.enum.join(" | ");
  if (schema.const !== undefined) return String(schema.const);
  if (schema.anyOf) return schema.anyOf.map(typeOf).join(" | ");
  if (schema.type === "array") return `list of ${typeOf(schema.items) || "values"}`;
  return schema.type ?? "";
}

/** @param {any[]} rows @param {string[]} titles */
function table(rows, titles) {
  if (!rows.length) return null;
  return element("div", { class: "wide" }, element("table", {}, element("thead", {}, element("tr", {}, ...titles.map((title) => element("th", { scope: "col" }, title)))),
    element("tbody", {}, ...rows.map((cells) => element("tr", {}, ...cells.map((/** @type {any} */ cell) => element("td", {}, cell ?? "")))))));
}

/** @param {any} content @returns {Node[]} */
const bodies = (content) => Object.entries(content ?? {}).map(([type, form]) => element("div", {}, element("code", {}, type), " ", reference(/** @type {any} */ (form).schema)));

/** @param {any} schema */
function reference(schema) {
  const name = typeOf(schema);
  const target = schema?.$ref ?? schema?.items?.$ref;
  return target ? element("a", { href: `#schema-${target.split("/").pop()}` }, name) : name;
}

/** @param {string} path @param {string} method @param {any} operation */
function operationOf(path, method, operation) {
  const parameters = (operation.parameters ?? []).map((/** @type {any} */ each) => [element("code", {}, each.name), each.in, typeOf(each.schema), each.required ? "yes" : "", each.description]);
  const answers = Object.entries(operation.responses ?? {}).map(([status, answer]) => [status, /** @type {any} */ (answer).description, element("div", {}, ...bodies(/** @type {any} */ (answer).content))]);
  return element("details", { class: "card" },
    element("summary", {}, element("code", {}, `${method.toUpperCase()} ${path}`), ` – ${operation.summary ?? ""}`),
    element("p", {}, operation.description ?? ""), table(parameters, ["Parameter", "In", "Type", "Required", "Meaning"]),
    operation.requestBody ? element("div", {}, element("h4", {}, "Body"), ...bodies(operation.requestBody.content)) : null,
    element("h4", {}, "Answers"), table(answers, ["Status", "Meaning", "Content"]));
}

/** @param {string} name @param {any} schema */
function schemaOf(name, schema) {
  const required = new Set(schema.required ?? []);
  const rows = Object.entries(schema.properties ?? {}).map(([field, property]) => [element("code", {}, field), reference(property), required.has(field) ? "yes" : "", /** @type {any} */ (property).description]);
  return element("details", { class: "card", id: `schema-${name}` }, element("summary", {}, name), element("p", {}, schema.description ?? ""),
    schema.enum ? element("p", {}, schema.enum.join(", ")) : null, table(rows, ["Field", "Type", "Required", "Meaning"]));
}

byId("top").append(header());
await attempt(async () => {
  const document_ = await get("/v1/openapi.json");
  byId("title").textContent = `The API of ${document_.info.title}`;
  const groups = new Map();
  for (const [path, methods] of Object.entries(document_.paths)) {
    for (const [method, operation] of Object.entries(/** @type {any} */ (methods))) {
      const tag = /** @type {any} */ (operation).tags?.[0] ?? "service";
      if (!groups.has(tag)) groups.set(tag, []);
      groups.get(tag).push(operationOf(path, method, operation));
    }
  }
  byId("content").append(
    element("p", {}, document_.info.summary ?? "", " The document for programs: ", element("a", { href: "/v1/openapi.json" }, "openapi.json"), "."),
    ...[...groups].flatMap(([tag, operations]) => [element("h2", {}, tag), ...operations]),
    element("h2", {}, "Shapes"), ...Object.entries(document_.components.schemas).map(([name, schema]) => schemaOf(name, schema)));
});
addEventListener("hashchange", () => {
  const target = document.getElementById(location.hash.slice(1));
  if (target instanceof HTMLDetailsElement) target.open = true;
});
document.body.dataset.ready = "yes";
