/** Tabs by the pattern of the WAI-ARIA authoring practices; a panel is made when it is first shown. */
import { clearMessage, element } from "../shared/elements.js";

/**
 * @param {HTMLElement} place
 * @param {[string, string, () => HTMLElement][]} panels Name in the address, title, and the maker of the content.
 * @returns {(name: string) => void} Shows a panel.
 */
export function tabs(place, panels) {
  const list = element("div", { role: "tablist", "aria-label": "Steps" });
  /** @type {Map<string, {tab: HTMLElement, panel: HTMLElement, make: (() => HTMLElement)|null}>} */
  const entries = new Map();
  for (const [name, title, make] of panels) {
    const tab = element("button", { role: "tab", id: `tab-${name}`, type: "button", "aria-controls": `panel-${name}`, onclick: () => show(name) }, title);
    const panel = element("section", { role: "tabpanel", id: `panel-${name}`, "aria-labelledby": `tab-${name}`, hidden: true });
    entries.set(name, { tab, panel, make });
    list.append(tab);
  }
  place.append(list, ...[...entries.values()].map((entry) => entry.panel));

  /** @param {string} name */
  function show(name) {
    if (entries.get(name)?.panel.hidden) clearMessage();
    for (const [each, entry] of entries) {
      const chosen = each === name;
      entry.tab.setAttribute("aria-selected", String(chosen));
      entry.tab.tabIndex = chosen ? 0 : -1;
      entry.panel.hidden = !chosen;
      if (chosen && entry.make) {
        entry.panel.append(entry.make());
        entry.make = null;
      }
      if (chosen) entry.panel.dispatchEvent(new Event("shown"));
    }
    history.replaceState(null, "", `#${name}`);
  }

  list.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const names = [...entries.keys()];
    const at = names.findIndex((name) => entries.get(name)?.tab === document.activeElement);
    const next = names[(at + step + names.length) % names.length] ?? "";
    show(next);
    entries.get(next)?.tab.focus();
    event.preventDefault();
  });
  addEventListener("hashchange", () => entries.has(location.hash.slice(1)) && show(location.hash.slice(1)));
  const wanted = location.hash.slice(1);
  show(entries.has(wanted) ? wanted : (panels[0]?.[0] ?? ""));
  return show;
}
