/** The second step: both views of a site side by side, and the tools that correct electrodes. */
import { get } from "../shared/api.js";
import { catheterColour } from "../shared/catheter-colours.js";
import { attempt, button, element, field, select } from "../shared/elements.js";
import { KEYS, listenToKeys } from "./keys.js";
import { Pen } from "./pen.js";
import { listenToPointer } from "./pointer.js";
import { View } from "./view.js";

/** @typedef {import("../study/page.js").StudyState} StudyState */

/** @type {[import("./pen.js").Tool, string][]} */
const TOOLS = [["edit", "Move electrodes"], ["add", "Add an electrode"], ["mark", "Mark from the tip"], ["contrast", "Contrast"], ["pan", "Move picture"]];

/** @param {StudyState} state @param {() => void} compute */
export function viewerPanel(state, compute) {
  const names = () => state.study.catheters.map((each) => each.name);
  const pen = new Pen(state.study);
  /** @type {View[]} */
  let views = [];
  let active = 0;
  /** @type {Map<string, number>} Run -> the frame that the newest map uses. */
  let mapFrames = new Map();
  let framesOf = "";
  /** @type {Map<string, string[]>} Site that the newest job could not locate -> reasons. */
  let lost = new Map();
  const problem = element("p", { class: "notice problem", hidden: true });
  const place = element("div", { class: "views" });
  const hint = element("p", { class: "soft hint", "aria-live": "polite" });
  const site = select([], "", { "aria-label": "Site" });
  const catheter = select([], "", {});
  const legend = element("p", { class: "row" });
  const tools = TOOLS.map(([name, label]) => button(label, () => pen.take({ tool: name }), { "data-tool": name }));

  const showPen = () => {
    const { catheter: name, count, next, tool } = pen;
    for (const each of tools) each.setAttribute("aria-pressed", String(each.dataset["tool"] === tool));
    catheter.value = name;
    hint.textContent = {
      edit: "Drag an electrode to move it; click it and press Delete to remove it. Circle: found by the service. Square: set by hand. A change counts from this frame on: the next computation tracks the run again from here. A change in the frame \"used for the map\" moves the map most.",
      add: `Click the place of an electrode that the catheter "${name}" lacks in this frame. Without a mouse: arrows move the cross, Enter sets the electrode. Esc ends.`,
      mark: `Click electrode ${next} of ${count} of the catheter "${name}"${next === 1 ? ", which is its tip" : ""}. The wheel zooms. Without a mouse: arrows move the cross, Enter sets the electrode. Esc ends.`,
      contrast: "Drag left and right for the width, up and down for the centre of the grey levels.",
      pan: "Drag to move the picture; the wheel zooms.",
    }[tool];
  };
  const trackAgain = () => attempt(async () => {
    if (await current()?.confirm()) compute();
  });

  /** Draw the line of the chosen electrode in the other view. @param {View} from @param {View} other @param {any} electrode */
  const showLine = async (from, other, electrode) => {
    const wanted = from.chosen;
    other.line = null;
    other.draw();
    if (!electrode) return;
    try {
      const query = `other=${other.run.sop_instance_uid}&u_px=${electrode.u_px.toFixed(2)}&v_px=${electrode.v_px.toFixed(2)}`;
      const line = await get(`${state.path}/instances/${from.run.sop_instance_uid}/epipolar-line?${query}`);
      if (from.chosen !== wanted) return;
      other.line = { start: line.start_px, end: line.end_px, colour: catheterColour(names(), electrode.catheter) };
      other.draw();
    } catch {
      // Without geometry there is no line; the first step says what is missing.
    }
  };

  /** @param {import("../shared/types.js").Site} each */
  const siteLabel = (each) => (each.site ? `site ${each.site}${lost.has(each.site) ? ", not located" : ""}` : `pair ${each.pair}`);

  const loadMapFrames = async () => {
    const job = state.finished;
    if (!job || job.id === framesOf) return;
    framesOf = job.id;
    const points = await state.points(job.id);
    const tips = await state.tips(job.id);
    lost = new Map(tips.filter((tip) => tip.grade === "rejected").map((tip) => [tip.site, tip.reasons]));
    mapFrames = new Map(points.flatMap(({ views: { a, b } }) => [a, b].flatMap((each) => (each?.frame ? [[each.sop_instance_uid, each.frame]] : []))));
    for (const view of views) view.setMapFrame(mapFrames.get(view.run.sop_instance_uid) ?? null);
    state.sites.forEach((each, index) => { if (site.options[index]) site.options[index].textContent = siteLabel(each); });
    await explain();
  };

  /** Say why the chosen site is not located. */
  const explain = async () => {
    const reasons = lost.get(state.chosen ?? "");
    problem.hidden = !reasons;
    if (!reasons) return;
    const sentences = await state.sentences();
    problem.textContent = [`Site ${state.chosen} is not located.`, ...reasons.map((code) => sentences.get(code) ?? code), "Any frame serves in which the whole catheter is seen clearly."].join(" ");
  };

  const open = () => {
    for (const view of views) view.close();
    const chosen = state.sites[Number(site.value)];
    const uids = chosen ? [chosen.view_a, chosen.view_b] : [];
    const loose = Number(site.value) < 0 ? [state.runs[-1 - Number(site.value)]?.sop_instance_uid ?? null] : [];
    const wanted = [...uids, ...loose];
    views = wanted.flatMap((uid, index) => {
      const run = state.runs.find((each) => each.sop_instance_uid === uid);
      return run ? [new View(index === 0 ? "a" : "b", state, run, pen)] : [];
    });
    views.forEach((view, index) => {
      view.setMapFrame(mapFrames.get(view.run.sop_instance_uid) ?? null);
      listenToPointer(view);
      listenToKeys(view, trackAgain);
      view.canvas.addEventListener("focus", () => (active = index));
      const other = views[1 - index];
      if (other) view.addEventListener("chosen", (event) => showLine(view, other, /** @type {CustomEvent} */ (event).detail));
    });
    active = 0;
    place.replaceChildren(...views.map((view) => view.element));
    if (!views.length) place.replaceChildren(element("p", { class: "card" }, "There is nothing to look at yet. Drop runs into the first step."));
    state.choose(chosen?.site ?? null);
    attempt(explain);
  };

  const fill = () => {
    attempt(loadMapFrames);
    const choicesOfPen = state.study.catheters.map((each) => /** @type {[string, string]} */ ([each.name, `${each.name} (${each.electrodes})`]));
    catheter.replaceChildren(...select(choicesOfPen, pen.catheter).children);
    legend.replaceChildren(...state.study.catheters.map((each) => {
      const swatch = element("span", { class: "swatch" });
      swatch.style.background = catheterColour(names(), each.name);
      return element("span", {}, swatch, each.name);
    }));
    const bound = new Set(state.sites.flatMap((each) => [each.view_a, each.view_b]));
    /** @type {[string, string][]} */
    const choices = state.sites.map((each, index) => [String(index), siteLabel(each)]);
    state.runs.forEach((run, index) => bound.has(run.sop_instance_uid) || choices.push([String(-1 - index), `run ${index + 1} without site`]));
    const wanted = state.sites.findIndex((each) => each.site !== null && each.site === state.chosen);
    const before = site.value || (wanted < 0 ? "" : String(wanted));
    site.replaceChildren(...select(choices, "").children);
    site.value = choices.some(([value]) => value === before) ? before : (choices[0]?.[0] ?? "");
    const now = [state.sites[Number(site.value)]?.view_a, state.sites[Number(site.value)]?.view_b].filter(Boolean).join();
    if (!views.length || site.value !== before || now !== views.map((view) => view.run.sop_instance_uid).join()) open();
  };

  site.addEventListener("change", open);
  catheter.addEventListener("change", () => pen.take({ catheter: catheter.value }));
  pen.addEventListener("changed", showPen);
  state.addEventListener("changed", fill);
  state.addEventListener("job", () => views.forEach((view) => attempt(() => view.marks.load())));
  state.addEventListener("chosen", () => {
    const index = state.sites.findIndex((each) => each.site !== null && each.site === state.chosen);
    if (index >= 0 && String(index) !== site.value) { site.value = String(index); open(); }
  });
  const current = () => views[active];
  fill();
  showPen();
  const keys = element("dl", { class: "keys" }, ...KEYS.flatMap(([key, act]) => [element("dt", {}, key), element("dd", {}, act)]));
  const help = element("details", {}, element("summary", {}, "Keys: everything works without a mouse"),
    element("p", {}, "Go to a picture with Tab. Choose an electrode with N, move it with Shift and the arrows, then press T to compute with it."),
    element("p", { class: "soft" }, "After a computation, a frame with electrodes set by hand shows only their catheters. The other frames show all."), keys);
  place.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => { if (event.key.toLowerCase() === "h") help.open = !help.open; });
  return element("div", {},
    element("div", { class: "tools" }, element("div", { class: "fields" }, field("Site", site), field("Catheter to mark", catheter),
      element("div", { class: "row", role: "group", "aria-label": "Tool" }, ...tools),
      button("Delete", () => current()?.removeChosen(), { title: "Delete the chosen electrode: click it first" }),
      button("Undo", () => current()?.step(-1)), button("Redo", () => current()?.step(1)),
      button("Automatic again", () => current()?.resetFrame(), { title: "Forget the electrodes set by hand in this frame" }),
      button("Track again from here", trackAgain, { title: "The catheter is right in this frame: follow it through the run from here, and compute the map" }),
      button("Compute the map again", compute, { class: "main" })), hint),
    problem, legend, place, help);
}
