/** The small figure that shows how the map is turned. The words are spelled, so that R and A are no atrium. */
import * as THREE from "../three/three.module.min.js";

/** @type {[string, number, number, number][]} */
const ENDS = [["Left", 1, 0, 0], ["Right", -1, 0, 0], ["Back", 0, 1, 0], ["Front", 0, -1, 0], ["Head", 0, 0, 1], ["Feet", 0, 0, -1]];
const SIZE = 130;

/** @param {HTMLCanvasElement} canvas @param {THREE.Camera} camera */
export function drawOrientation(canvas, camera) {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.height = SIZE * ratio;
  canvas.style.width = canvas.style.height = `${SIZE}px`;
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.scale(ratio, ratio);
  context.font = "12px system-ui";
  context.textAlign = "center";
  context.textBaseline = "middle";
  const turn = new THREE.Matrix3().setFromMatrix4(camera.matrixWorldInverse);
  const ends = ENDS.map(([word, x, y, z]) => ({ word, at: new THREE.Vector3(x, y, z).applyMatrix3(turn) })).sort((a, b) => a.at.z - b.at.z);
  for (const { word, at } of ends) {
    const near = at.z > -0.2;
    const [x, y] = [SIZE / 2 + at.x * 38, SIZE / 2 - at.y * 38];
    context.strokeStyle = near ? "#333" : "#aaa";
    context.beginPath();
    context.moveTo(SIZE / 2, SIZE / 2);
    context.lineTo(x, y);
    context.stroke();
    // An axis towards or away from the eye has no place for its word, and a far end may lie behind a near one.
    if (Math.abs(at.z) > 0.9 || at.z < -0.3) continue;
    context.lineWidth = 3;
    context.strokeStyle = "rgba(255,255,255,.9)";
    context.strokeText(word, SIZE / 2 + at.x * 44, SIZE / 2 - at.y * 44);
    context.lineWidth = 1;
    context.fillStyle = near ? "#16181c" : "#666";
    context.fillText(word, SIZE / 2 + at.x * 44, SIZE / 2 - at.y * 44);
  }
}
