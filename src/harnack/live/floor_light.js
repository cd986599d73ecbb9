// The light on the floor: directions of the rays that are traced from its cells, and the light that
// reaches them. See `harnack.rendering.shading`.
// @ts-check

import { cross } from "./camera.js";

/** Constants of shading, from `scene_shading` of harnack.live.shading_data. The floor has
 *  `floor_cells` x `floor_cells` cells; each traces `rays_per_cell` rays to the key light and as many
 *  to the sky.
 *  @typedef {{
 *   floor_cells: number, rays_per_cell: number, sky_direction_count: number, key_direction: number[],
 *   key_light_points: number[][], sky_directions: number[][], least_key_height: number,
 *   blur_weights: number[], reflectance: Record<string, number[]>,
 *   background: Record<string, number[]>, css_background: Record<string, string>
 * }} Shading */

/** Unit vectors to points of the key light, and after them to points of the sky; four numbers each.
 *  @param {Shading} shading @param {number[]} key the unit vector to the middle of the key light */
export function lightDirections(shading, key) {
  const absolute = key.map(Math.abs);
  const axis = [0, 0, 0];
  axis[absolute.indexOf(Math.min(...absolute))] = 1;
  const u = normalize(cross(key, axis));
  const v = cross(key, u);
  const toKey = shading.key_light_points.map(([radius, angle]) => {
    const toLight = key.map((x, i) => x + radius * (Math.cos(angle) * u[i] + Math.sin(angle) * v[i]));
    toLight[2] = Math.max(toLight[2], shading.least_key_height);
    return normalize(toLight);
  });
  return new Float32Array([...toKey, ...shading.sky_directions].flatMap((direction) => [...direction, 0]));
}

/** The fractions of the key light and of the sky that reach each cell: pairs of numbers.
 *  @param {Shading} shading
 *  @param {Uint32Array} occluded 1 for each ray that meets a surface; first those to the key light */
export function floorLight(shading, occluded) {
  const { floor_cells: cells, rays_per_cell: rays } = shading;
  const light = new Float32Array(2 * cells * cells);
  const indices = Array.from({ length: cells }, (_, k) => k);
  for (const kind of [0, 1]) {
    const visibility = indices.map((j) => indices.map((i) => {
      const start = rays * ((kind * cells + j) * cells + i);
      let hitCount = 0;
      for (let ray = 0; ray < rays; ray++) hitCount += occluded[start + ray];
      return 1 - hitCount / rays;
    }));
    const blurred = blurRows(blurRows(visibility, shading.blur_weights), shading.blur_weights);
    blurred.forEach((row, j) => row.forEach((x, i) => { light[2 * (j * cells + i) + kind] = x; }));
  }
  return light;
}

/** A picture with its rows blurred, transposed. It is 1 outside of its border.
 *  @param {number[][]} rows @param {number[]} weights an odd number of them */
function blurRows(rows, weights) {
  const n = rows.length;
  return Array.from({ length: n }, (_, column) =>
    rows.map((row) => weights.reduce((sum, weight, k) => {
      const neighbor = column + k - (weights.length - 1) / 2;
      return sum + weight * (neighbor < 0 || neighbor >= n ? 1 : row[neighbor]);
    }, 0)));
}

/** @param {number[]} v */
function normalize(v) { return v.map((x) => x / Math.hypot(...v)); }
