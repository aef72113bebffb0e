/** The wall of the chamber: bands and lines of equal time, drawn for each pixel, and a hatch where no site is near. */
import * as THREE from "../three/three.module.min.js";

const MOST_BANDS = 32;
const EVER = 1e9;

const VERTEX = `
attribute float value; attribute float known; attribute float time;
varying float vValue; varying float vKnown; varying float vTime; varying vec3 vNormal; varying vec3 vView;
void main() {
  vValue = value; vKnown = known; vTime = time;
  vec4 place = modelViewMatrix * vec4(position, 1.0);
  vNormal = normalMatrix * normal; vView = -place.xyz;
  gl_Position = projectionMatrix * place;
}`;

// The shares of colour over fluoroscopy are those of the overlays that the service draws: electrodes stay visible.
const FRAGMENT = `
uniform vec3 colours[${MOST_BANDS}]; uniform float start; uniform float step_; uniform float bands; uniform float until; uniform bool over;
varying float vValue; varying float vKnown; varying float vTime; varying vec3 vNormal; varying vec3 vView;
void main() {
  vec3 colour = vec3(0.59);
  float share = 0.0;
  float hatch = mod(gl_FragCoord.x + gl_FragCoord.y, 9.0);
  if (hatch < 1.6) { colour = vec3(0.82); share = 0.4; }
  if (vKnown > 0.5) {
    float position = (vValue - start) / step_;
    int band = int(clamp(floor(position), 0.0, bands - 1.0));
    colour = vec3(0.93);
    share = 0.0;
    if (vTime <= until) {
      colour = colours[band];
      float away = abs(fract(position + 0.5) - 0.5) / max(fwidth(position), 1e-6);
      // At the rim the values are those of neighbours: lines there mean nothing.
      float line = vKnown > 0.999 ? 1.0 - smoothstep(0.6, 1.4, away) : 0.0;
      share = mix(0.32, 0.5, line);
      colour = mix(colour, vec3(1.0), line);
    }
    float front = abs(vTime - until) / max(fwidth(vTime), 1e-6);
    if (front < 2.0) { colour = vec3(over ? 1.0 : 0.0); share = 1.0; }
  }
  if (over) {
    gl_FragColor = vec4(colour * share, share);
  } else {
    // A little light shows the shape and keeps each colour recognisable beside the colour bar.
    float facing = abs(dot(normalize(vNormal), normalize(vView)));
    gl_FragColor = vec4(colour * (0.78 + 0.22 * facing), 1.0);
  }
}`;

/** Values past the rim of the covered part: the mean of the covered neighbours, so that bands end at the rim and not at zero. @param {number[][]} faces @param {(number|null)[]} values */
function extended(faces, values) {
  const sums = new Float64Array(values.length);
  const counts = new Float64Array(values.length);
  for (const face of faces) for (const k of face) for (const other of face) {
    const value = values[other];
    if (value !== null && value !== undefined) { sums[k] = (sums[k] ?? 0) + value; counts[k] = (counts[k] ?? 0) + 1; }
  }
  return values.map((value, k) => value ?? (counts[k] ? (sums[k] ?? 0) / (counts[k] ?? 1) : 0));
}

export class Surface {
  /** @param {import("./look.js").MapLook} look @param {boolean} over True for the see-through colours over fluoroscopy. */
  constructor(look, over) {
    this.look = look;
    const { map } = look;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(map.vertices_mm.flat(), 3));
    geometry.setIndex(map.faces.flat());
    geometry.computeVertexNormals();
    geometry.computeBoundingSphere();
    geometry.computeBoundingBox();
    geometry.setAttribute("known", new THREE.Float32BufferAttribute(map.covered.map(Number), 1));
    geometry.setAttribute("time", new THREE.Float32BufferAttribute(extended(map.faces, map.lat_ms), 1));
    this.uniforms = {
      colours: { value: Array.from({ length: MOST_BANDS }, () => new THREE.Vector3()) },
      start: { value: 0 }, step_: { value: 1 }, bands: { value: 1 }, until: { value: EVER }, over: { value: over },
    };
    const material = new THREE.ShaderMaterial({
      uniforms: this.uniforms, vertexShader: VERTEX, fragmentShader: FRAGMENT, side: THREE.DoubleSide, blending: THREE.NoBlending,
    });
    this.mesh = new THREE.Mesh(geometry, material);
    this.sphere = /** @type {THREE.Sphere} */ (geometry.boundingSphere);
    /** @type {(number|null)[]|null} */
    this.shown = null;
    this.update();
  }

  /** Take the colours, values and time of the look. */
  update() {
    const { scale, values, untilMs, map } = this.look;
    if (this.shown !== values) this.mesh.geometry.setAttribute("value", new THREE.Float32BufferAttribute(extended(map.faces, values), 1));
    this.shown = values;
    scale.colours.slice(0, MOST_BANDS).forEach((rgb, k) => this.uniforms.colours.value[k]?.set((rgb[0] ?? 0) / 255, (rgb[1] ?? 0) / 255, (rgb[2] ?? 0) / 255));
    [this.uniforms.start.value, this.uniforms.step_.value, this.uniforms.bands.value] = [scale.start, scale.step, scale.bands];
    this.uniforms.until.value = untilMs ?? EVER;
  }

  /** Draw the faces of one side only. @param {THREE.Side} side */
  show(side) {
    const material = /** @type {THREE.Material} */ (this.mesh.material);
    if (material.side === side) return;
    material.side = side;
    material.needsUpdate = true;
  }

  close() {
    this.mesh.geometry.dispose();
    /** @type {THREE.Material} */ (this.mesh.material).dispose();
  }
}

/** A renderer whose colours are those of the colour bar. @param {HTMLCanvasElement} canvas @param {boolean} smooth Smooth edges, and a picture that stays: for a canvas that the page shows. */
export function rendererOf(canvas, smooth) {
  THREE.ColorManagement.enabled = false;
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: smooth, alpha: true, preserveDrawingBuffer: smooth });
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  return renderer;
}
