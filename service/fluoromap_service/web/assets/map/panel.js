/** The map with its buttons: directions, colours, uncertainty, catheters, and the time that runs. */
import { button, element, field, select } from "../shared/elements.js";
import { number } from "../shared/words.js";
import { timesOf } from "./colour-scale.js";
import { MapLook } from "./look.js";
import { VIEWS } from "./orbit.js";
import { MapScene } from "./scene.js";

const RUN_MS = 4000;

/**
 * @param {import("./look.js").MapLook} look
 * @param {import("../shared/types.js").Point[]} points Electrodes of all sites.
 * @param {string[]} catheters Names in the order of the study.
 * @param {string} title What is on the map, for the picture itself: study and kind of data.
 */
export function mapPanel(look, points, catheters, title) {
  const place = element("div", { class: "scene" });
  const tools = element("div", { class: "fields" });
  const panel = element("div", {}, place, tools, facts(look.map));
  panel.scene = null;
  // A canvas gets its size from the page: make the scene when it is there.
  requestAnimationFrame(() => {
    let scene;
    try {
      scene = new MapScene(place, look, points, catheters);
    } catch (error) {
      place.append(element("p", { class: "notice problem" }, `This browser cannot draw in 3D: ${error instanceof Error ? error.message : error} The map from six sides is among the downloads; the views over fluoroscopy show outline and sites. Turn on WebGL in the settings of the browser.`));
      return;
    }
    panel.scene = scene;
    place.append(element("p", { class: "note" }, `${title}. Grey with stripes: no site is near.`));
    tools.append(...toolsOf(scene, look));
    scene.choose(look.map.earliest[0]?.site ?? null);
    panel.dispatchEvent(new Event("made"));
  });
  return panel;
}

/** The panel of a page that has nothing else of the map: the report. @param {{map: import("../shared/types.js").ChamberMap, points: import("../shared/types.js").Point[], catheters: string[]}} scene @param {string} title */
export const reportPanel = ({ map, points, catheters }, title) => mapPanel(new MapLook(map), points, catheters, title);

/** @param {MapScene} scene @param {import("./look.js").MapLook} look */
function toolsOf(scene, look) {
  const views = element("div", { class: "row", role: "group", "aria-label": "Direction" }, ...VIEWS.map(([name, title, azimuth, elevation]) => button(name, () => scene.orbit.look(azimuth, elevation), { title })));
  const colours = select([["safe", "yellow early, violet late"], ["red-early", "red early, violet late"]], look.palette, {
    onchange: () => look.change({ palette: /** @type {any} */ (colours.value) }),
  });
  const uncertainty = element("input", { type: "checkbox", onchange: () => look.change({ uncertainty: uncertainty.checked }) });
  const catheters = element("input", { type: "checkbox", checked: true, onchange: () => scene.showCatheters(catheters.checked) });
  const times = timesOf(look.map, "safe");
  const shown = element("span", {}, "all times");
  const slider = element("input", { type: "range", min: times.start, max: times.stop, value: times.stop, step: 1, "aria-label": "Activated until, ms" });
  const show = () => {
    const all = Number(slider.value) >= times.stop;
    shown.textContent = all ? "all times" : `until ${number(Number(slider.value), 0)} ms`;
    look.change({ untilMs: all ? null : Number(slider.value) });
  };
  slider.addEventListener("input", show);
  let running = 0;
  const play = button("Run the activation", () => {
    cancelAnimationFrame(running);
    const start = performance.now();
    /** @param {number} now */
    const step = (now) => {
      slider.value = String(times.start + ((now - start) / RUN_MS) * (times.stop - times.start));
      show();
      if (Number(slider.value) < times.stop) running = requestAnimationFrame(step);
    };
    running = requestAnimationFrame(step);
  }, { title: "Let the activation run over the wall, slowed down" });
  return [views, field("Colours", colours), element("label", { class: "row" }, uncertainty, "uncertainty instead of time"),
    element("label", { class: "row" }, catheters, "catheters of the chosen site"),
    element("div", { class: "row", role: "group", "aria-label": "Activation" }, play, slider, shown)];
}

/** @param {import("../shared/types.js").ChamberMap} map */
function facts(map) {
  const earliest = map.earliest[0];
  const words = [
    `${map.sites.length} sites`, `total activation time ${number(map.total_activation_time_ms, 0)} ms`,
    earliest && `earliest: ${earliest.site} with ${Math.round(100 * earliest.probability)} % probability`,
    map.leave_one_out_rms_ms !== null && `leave-one-site-out error ${number(map.leave_one_out_rms_ms, 1)} ms`,
    `volume ${number(map.volume_ml, 0)} ml`, `area ${number(map.area_cm2, 0)} cm²`, `${Math.round(100 * map.coverage)} % covered`,
  ];
  return element("p", {}, words.filter(Boolean).join(" · "));
}
