/** The page of all studies. */
import { get, getAll, send } from "../shared/api.js";
import { announce, attempt, button, byId, element } from "../shared/elements.js";
import { header } from "../shared/header.js";
import { JOB_STATES } from "../shared/words.js";
import { newStudyForm } from "./new-study.js";

/** @typedef {import("../shared/types.js").Study} Study */

/** @param {Study} study */
function card(study) {
  const state = element("span", { class: "badge" }, "…");
  const made = element(
    "li",
    { class: "card study" },
    element("h3", {}, element("a", { href: `/studies/${study.id}` }, study.label)),
    element("p", { class: "soft" }, [study.chamber, new Date(study.created).toLocaleString()].filter(Boolean).join(" · ")),
    element("div", { class: "row" }, state, element("span", { class: "grow" }),
      button("Delete", () => remove(study, made), { class: "quiet", "aria-label": `Delete ${study.label}` })),
  );
  showState(study, state);
  return made;
}

/** @param {Study} study @param {HTMLElement} place */
async function showState(study, place) {
  const [job] = (await get(`/v1/jobs?study=${study.id}&limit=1`)).items;
  if (job) {
    place.textContent = `computation ${JOB_STATES[job.state] ?? job.state}`;
    place.dataset.state = job.state;
    return;
  }
  const runs = (await get(`/v1/studies/${study.id}/instances?limit=1`)).items.length;
  place.textContent = runs ? "runs uploaded" : "empty";
}

/** @param {Study} study @param {HTMLElement} item */
async function remove(study, item) {
  if (!confirm(`Delete the study "${study.label}" with its runs and results? Nobody can undo this.`)) return;
  await attempt(async () => {
    await send("DELETE", `/v1/studies/${study.id}`);
    item.remove();
    announce(`The study "${study.label}" is deleted.`);
  });
}

/** Fill the page. */
export async function start() {
  document.title = "Studies – fluoromap";
  byId("title").textContent = "Studies";
  byId("top").append(header());
  const [studies, types] = await Promise.all([getAll("/v1/studies"), getAll("/v1/catheter-types")]);
  const form = newStudyForm(types);
  const details = element("details", { class: "card", open: studies.length === 0 }, element("summary", {}, "New study"), form);
  byId("content").append(
    details,
    studies.length
      ? element("ul", { class: "cards" }, ...studies.map(card))
      : element("p", {}, "There is no study yet. Make one: give it a name and say which catheters are in the heart."),
  );
}
