// What the colors of a picture mean, beside it: see harnack.live.legend_data.
// @ts-check

import { element, format } from "./elements.js";

/** @typedef {{title: string, colors?: string[], ticks?: [number, string][] | null,
 *             swatches: [string, string | null][]}} Legend */

/** The legend of a picture. @param {Legend} legend
 *  @param {[number, number] | null} range the least and the greatest number that is seen, of scales
 *  whose ticks depend on it @param {string} background behind the surfaces */
export function legend_of(legend, range, background) {
  const { title, colors, swatches } = legend;
  const made = element("figure", { className: "legend" }, element("figcaption", {}, title));
  const words = [title];
  if (colors) {
    const ticks = legend.ticks ?? (range ? [[0, format(range[0])], [1, format(range[1])]] : []);
    const bar = element("div", { className: "bar" });
    bar.style.background = `linear-gradient(to right, ${colors.join(", ")})`;
    const row = element("div", { className: "ticks" });
    for (const [share, text] of /** @type {[number, string][]} */ (ticks)) {
      const tick = element("span", {}, text);
      // The numbers at both ends stay within the bar.
      tick.style.left = `${100 * share}%`;
      tick.style.transform = `translateX(${share < 0.05 ? 0 : share > 0.95 ? -100 : -50}%)`;
      row.append(tick);
    }
    made.append(bar, row);
    if (ticks.length) words.push(`from ${ticks[0][1]}, ${name_of(colors[0])}, to `
      + `${ticks[ticks.length - 1][1]}, ${name_of(colors[colors.length - 1])}`);
  }
  for (const [name, color] of swatches) {
    const patch = element("i");
    patch.style.background = color ?? background;
    made.append(element("span", { className: "swatch" }, patch, name));
  }
  words.push(...swatches.filter(([, color]) => color).map(([name, color]) => `${name}: ${color}`));
  made.setAttribute("role", "img");
  made.setAttribute("aria-label", words.join("; "));
  return made;
}

/** The lightness of a color, for who cannot see it. @param {string} color #rrggbb */
function name_of(color) {
  const parts = [1, 3, 5].map((k) => parseInt(color.slice(k, k + 2), 16));
  return (0.3 * parts[0] + 0.6 * parts[1] + 0.1 * parts[2]) > 128 ? "bright" : "dark";
}
