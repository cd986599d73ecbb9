// The legend beside a picture: what its colors mean. See harnack.live.legend_data.
// @ts-check

import { createElement, formatNumber } from "./dom.js";

/** Ticks are pairs of a position between 0 and 1 and a text; swatches are pairs of a name and a
 *  color, null for the background.
 *  @typedef {{title: string, colors?: string[], ticks?: [number, string][] | null,
 *             swatches: [string, string | null][]}} Legend */

/** The element that shows a legend. @param {Legend} legend
 *  @param {[number, number] | null} range the least and the greatest visible number, for scales
 *  whose ticks depend on it @param {string} background the color behind the surfaces */
export function createLegend(legend, range, background) {
  const { title, colors, swatches } = legend;
  const figure = createElement("figure", { className: "legend" }, createElement("figcaption", {}, title));
  const descriptions = [title];
  if (colors) {
    const ticks = legend.ticks ?? rangeTicks(range);
    figure.append(...createColorBar(colors, ticks));
    if (ticks.length) descriptions.push(`from ${ticks[0][1]}, ${describeLightness(colors[0])}, to `
      + `${ticks[ticks.length - 1][1]}, ${describeLightness(colors[colors.length - 1])}`);
  }
  figure.append(...swatches.map(([name, color]) => createSwatch(name, color ?? background)));
  descriptions.push(...swatches.filter(([, color]) => color).map(([name, color]) => `${name}: ${color}`));
  figure.setAttribute("role", "img");
  figure.setAttribute("aria-label", descriptions.join("; "));
  return figure;
}

/** Ticks at both ends of a range. @param {[number, number] | null} range
 *  @returns {[number, string][]} */
function rangeTicks(range) {
  return range ? [[0, formatNumber(range[0])], [1, formatNumber(range[1])]] : [];
}

/** A bar of colors, and the row of ticks below it.
 *  @param {string[]} colors @param {[number, string][]} ticks */
function createColorBar(colors, ticks) {
  const bar = createElement("div", { className: "bar" });
  bar.style.background = `linear-gradient(to right, ${colors.join(", ")})`;
  const row = createElement("div", { className: "ticks" });
  for (const [position, text] of ticks) {
    const tick = createElement("span", {}, text);
    // The numbers at both ends stay within the bar.
    tick.style.left = `${100 * position}%`;
    tick.style.transform = `translateX(${position < 0.05 ? 0 : position > 0.95 ? -100 : -50}%)`;
    row.append(tick);
  }
  return [bar, row];
}

/** A patch of a color, with its name. @param {string} name @param {string} color */
function createSwatch(name, color) {
  const patch = createElement("i");
  patch.style.background = color;
  return createElement("span", { className: "swatch" }, patch, name);
}

/** The lightness of a color, for people who cannot see it. @param {string} color #rrggbb */
function describeLightness(color) {
  const [red, green, blue] = [1, 3, 5].map((k) => parseInt(color.slice(k, k + 2), 16));
  return (0.3 * red + 0.6 * green + 0.1 * blue) > 128 ? "bright" : "dark";
}
