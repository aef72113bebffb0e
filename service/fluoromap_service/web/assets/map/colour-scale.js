/** Bands of activation time and their colours, as in the pictures that the service draws. */

/** @typedef {"safe"|"red-early"} Palette */

/** @type {Record<Palette, number[][]>} */
const ANCHORS = {
  // The map "plasma" of matplotlib (public domain, CC0), reversed, without its darkest end.
  safe: [[240, 249, 33], [253, 202, 38], [252, 162, 54], [242, 125, 76], [225, 93, 101], [203, 66, 127], [174, 36, 146], [138, 9, 165], [100, 0, 167], [62, 4, 156]],
  "red-early": [[150, 0, 10], [225, 60, 0], [255, 150, 0], [255, 240, 50], [200, 245, 210], [60, 210, 235], [20, 120, 235], [40, 20, 170], [50, 0, 90]],
};
const STEPS_MS = [5, 10, 20, 50];
const MOST_BANDS = 13;

/** @param {number} fraction 0 early, 1 late. @param {Palette} palette @returns {number[]} RGB, 0 to 255. */
function colourAt(fraction, palette) {
  const anchors = ANCHORS[palette];
  const position = Math.min(1, Math.max(0, fraction)) * (anchors.length - 1);
  const low = Math.min(anchors.length - 2, Math.floor(position));
  const share = position - low;
  const [a, b] = [anchors[low] ?? [], anchors[low + 1] ?? []];
  return [0, 1, 2].map((k) => Math.round((a[k] ?? 0) * (1 - share) + (b[k] ?? 0) * share));
}

/** @typedef {{start: number, step: number, bands: number, stop: number, colours: number[][], unit: string}} Scale */

/** @param {number[]} values @param {Palette} palette @param {number[]} [steps] @returns {Scale} */
function scaleOf(values, palette, steps = STEPS_MS) {
  const low = values.length ? Math.min(...values) : 0;
  const high = values.length ? Math.max(...values) : 0;
  let [start, step, bands] = [0, 1, 1];
  for (step of steps) {
    start = Math.floor(low / step) * step;
    bands = Math.max(1, Math.round((Math.ceil(high / step) * step - start) / step));
    if (bands <= MOST_BANDS) break;
  }
  const colours = Array.from({ length: bands }, (_, k) => colourAt((k + 0.5) / bands, palette));
  return { start, step, bands, stop: start + bands * step, colours, unit: "ms" };
}

/** Scale of the times of a map: it covers each coloured vertex and each site that agrees with its neighbours. @param {import("../shared/types.js").ChamberMap} map @param {Palette} palette */
export function timesOf(map, palette) {
  const atSites = map.sites.filter((site) => !site.reasons.includes("lat_outlier")).map((site) => site.lat_ms);
  return scaleOf([...map.lat_ms.filter((lat, k) => map.covered[k] && lat !== null), ...atSites].map(Number), palette);
}

/** Scale of the standard deviations of a map. @param {import("../shared/types.js").ChamberMap} map */
export function deviationsOf(map) {
  return scaleOf([0, ...map.lat_sd_ms.filter((sd) => sd !== null).map(Number)], "safe", [1, 2, 5, 10]);
}
