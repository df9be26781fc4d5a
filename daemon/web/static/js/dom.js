// Elements from text and data. No code of the page makes HTML from strings.

const SVG = "http://www.w3.org/2000/svg";

function made(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** An HTML element; attributes that begin with "on" are listeners; null and false are omitted. */
export const h = (tag, attributes, ...children) => made(document.createElement(tag), attributes, children);

/** An SVG element. */
export const s = (tag, attributes, ...children) => made(document.createElementNS(SVG, tag), attributes, children);

/** Set a text only if it has changed, so that screen readers, selection and focus are not disturbed. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

const keys = new WeakMap();

/** Fill an element again, but only if its key has changed since the last time. */
export function fill(element, key, build) {
  const text = JSON.stringify(key);
  if (keys.get(element) === text) return;
  keys.set(element, text);
  const focused = element.contains(document.activeElement) ? document.activeElement.dataset.key : undefined;
  element.replaceChildren(...[build()].flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  if (focused !== undefined) element.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus();
}

/** A table: columns are [heading, is text], rows are lists of cells. */
export function table(caption, columns, rows) {
  const kind = (column) => (columns[column][1] ? "text" : null);
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption },
    h("table", null,
      h("caption", null, caption),
      h("thead", null, h("tr", null, columns.map(([name], i) => h("th", { scope: "col", class: kind(i) }, name)))),
      h("tbody", null, rows.map((row) => h("tr", null, row.map((cell, i) =>
        i === 0 ? h("th", { scope: "row" }, cell) : h("td", { class: kind(i) }, cell)))))));
}

/** A tile: a label, a large value, and a line below it. */
export const tile = (label, value, unit = "", below = "") =>
  h("div", { class: "tile" }, h("dt", null, label), h("dd", null, value, unit && h("small", null, ` ${unit}`)), below && h("dd", null, h("p", null, below)));

/** A bar that is filled between two shares, 0 to 1. */
export function bar(label, from, to) {
  const at = (share) => `${(100 * Math.min(Math.max(share, 0), 1)).toFixed(1)}%`;
  const width = Math.max(Math.min(to, 1) - Math.max(from, 0), 0);
  return s("svg", { class: "bar", role: "img", "aria-label": label, preserveAspectRatio: "none" },
    s("rect", { class: "share", x: at(from), y: "0", height: "100%", width: at(width) }));
}
