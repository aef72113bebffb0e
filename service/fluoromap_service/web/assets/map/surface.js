/** The wall of the chamber: bands and lines of equal time, drawn for each pixel, and a hatch where no site is near. */
import * as THREE from "../three/three.module.min.js";

const MOST_BANDS = 32;

const VERTEX = `
attribute float value; attribute float known; attribute float time;
varying float vValue; varying float vKnown; varying float vTime; varying vec3 vNormal; varying vec3 vView;
void main() {
  vValue = value; vKnown = known; vTime = time;
  vec4 place = modelViewMatrix * vec4(position, 1.0);
  vNormal = normalMatrix * normal; vView = -place.xyz;
  gl_Position = projectionMatrix * place;
}`;

const FRAGMENT = `
uniform vec3 colours[${MOST_BANDS}]; uniform float start; uniform float step_; uniform float bands; uniform float until; uniform bool lines;
varying float vValue; varying float vKnown; varying float vTime; varying vec3 vNormal; varying vec3 vView;
void main() {
  vec3 colour = vec3(0.59);
  float hatch = mod(gl_FragCoord.x + gl_FragCoord.y, 9.0);
  if (hatch < 1.6) colour = vec3(0.82);
  if (vKnown > 0.5) {
    float position = (vValue - start) / step_;
    int band = int(clamp(floor(position), 0.0, bands - 1.0));
    colour = vec3(0.93);
    if (vTime <= until) {
      for (int k = 0; k < ${MOST_BANDS}; k++) if (k == band) colour = colours[k];
      float away = abs(fract(position + 0.5) - 0.5) / max(fwidth(position), 1e-6);
      if (lines) colour = mix(vec3(1.0), colour, smoothstep(0.6, 1.4, away));
    }
    float front = abs(vTime - until) / max(fwidth(vTime), 1e-6);
    if (front < 2.0) colour = vec3(0.0);
  }
  // A little light shows the shape and keeps each colour recognisable beside the colour bar.
  float facing = abs(dot(normalize(vNormal), normalize(vView)));
  gl_FragColor = vec4(colour * (0.78 + 0.22 * facing), 1.0);
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

/**
 * @param {import("../shared/types.js").ChamberMap} map
 * @returns {{mesh: THREE.Mesh, show: (scale: import("./colour-scale.js").Scale, values: (number|null)[]) => void, setUntil: (ms: number) => void}}
 */
export function surfaceOf(map) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(map.vertices_mm.flat(), 3));
  geometry.setIndex(map.faces.flat());
  geometry.computeVertexNormals();
  geometry.setAttribute("known", new THREE.Float32BufferAttribute(map.covered.map(Number), 1));
  geometry.setAttribute("time", new THREE.Float32BufferAttribute(extended(map.faces, map.lat_ms), 1));
  const uniforms = {
    colours: { value: Array.from({ length: MOST_BANDS }, () => new THREE.Vector3()) },
    start: { value: 0 }, step_: { value: 1 }, bands: { value: 1 }, until: { value: 1e9 }, lines: { value: true },
  };
  const material = new THREE.ShaderMaterial({ uniforms, vertexShader: VERTEX, fragmentShader: FRAGMENT, side: THREE.DoubleSide });
  return {
    mesh: new THREE.Mesh(geometry, material),
    show(scale, values) {
      geometry.setAttribute("value", new THREE.Float32BufferAttribute(extended(map.faces, values), 1));
      scale.colours.slice(0, MOST_BANDS).forEach((rgb, k) => uniforms.colours.value[k]?.set((rgb[0] ?? 0) / 255, (rgb[1] ?? 0) / 255, (rgb[2] ?? 0) / 255));
      [uniforms.start.value, uniforms.step_.value, uniforms.bands.value] = [scale.start, scale.step, scale.bands];
    },
    setUntil(ms) { uniforms.until.value = ms; },
  };
}
