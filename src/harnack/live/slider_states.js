// State deltas relative to the initial state: sent by Python, or stored in a standalone page for
// each combination of slider values.
// @ts-check

import { decodeWords } from "./renderer.js";

/** @import {Check, State, Surface} from "./renderer.js" */
/** A surface that differs from the initial one: `to` are the changed words of its data, `at` their
 *  indices; other entries replace those of the initial surface.
 *  @typedef {Partial<Surface> & {at: string, to: string, check?: Check}} SurfaceDelta */
/** The difference between a state and the initial one; surfaces with other kernels are sent whole.
 *  @typedef {{surfaces: (Surface | SurfaceDelta)[], curves?: number[][][]}} StateDelta */

/** The state that a delta describes; the inverse of `state_delta` in harnack.live.live_scene.
 *  @param {State} initialState @param {StateDelta} delta @returns {Promise<State>} */
export async function applyDelta(initialState, delta) {
  const surfaces = await Promise.all(delta.surfaces.map((surfaceDelta, k) =>
    ("at" in surfaceDelta ? applySurfaceDelta(initialState.surfaces[k], surfaceDelta) : surfaceDelta)));
  return { surfaces, curves: delta.curves ?? initialState.curves };
}

/** @param {Surface} initialSurface @param {SurfaceDelta} delta @returns {Promise<Surface>} */
async function applySurfaceDelta(initialSurface, delta) {
  // The decoded words are stored for the next delta.
  initialSurface.data = await decodeWords(initialSurface.data);
  const { at, to, ...replacements } = delta;
  const [indices, values] = await Promise.all([decodeWords(at), decodeWords(to)]);
  const data = initialSurface.data.slice();
  indices.forEach((index, k) => { data[index] = values[k]; });
  return { ...initialSurface, check: undefined, ...replacements, data };
}

/** The states that a standalone page holds, one for each combination of slider values. The last
 *  slider varies fastest. */
export class SliderStates {
  /** @param {{places: Record<string, number[]>, frames: StateDelta[]}} stored the values of each
   *  slider, and the deltas */
  constructor({ places, frames }) {
    this.sliderValues = places;
    this.deltas = frames;
  }

  /** The delta of the stored slider values that are nearest to given ones.
   *  @param {{sliders: Record<string, number>}} controlValues @returns {Promise<StateDelta>} */
  async fetchDelta({ sliders }) {
    let index = 0;
    for (const [name, values] of Object.entries(this.sliderValues)) {
      const distances = values.map((x) => Math.abs(x - sliders[name]));
      index = index * values.length + distances.indexOf(Math.min(...distances));
    }
    return this.deltas[index];
  }
}
