// Helpers for the elements of the window, and for numbers as they are written in it.
// @ts-check

/** Creates an element. @template {keyof HTMLElementTagNameMap} K @param {K} tagName
 *  @param {object} [properties] @param {(Node | string)[]} children
 *  @returns {HTMLElementTagNameMap[K]} */
export function createElement(tagName, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tagName), properties);
  element.append(...children);
  return element;
}

/** The text of a number, with four digits. @param {number} x */
export function formatNumber(x) { return String(Number(x.toPrecision(4))); }

/** Lets the person who views the page save a file. @param {string} href @param {string} name */
export function download(href, name) { createElement("a", { href, download: name }).click(); }

/** Lets the person who views the page save a file. @param {Blob} blob @param {string} name */
export function downloadBlob(blob, name) {
  const href = URL.createObjectURL(blob);
  download(href, name);
  setTimeout(() => URL.revokeObjectURL(href), 1000);
}

/** The options of a list, for createElement. @param {string[]} names */
export function createOptions(names) {
  return names.map((name) => createElement("option", { value: name }, name));
}

/** A button. @param {string} name @param {() => void} onclick */
export function createButton(name, onclick) {
  return createElement("button", { type: "button", onclick }, name);
}

/** A checkbox with its label. @param {string} name @param {(isChecked: boolean) => void} onChange */
export function createCheckbox(name, onChange) {
  const input = createElement("input", { type: "checkbox", onchange: () => onChange(input.checked) });
  return createElement("label", {}, input, ` ${name}`);
}

/** The input of a slider.
 *  @param {{name: string, low: number, high: number, start: number, step: number | null}} slider
 *  @param {(value: number) => void} onInput */
export function createRangeInput({ name, low, high, start, step }, onInput) {
  const input = createElement("input", {
    type: "range", min: String(low), max: String(high), step: step === null ? "any" : String(step),
    name, value: String(start), oninput: () => onInput(Number(input.value)),
  });
  return input;
}
