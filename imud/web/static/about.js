// Status of a device as rows of name and text, as `imud status` prints it (imud/cli/status.py).

import { session } from "./state.js";
import { button, section, toast } from "./ui.js";
import { call, command, copy, el, facts, number, seconds, shown } from "./util.js";

const times = (count) => (count === 1 ? "once" : `${number(count)} times`);
const inBrackets = (words) => (words ? ` (${words})` : "");
const pairs = (values) => Object.entries(values).map(([name, value]) => `${name} ${shown(value)}`).join(", ");

/** message: `status` of imud/web/messages.py. */
export function aboutRows({ status, lost, bytes_open, frames_open }) {
  const { clock, ledger, kernel } = status;
  const rows = [
    ["link", `${status.link}, driver ${status.driver}, opened ${times(status.connects)}`],
    ["identity", pairs(status.identity) || "unknown"],
    ["rate", `${number(status.rate_hz, 1)} Hz measured, ${number(status.expected_rate_hz, 1)} Hz by the device's clock`],
    ["clock", `${clock.sync}, skew ${number(clock.skew_ppm, 2)} ppm, residual ${seconds(clock.residual_ns)}, error ${seconds(clock.t_err_ns)}, ${number(clock.resets)} resets`],
    ["latency", latency(status)],
    ["samples", `${number(ledger.samples)}; lost ${number(lost)} (device ${number(ledger.lost_gap_device)}, damaged ${number(ledger.lost_crc)}, ` +
      `overrun ${number(ledger.lost_overrun)}, queue ${number(ledger.lost_queue)}), ${number(ledger.lost_unknown)} ${ledger.lost_unknown === 1 ? "gap" : "gaps"} of unknown size, ${number(ledger.frames_lost)} lost CAN frames`],
    ["bytes", `${number(ledger.bytes_in)}: ${bytes_open || frames_open ? "NOT ALL ACCOUNTED FOR" : "all accounted for"}`],
    ["kernel", `${number(kernel.overrun)} overruns, ${number(kernel.framing)} framing, ${number(kernel.parity)} parity`],
  ];
  if (status.temperature_c !== null) rows.splice(3, 0, ["temperature", `${number(status.temperature_c, 1)} °C`]);
  if (status.frame) rows.splice(2, 0, ["axes", axes(status.frame)]);
  return [...rows, ...parts(status)];
}

/** Return the rows that only some devices have. */
function parts(status) {
  const rows = [];
  if (status.declared && status.declared.state !== "undeclared") rows.push(["settings", declared(status.declared)]);
  if (status.declared && status.declared.unsaved) rows.push(["unsaved", "the flash of the device lacks a change: run the command save"]);
  if (Object.keys(status.status_bit_names).length && status.status_bits !== null)
    rows.push(["status", status.status_words.join(", ") || "no known bit is set"]);
  if (Object.keys(status.settings).length) rows.push(["present", pairs(status.settings)]);
  if (status.polling) rows.push(["polling", polling(status.polling)]);
  if (status.serial_line) rows.push(["line", serialLine(status.serial_line)]);
  if (status.lines) rows.push(...lines(status.lines, status.clock));
  if (status.utc) rows.push(["utc", utc(status.utc)]);
  return rows;
}

function latency(status) {
  const count = status.latency_buckets.reduce((a, b) => a + b, 0);
  const mean = count ? `${seconds(status.latency_sum_ns / count)} mean over ${number(count)} samples` : "no samples";
  return `${mean}; batching ${seconds(status.hold_ns)} (limit ${seconds(status.hold_wanted_ns)}, ${status.hold_by || "all clients"})`;
}

function axes(frame) {
  const words = frame.convention === "device" ? frame.frame : `${frame.convention}, ${frame.frame}`;
  const isRelative = frame.heading === "relative";
  const ignored = frame.declination_deg === null ? "" : "; declination_deg is ignored";
  const declination = isRelative ? ` to power-on${ignored}` : frame.declination_deg === null ? "" : ` with a declination of ${shown(frame.declination_deg)}°`;
  return `${words}; heading ${frame.heading}${declination}${inBrackets(frame.problem)}`;
}

