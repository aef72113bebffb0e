/** Colours of catheters, which colour-blind people can distinguish (M. Okabe and K. Ito). */
const COLOURS = ["#56b4e9", "#f0e442", "#e69f00", "#cc79a7", "#009e73", "#d55e00"];
export const UNNAMED = "#bbbbbb";

/** @param {import("../shared/types.js").Study} study @param {string|null} catheter */
export function catheterColour(study, catheter) {
  const index = study.catheters.findIndex((each) => each.name === catheter);
  return index < 0 ? UNNAMED : (COLOURS[index % COLOURS.length] ?? UNNAMED);
}
