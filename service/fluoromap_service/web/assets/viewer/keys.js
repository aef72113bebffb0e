/** Keys of one view: everything that a pointer does is done without one too. */
import { keyOf } from "./frame-painter.js";

/** @typedef {import("./view.js").View} View */

/** Keys and what they do, for the help on the page. */
export const KEYS = [
  ["Tab", "go to a picture, a button or a field"], ["Space", "play or pause"], ["← →", "previous or next frame"], ["Home End", "first or last frame"],
  ["+ −", "zoom (also the wheel)"], ["0", "whole frame, usual contrast"], ["N, Shift + N", "choose the next or previous electrode (also ] and [ )"],
  ["Shift + arrows", "move the chosen electrode by 1 pixel for each press"], ["Delete", "delete the chosen electrode"],
  ["A", "add an electrode that the catheter lacks: move the cross with the arrows (Shift: 10 pixels), set it with Enter"],
  ["M", "mark a whole catheter from its tip on: arrows and Enter for each electrode"], ["Esc", "end adding or marking"],
  ["T", "track again from here: this frame is right, so compute with it"],
  ["Ctrl + Z, Ctrl + Y", "undo, redo"], ["right button", "drag: contrast"], ["middle button", "drag: move the picture"],
];

const STEP_PX = 1;
const LONG_STEP_PX = 10;

/** @type {Record<string, [number, number]>} */
const WAYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** @param {View} view @param {() => void} trackAgain */
export function listenToKeys(view, trackAgain) {
  const { canvas, pen } = view;

  /** @param {number} step */
  const chooseNext = (step) => {
    const all = [...view.electrodes].sort((a, b) => `${a.catheter}`.localeCompare(`${b.catheter}`) || a.electrode - b.electrode);
    const at = all.findIndex((each) => keyOf(each) === view.chosen);
    view.choose(all[at < 0 ? (step > 0 ? 0 : all.length - 1) : (at + step + all.length) % all.length] ?? null);
  };

  /** @param {KeyboardEvent} event */
  const correct = (event) => {
    const chosen = view.chosenElectrode;
    const way = WAYS[event.key];
    const key = event.key.toLowerCase();
    if (view.cross && way) view.moveCross(...scaled(way, event.shiftKey ? LONG_STEP_PX : STEP_PX));
    else if (view.cross && key === "enter") view.place(view.cross.u, view.cross.v);
    else if (event.shiftKey && way) {
      if (!chosen?.catheter) return false;
      view.carry(chosen, chosen.u_px + way[0], chosen.v_px + way[1]);
    } else if (key === "n" || key === "]" || key === "[") chooseNext(key === "[" || (key === "n" && event.shiftKey) ? -1 : 1);
    else if (key === "delete" || key === "backspace") {
      if (!chosen) return false;
      view.remove(chosen);
    } else if (key === "a") pen.take({ tool: "add" });
    else if (key === "m") pen.take({ tool: "mark" });
    else if (key === "escape") pen.take({ tool: "edit" });
    else if (key === "t") trackAgain();
    else return view.press(event.key);
    return true;
  };

  canvas.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
    const key = event.key.toLowerCase();
    if (event.ctrlKey && !event.altKey && (key === "z" || key === "y")) view.step(key === "y" || event.shiftKey ? 1 : -1);
    // With AltGr, which reports Ctrl and Alt, some keyboards write [ and ].
    else if ((event.ctrlKey || event.altKey || event.metaKey) && key !== "[" && key !== "]") return;
    else if (!correct(event)) return;
    event.preventDefault();
  });
  // An electrode that moves by keys is stored once, when the keys are released.
  canvas.addEventListener("keyup", (/** @type {KeyboardEvent} */ event) => event.key === "Shift" && view.drop());
  canvas.addEventListener("blur", () => view.drop());
}

/** @param {[number, number]} way @param {number} by @returns {[number, number]} */
const scaled = (way, by) => [way[0] * by, way[1] * by];
