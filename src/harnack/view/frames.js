// The states of a page without Python behind it: those at the places of its sliders travel with it.
// @ts-check

import { words } from "./drawing.js";

/** @import {State, Surface} from "./drawing.js" */
/** What a choice of places changes: words of the data of each surface, or whole surfaces.
 * @typedef {{state?: State, changes?: {at: string, to: string}[], curves?: number[][][]}} Frame */

export class Frames {
  /** @param {State} state at the start @param {{places: Record<string, number[]>, frames: Frame[]}} given */
  constructor(state, given) {
    this.state = state;
    this.given = given;
  }

  /** What is drawn at the places that are nearest to these. @param {{sliders: Record<string, number>}}
   *  wanted @returns {Promise<State>} */
  async change({ sliders }) {
    let at = 0;
    for (const [name, places] of Object.entries(this.given.places)) {
      const far = places.map((x) => Math.abs(x - sliders[name]));
      at = at * places.length + far.indexOf(Math.min(...far));
    }
    const { state, changes, curves } = this.given.frames[at];
    if (state) return state;
    const surfaces = this.state.surfaces.map((surface, k) => {
      const data = words(surface.data);
      const [places, to] = [changes?.[k].at ?? "", changes?.[k].to ?? ""].map(words);
      places.forEach((place, i) => { data[place] = to[i]; });
      return { ...surface, data: text(data), check: undefined };
    });
    return { surfaces, curves: curves ?? this.state.curves };
  }
}

/** Words as base64. @param {Uint32Array} given */
function text(given) {
  let bytes = "";
  for (const byte of new Uint8Array(given.buffer)) bytes += String.fromCharCode(byte);
  return btoa(bytes);
}
