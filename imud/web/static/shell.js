// The frame of the page.

import { deviceLink, known, sorted } from "./condition.js";
import { edits, world } from "./state.js";
import { button, icon, toast } from "./ui.js";
import { byId, el } from "./util.js";

export const SECTIONS = [
  ["live", "Live"], ["time", "Time"], ["ledger", "Ledger"], ["settings", "Settings"], ["calibration", "Calibration"],
  ["events", "Events"], ["about", "About"],
];
const BOTTOM = [["live", "Live"], ["settings", "Settings"], ["calibration", "Calibrate"], ["events", "Events"]];
const MORE = [["time", "error of the time stamps"], ["ledger", "counters of all bytes, frames and samples"], ["about", "identity, axes, maintenance"]];
const THEMES = ["auto", "light", "dark"];
const KEYS = [
  ["g", "all devices"], ["[ ]", "previous device, next device"], ["1 … 7", "sections"], ["Space", "pause, continue"],
  ["← →", "move the cursor in a plot"], ["+ − 0", "zoom in, zoom out, reset the zoom"], ["?", "show this list"],
];

export function routeOf() {
  let parts;
  try {
    parts = location.hash.split("/").map(decodeURIComponent);
  } catch {
    parts = [];
  }
  const [, what, name = "", section = "", item = ""] = parts;
  if (what === "device" && name) return { what, name, section, item };
  if (what === "compare") return { what, name, section: "", other: section };
  return { what: what === "wall" ? what : "overview", name: "", section: "" };
}

export function showDialog(kind, ...parts) {
  const dialog = byId("dialog");
  dialog.className = kind;
  dialog.replaceChildren(...parts);
  if (!dialog.open) dialog.showModal();
  return dialog;
}

export const closeDialog = () => byId("dialog").close();

export class Shell {
  constructor() {
    this.drawn = "";
    byId("host").textContent = location.hostname;
    byId("back").append(icon("back"));
    byId("wall").append(icon("wall"), el("span", { text: "Wall display" }));
    byId("theme").append(icon("theme"));
    byId("skip").addEventListener("click", (event) => {
      event.preventDefault(); // the address is the route
      byId("main").focus();
    });
    try {
      this.theme = localStorage.getItem("theme");
    } catch {
      // a private window
    }
    this.setTheme(this.theme);
    byId("theme").addEventListener("click", () => {
      this.setTheme(THEMES[(THEMES.indexOf(this.theme) + 1) % THEMES.length]);
      toast(`Colors: ${this.theme}`);
    });
    document.addEventListener("keydown", (event) => this.onKey(event));
    document.addEventListener("edits", () => this.draw());
  }

  setTheme(name) {
    this.theme = THEMES.includes(name) ? name : "auto";
    if (this.theme === "auto") delete document.documentElement.dataset.theme;
    else document.documentElement.dataset.theme = this.theme;
    try {
      localStorage.setItem("theme", this.theme);
    } catch {
      // a private window
    }
    this.onTheme?.();
  }

  draw() {
    const route = routeOf();
    const rows = sorted(world.devices);
    const changed = rows.filter((one) => edits.get(one.name)?.size).map((one) => one.name);
    const drawn = JSON.stringify([route, rows.map((one) => [one.name, one.state]), changed]);
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    document.body.dataset.view = route.what;
    document.body.dataset.section = route.section || "live";
    document.body.classList.toggle("has-device", route.what === "device");
    this.drawRail(route, rows, changed);
    this.drawPhone(route, rows);
  }

