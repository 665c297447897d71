// Parts of the page, and numbers as text. Texts of devices are never taken as HTML.

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

/** The context of a square canvas of `size` CSS pixels, cleared, as sharp as the screen. */
export function cleared(canvas, size) {
  const scale = Math.max(devicePixelRatio || 1, 1);
  const pixels = Math.round(size * scale);
  if (canvas.width !== pixels || canvas.height !== pixels) canvas.width = canvas.height = pixels;
  const context = canvas.getContext("2d");
  context.setTransform(scale, 0, 0, scale, 0, 0);
  context.clearRect(0, 0, size, size);
  return context;
}

/** A number with so many decimals and a true minus sign; "–" for none. */
export function number(value, decimals = 0) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const text = value.toLocaleString("en", { minimumFractionDigits: decimals, maximumFractionDigits: decimals });
  return text.replace("-", "−");
}

export function length(vector) {
  return vector ? Math.hypot(...vector) : null;
}

/** A time in s with a fitting unit. */
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

/** A value in SI with three digits and the unit that people read; a value without a unit is a share. */
export function quantity(value, unit) {
  if (value === null || value === undefined) return "–";
  const [factor, name] = SHOWN_UNITS[unit] ?? [1, unit];
  const shownValue = value * factor;
  const isTiny = shownValue !== 0 && Math.abs(shownValue) < 0.01;
  const text = isTiny ? "< 0.01" : shownValue.toLocaleString("en", { maximumSignificantDigits: 3 }).replace("-", "−");
  return name === "°" ? text + name : `${text} ${name}`;
}

/** A value of a setting or an identity as text. */
export function shown(value) {
  if (value === null || value === undefined) return "–";
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

/** A text whose words between backticks are those of a command line. */
export function marked(text) {
  return text.split("`").map((part, index) => (index % 2 ? el("code", { text: part }) : part));
}

/** A panel with its title. */
export function panel(id, title, ...children) {
  return el("section", { id, class: "panel" }, el("h2", { text: title }), ...children);
}

/** Rows of name and value. */
export function facts(rows) {
  const list = el("dl", { class: "facts" });
  for (const [name, value] of rows) list.append(el("dt", { text: name }), el("dd", { text: value }));
  return list;
}

/** Replace the text of a node only where it differs: the browser draws less. */
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** A question or an order to the daemon; throws Error with what was wrong. */
export async function call(method, params) {
  const response = await fetch("/api/call", {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ method, params }),
  });
  const answer = await response.json();
  if (answer.error) throw new Error(answer.error);
  return answer.result;
}
