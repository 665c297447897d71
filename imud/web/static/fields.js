// Controls for settings, from their JSON Schemas.

import { segmented, toggle, button } from "./ui.js";
import { el, number } from "./util.js";

const CHOICES_MAX = 3; // more words need a list
const IDENTITY = [1, 0, 0, 0, 1, 0, 0, 0, 1];
const ROTATION_ERROR = 1e-3;
const MATRIX = "matrix"; // option of a list: nine numbers in place of a word

export const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);
export const isObject = (value) => value !== null && typeof value === "object" && !Array.isArray(value);
export const words = (name) => String(name).replaceAll("_", " ");

/** Return whether the device has the declared value. A declared object may contain only some keys. */
export function agrees(declared, actual) {
  if (declared === null || declared === undefined) return true;
  return isObject(declared) ? Object.entries(declared).every(([key, one]) => agrees(one, actual?.[key])) : same(declared, actual);
}

/** Return the changed keys of an object, and other values as they are. */
export function changed(actual, value) {
  if (!isObject(value) || !isObject(actual)) return value;
  return Object.fromEntries(Object.entries(value).filter(([key, one]) => !same(one, actual[key])));
}

export function said(value, unit = "") {
  if (value === null || value === undefined) return "not reported";
  if (typeof value === "boolean") return value ? "on" : "off";
  if (value === 0 && unit === "Hz") return "off";
  if (typeof value === "number") return `${number(value, Number.isInteger(value) ? 0 : 3)}${unit ? ` ${unit}` : ""}`;
  if (Array.isArray(value)) return value.length === 9 ? "rotation matrix" : `${value.map((one) => said(one)).join(", ")}${unit ? ` ${unit}` : ""}`;
  if (!isObject(value)) return words(value);
  return Object.entries(value).map(([key, one]) => `${words(key)} ${isObject(one) ? `(${said(one)})` : said(one, unit)}`).join(", ");
}

/** Return a schema without references and `anyOf`. */
function plain(schema, definitions) {
  if (schema.$ref) return plain(definitions[schema.$ref.split("/").at(-1)] ?? {}, definitions);
  const parts = (schema.anyOf ?? []).map((one) => plain(one, definitions)).filter((one) => one.type !== "null");
  if (!parts.length) return schema;
  const choices = parts.flatMap((one) => one.enum ?? []);
  const array = parts.find((one) => one.type === "array");
  return choices.length ? { enum: choices, array } : parts[0];
}

