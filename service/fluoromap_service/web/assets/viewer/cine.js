/** The frames of one run, loaded in parts; parts that were not used for long are dropped, so that memory stays bounded. */
import { getBytes } from "../shared/api.js";

const MOST_BYTES = 160 * 2 ** 20;

export class Cine {
  /** @param {string} studyPath @param {import("../shared/types.js").Run} run @param {() => void} onFrames Called when frames have arrived. */
  constructor(studyPath, run, onFrames) {
    this.run = run;
    this.size = run.rows * run.columns;
    this.path = `${studyPath}/instances/${run.sop_instance_uid}/frames`;
    this.perPart = Math.max(1, Math.floor((4 * 2 ** 20) / this.size));
    /** @type {Map<number, Uint8Array>} Part number -> its frames; the order is that of the last use. */
    this.parts = new Map();
    /** @type {Set<number>} */
    this.loading = new Set();
    this.abort = new AbortController();
    this.onFrames = onFrames;
  }

  /** Return the pixels of a frame (from 1); null while they load. @param {number} frame */
  pixels(frame) {
    const part = Math.floor((frame - 1) / this.perPart);
    this.#load(part);
    if ((part + 1) * this.perPart < this.run.frames) this.#load(part + 1);
    const found = this.parts.get(part);
    if (!found) return null;
    this.parts.delete(part);
    this.parts.set(part, found);
    const start = (frame - 1 - part * this.perPart) * this.size;
    return found.subarray(start, start + this.size);
  }

  /** @param {number} part */
  async #load(part) {
    if (this.parts.has(part) || this.loading.has(part)) return;
    this.loading.add(part);
    try {
      const content = await getBytes(`${this.path}?first=${part * this.perPart + 1}&count=${this.perPart}`, this.abort.signal);
      this.parts.set(part, content);
      let bytes = 0;
      for (const each of this.parts.values()) bytes += each.length;
      for (const [oldest, each] of this.parts) {
        if (bytes <= MOST_BYTES) break;
        this.parts.delete(oldest);
        bytes -= each.length;
      }
      this.onFrames();
    } catch (error) {
      if (!this.abort.signal.aborted) console.warn(error);
    } finally {
      this.loading.delete(part);
    }
  }

  close() {
    this.abort.abort();
    this.parts.clear();
  }
}
