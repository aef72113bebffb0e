/** Pointer and keys of one view. */

/** @typedef {import("./view.js").View} View */

export const KEYS = [
  ["Space", "play or pause"], ["← →", "previous or next frame"], ["Home End", "first or last frame"], ["+ −  wheel", "zoom"],
  ["0", "whole frame, usual contrast"], ["[ ]", "previous or next electrode"], ["Shift + arrows", "move the electrode by 1 pixel"],
  ["Delete", "delete the electrode"], ["M", "mark a catheter from its tip on"], ["Esc", "end marking"],
  ["Ctrl + Z, Ctrl + Y", "undo, redo"], ["right button", "drag: contrast"], ["middle button", "drag: move the picture"],
];

/** @param {View} view @param {(act: "mark"|"end"|"marked") => void} onPen */
export function control(view, onPen) {
  const { canvas } = view;
  /** @type {{kind: string, x: number, y: number, electrode: import("../shared/types.js").Electrode|null, moved: boolean}|null} */
  let drag = null;

  canvas.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    const { x, y } = view.at(event);
    const electrode = view.hit(x, y);
    const tool = event.button === 2 ? "contrast" : event.button === 1 ? "pan" : view.pen.tool;
    const kind = tool !== "edit" ? tool : electrode?.catheter ? "move" : "pan";
    drag = { kind, x, y, electrode, moved: false };
    if (kind === "move") view.choose(electrode);
    event.preventDefault();
  });

  canvas.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => {
    const { x, y } = view.at(event);
    if (!drag) {
      if (view.pen.tool !== "mark") view.choose(view.hit(x, y));
      return;
    }
    const dx = x - drag.x;
    const dy = y - drag.y;
    if (!drag.moved && Math.hypot(dx, dy) < 3) return;
    drag.moved = true;
    if (drag.kind === "move" && drag.electrode) {
      const { u, v } = view.placement.toFrame(canvas, view.run, x, y);
      const electrode = drag.electrode;
      view.moving = view.marks.of(view.frame).map((each) => (each === electrode ? { ...each, u_px: u, v_px: v, source: "manual" } : each));
    } else if (drag.kind === "pan") {
      view.placement.shift.x += dx;
      view.placement.shift.y += dy;
    } else if (drag.kind === "contrast") {
      const scale = 256 / canvas.width;
      view.painter.setContrast((view.painter.centre ?? 128) + dy * scale, Math.max(8, (view.painter.width ?? 256) + dx * scale));
    }
    if (drag.kind !== "move" && drag.kind !== "mark") [drag.x, drag.y] = [x, y];
    view.draw();
  });

  canvas.addEventListener("pointerup", (/** @type {PointerEvent} */ event) => {
    const ended = drag;
    drag = null;
    view.moving = null;
    if (!ended) return;
    const { x, y } = view.at(event);
    const { u, v } = view.placement.toFrame(canvas, view.run, x, y);
    if (ended.kind === "move" && ended.moved && ended.electrode?.catheter) {
      view.set(ended.electrode.catheter, ended.electrode.electrode, u, v);
    } else if (ended.kind === "mark" && !ended.moved) {
      if (view.pen.next === 1) view.begin(view.pen.catheter, u, v);
      else view.set(view.pen.catheter, view.pen.next, u, v);
      onPen("marked");
    }
    view.draw();
  });
  canvas.addEventListener("pointercancel", () => { drag = null; view.moving = null; });
  canvas.addEventListener("pointerleave", () => drag || view.choose(null));
  canvas.addEventListener("contextmenu", (/** @type {Event} */ event) => event.preventDefault());
  canvas.addEventListener("wheel", (/** @type {WheelEvent} */ event) => {
    event.preventDefault();
    const { x, y } = view.at(event);
    view.placement.zoomAt(canvas, Math.exp(-event.deltaY / 400), x, y);
    view.draw();
  }, { passive: false });

  /** @param {number} step */
  const chooseNext = (step) => {
    const all = [...view.electrodes].sort((a, b) => `${a.catheter}`.localeCompare(`${b.catheter}`) || a.electrode - b.electrode);
    if (!all.length) return;
    const at = all.indexOf(/** @type {any} */ (view.chosenElectrode));
    view.choose(all[(at + step + all.length) % all.length] ?? null);
  };

  /** @type {Record<string, [number, number]>} */
  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  canvas.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
    const chosen = view.chosenElectrode;
    const way = ways[event.key];
    const middle = [canvas.width / 2, canvas.height / 2];
    if (event.shiftKey && way && chosen?.catheter) view.set(chosen.catheter, chosen.electrode, chosen.u_px + way[0], chosen.v_px + way[1]);
    else if (event.ctrlKey && event.key.toLowerCase() === "z") view.step(event.shiftKey ? 1 : -1);
    else if (event.ctrlKey && event.key.toLowerCase() === "y") view.step(1);
    else if (event.ctrlKey || event.altKey || event.metaKey) return;
    else if (event.key === " ") view.play(!view.playing);
    else if (event.key === "ArrowRight") view.show(view.frame + 1);
    else if (event.key === "ArrowLeft") view.show(view.frame - 1);
    else if (event.key === "Home") view.show(1);
    else if (event.key === "End") view.show(view.run.frames);
    else if (event.key === "[") chooseNext(-1);
    else if (event.key === "]") chooseNext(1);
    else if (event.key === "Delete" && chosen) view.remove(chosen);
    else if (event.key === "+" || event.key === "-") view.placement.zoomAt(canvas, event.key === "+" ? 1.25 : 0.8, middle[0] ?? 0, middle[1] ?? 0);
    else if (event.key === "0") { view.placement.reset(); view.painter.setContrast(128, 256); }
    else if (event.key.toLowerCase() === "m") onPen("mark");
    else if (event.key === "Escape") onPen("end");
    else return;
    event.preventDefault();
    view.draw();
  });
}
