// Elements of the page, and numbers as text. The page never inserts texts of devices as HTML.

/** Return a new element. `text` is its text, `css` are styles (CSSOM), `on…` are handlers; other names are attributes. */
export function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name === "text") node.textContent = value;
    else if (name === "css") for (const [property, one] of Object.entries(value)) node.style.setProperty(property, one);
    else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

export const byId = (id) => document.getElementById(id);

export const DEGREE = Math.PI / 180;
export const AXES = ["x", "y", "z"];

/** Return the cleared context of a square canvas of `size` CSS pixels. */
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
  return text.replace(/^-(?=[0.]+$)/, "").replace("-", "−");
}

/** Return a share in percent as text. A small share is not 0. */
export const percent = (value) => (value > 0 && value < 0.1 ? "< 0.1" : number(value, value ? 1 : 0));

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

export function shown(value) {
  if (value === null || value === undefined) return "–";
  return typeof value === "object" ? JSON.stringify(value) : String(value);
}

/** Return the parts of a text, with the parts between backticks as code. */
export function marked(text) {
  return text.split("`").map((part, index) => (index % 2 ? el("code", { text: part }) : part));
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

/** Run a command of a device. Return a sentence about its result, or about the problem. */
export async function command(device, name, title) {
  try {
    const answer = await call("command", { device, name, arguments: {} });
    const evidence = answer?.evidence ? `${answer.verified ? "verified" : "sent, not verified"}: ${answer.evidence}` : "sent, not verified";
    return [`${title}: ${evidence}`, answer?.not_saved].filter(Boolean).join(". ");
  } catch (error) {
    return error.message;
  }
}

/** Return a span of time as `imud status` prints it: 40 s, 14 min, 3 h, 2 days. */
export function span(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  if (whole < 120) return `${whole} s`;
  if (whole < 7200) return `${Math.floor(whole / 60)} min`;
  return whole < 172800 ? `${Math.floor(whole / 3600)} h` : `${Math.floor(whole / 86400)} days`;
}

/** Difference of wall-clock time and the clock of the daemon, s; null before the first message. */
export const clock = { offset_s: null };

/** Return the local time of day of a time of the daemon's clock. */
export function timeOf(t_s, { date = false } = {}) {
  if (clock.offset_s === null) return "";
  const at = new Date((t_s + clock.offset_s) * 1000);
  const day = at.toDateString() === new Date().toDateString() && !date ? "" : `${at.getDate()} ${at.toLocaleString("en", { month: "short" })} `;
  return day + at.toTimeString().slice(0, 8);
}

/** Copy a text, also without HTTPS. */
export async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    const area = el("textarea", { "aria-hidden": "true" });
    area.value = text;
    (document.querySelector("dialog[open]") ?? document.body).append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
  }
}
