/** The page of one study: four steps as tabs. */
import { get, getAll } from "../shared/api.js";
import { byId, element } from "../shared/elements.js";
import { header } from "../shared/header.js";
import { jobPanel } from "../jobs/panel.js";
import { resultsPanel } from "../results/panel.js";
import { runsPanel } from "./runs.js";
import { tabs } from "./tabs.js";
import { viewerPanel } from "../viewer/panel.js";

/**
 * The study as its panels share it. `changed` fires after each change of runs or sites, `mapped` when a running job has its map,
 * `job` when a job has ended, `compute` when a person asks for a new job, `chosen` when a person chooses another site.
 */
export class StudyState extends EventTarget {
  /** @param {import("../shared/types.js").Study} study */
  constructor(study) {
    super();
    this.study = study;
    this.path = `/v1/studies/${study.id}`;
    /** @type {import("../shared/types.js").Run[]} */
    this.runs = [];
    /** @type {import("../shared/types.js").Site[]} */
    this.sites = [];
    /** @type {import("../shared/types.js").Job[]} */
    this.jobs = [];
    /** @type {import("../shared/types.js").Job|null} The running job that has its map already. */
    this.mapped = null;
    /** @type {Promise<void>} Fulfilled when the service has answered each change of electrodes. */
    this.stored = Promise.resolve();
    /** @type {string|null} The site that a person looks at. */
    this.chosen = null;
    /** @type {{job: string, points: Promise<import("../shared/types.js").Point[]>}|null} */
    this.latest = null;
    /** @type {Promise<Map<string, string>>|null} */
    this.reasons = null;
  }

  async load() {
    const study = this.study.id;
    [this.study, this.runs, this.sites, this.jobs] = await Promise.all([
      get(this.path), getAll(`${this.path}/instances`), getAll(`${this.path}/sites`), get(`/v1/jobs?study=${study}&limit=20`).then((page) => page.items),
    ]);
    this.dispatchEvent(new Event("changed"));
  }

  /** The newest job with results. */
  get finished() {
    return this.jobs.find((job) => job.state === "succeeded") ?? null;
  }

  /** Electrodes of all sites; those of the newest job are asked for once. @param {string} job @returns {Promise<import("../shared/types.js").Point[]>} */
  points(job) {
    if (this.latest?.job === job) return this.latest.points;
    const points = get(`/v1/jobs/${job}/points`).then((answer) => answer.points);
    this.latest = { job, points };
    points.catch(() => (this.latest = null));
    return points;
  }

  /** The tip of the mapping catheter at each site. @param {string} job */
  async tips(job) {
    return (await this.points(job)).filter((each) => each.catheter === this.study.mapping && each.electrode === 1);
  }

  /** Reason code -> sentence. */
  sentences() {
    if (this.reasons) return this.reasons;
    const reasons = get("/v1/reasons").then((all) => new Map(all.map((/** @type {any} */ each) => [each.code, each.sentence])));
    this.reasons = reasons;
    reasons.catch(() => (this.reasons = null));
    return reasons;
  }

  /** Take the map of a job that still runs. @param {import("../shared/types.js").Job} job */
  takeMap(job) {
    this.mapped = job;
    this.jobs = [job, ...this.jobs.filter((each) => each.id !== job.id)];
    this.dispatchEvent(new Event("mapped"));
  }

  /** @param {string|null} site */
  choose(site) {
    if (site === this.chosen) return;
    this.chosen = site;
    this.dispatchEvent(new Event("chosen"));
  }
}

/** Fill the page. */
export async function start() {
  const study = await get(`/v1/studies/${location.pathname.split("/")[2]}`);
  const state = new StudyState(study);
  byId("top").append(header(element("span", { "aria-current": "page" }, study.label)));
  byId("title").textContent = study.label;
  document.title = `${study.label} – fluoromap`;
  // After a correction there is nothing to choose: the third step starts at once.
  const compute = () => {
    show("compute");
    state.dispatchEvent(new Event("compute"));
  };
  const correct = () => {
    show("electrodes");
    document.querySelector("#panel-electrodes .views")?.scrollIntoView({ block: "nearest" });
  };
  const show = tabs(byId("content"), [
    ["runs", "1 Runs and times", () => runsPanel(state, () => show("electrodes"), () => show("compute"))],
    ["electrodes", "2 Look and correct", () => viewerPanel(state, compute)],
    ["compute", "3 Compute", () => jobPanel(state, () => show("map"))],
    ["map", "4 Map and results", () => resultsPanel(state, correct)],
  ]);
  await state.load();
}
