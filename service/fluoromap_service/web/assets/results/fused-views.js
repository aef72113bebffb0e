/** The map over both fluoroscopy views of a site, following the frames. */
import { element } from "../shared/elements.js";

/**
 * @param {string} jobId
 * @param {{sop_instance_uid: string, site: string, view: string, frame: number, href: string}[]} overlays Of one site.
 * @param {Map<string, number>} frames SOP Instance UID -> number of frames.
 */
export function fusedViews(jobId, overlays, frames) {
  const figures = overlays.map((overlay) => {
    const last = frames.get(overlay.sop_instance_uid) ?? overlay.frame;
    const image = element("img", { alt: `The map over view ${overlay.view} of site ${overlay.site}`, src: overlay.href });
    const caption = element("span", {}, `view ${overlay.view}, frame ${overlay.frame} (diastole)`);
    const slider = element("input", { type: "range", min: 1, max: last, value: overlay.frame, "aria-label": `Frame of the map over view ${overlay.view}` });
    slider.addEventListener("change", () => {
      image.src = `${overlay.href}?frame=${slider.value}`;
      caption.textContent = `view ${overlay.view}, frame ${slider.value}${Number(slider.value) === overlay.frame ? " (diastole)" : ""}`;
    });
    return element("figure", {}, image, element("figcaption", { class: "row" }, caption, slider));
  });
  return element("div", { class: "pictures", "data-job": jobId }, ...figures);
}
