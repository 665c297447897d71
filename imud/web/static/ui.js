import { byId, el } from "./util.js";

const PATHS = {
  ok: '<circle cx="12" cy="12" r="9.5"/><path d="M7.6 12.4l3 3 5.8-6.4"/>',
  degraded: '<path d="M12 3.2 22 20.5H2z"/><path d="M12 10v4.6M12 17.4v.2"/>',
  attention: '<path d="M12 1.8 22.2 12 12 22.2 1.8 12z"/><path d="M12 7.4v5.6M12 16.2v.2"/>',
  missing: '<circle cx="12" cy="12" r="9.5"/><path d="M8.4 8.4l7.2 7.2M15.6 8.4l-7.2 7.2"/>',
  devices: '<rect x="3" y="4" width="7.5" height="7" rx="1.5"/><rect x="13.5" y="4" width="7.5" height="7" rx="1.5"/><rect x="3" y="14" width="7.5" height="7" rx="1.5"/><rect x="13.5" y="14" width="7.5" height="7" rx="1.5"/>',
  live: '<path d="M2.5 12.5h4l3-8.5 5 16 3-7.5h4"/>',
  time: '<circle cx="12" cy="12" r="9"/><path d="M12 6.8V12l3.6 2.4"/>',
  ledger: '<path d="M4 6h16M4 12h11M4 18h7"/>',
  settings: '<path d="M4 7h9M18.5 7H20M4 17h1.5M11 17h9"/><circle cx="15.6" cy="7" r="2.6"/><circle cx="8.2" cy="17" r="2.6"/>',
  calibration: '<circle cx="12" cy="12" r="9"/><ellipse cx="12" cy="12" rx="3.8" ry="9"/><path d="M3.4 9.4h17.2M3.4 14.6h17.2"/>',
  events: '<path d="M9 6h11M9 12h11M9 18h11M4.2 6h.1M4.2 12h.1M4.2 18h.1"/>',
  about: '<circle cx="12" cy="12" r="9"/><path d="M12 11v5.4M12 7.6v.2"/>',
  compare: '<path d="M3 15c3-8 5-8 8-2s5 4 10-5"/><path d="M3 19c4-5 6-5 9-2s5 2 9-5" stroke-dasharray="2.4 2.6"/>',
  more: '<path d="M5 12h.1M12 12h.1M19 12h.1" stroke-width="3.4"/>',
  back: '<path d="M14.5 5 7.5 12l7 7"/>',
  next: '<path d="M9.5 5l7 7-7 7"/>',
  down: '<path d="M5.5 9l6.5 6.5L18.5 9"/>',
  lock: '<rect x="5" y="10.5" width="14" height="10" rx="2"/><path d="M8 10.5V8a4 4 0 0 1 8 0v2.5"/>',
  unlock: '<rect x="5" y="10.5" width="14" height="10" rx="2"/><path d="M8 10.5V8a4 4 0 0 1 7.6-1.6"/>',
  theme: '<circle cx="12" cy="12" r="9"/><path d="M12 3a9 9 0 0 0 0 18z" fill="currentColor"/>',
  pause: '<path d="M8 5v14M16 5v14"/>',
  play: '<path d="M7 4.5v15l12-7.5z"/>',
  undo: '<path d="M8.5 5 4.5 9l4 4M5 9h9a5.5 5.5 0 0 1 0 11h-3"/>',
  copy: '<rect x="8.5" y="8.5" width="12" height="12" rx="2"/><path d="M5 15.5H3.5v-12h12V5"/>',
  arrow: '<path d="M4 12h15M13 6l6 6-6 6"/>',
  wall: '<rect x="2.5" y="4" width="19" height="13" rx="2"/><path d="M8 21h8"/>',
  zoom: '<circle cx="10.5" cy="10.5" r="6.5"/><path d="M15.5 15.5 21 21"/>',
  save: '<path d="M12 3.5v11M7.5 10.5 12 15l4.5-4.5M4 20h16"/>',
};

const SVG = "http://www.w3.org/2000/svg";
const LINES = { viewBox: "0 0 24 24", fill: "none", stroke: "currentColor", "stroke-width": "2", "stroke-linecap": "round", "stroke-linejoin": "round", "aria-hidden": "true" };

function drawing(tag, attributes) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
}

export function icon(name, label = "") {
  const picture = drawing("svg", LINES);
  for (const [, tag, text] of (PATHS[name] ?? "").matchAll(/<(\w+) ([^>]*)\/>/g))
    picture.append(drawing(tag, Object.fromEntries([...text.matchAll(/([\w-]+)="([^"]*)"/g)].map((one) => one.slice(1)))));
  return el("span", { class: `icon i-${name}`, ...(label ? { role: "img", "aria-label": label } : { "aria-hidden": "true" }) }, picture);
}

export const CONDITIONS = ["missing", "attention", "degraded", "ok"];
export const CONDITION_WORDS = { missing: "Missing", attention: "Needs attention", degraded: "Degraded", ok: "OK" };

export function chip(condition, more = "") {
  return el("span", { class: `chip c-${condition}` }, icon(condition), CONDITION_WORDS[condition] + more);
}

export function button(words, onclick, { kind = "", glyph = null, label = null, disabled = false, title = null } = {}) {
  return el("button", { type: "button", class: kind, onclick, "aria-label": label, disabled, title }, glyph && icon(glyph), words && el("span", { text: words }));
}

export function section(id, title, ...children) {
  const head = el("h2", { text: title });
  return el("section", { id, class: "section", "aria-labelledby": `${id}-title` }, el("div", { class: "section-head" }, Object.assign(head, { id: `${id}-title` })), ...children);
}

export function segmented(label, options, chosen, onChange) {
  const group = el("div", { class: "segmented", role: "radiogroup", "aria-label": label });
  const draw = (value) => group.replaceChildren(...options.map(([key, words], index) => el("button", {
    type: "button", role: "radio", "aria-checked": String(key === value), tabindex: key === value || (index === 0 && !options.some(([one]) => one === value)) ? "0" : "-1", text: words,
    onclick: () => { draw(key); onChange(key); group.querySelector("[aria-checked=true]")?.focus(); },
    onkeydown: (event) => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      const at = options.findIndex(([one]) => one === key);
      const next = options[(at + step + options.length) % options.length][0];
      draw(next); onChange(next);
      group.querySelector("[aria-checked=true]").focus();
    },
  })));
  draw(chosen);
  return group;
}

export function toggle(label, isOn, onChange, { disabled = false, name = null } = {}) {
  const box = el("input", { type: "checkbox", role: "switch", checked: isOn, disabled, "aria-label": name ?? label, onchange: (event) => onChange(event.target.checked) });
  return el("label", { class: "switch" }, box, el("i"), label && el("span", { text: label }));
}

export function toast(words) {
  const box = byId("toast");
  box.textContent = words;
  box.className = "shown";
  clearTimeout(box.timer);
  box.timer = setTimeout(() => (box.className = ""), 4000);
}