function declared(settings) {
  const differences = Object.entries(settings.differences).map(([name, one]) =>
    `${name} is ${one.actual === null ? "not reported" : shown(one.actual)}, declared ${shown(one.declared)}`);
  const words = differences.length ? `${settings.state}: ${differences.join(", ")}` : settings.state;
  const unverified = settings.unverified.length ? `; not reported by the device: ${settings.unverified.join(", ")}` : "";
  return words + unverified + inBrackets(settings.problem);
}

function polling(polls) {
  return `${number(polls.polls)} reads, ${number(polls.late)} late, ${number(polls.missed)} missed, ${number(polls.stale)} stale, ` +
    `${number(polls.failed)} failed; ${seconds(polls.late_mean_ns)} after the deadline, maximum ${seconds(polls.late_worst_ns)}; ` +
    `vanished ${times(polls.vanished)}`;
}

function serialLine(line) {
  return `${number(line.timeouts)} requests without a reply; ${number(line.late_bytes)} bytes without a request, ${number(line.strange_bytes)} invalid bytes; ` +
    `${number(line.echoes)} echoes (all devices of the bus)`;
}

/** Return a row for each input line, for SIN, and for each line that imud cannot watch or drive. */
function lines(status, clock) {
  const { problems } = status;
  const rows = Object.entries(status.edges).map(([name, edges]) => {
    const words = [`${number(edges)} edges, ${number(status.edges_lost[name] ?? 0)} lost`];
    if (name === "alarm") words.unshift(`${alarmLevel(status.alarm)}, raised ${times(status.alarms)}`);
    return [name, words.join("; ") + inBrackets(problems[name])];
  });
  if (clock.edges)
    rows.push(["pulses", `${number(clock.edges)}, ${number(clock.edges_unpaired)} without a sample; ${number(clock.samples_unpaired)} samples without a pulse`]);
  if (status.sin)
    rows.push(["sin", `${number(status.triggers)} triggers, ${number(status.triggers_missed)} missed; ${seconds(status.trigger_late_mean_ns)} after the ` +
      `deadline, maximum ${seconds(status.trigger_late_worst_ns)}; ${number(clock.triggers_missed)} without a frame${inBrackets(problems.sin)}`]);
  const others = Object.keys(problems).filter((name) => !(name in status.edges) && name !== "sin");
  return [...rows, ...others.sort().map((name) => [name, problems[name]])];
}

function alarmLevel(isActive) {
  if (isActive === null) return "level unknown";
  return isActive ? "ACTIVE" : "inactive";
}

function utc(status) {
  const words = [];
  const refused = pairs(status.refused);
  if (status.source)
    words.push(`${status.source}: ${number(status.sentences)} sentences, ${number(status.sent)} sent${refused ? `, not sent: ${refused}` : ""}`);
  if (status.pulses || status.pulses_ignored) words.push(`${number(status.pulses)} pulses, ${number(status.pulses_ignored)} ignored`);
  if (status.chrony_sent || status.chrony_refused)
    words.push(`chronyd accepted ${number(status.chrony_sent)}, refused ${number(status.chrony_refused)}`);
  return (words.join("; ") || "no pulse and no sentence yet") + inBrackets(status.problem);
}

const MAINTENANCE = {
  restart: ["Restart", "Settings that are not saved are lost. The samples pause."], save: ["Save", "imud writes all settings to the flash of the device."],
  wake: ["Wake", "Starts the output again if the device sends no frames."], factory_reset: ["Reset to factory settings", "The device loses all its settings."],
};

/** The section About: identity, axes, link; maintenance of the device. */
export class AboutSection {
  constructor(device) {
    this.device = device;
    this.facts = el("div");
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

  draw(message) {
    this.rows = aboutRows(message);
    const drawn = JSON.stringify(this.rows);
    if (drawn !== this.drawn) this.facts.replaceChildren(facts(this.rows));
    this.drawn = drawn;
  }
}
