/** Pointer of one view: it moves and sets electrodes, changes the contrast and moves the picture. */

/** @typedef {import("./view.js").View} View */

/** Least way of a drag, canvas pixels: less is a click. */
const LEAST_DRAG = 3;

/** @param {View} view */
export function listenToPointer(view) {
  const { canvas, pen } = view;
  /** @type {{kind: string, x: number, y: number, electrode: import("../shared/types.js").Electrode|null, moved: boolean}|null} */
  let drag = null;

  canvas.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    const { x, y } = view.at(event);
    const electrode = view.hit(x, y);
    const tool = event.button === 2 ? "contrast" : event.button === 1 ? "pan" : pen.tool;
    const kind = tool !== "edit" ? tool : electrode?.catheter ? "move" : "pan";
    drag = { kind, x, y, electrode, moved: false };
    if (kind === "move") view.choose(electrode);
    event.preventDefault();
  });

  canvas.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => {
    const { x, y } = view.at(event);
    if (!drag) {
      if (pen.tool === "edit") view.point(view.hit(x, y));
      return;
    }
    const [dx, dy] = [x - drag.x, y - drag.y];
    if (!drag.moved && Math.hypot(dx, dy) < LEAST_DRAG) return;
    drag.moved = true;
    if (drag.kind === "move" && drag.electrode) {
      const { u, v } = view.placement.toFrame(canvas, view.run, x, y);
      view.carry(drag.electrode, u, v);
    } else if (drag.kind === "pan") {
      view.pan(dx, dy);
    } else if (drag.kind === "contrast") {
      const scale = 256 / canvas.width;
      view.painter.setContrast((view.painter.centre ?? 128) + dy * scale, Math.max(8, (view.painter.width ?? 256) + dx * scale));
      view.draw();
    }
    if (drag.kind === "pan" || drag.kind === "contrast") [drag.x, drag.y] = [x, y];
  });

  canvas.addEventListener("pointerup", (/** @type {PointerEvent} */ event) => {
    const ended = drag;
    drag = null;
    if (!ended) return;
    const { x, y } = view.at(event);
    const { u, v } = view.placement.toFrame(canvas, view.run, x, y);
    if ((ended.kind === "mark" || ended.kind === "add") && !ended.moved) view.place(u, v);
    else view.drop();
  });
  canvas.addEventListener("pointercancel", () => { drag = null; view.forgetMove(); });
  canvas.addEventListener("pointerleave", () => drag || view.point(null));
  canvas.addEventListener("contextmenu", (/** @type {Event} */ event) => event.preventDefault());
}
