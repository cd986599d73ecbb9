// The light on the floor: directions of the rays that are traced from its cells, and the light that
// reaches them. See `harnack.rendering.shading`.
// @ts-check

import { cross } from "./camera.js";

/** The floor has FLOOR_CELLS x FLOOR_CELLS cells; each traces RAYS_PER_CELL rays to the key light
 *  and as many to the sky. These numbers are in passes.wgsl, too. */
export const FLOOR_CELLS = 64;
export const RAYS_PER_CELL = 8;
// The cells of a block of SAMPLE_BLOCK x SAMPLE_BLOCK have different rays.
export const SAMPLE_BLOCK = 4;
export const FLOOR_RAYS = FLOOR_CELLS * FLOOR_CELLS * RAYS_PER_CELL;
// The radius of the round key light, at distance 1.
const KEY_LIGHT_RADIUS = 0.34;
const BLUR_WEIGHTS = [0.025, 0.125, 0.225, 0.25, 0.225, 0.125, 0.025];

/** Points in the unit square, spread evenly (Roberts 2018), in the order of `_square` in harnack.rendering.shading. */
function spreadPoints() {
  const plasticNumber = 1.32471795724474602596;
  const cellCount = SAMPLE_BLOCK * SAMPLE_BLOCK;
  /** @type {number[][]} */
  const points = [];
  for (let cell = 0; cell < cellCount; cell++)
    for (let ray = 0; ray < RAYS_PER_CELL; ray++) {
      const k = ray * cellCount + cell;
      points.push([(0.5 + k / plasticNumber) % 1, (0.5 + k / plasticNumber ** 2) % 1]);
    }
  return points;
}

/** Unit vectors to points of the key light, and after them to points of the sky; four numbers each.
 *  @param {number[]} key the unit vector to the middle of the key light */
export function lightDirections(key) {
  const absolute = key.map(Math.abs);
  const axis = [0, 0, 0];
  axis[absolute.indexOf(Math.min(...absolute))] = 1;
  const u = normalize(cross(key, axis));
  const v = cross(key, u);
  const points = spreadPoints();
  const directions = new Float32Array(8 * points.length);
  points.forEach(([s, turn], k) => {
    const [radius, angle] = [Math.sqrt(s), 2 * Math.PI * turn];
    const spread = KEY_LIGHT_RADIUS * radius;
    const toLight = key.map((x, i) => x + spread * (Math.cos(angle) * u[i] + Math.sin(angle) * v[i]));
    toLight[2] = Math.max(toLight[2], 0.05);
    const toSky = [radius * Math.cos(angle), radius * Math.sin(angle), Math.sqrt(Math.max(1 - s, 1e-3))];
    directions.set(normalize(toLight), 4 * k);
    directions.set(toSky, 4 * (points.length + k));
  });
  return directions;
}

/** The fractions of the key light and of the sky that reach each cell: pairs of numbers.
 *  @param {Uint32Array} occluded 1 for each ray that meets a surface; first those to the key light */
export function floorLight(occluded) {
  const light = new Float32Array(2 * FLOOR_CELLS * FLOOR_CELLS);
  const indices = Array.from({ length: FLOOR_CELLS }, (_, k) => k);
  for (const kind of [0, 1]) {
    const visibility = indices.map((j) => indices.map((i) => {
      const start = kind * FLOOR_RAYS + RAYS_PER_CELL * (j * FLOOR_CELLS + i);
      let hitCount = 0;
      for (let ray = 0; ray < RAYS_PER_CELL; ray++) hitCount += occluded[start + ray];
      return 1 - hitCount / RAYS_PER_CELL;
    }));
    blur(visibility).forEach((row, j) => row.forEach((x, i) => { light[2 * (j * FLOOR_CELLS + i) + kind] = x; }));
  }
  return light;
}

/** A picture blurred along both axes; it is 1 outside of its border. @param {number[][]} picture */
function blur(picture) { return blurRows(blurRows(picture)); }

/** A picture with its rows blurred, transposed. @param {number[][]} rows */
function blurRows(rows) {
  const n = rows.length;
  return Array.from({ length: n }, (_, column) =>
    rows.map((row) => BLUR_WEIGHTS.reduce((sum, weight, k) => {
      const neighbor = column + k - 3;
      return sum + weight * (neighbor < 0 || neighbor >= n ? 1 : row[neighbor]);
    }, 0)));
}

/** @param {number[]} v */
function normalize(v) { return v.map((x) => x / Math.hypot(...v)); }
