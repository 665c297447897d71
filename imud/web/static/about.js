import { said, words } from "./fields.js";
import { session } from "./state.js";
import { button, section, toast } from "./ui.js";
import { call, command, copy, el, marked } from "./util.js";

const MAINTENANCE = {
  restart: ["Restart", "Settings that are not saved are lost. The samples pause."], save: ["Save", "imud writes all settings to the flash of the device."],
  wake: ["Wake", "Starts the output again if the device sends no frames."], factory_reset: ["Reset to factory settings", "The device loses all its settings."],
};

const HEADING_WORDS = { relative: "measured from the direction at power-on", magnetic: "magnetic north", true: "true north" };
const IN_FACTS = ["link", "identity", "axes", "settings"]; // rows of `imud status` that the facts contain
const times = (count) => (count === 1 ? "once" : `${count} times`);

/** Return name and text of the facts about a device. */
export function factsOf({ identity, driver, link, connects, frame, declared }) {
  const differences = Object.entries(declared?.differences ?? {}).map(([name, one]) => `${words(name)}: ${said(one.actual)}, declared: ${said(one.declared)}`);
  const unverified = declared?.unverified?.length ? [`not reported by the device: ${declared.unverified.map(words).join(", ")}`] : [];
  const writes = declared && `${declared.flash_writes} write${declared.flash_writes === 1 ? "" : "s"} by imud, ${declared.flash_writes_day} in the last 24 hours`;
  return [
    ...Object.entries(identity).map(([name, value]) => [words(name), value]),
    ["driver", driver], ["link", link && `${link}, opened ${times(connects)}`],
    ["axes", frame?.frame], ["convention", frame && frame.convention !== "device" && frame.convention], ["angles", frame?.euler_convention],
    ["attitude", frame?.attitude === "host" && "computed by imud on the host"],
    ["heading", frame && (frame.attitude === "host" ? "measured from the direction at the start of the attitude filter" : HEADING_WORDS[frame.heading] ?? frame.heading) + (frame.declination_deg === null ? "" : frame.heading === "relative" ? "; declination_deg is ignored" : `, declination ${frame.declination_deg}°`)],
    ["settings", declared && [words(declared.state), ...differences, ...unverified, declared.problem].filter(Boolean).join("; ")], ["flash", writes],
  ].filter(([, text]) => text).map(([name, text]) => [name[0].toUpperCase() + name.slice(1), String(text)]);
}

export class AboutSection {
  constructor(device) {
    this.device = device;
    this.facts = el("dl", { class: "facts" });
    this.more = el("dl", { class: "facts" });
    this.actions = el("div");
    this.result = el("p", { class: "help", role: "status" });
    const copyAll = button("Copy as text", async () => { await copy(this.rows.map(([name, value]) => `${name}: ${value}`).join("\n")); toast("Copied."); }, { kind: "small", glyph: "copy" });
    this.rows = [];
    this.node = section("about", "About", el("div", { class: "two" }, el("div", { class: "panel" }, this.facts, el("details", {}, el("summary", { text: "All values of imud status" }), this.more), copyAll), el("div", { class: "panel" }, el("h3", { text: "Maintenance" }), this.actions, this.result)));
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

  draw({ status, rows }) {
    const parts = [factsOf(status), rows.filter(([name]) => !IN_FACTS.includes(name))];
    this.rows = parts.flat();
    const drawn = JSON.stringify(parts);
    if (drawn !== this.drawn) [this.facts, this.more].forEach((list, index) => list.replaceChildren(...parts[index].flatMap(([name, text]) => [el("dt", { text: name }), el("dd", {}, marked(text))])));
    this.drawn = drawn;
  }
}
