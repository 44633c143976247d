// Numbers as the page writes them: three figures, a unit on each, "unavailable" for what nobody knows.

export const UNAVAILABLE = "unavailable";

const known = (value) => typeof value === "number" && Number.isFinite(value);

export const byId = (id) => document.getElementById(id);

// Three significant figures without an exponent.
export function figures(value) {
  const size = Math.abs(value);
  if (size === 0) return "0";
  const digits = Math.max(0, 2 - Math.floor(Math.log10(size * 1.0005)));
  return value.toFixed(Math.min(digits, 6));
}

export function microseconds(value) {
  if (!known(value)) return UNAVAILABLE;
  const size = Math.abs(value);
  if (size >= 0.9995e6) return `${figures(value / 1e6)} s`;
  if (size >= 0.9995e3) return `${figures(value / 1e3)} ms`;
  if (size >= 0.9995 || size === 0) return `${figures(value)} µs`;
  return `${figures(value * 1e3)} ns`;
}

export function seconds(value, digits = 1) {
  return known(value) ? `${value.toFixed(digits)} s` : UNAVAILABLE;
}

export function quantity(value, unit, digits) {
  if (!known(value)) return UNAVAILABLE;
  return `${digits === undefined ? figures(value) : value.toFixed(digits)} ${unit}`;
}

export function count(value) {
  return known(value) ? Math.round(value).toLocaleString("en-GB") : UNAVAILABLE;
}

export function share(part, whole) {
  if (!known(part) || !known(whole) || whole <= 0) return UNAVAILABLE;
  return `${((100 * part) / whole).toFixed(2)} %`;
}

export function age(value) {
  if (!known(value)) return "never heard";
  if (value < 1) return `${Math.round(value * 1000)} ms`;
  return value < 100 ? `${value.toFixed(1)} s` : `${Math.round(value)} s`;
}

// Writes only what changed, so that readers of the page and of its accessibility tree stay calm.
export function write(element, text) {
  if (element && element.textContent !== text) element.textContent = text;
}

// An element with attributes and children, without markup in strings.
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === false || value === undefined || value === null) continue;
    element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

// An entry of a scene's legend.
export function legendEntry(kind, words, text = "") {
  return make("li", {}, make("i", { class: kind }, text), words);
}

// Something of a scene in words, at the end of their list.
export function chipOf(list, name, told, kind) {
  const mark = make("b", {}, name);
  const text = make("output", told);
  const item = make("li", { class: kind }, mark, text);
  list.append(item);
  return { item, mark, text };
}

// Puts a child at its place among its parent's others, and touches nothing when it is there.
export function keepAt(parent, index, child) {
  if (parent.children[index] !== child) parent.insertBefore(child, parent.children[index] ?? null);
}

// Forgets the items of a map, and takes them off the page, whose keys are not present any more.
export function keepOnly(items, present) {
  for (const [key, { item }] of items) {
    if (present.has(key)) continue;
    item.remove();
    items.delete(key);
  }
}

// The page's colours as the stylesheet has them now; they change with the system's light or dark.
export function palette() {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(`--${name}`).trim();
  const names = ["paper", "panel", "ink", "faint", "rule", "tint", "bad", "caution", "good", "accent"];
  const colours = Object.fromEntries(names.map((name) => [name, colour(name)]));
  colours.series = [0, 1, 2, 3, 4, 5, 6].map((index) => colour(`k${index}`));
  return colours;
}

export const FONT = 'system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';

// Fits a canvas to its box and the screen's resolution; returns its context in CSS pixels.
export function surface(canvas) {
  const box = canvas.getBoundingClientRect();
  const ratio = Math.min(window.devicePixelRatio || 1, 2.5);
  const [width, height] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, box.width, box.height);
  return { context, width: box.width, height: box.height };
}

// A path through points [x, y], for the caller to fill or to stroke.
export function polyline(context, points, isClosed = false) {
  context.beginPath();
  points.forEach(([x, y], index) => context[index ? "lineTo" : "moveTo"](x, y));
  if (isClosed) context.closePath();
}

// A line through points [x, y].
export function stroked(context, points, style, width) {
  context.strokeStyle = style;
  context.lineWidth = width;
  polyline(context, points);
  context.stroke();
}

// A canvas without an area, as before the first layout: there is nothing to draw on, and a sheet of
// its size may not be copied.
export function isEmpty(canvas) {
  return canvas.width === 0 || canvas.height === 0;
}
