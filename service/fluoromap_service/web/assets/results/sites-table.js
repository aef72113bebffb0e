/** All sites of a job: located ones with their distance from the earliest, rejected ones with what to do. */
import { button, element } from "../shared/elements.js";
import { number } from "../shared/words.js";
import { tipDistance } from "./tip-distance.js";

/** @typedef {import("../shared/types.js").Point} Point */

/** A line for each site that is not located: why, and the way to its electrodes. @param {Point[]} tips @param {Map<string, string>} sentences @param {(site: string) => void} onCorrect */
export function lostSites(tips, sentences, onCorrect) {
  return tips.filter((tip) => tip.grade === "rejected").map((tip) => element("p", { class: "notice problem", "data-lost": tip.site },
    element("strong", {}, `Site ${tip.site} is not located. `), tip.reasons.map((code) => sentences.get(code) ?? code).join(" "), " ",
    button(`Correct site ${tip.site}`, () => onCorrect(tip.site))));
}

/**
 * @param {Point[]} tips
 * @param {string|null} earliest
 * @param {Map<string, string>} sentences Reason code -> sentence.
 * @param {(site: string) => void} onChoose
 * @param {(site: string) => void} onCorrect
 */
export function resultSites(tips, earliest, sentences, onChoose, onCorrect) {
  const first = tips.find((tip) => tip.site === earliest);
  const rows = tips.map((tip) => {
    const distance = first && tip !== first ? tipDistance(first, tip) : null;
    const words = tip.reasons.map((code) => sentences.get(code) ?? code);
    return element("tr", { "data-site": tip.site, "data-grade": tip.grade },
      element("td", {}, button(tip.site, () => onChoose(tip.site), { class: "quiet", "aria-label": `Find site ${tip.site} in all views` })),
      element("td", { class: "figure" }, number(tip.lat_ms, 0)),
      element("td", { class: "figure" }, tip === first ? "earliest" : distance ? `${number(distance.mm, 1)} (${number(distance.low, 1)} to ${number(distance.high, 1)})` : "–"),
      element("td", {}, tip.grade === "rejected" ? element("span", { class: "badge", "data-state": "failed" }, "not located") : `grade ${tip.grade}`),
      element("td", {}, ...words.map((sentence) => element("div", {}, sentence)), words.length ? button("Correct it", () => onCorrect(tip.site), { "aria-label": `Correct it: site ${tip.site}` }) : null));
  });
  return element("section", {},
    element("h2", {}, "Sites"),
    element("div", { class: "wide", tabIndex: 0, role: "region", "aria-label": "Sites of the map" }, element("table", {},
      element("thead", {}, element("tr", {}, ...["Site", "Time, ms", "From the earliest, mm (95 %)", "Grade", "What happened, and what to do"].map((title) => element("th", { scope: "col" }, title)))),
      element("tbody", {}, ...rows))),
    element("p", { class: "soft" }, "Grade by the largest semi-axis of the 95 % ellipsoid: A up to 2 mm, B up to 4 mm, C beyond."));
}
