/** Labels beside points of a picture. A later label gives way to the earlier ones. */

/** @typedef {{at: {x: number, y: number}, text: string, chosen: boolean, faint: boolean}} Label */

const FONT_PX = 12;
const FAR_STEPS = 4;

/** @param {CanvasRenderingContext2D} context @param {Label[]} labels @param {number} unit Canvas pixels for each pixel of the page. @param {number} right Where the space for labels ends. */
export function drawLabels(context, labels, unit, right) {
  const height = (FONT_PX + 3) * unit;
  /** @type {{x: number, y: number, width: number}[]} */
  const taken = [];
  context.textAlign = "left";
  context.textBaseline = "middle";
  for (const { at, text, chosen, faint } of labels) {
    context.font = `${faint ? 400 : 600} ${FONT_PX * unit}px system-ui`;
    const { width } = context.measureText(text);
    const x = at.x + 12 * unit + width > right ? at.x - 12 * unit - width : at.x + 9 * unit;
    const free = (/** @type {number} */ y) => taken.every((each) => x > each.x + each.width || each.x > x + width || Math.abs(each.y - y) >= height);
    const places = Array.from({ length: FAR_STEPS }, (_, k) => [at.y - 7 * unit - k * height, at.y + 9 * unit + k * height]).flat();
    const y = places.find(free) ?? at.y - 7 * unit;
    taken.push({ x, y, width });
    if (chosen) {
      context.fillStyle = "#fff";
      context.fillRect(x - 3 * unit, y - height / 2, width + 6 * unit, height);
      context.fillStyle = "#000";
    } else {
      context.lineWidth = 3 * unit;
      context.strokeStyle = "rgba(0,0,0,.85)";
      context.strokeText(text, x, y);
      context.fillStyle = faint ? "#d0d0d0" : "#fff";
    }
    context.fillText(text, x, y);
  }
}
