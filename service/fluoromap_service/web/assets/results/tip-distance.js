/** Distance between two tips, with its 95 % interval. */

import { number } from "../shared/words.js";

/** @typedef {import("../shared/types.js").Point} Point */

/** @param {Point} point @returns {[number, number, number]|null} */
const place = (point) => (point.x_mm === null || point.y_mm === null || point.z_mm === null ? null : [point.x_mm, point.y_mm, point.z_mm]);

/**
 * @param {Point} a
 * @param {Point} b
 * @returns {{mm: number, low: number, high: number}|null}
 */
export function tipDistance(a, b) {
  const [from, to] = [place(a), place(b)];
  if (!from || !to) return null;
  const way = [0, 1, 2].map((k) => (to[k] ?? 0) - (from[k] ?? 0));
  const mm = Math.hypot(...way);
  const unit = mm ? way.map((each) => each / mm) : [1, 0, 0];
  const variance = along(a, unit) + along(b, unit);
  const reach = 1.96 * Math.sqrt(variance);
  return { mm, low: Math.max(0, mm - reach), high: mm + reach };
}

/**
 * The distance from the tip of one site to the earliest site, in words; null where one of them is not located.
 *
 * @param {Point[]} tips
 * @param {string} site
 * @param {string|null} earliest
 */
export function distanceText(tips, site, earliest) {
  const [from, to] = [site, earliest].map((name) => tips.find((each) => each.site === name));
  const distance = from && to && from !== to ? tipDistance(from, to) : null;
  if (!distance) return null;
  const mm = number(distance.mm, 1);
  return { short: `${mm} mm`, sentence: `From the tip at ${site} to the earliest site ${earliest}: ${mm} mm (95 %: ${number(distance.low, 1)} to ${number(distance.high, 1)} mm).` };
}

/** Variance of a position along a direction. @param {Point} point @param {number[]} unit */
function along(point, unit) {
  const [xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0] = point.covariance_mm2 ?? [];
  const [x = 0, y = 0, z = 0] = unit;
  return x * x * xx + y * y * yy + z * z * zz + 2 * (x * y * xy + x * z * xz + y * z * yz);
}
