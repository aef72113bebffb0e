/** What people chose to see of a map: the 3D view and the fluoroscopy views show the same. */
import { deviationsOf, timesOf } from "./colour-scale.js";

/** @typedef {{palette?: import("./colour-scale.js").Palette, uncertainty?: boolean, untilMs?: number|null}} Choice */

/** The event `changed` fires after each change. */
export class MapLook extends EventTarget {
  /** @param {import("../shared/types.js").ChamberMap} map */
  constructor(map) {
    super();
    this.map = map;
    /** @type {import("./colour-scale.js").Palette} */
    this.palette = "safe";
    this.uncertainty = false;
    /** @type {number|null} The wall is coloured where it is activated by this time; null: everywhere. */
    this.untilMs = null;
  }

  /** @param {Choice} choice */
  change(choice) {
    Object.assign(this, choice);
    this.dispatchEvent(new Event("changed"));
  }

  get scale() {
    return this.uncertainty ? deviationsOf(this.map) : timesOf(this.map, this.palette);
  }

  /** The value that the colours show at each vertex. */
  get values() {
    return this.uncertainty ? this.map.lat_sd_ms : this.map.lat_ms;
  }
}