  drawRail(route, rows, changed) {
    const current = (is) => (is ? "page" : null);
    const devices = rows.map((one) =>
      el("a", { href: deviceLink(one.name), class: "rail-device", "aria-current": current(route.name === one.name && route.what === "device") },
        icon(known(one.state), one.state), el("span", { text: one.name }), changed.includes(one.name) && el("i", { class: "dot", role: "img", "aria-label": "changes not applied" })));
    const sections = SECTIONS.map(([id, words], index) =>
      el("a", { href: deviceLink(route.name, id), "data-section": id }, icon(id), el("span", { text: words }), el("kbd", { "aria-hidden": "true", text: String(index + 1) })));
    byId("rail").replaceChildren(
      el("a", { href: "#/", "aria-current": current(route.what === "overview") }, icon("devices"), el("span", { text: "All devices" })),
      el("a", { href: "#/compare", "aria-current": current(route.what === "compare") }, icon("compare"), el("span", { text: "Compare" })),
      el("h2", { text: "Devices" }), ...devices,
      ...(route.what === "device" ? [el("h2", { text: `Sections of ${route.name}` }), ...sections] : []));
  }

  drawPhone(route, rows) {
    const isDevice = route.what === "device";
    const bottom = byId("bottom");
    bottom.hidden = !isDevice;
    if (!isDevice) return byId("phone-title").replaceChildren();
    const names = rows.map((one) => one.name);
    if (!names.includes(route.name)) names.unshift(route.name);
    const state = rows.find((one) => one.name === route.name)?.state ?? "missing";
    const options = names.map((name) => el("option", { value: name, text: name, selected: name === route.name }));
    const choice = el("select", { "aria-label": "device", onchange: (event) => (location.hash = deviceLink(event.target.value, route.section || "live")) }, options);
    byId("phone-title").replaceChildren(el("label", { class: "picker" }, icon(known(state), state), choice));
    const here = route.section || "live";
    const links = BOTTOM.map(([id, words]) => el("a", { href: deviceLink(route.name, id), "aria-current": here === id ? "page" : null }, icon(id), words));
    const isMore = MORE.some(([id]) => id === here);
    bottom.replaceChildren(...links, el("button", { type: "button", "aria-current": isMore ? "page" : null, onclick: () => this.more(route.name) }, icon("more"), "More"));
    return undefined;
  }

  more(name) {
    const link = (href, glyph, words, about) => el("a", { href, onclick: closeDialog }, icon(glyph), el("div", {}, el("b", { text: words }), el("p", { class: "help", text: about })));
    const title = Object.fromEntries(SECTIONS);
    showDialog("sheet", el("nav", { "aria-label": "more sections" }, MORE.map(([id, about]) => link(deviceLink(name, id), id, title[id], about)),
      link(`#/compare/${encodeURIComponent(name)}`, "compare", "Compare", "this device with another device")), button("Close", closeDialog));
  }

  mark(section) {
    for (const link of document.querySelectorAll("#rail [data-section]")) {
      link.toggleAttribute("data-here", link.dataset.section === section);
      if (link.dataset.section === section) link.setAttribute("aria-current", "location");
      else link.removeAttribute("aria-current");
    }
  }

  onKey(event) {
    if (event.target.closest("input:not([type=checkbox]), select, textarea, dialog") || event.ctrlKey || event.metaKey || event.altKey) return;
    const route = routeOf();
    const names = sorted(world.devices).map((one) => one.name);
    const section = SECTIONS[Number(event.key) - 1];
    if (event.key === "?") showDialog("", el("h2", { text: "Keys" }), el("dl", { class: "keyhelp" }, KEYS.map(([key, words]) => [el("dt", {}, el("kbd", { text: key })), el("dd", { text: words })])), button("Close", closeDialog));
    else if (event.key === "g") location.hash = "#/";
    else if ((event.key === "[" || event.key === "]") && names.length) {
      const at = names.indexOf(route.name);
      const step = event.key === "]" ? 1 : at < 0 ? 0 : -1;
      location.hash = deviceLink(names[(at + step + names.length) % names.length]);
    } else if (route.what === "device" && section) location.hash = deviceLink(route.name, section[0]);
    else if (event.key === " " && !event.target.closest("button, a, summary, input") && this.onPause?.()) event.preventDefault();
  }
}
