/** The colour bar of a scale, as a small picture with its numbers. */

/** @param {HTMLCanvasElement} canvas @param {import("./colour-scale.js").Scale} scale @param {string} title */
export function drawColourBar(canvas, scale, title) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [96, 40 + Math.min(220, Math.max(90, 22 * scale.bands))];
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  canvas.style.width = `${width}px`;
  canvas.style.height = `${height}px`;
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.scale(ratio, ratio);
  context.fillStyle = "rgba(255,255,255,.88)";
  context.fillRect(0, 0, width, height);
  context.fillStyle = "#16181c";
  context.font = "600 12px system-ui";
  context.fillText(title, 6, 14);
  const top = 24;
  const each = (height - top - 12) / scale.bands;
  const every = Math.ceil(14 / each);
  context.font = "12px system-ui";
  context.textBaseline = "middle";
  for (let k = 0; k <= scale.bands; k += 1) {
    const y = top + k * each;
    const colour = scale.colours[k];
    if (colour) {
      context.fillStyle = `rgb(${colour.join(",")})`;
      context.fillRect(6, y, 22, each + 0.5);
    }
    context.fillStyle = "#16181c";
    if (k % every === 0 || k === scale.bands) context.fillText(`${scale.start + k * scale.step}`.replace("-", "−"), 34, y);
  }
  context.strokeStyle = "#16181c";
  context.strokeRect(6, top, 22, each * scale.bands);
}