/** Return a control. It calls onChange(value) for a valid value, otherwise onInvalid(). */
export function control(setting, value, { disabled, onChange, onInvalid }) {
  const definitions = setting.schema.$defs ?? {};
  const make = (schema_, one, label, change) => {
    const schema = plain(schema_, definitions);
    if (schema.enum) return choice(schema, one, label, change);
    if (schema.type === "boolean") return onOff(one, label, change);
    if (schema.type === "integer" || schema.type === "number") return numeric(schema, one, label, change);
    if (schema.type === "array") return list(schema, one, label, change);
    if (schema.type === "object") return group(schema, one, label, change);
    return text(one, label, change);
  };

  const choice = (schema, one, label, change) => {
    const isArray = Array.isArray(one);
    const choices = one === null || one === undefined || isArray || schema.enum.includes(one) ? schema.enum : [one, ...schema.enum];
    if (choices.length <= CHOICES_MAX && choices.every((word) => typeof word === "string") && !schema.array) {
      const node = segmented(label, choices.map((word) => [word, words(word)]), one, change);
      node.inert = disabled;
      return node;
    }
    const unknown = one === null || one === undefined;
    const options = [...(unknown ? [[null, "not reported"]] : []), ...choices.map((word) => [word, typeof word === "number" ? said(word, setting.unit) : words(word)]), ...(schema.array ? [[MATRIX, "rotation matrix …"]] : [])];
    const chosen = isArray ? MATRIX : one;
    const select = el("select", { disabled, "aria-label": label, onchange: (event) => {
      const next = options[event.target.selectedIndex][0];
      if (next === MATRIX && isArray) return;
      if (next !== null) change(next === MATRIX ? IDENTITY : next, true);
    } }, options.map(([word, shown]) => el("option", { text: shown, selected: word === chosen })));
    return isArray ? el("div", {}, select, matrix(one, change)) : select;
  };

  const onOff = (one, label, change) => {
    if (typeof one === "boolean") return toggle(one ? "on" : "off", one, (next) => change(next, true), { disabled, name: label });
    const one_ = (title, next) => button(title, () => change(next, true), { kind: "small", disabled, label: `${title}: ${label}` });
    return el("div", { class: "pairs" }, one_("Switch on", true), one_("Switch off", false));
  };

  const numeric = (schema, one, label, change) => {
    const [least, most] = [schema.minimum ?? schema.exclusiveMinimum, schema.maximum ?? schema.exclusiveMaximum];
    const range = least !== undefined && most !== undefined ? `${number(least, Number.isInteger(least) ? 0 : 2)} … ${number(most, Number.isInteger(most) ? 0 : 2)}` : "a number";
    const note = el("span", { class: "help range", text: range });
    const input = el("input", { type: "number", inputmode: "decimal", min: least, max: most, step: schema.type === "integer" ? 1 : "any", value: one, disabled, "aria-label": `${label}, ${range}`, oninput: () => {
      const is = input.checkValidity() && input.value !== "";
      input.classList.toggle("wrong", !is);
      note.classList.toggle("wrong", !is);
      input.setAttribute("aria-invalid", String(!is));
      if (is) change(Number(input.value));
      else onInvalid();
    } });
    return el("span", { class: "field" }, input, setting.unit && el("span", { class: "unit", text: setting.unit }), note);
  };

  const list = (schema, one, label, change) => {
    const values = one ?? Array.from({ length: schema.minItems ?? 1 }, () => 0);
    if (values.length === 9) return matrix(values, change);
    let now = [...values];
    return el("div", { class: "pairs" }, values.map((each, index) => make(schema.items ?? {}, each, `${label}, number ${index + 1}`, (next) => change((now = now.with(index, next))))));
  };

  const group = (schema, one, label, change) => {
    const keys = [...new Set([...Object.keys(schema.properties ?? {}), ...Object.keys(one ?? {}), ...(schema.properties ? [] : Object.keys(setting.declared ?? {}))])];
    let now = { ...(one ?? {}) };
    const rows = keys.map((key) => {
      const part = schema.properties?.[key] ?? schema.additionalProperties ?? {};
      const made = make(part, one?.[key], `${label}, ${words(key)}`, (next, isRedrawn) => change((now = { ...now, [key]: next }), isRedrawn));
      return el("div", { class: "pair-field" }, el("span", { text: words(key) }), made);
    });
    return el("div", { class: "pairs" }, rows.length ? rows : el("span", { class: "help", text: "not reported" }));
  };

  const text = (one, label, change) => el("input", { type: "text", value: typeof one === "object" && one !== null ? JSON.stringify(one) : one, disabled, "aria-label": label, oninput: (event) => change(event.target.value) });

  const matrix = (values, change) => {
    const note = el("p", { class: "help" });
    let now = [...values];
    const check = () => {
      const is = isRotation(now);
      note.textContent = is ? "The matrix is a rotation." : "The matrix is not a rotation: each row must have the length 1, and the rows must be at right angles to each other.";
      note.classList.toggle("wrong", !is);
      return is;
    };
    const cells = values.map((one, index) => el("input", { type: "number", step: "any", value: one, disabled, "aria-label": `row ${Math.floor(index / 3) + 1}, column ${(index % 3) + 1}`, oninput: (event) => {
      now = now.with(index, event.target.value === "" ? NaN : Number(event.target.value));
      if (check()) change(now);
      else onInvalid();
    } }));
    check();
    return el("div", {}, el("div", { class: "matrix", role: "group", "aria-label": "rotation matrix, by rows" }, cells), note);
  };

  return make(setting.schema, value, setting.title, onChange);
}

export function isRotation(m) {
  const rows = [m.slice(0, 3), m.slice(3, 6), m.slice(6, 9)];
  const dot = (a, b) => a.reduce((sum, one, index) => sum + one * b[index], 0);
  const [a, b, c] = rows;
  const turned = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  return rows.every((one) => Math.abs(dot(one, one) - 1) < ROTATION_ERROR) && Math.abs(dot(a, b)) < ROTATION_ERROR && dot(turned, c) > 1 - 10 * ROTATION_ERROR;
}
