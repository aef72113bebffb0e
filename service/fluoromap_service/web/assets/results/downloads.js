/** Everything that a finished job offers for download. */
import { element } from "../shared/elements.js";

/** @type {[string, string][]} */
const FILES = [
  ["report.html", "Report"], ["archive.zip", "Everything in one file"], ["points.csv", "Positions, CSV"], ["tracks.csv", "Tracks, CSV"],
  ["mesh.ply", "Mesh, PLY"], ["mesh.stl", "Mesh, STL"], ["mesh.glb", "Mesh, GLB"], ["mesh.vtp", "Mesh, VTP"], ["mesh.mat", "Mesh, OpenEP"], ["mesh.csv", "Mesh, CSV"], ["map.png", "Map from six sides, PNG"],
];

/** Files that a job without a map lacks. */
const OF_MAP = /^(mesh|map)\./;

/** @param {import("../shared/types.js").Job} job @param {boolean} hasMap */
export function downloads(job, hasMap) {
  const links = FILES.filter(([name]) => hasMap || !OF_MAP.test(name)).map(([name, title]) =>
    element("li", {}, element("a", { href: `/v1/jobs/${job.id}/${name}`, ...(name === "report.html" ? { target: "_blank" } : { download: "" }) }, title)));
  return element("section", {}, element("h2", {}, "Downloads"), element("ul", { class: "row downloads" }, ...links));
}
