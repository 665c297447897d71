import { session } from "./state.js";
import { button, section, toast } from "./ui.js";
import { call, command, copy, el, marked } from "./util.js";

const MAINTENANCE = {
  restart: ["Restart", "Settings that are not saved are lost. The samples pause."], save: ["Save", "imud writes all settings to the flash of the device."],
  wake: ["Wake", "Starts the output again if the device sends no frames."], factory_reset: ["Reset to factory settings", "The device loses all its settings."],
};

export class AboutSection {
  constructor(device) {
    this.device = device;
    this.facts = el("dl", { class: "facts" });
    this.actions = el("div");
    this.result = el("p", { class: "help", role: "status" });
    const copyAll = button("Copy as text", async () => { await copy(this.rows.map(([name, value]) => `${name}: ${value}`).join("\n")); toast("Copied."); }, { kind: "small", glyph: "copy" });
    this.rows = [];
    this.node = section("about", "About", el("div", { class: "two" }, el("div", { class: "panel" }, this.facts, copyAll), el("div", { class: "panel" }, el("h3", { text: "Maintenance" }), this.actions, this.result)));
    this.load();
  }

  async load() {
    try {
      this.verbs = await call("actions", { device: this.device });
      this.onSession();
    } catch (error) {
      this.result.textContent = error.message;
    }
  }

  onSession() {
    const found = (this.verbs ?? []).filter((one) => one.name in MAINTENANCE);
    const [risky, calm] = [found.filter((one) => one.name === "factory_reset"), found.filter((one) => one.name !== "factory_reset")];
    const words = !found.length ? "This device has no commands for maintenance." : session.control ? "" : "Log in to use these commands.";
    this.actions.replaceChildren(...[words && el("p", { class: "help", text: words }), ...calm.map((one) => this.entry(one)),
      risky.length && el("details", {}, el("summary", { text: "Factory settings" }), risky.map((one) => this.entry(one)))].filter(Boolean));
  }

  entry({ name, risk }) {
    const [title, about] = MAINTENANCE[name];
    const run = button(title.split(" ")[0], () => this.run(name, title, risk), { kind: risk ? "danger small" : "small", disabled: !session.control, label: title });
    return el("div", { class: "action", "data-action": name }, el("div", {}, el("b", { text: title }), el("p", { class: "help", text: about })), run);
  }

  async run(name, title, risk) {
    if (risk && !confirm(`${risk}\n${title}?`)) return;
    this.result.textContent = `${title}…`;
    this.result.textContent = await command(this.device, name, title);
  }

  draw({ rows }) {
    this.rows = rows;
    const drawn = JSON.stringify(rows);
    if (drawn !== this.drawn) this.facts.replaceChildren(...rows.flatMap(([name, text]) => [el("dt", { text: name }), el("dd", {}, marked(text))]));
    this.drawn = drawn;
  }
}
