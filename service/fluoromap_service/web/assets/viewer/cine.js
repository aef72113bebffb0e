/** The frames of one run, loaded in parts. */
import { getBytes } from "../shared/api.js";
import { hasPart, storePart, takePart } from "./frame-store.js";

const PART_BYTES = 4 * 2 ** 20;

export class Cine {
  /** @param {string} studyPath @param {import("../shared/types.js").Run} run @param {() => void} onFrames Called when frames have arrived. */
  constructor(studyPath, run, onFrames) {
    this.run = run;
    this.size = run.rows * run.columns;
    this.path = `${studyPath}/instances/${run.sop_instance_uid}/frames`;
    this.perPart = Math.max(1, Math.floor(PART_BYTES / this.size));
    /** @type {Set<string>} */
    this.loading = new Set();
    this.abort = new AbortController();
    this.onFrames = onFrames;
  }

  /** Return the pixels of a frame (from 1); null while they load. @param {number} frame */
  pixels(frame) {
    const part = Math.floor((frame - 1) / this.perPart);
    this.#load(part);
    if ((part + 1) * this.perPart < this.run.frames) this.#load(part + 1);
    const found = takePart(this.#address(part));
    if (!found) return null;
    const start = (frame - 1 - part * this.perPart) * this.size;
    return found.subarray(start, start + this.size);
  }

  /** @param {number} part */
  #address(part) {
    return `${this.path}?first=${part * this.perPart + 1}&count=${this.perPart}`;
  }

  /** @param {number} part */
  async #load(part) {
    const address = this.#address(part);
    if (hasPart(address) || this.loading.has(address)) return;
    this.loading.add(address);
    try {
      storePart(address, await getBytes(address, this.abort.signal));
      this.onFrames();
    } catch (error) {
      if (!this.abort.signal.aborted) console.warn(error);
    } finally {
      this.loading.delete(address);
    }
  }

  close() {
    this.abort.abort();
  }
}
