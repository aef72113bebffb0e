/** The third step: start a computation, follow it, cancel it, and read why something failed. */
import { get, send } from "../shared/api.js";
import { announce, attempt, button, element, field, select } from "../shared/elements.js";
import { JOB_STATES, STAGES } from "../shared/words.js";
import { follow } from "./follow.js";
import { parameterForm } from "./plugin-form.js";

/** @typedef {import("../shared/types.js").Job} Job */
/** @typedef {import("../study/page.js").StudyState} StudyState */

/** @type {[string, string][]} */
const KINDS = [["segmenter", "Find electrodes"], ["triangulator", "Locate in 3D"], ["fuser", "Make the map"], ["monoplane", "Track one view"]];
const ENDED = ["done", "failed"];

/** @param {Job} job */
function progressOf(job) {
  const names = [...new Set(job.stages.map((stage) => stage.name))];
  return names.map((name) => {
    const own = job.stages.filter((stage) => stage.name === name);
    const done = own.reduce((sum, stage) => sum + (ENDED.includes(stage.state) ? 1 : stage.progress), 0) / own.length;
    const failed = own.filter((stage) => stage.state === "failed").length;
    const reused = own.filter((stage) => stage.reused).length;
    const cancelled = own.filter((stage) => stage.state === "cancelled").length;
    const remarks = [failed && `${failed} failed`, cancelled && `${cancelled} cancelled`, reused && `${reused} unchanged, not computed again`].filter(Boolean).join("; ");
    return element("div", { class: "stage" }, element("span", {}, `${STAGES[name] ?? name}: ${Math.round(100 * done)} %`, remarks && ` (${remarks})`),
      element("progress", { max: 1, value: done, "aria-label": STAGES[name] ?? name }));
  });
}

/** @param {StudyState} state @param {Job} job */
function problemsOf(state, job) {
  const failed = job.stages.filter((stage) => stage.error);
  const lines = failed.map((stage) => {
    const index = state.runs.findIndex((run) => run.sop_instance_uid === stage.subject);
    const where = index >= 0 ? `run ${index + 1}` : stage.subject === state.study.id ? "the study" : `site ${stage.subject}`;
    return element("li", {}, `${STAGES[stage.name] ?? stage.name}, ${where}: ${stage.error?.detail ?? ""}`);
  });
  if (job.error) lines.unshift(element("li", {}, element("strong", {}, job.error.detail)));
  return lines.length ? element("ul", { class: "notice problem" }, ...lines) : null;
}

/** Whether a running job has its map: tracks of single views follow. @param {Job} job */
const hasMap = (job) => job.stages.some((stage) => stage.name === "fuse" && stage.state === "done");

/** @param {StudyState} state @param {() => void} showMap */
export function jobPanel(state, showMap) {
  const view = select([["both", "both views"], ["a", "view a only"], ["b", "view b only"]], "both");
  /** @type {Record<string, {plugin: HTMLSelectElement, form: any}>} */
  const chosen = {};
  const plugins = element("div", {});
  const current = element("div", { "aria-live": "polite" });
  const start = element("button", { type: "button", class: "main", onclick: () => attempt(() => run()) }, "Compute the map");

  attempt(async () => {
    const all = await get("/v1/plugins");
    for (const [kind, title] of KINDS) {
      const own = all.filter((/** @type {any} */ each) => each.kind === kind && each.error === null);
      const plugin = select(own.map((/** @type {any} */ each) => [each.name, `${each.name} ${each.version}${each.default ? " (usual)" : ""}`]), own.find((/** @type {any} */ each) => each.default)?.name ?? "");
      const place = element("div", {});
      const entry = { plugin, form: parameterForm(null) };
      const show = () => place.replaceChildren((entry.form = parameterForm(own.find((/** @type {any} */ each) => each.name === plugin.value)?.parameters)));
      plugin.addEventListener("change", show);
      show();
      chosen[kind] = entry;
      plugins.append(element("fieldset", {}, element("legend", {}, title), field("Method", plugin), place));
    }
  });

  /** @param {Job} job */
  const show = (job) => {
    const running = job.state === "queued" || job.state === "running";
    const cancel = button("Cancel", () => attempt(() => send("POST", `/v1/jobs/${job.id}:cancel`)), { disabled: !running });
    const problems = problemsOf(state, job);
    current.replaceChildren(
      element("div", { class: "card", "data-job": job.state },
        element("div", { class: "row" }, element("h2", {}, `Computation: ${JOB_STATES[job.state] ?? job.state}`), element("span", { class: "grow" }), running ? cancel : null,
          job.state === "succeeded" || (running && hasMap(job)) ? button("Show the map", showMap, { class: "main" }) : null),
        ...progressOf(job)));
    if (problems) current.append(problems);
  };
  /** @param {Job} job @param {boolean} showsMap Whether the page goes on to the map as soon as there is one. */
  const watch = async (job, showsMap) => {
    start.disabled = true;
    show(job);
    const ended = await follow(job, (news) => {
      show(news);
      if (state.mapped?.id === news.id || !hasMap(news)) return;
      state.takeMap(news);
      if (showsMap) showMap();
    });
    start.disabled = false;
    state.mapped = null;
    await state.load();
    show(ended);
    state.dispatchEvent(new Event("job"));
    announce(`The computation has ended: ${JOB_STATES[ended.state] ?? ended.state}.`, ended.state === "failed" ? "problem" : "done");
  };
  const run = async (showsMap = false) => {
    const pipeline = Object.fromEntries(Object.entries(chosen).map(([kind, entry]) => [kind, { name: entry.plugin.value, params: entry.form.value() }]));
    // The job counts each electrode that a person has set.
    await state.stored;
    const job = await send("POST", `${state.path}/jobs`, { pipeline, view: view.value });
    await watch(job, showsMap);
  };
  // A correction has one aim, the new map.
  state.addEventListener("compute", () => start.disabled || attempt(() => run(true)));
  state.addEventListener("changed", () => {
    const [newest] = state.jobs;
    if (!newest || current.children.length) return;
    if (newest.state === "queued" || newest.state === "running") attempt(async () => watch(await get(`/v1/jobs/${newest.id}`), false));
    else attempt(async () => show(await get(`/v1/jobs/${newest.id}`)));
  });
  if (state.jobs[0]) state.dispatchEvent(new Event("changed"));
  return element("div", {},
    element("div", { class: "card" },
      element("p", {}, "The service finds the electrodes in every run, locates them in 3D, and makes the map. It computes again only what a change touches."),
      element("div", { class: "fields" }, field("Views to follow frame by frame", view), start),
      element("details", {}, element("summary", {}, "Methods and parameters"), plugins)),
    current);
}
