/** The tool in a person's hand, and the catheter that it marks: the same in all views. */

/** @typedef {"edit"|"add"|"mark"|"contrast"|"pan"} Tool */

/** The event `changed` fires after each change. */
export class Pen extends EventTarget {
  /** @param {import("../shared/types.js").Study} study */
  constructor(study) {
    super();
    this.study = study;
    this.catheter = study.mapping;
    /** @type {Tool} */
    this.tool = "edit";
    /** Number of the electrode that "mark" sets next. */
    this.next = 1;
  }

  /** Electrodes of the catheter. */
  get count() {
    return this.study.catheters.find((each) => each.name === this.catheter)?.electrodes ?? 0;
  }

  /** @param {{tool?: Tool, catheter?: string}} choice */
  take(choice) {
    Object.assign(this, choice);
    this.next = 1;
    this.dispatchEvent(new Event("changed"));
  }

  /** Go on to the next electrode; past the last one the catheter is complete. */
  advance() {
    this.next += 1;
    if (this.next > this.count) this.take({ tool: "edit" });
    else this.dispatchEvent(new Event("changed"));
  }
}
