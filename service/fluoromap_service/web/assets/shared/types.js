/**
 * Shapes of the HTTP API, as far as the pages read them.
 *
 * @typedef {{name: string, electrodes: number, spacing_mm: number[], tip_mm: number, ring_mm: number}} Catheter
 * @typedef {{primary_deg: number|null, secondary_deg: number|null, source_detector_mm: number|null,
 *   source_isocentre_mm: number|null, pixel_spacing_mm: number[]|null}} Gantry
 * @typedef {Gantry & {table_mm: number[]|null, table_origin: string|null}} RunGantry
 * @typedef {{id: string, label: string, chamber: string|null, catheters: Catheter[], reference: string|null, mapping: string,
 *   notes: string|null, gantry: Gantry, created: string}} Study
 * @typedef {{sop_instance_uid: string, site: string|null, view: "a"|"b"|null, frames: number, rows: number, columns: number,
 *   frame_time_ms: number|null, acquired: string|null, plane: string, gantry: RunGantry, missing: string[],
 *   warnings: string[], simulated: boolean}} Run
 * @typedef {{site: string|null, pair: number|null, lat_ms: number|null, view_a: string|null, view_b: string|null,
 *   bound_by: string|null, missing: string[], warnings: string[], angle_deg: number|null, ready: boolean}} Site
 * @typedef {{catheter: string|null, electrode: number, u_px: number, v_px: number, sd_px: number,
 *   source: "manual"|"automatic"}} Electrode
 * @typedef {{code: string, detail: string, status?: number, errors?: {where: string, message: string}[]}} ProblemBody
 * @typedef {{name: string, subject: string, plugin: string, version: string, state: string, progress: number,
 *   reused: boolean, error: ProblemBody|null}} Stage
 * @typedef {{id: string, study: string, state: string, progress: number, stages: Stage[], error: ProblemBody|null,
 *   warnings: string[], created: string, finished: string|null}} Job
 * @typedef {{site: string, catheter: string, electrode: number, x_mm: number|null, y_mm: number|null, z_mm: number|null,
 *   covariance_mm2: number[]|null, lat_ms: number|null, grade: string, reasons: string[],
 *   views: {a: {sop_instance_uid: string, frame: number|null}|null, b: {sop_instance_uid: string, frame: number|null}|null}
 *   }} Point
 * @typedef {{site: string, x_mm: number, y_mm: number, z_mm: number, surface_mm: number[], distance_mm: number,
 *   lat_ms: number, leave_one_out_error_ms: number|null, reasons: string[]}} MapSite
 * @typedef {{vertices_mm: number[][], faces: number[][], lat_ms: (number|null)[], lat_sd_ms: (number|null)[],
 *   covered: boolean[], sites: MapSite[], earliest: {site: string, probability: number}[],
 *   total_activation_time_ms: number, leave_one_out_rms_ms: number|null, volume_ml: number, area_cm2: number,
 *   coverage: number, warnings: string[], cycle_length_ms: number|null, simulated: boolean}} ChamberMap
 */
export {};
