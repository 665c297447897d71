// Elements of the page, and numbers as text. The page never inserts texts of devices as HTML.

export function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") node.textContent = value;
    else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "hidden" || name === "disabled" || name === "checked" || name === "selected") node[name] = value;
    else if (value !== null && value !== undefined) node.setAttribute(name, value);
  }
  node.append(...children.filter((child) => child !== null));
  return node;
}

export const DEGREE = Math.PI / 180;
export const AXES = ["x", "y", "z"];

/** Return the cleared context of a square canvas of `size` CSS pixels, in the resolution of the screen. */
export function cleared(canvas, size) {
  const scale = Math.max(devicePixelRatio || 1, 1);
  const pixels = Math.round(size * scale);
  if (canvas.width !== pixels || canvas.height !== pixels) canvas.width = canvas.height = pixels;
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, size, size);
  return context;
}

/** Return a number as text with `decimals` digits and a minus sign; "–" for null. */
export function number(value, decimals = 0) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const text = value.toLocaleString("en", { minimumFractionDigits: decimals, maximumFractionDigits: decimals });
  return text.replace("-", "−");
}

export function length(vector) {
  return vector ? Math.hypot(...vector) : null;
}

/** Return a time in s as text with a suitable unit. */
export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return "–";
  const size = Math.abs(seconds);
  if (size < 1e-6) return `${number(seconds * 1e9, 0)} ns`;
  if (size < 1e-3) return `${number(seconds * 1e6, size < 1e-4 ? 1 : 0)} µs`;
  if (size < 1) return `${number(seconds * 1e3, size < 0.1 ? 1 : 0)} ms`;
  if (size < 120) return `${number(seconds, 1)} s`;
  if (size < 7200) return `${number(seconds / 60, 0)} min`;
  return size < 172800 ? `${number(seconds / 3600, 0)} h` : `${number(seconds / 86400, 0)} d`;
}

const SHOWN_UNITS = { rad: [1 / DEGREE, "°"], "rad/s": [1 / DEGREE, "°/s"], T: [1e6, "µT"], "": [100, "%"] };

/** Return an SI value as text with three digits in a usual unit. A value without a unit is a ratio. */
export function quantity(value, unit) {
  if (value === null || value === undefined) return "–";
  const [factor, name] = SHOWN_UNITS[unit] ?? [1, unit];
  const shownValue = value * factor;
  const isTiny = shownValue !== 0 && Math.abs(shownValue) < 0.01;
  const text = isTiny ? "< 0.01" : shownValue.toLocaleString("en", { maximumSignificantDigits: 3 }).replace("-", "−");
  return name === "°" ? text + name : `${text} ${name}`;
}

/** Return a value of a setting or of an identity as text. */
export function shown(value) {
  if (value === null || value === undefined) return "–";
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

/** Return the parts of a text, with the parts between backticks as code. */
export function marked(text) {
  return text.split("`").map((part, index) => (index % 2 ? el("code", { text: part }) : part));
}

/** Return a panel with a title. */
export function panel(id, title, ...children) {
  return el("section", { id, class: "panel" }, el("h2", { text: title }), ...children);
}

/** Return a list of rows with name and value. */
export function facts(rows) {
  const list = el("dl", { class: "facts" });
  for (const [name, value] of rows) list.append(el("dt", { text: name }), el("dd", { text: value }));
  return list;
}

/** Set the text of a node if it differs, so that the browser draws less. */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Send a request to the daemon. Return its result. Throws Error with the message of the daemon. */
export async function call(method, params) {
  const response = await fetch("/api/call", {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ method, params }),
  });
  const answer = await response.json();
  if (answer.error) throw new Error(answer.error);
  return answer.result;
}
