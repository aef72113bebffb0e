/** Colours of catheters, which colour-blind people can distinguish (M. Okabe and K. Ito). The service's pictures use the same. */
const COLOURS = ["#56b4e9", "#f0e442", "#e69f00", "#cc79a7", "#009e73", "#d55e00"];
const UNNAMED = "#bbbbbb";

/** @param {string[]} names Catheters of the study in its order. @param {string|null} catheter */
export function catheterColour(names, catheter) {
  const index = catheter === null ? -1 : names.indexOf(catheter);
  return index < 0 ? UNNAMED : (COLOURS[index % COLOURS.length] ?? UNNAMED);
}
