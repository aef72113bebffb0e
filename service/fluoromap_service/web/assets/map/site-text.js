/** Name and time of a site, as the map shows them. */

/** Reasons that put a site's time, position or catheter in doubt: its time gets a question mark, as in the pictures. */
const DOUBTS = ["extra_catheter", "geometry_doubtful", "identity_uncertain", "no_resting_catheter", "pairing_failed", "spacing_mismatch", "table_moved", "view_mirrored", "lat_outlier"];

/** @param {import("../shared/types.js").MapSite} site */
export const timeText = (site) => `${Math.round(site.lat_ms)} ms${site.reasons.some((code) => DOUBTS.includes(code)) ? " ?" : ""}`.replace("-", "−");

/** @param {import("../shared/types.js").MapSite} site */
export const siteText = (site) => `${site.site} ${timeText(site)}`;
