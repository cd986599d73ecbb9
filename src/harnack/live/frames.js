// State deltas relative to the initial state: sent by Python, or stored in a standalone page for
// each combination of slider values.
// @ts-check

import { words } from "./drawing.js";

/** @import {Check, State, Surface} from "./drawing.js" */
/** Words of the data of each surface and whatever else has changed of it, or other surfaces.
 * @typedef {{surfaces: (Surface | Partial<Surface> & {at: string, to: string, check?: Check})[],
 *            curves?: number[][][]}} Change */

/** The state after a change; see `state_delta` in harnack.live.live_scene. @param {State} first
 *  @param {Change} change @returns {Promise<State>} */
export async function changed(first, change) {
  const surfaces = await Promise.all(change.surfaces.map(async (given, k) => {
    if (!("at" in given)) return given;
    const old = first.surfaces[k];
    old.data = await words(old.data);
    const { at, to, ...others } = given;
    const [places, values] = await Promise.all([words(at), words(to)]);
    const data = old.data.slice();
    places.forEach((place, i) => { data[place] = values[i]; });
    return { ...old, check: undefined, ...others, data };
  }));
  return { surfaces, curves: change.curves ?? first.curves };
}

export class Frames {
  /** @param {{places: Record<string, number[]>, frames: Change[]}} given */
  constructor(given) { this.given = given; }

  /** What changes at the places that are nearest to these. @param {{sliders: Record<string, number>}}
   *  wanted @returns {Promise<Change>} */
  async change({ sliders }) {
    let at = 0;
    for (const [name, places] of Object.entries(this.given.places)) {
      const far = places.map((x) => Math.abs(x - sliders[name]));
      at = at * places.length + far.indexOf(Math.min(...far));
    }
    return this.given.frames[at];
  }
}
