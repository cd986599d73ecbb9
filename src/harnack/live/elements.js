// Elements of the window, and numbers as it writes them.
// @ts-check

/** @template {keyof HTMLElementTagNameMap} K @param {K} kind @param {object} [given]
 *  @param {(Node | string)[]} within @returns {HTMLElementTagNameMap[K]} */
export function element(kind, given = {}, ...within) {
  const made = Object.assign(document.createElement(kind), given);
  made.append(...within);
  return made;
}

/** A number with four digits. @param {number} x */
export function format(x) { return String(Number(x.toPrecision(4))); }
