/** Codes of the service in plain words. */

/** @type {Record<string, string>} */
const MISSING = {
  site: "a name",
  lat_ms: "its activation time",
  view_a: "the run of view a",
  view_b: "the run of view b",
  "gantry:view_a": "the geometry of view a",
  "gantry:view_b": "the geometry of view b",
};

/** @type {Record<string, string>} */
const BOUND_BY = {
  explicit: "set by hand",
  csv: "named in the table",
  upload: "named at upload",
  order: "guess: row order",
  time: "guess: time of acquisition",
};

/** @type {Record<string, string>} */
const WARNINGS = {
  paired_by_order: "runs and times were paired in order of time",
  order_unknown: "the files do not say which runs came first; check the pair",
  patient_or_study_repaired: "an attribute of patient or study breaks the rules of DICOM; results carry it repaired or empty",
  table_moved: "the table may have moved",
  gantry_turned: "the gantry turned during one of the runs; record this view again",
  views_parallel: "the two views are less than 20° apart, which shows no depth",
  unbound: "no site uses this run",
  frame_time_assumed: "no frame rate in the file; 15 frames a second are assumed",
  positioner_moved: "the gantry turned during the run, so a job cannot use it",
  geometry_implausible: "the file has a geometry value that no C-arm can have; it counts as missing",
};

/** @type {Record<string, string>} */
export const KEYWORDS = {
  PositionerPrimaryAngle: "primary angle",
  PositionerSecondaryAngle: "secondary angle",
  DistanceSourceToDetector: "distance source to detector",
  DistanceSourceToPatient: "distance source to isocentre",
  ImagerPixelSpacing: "pixel spacing at the detector",
};

/** @type {Record<string, string>} */
export const STAGES = {
  segment: "Find electrodes",
  match: "Name catheters",
  triangulate: "Locate in 3D",
  fuse: "Make the map",
  monoplane: "Track one view",
};

/** @type {Record<string, string>} */
export const JOB_STATES = { queued: "waiting", running: "running", succeeded: "finished", failed: "failed", cancelled: "cancelled" };

/** @param {string} code */
export const missingWords = (code) => MISSING[code] ?? code;
/** @param {string|null} rule */
export const boundByWords = (rule) => (rule ? (BOUND_BY[rule] ?? rule) : "");
/** @param {string} code */
export const warningWords = (code) => WARNINGS[code] ?? code.replaceAll("_", " ");

/** @param {string|null} rule Whether the service guessed which runs belong together. */
export const isGuess = (rule) => rule === "order" || rule === "time";

/** @param {string[]} words */
export function listed(words) {
  return words.length < 2 ? words.join("") : `${words.slice(0, -1).join(", ")} and ${words.at(-1)}`;
}

/** @type {Record<string, string>} */
const TABLE_ORIGINS = {
  isocentre: "from the isocentre",
  table_top: "of the table top",
  ge: "by the private attributes of GE",
};

/** The table's position in words. @param {import("./types.js").RunGantry} gantry */
export function tableWords(gantry) {
  if (!gantry.table_mm || !gantry.table_origin) return "The file does not state the position of the table.";
  const [x, y, z] = gantry.table_mm.map((value) => value.toFixed(1).replace("-", "−"));
  return `Table ${TABLE_ORIGINS[gantry.table_origin]}: left ${x} mm, back ${y} mm, head ${z} mm. Only differences between runs count.`;
}

/** Direction of a view as people say it. @param {import("./types.js").Gantry} gantry */
export function direction(gantry) {
  const { primary_deg: primary, secondary_deg: secondary } = gantry;
  if (primary === null) return "angle unknown";
  const side = Math.abs(primary) < 0.5 ? "AP" : `${primary > 0 ? "LAO" : "RAO"} ${Math.abs(primary).toFixed(0)}°`;
  if (secondary === null || Math.abs(secondary) < 0.5) return side;
  return `${side} ${secondary > 0 ? "CRA" : "CAU"} ${Math.abs(secondary).toFixed(0)}°`;
}

/** @param {number|null|undefined} value @param {number} digits */
export const number = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits).replace("-", "−"));

/** @param {import("./types.js").Job} job */
export const jobLabel = (job) => new Date(job.created).toLocaleString();

/** @param {string|null} time */
export function shortTime(time) {
  return time === null ? "time unknown" : new Date(time).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit" });
}
