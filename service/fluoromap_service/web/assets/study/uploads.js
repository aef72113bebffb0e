/** Drag and drop of DICOM files and tables, with progress for each file. */
import { Problem, upload } from "../shared/api.js";
import { element } from "../shared/elements.js";
import { listed } from "../shared/words.js";

const AT_ONCE = 2;
const TABLE = /\.(csv|tsv|txt)$/i;
/** Files that folders hold besides runs and tables. */
const OTHER = /(^\.|^desktop\.ini$|^dicomdir$|\.(json|toml|md|html|pdf|png|jpe?g|gif|xml|zip)$)/i;

/** Return all files of a drop, folders included. @param {DataTransfer} transfer @returns {Promise<File[]>} */
async function droppedFiles(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter((entry) => entry !== null && entry !== undefined);
  if (!entries.length) return [...transfer.files];
  /** @param {any} entry @returns {Promise<File[]>} */
  const open = async (entry) => {
    if (entry.isFile) return [await new Promise((resolve, reject) => entry.file(resolve, reject))];
    const reader = entry.createReader();
    const found = [];
    for (;;) {
      const batch = /** @type {any[]} */ (await new Promise((resolve, reject) => reader.readEntries(resolve, reject)));
      if (!batch.length) return found;
      for (const each of batch) found.push(...(await open(each)));
    }
  };
  return (await Promise.all(entries.map(open))).flat();
}

/** @param {string} path Of the study. @param {File} file @param {(fraction: number) => void} onProgress @returns {Promise<string>} */
async function sendFile(path, file, onProgress) {
  if (!TABLE.test(file.name)) {
    const form = new FormData();
    form.append("file", file);
    const answer = await upload("POST", `${path}/instances`, form, null, onProgress);
    if (answer.rejected.length) throw new Problem(422, answer.rejected[0]);
    const run = answer.instances[0];
    return `${run.frames} frames${run.missing.length ? "; geometry is missing" : ""}`;
  }
  const text = await file.text();
  if (/^﻿?\s*"?time_ms/i.test(text)) {
    const site = file.name.replace(/\.[^.]+$/, "");
    const answer = await upload("PUT", `${path}/electrograms/${encodeURIComponent(site)}`, text, "text/csv", onProgress);
    return `electrograms of site ${site}: ${answer.lat_ms.toFixed(0)} ms`;
  }
  const answer = await upload("PUT", `${path}/activation-times`, text, "text/csv", onProgress);
  const open = answer.unmatched.length ? `; without runs: ${answer.unmatched.join(", ")}` : "";
  return `times of ${answer.sites} sites${open}`;
}

/**
 * @param {string} path Of the study.
 * @param {() => void} onChange Called after files have arrived.
 */
export function uploadZone(path, onChange) {
  const rows = element("ul", { class: "cards", "aria-label": "Files", "aria-live": "polite" });
  const input = element("input", { type: "file", multiple: true, id: "files", "aria-label": "Choose files" });
  const folder = element("input", { type: "file", webkitdirectory: true, id: "folder", "aria-label": "Choose a folder" });
  const zone = element("div", { class: "drop" },
    element("p", {}, element("strong", {}, "Drop DICOM files or folders here"), ", and a table of activation times (CSV: site,lat_ms)."),
    element("div", { class: "row choices" }, element("label", { class: "row" }, "Files", input), element("label", { class: "row" }, "A folder", folder)));

  /** @param {File} file */
  const send = async (file) => {
    const bar = element("progress", { max: 1, value: 0, "aria-label": file.name });
    const result = element("span", { class: "soft" }, "waiting");
    const row = element("li", { class: "card" }, element("strong", {}, file.name), " ", result, bar);
    rows.append(row);
    return async () => {
      try {
        result.textContent = "sending";
        result.textContent = await sendFile(path, file, (fraction) => (bar.value = fraction));
        bar.value = 1;
        row.dataset.state = "done";
      } catch (error) {
        result.className = "notice problem";
        result.textContent = error instanceof Error ? error.message : String(error);
        bar.remove();
      }
    };
  };

  /** @param {File[]} all */
  const sendAll = async (all) => {
    const files = all.filter((file) => !OTHER.test(file.name));
    const others = all.filter((file) => OTHER.test(file.name)).map((file) => file.name);
    if (others.length) rows.append(element("li", { class: "card" }, element("strong", {}, listed(others)), " ", element("span", { class: "soft" }, "left out: no run and no table")));
    const isTable = (/** @type {File} */ file) => TABLE.test(file.name);
    // Tables go last: then the answer says truly which of their sites have no runs.
    for (const some of [files.filter((file) => !isTable(file)), files.filter(isTable)]) {
      const waiting = await Promise.all(some.map(send));
      await Promise.all(Array.from({ length: AT_ONCE }, async () => {
        for (let act = waiting.shift(); act; act = waiting.shift()) {
          await act();
          onChange();
        }
      }));
    }
  };

  for (const each of [input, folder]) each.addEventListener("change", () => { sendAll([...each.files]); each.value = ""; });
  for (const name of ["dragenter", "dragover"]) zone.addEventListener(name, (/** @type {DragEvent} */ event) => { event.preventDefault(); zone.classList.add("over"); });
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", async (/** @type {DragEvent} */ event) => {
    event.preventDefault();
    zone.classList.remove("over");
    if (event.dataTransfer) sendAll(await droppedFiles(event.dataTransfer));
  });
  const files = element("details", { open: true, hidden: true }, element("summary", {}, "Files of this visit"), rows);
  new MutationObserver(() => (files.hidden = !rows.children.length)).observe(rows, { childList: true });
  return element("div", {}, zone, files);
}
