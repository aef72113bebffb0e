/** Making elements of a page. Text is always set as text, so no answer of the service can become markup. */

/**
 * @param {string} tag
 * @param {Record<string, any>} [properties] `class`, `data-*` and `aria-*` become attributes, `on...` listeners.
 * @param {...(Node|string|number|null|undefined|false)} children
 * @returns {any}
 */
export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made && !name.startsWith("aria-")) /** @type {any} */ (made)[name] = value;
    else made.setAttribute(name, String(value));
  }
  for (const child of children) if (child !== null && child !== undefined && child !== false) made.append(String(child) === child || typeof child === "number" ? String(child) : /** @type {Node} */ (child));
  return made;
}

/** @param {string} id @returns {any} */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no element ${id}`);
  return found;
}

/**
 * A labelled field of a form.
 *
 * @param {string} label
 * @param {HTMLElement} control
 * @param {string} [hint]
 */
export function field(label, control, hint) {
  return element("label", { class: "field" }, element("span", {}, label), control, hint && element("small", {}, hint));
}

/**
 * @param {[string, string][]} choices Values and their labels.
 * @param {string} value
 * @param {Record<string, any>} [properties]
 * @returns {HTMLSelectElement}
 */
export function select(choices, value, properties = {}) {
  const made = element("select", properties);
  for (const [each, label] of choices) made.append(element("option", { value: each, selected: each === value }, label));
  made.value = value;
  return made;
}

/** @param {string} label @param {(event: Event) => void} act @param {Record<string, any>} [properties] @returns {HTMLButtonElement} */
export function button(label, act, properties = {}) {
  return element("button", { type: "button", onclick: act, ...properties }, label);
}

/** Say something to people who see the page and to those who hear it. @param {unknown} message @param {"problem"|"done"} [kind] */
export function announce(message, kind = "done") {
  const text = message instanceof Error ? message.message : String(message);
  const place = byId("message");
  const close = button("Close", () => place.replaceChildren(), { class: "quiet" });
  place.replaceChildren(element("p", { class: `notice ${kind}` }, text, " ", close));
}

/** Take the message away: it belongs to a step that nobody sees any more. */
export const clearMessage = () => byId("message").replaceChildren();

/** Do something that may fail, and show the failure. @template T @param {() => Promise<T>} act @returns {Promise<T|undefined>} */
export async function attempt(act) {
  try {
    return await act();
  } catch (error) {
    announce(error, "problem");
    return undefined;
  }
}
