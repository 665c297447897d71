import { button, icon, section, segmented, toast } from "./ui.js";
import { call, copy, duration, el, number, shown, timeOf } from "./util.js";

const EVENT_WORDS = {
  up: "Device found", down: "Device lost", condition: "Condition", sync: "Time source", loss: "Lost samples", configuration: "Configuration", alarm: "Alarm",
  attitude: "Gravity and attitude", "bad-frame": "Damaged frames", link: "Port or bus", mark: "Marks", calibration: "Calibration", recorder: "Recorder",
  mqtt: "MQTT", output: "Output", rule: "Rule",
};
const CALM = ["up", "sync", "condition", "mark", "calibration"]; // kinds that are not warnings
const GROUP_NS = 60e9; // maximum time between two events of a group
const REPEATED = ["loss", "bad-frame", "mark"]; // kinds whose messages contain counts
const EVENTS_MAX = 1000;

/** Return the message of an event, and the bytes of a damaged frame. */
export const messageOf = ({ kind, message }) => (kind === "bad-frame" ? message.split(/: (?=[\da-f]{2}(?: |$))/) : [message]);

export const eventWords = (kind) => EVENT_WORDS[kind] ?? kind;

/** Return `events`, the stored events, the oldest first, and `since_ns`. devices: names; undefined for all. */
export async function pastEvents(devices, limit = EVENTS_MAX) {
  return { events: [], ...(await call("events", { enable: false, since_ns: 0, limit, ...(devices ? { devices } : {}) })) };
}

const levelOf = (one) => (CALM.includes(one.kind) ? "info" : "warning");
const isSame = (a, b) => a.kind === b.kind && a.device === b.device && (REPEATED.includes(a.kind) || a.message === b.message) && b.t_ns - a.t_ns <= GROUP_NS;

export function addEvent(groups, event) {
  const at = groups.findLastIndex((one) => isSame(one, event));
  const before = at >= 0 ? groups.splice(at, 1)[0] : null;
  groups.push({ ...event, count: (before?.count ?? 0) + 1, first_ns: before?.first_ns || before?.t_ns || event.t_ns });
  if (groups.length > EVENTS_MAX) groups.shift();
}

/** Return the groups with the start and the end of an alarm or a rule as one group. `open` contains the active alarms of a group;
 *  `to_ns` is the end of its last alarm. */
export function joinAlarms(groups) {
  let found = [];
  const beginOf = (one) => one.first_ns || one.t_ns;
  for (const one of groups) {
    const flags = one.kind === "rule" && typeof one.detail?.active === "boolean" ? [[`rule ${one.detail.rule}`, one.detail.active]]
      : one.kind === "alarm" && !one.detail?.verdict ? Object.entries(one.detail ?? {}).filter(([, value]) => typeof value === "boolean") : [];
    const [begun, ended] = [true, false].map((is) => flags.filter(([, value]) => value === is).map(([name]) => name));
    const known = ended.filter((name) => {
      const at = found.findLastIndex((other) => other.device === one.device && other.open?.has(name));
      if (at < 0) return false;
      const [start] = found.splice(at, 1);
      start.open.delete(name);
      found.push({ ...start, to_ns: one.t_ns });
      return true;
    });
    if (flags.length && !begun.length && known.length === ended.length) continue;
    if (begun.length) found = found.filter((other) => !(other.device === one.device && other.ended?.some((name) => begun.includes(name)) && beginOf(other) > beginOf(one))); // an alarm that starts again
    found.push({ ...one, ...(begun.length ? { open: new Set(begun) } : { ended }) });
  }
  return found.sort((a, b) => (a.to_ns ?? a.t_ns) - (b.to_ns ?? b.t_ns));
}

/** Return the number of events and warnings in each of the last 60 minutes; null before the start of imud. */
export function perMinute(groups, now_ns, begun_ns) {
  return Array.from({ length: 60 }, (_, index) => {
    const [from, to] = [now_ns - (60 - index) * 60e9, now_ns - (59 - index) * 60e9];
    if (to < begun_ns) return null;
    const found = groups.filter((one) => one.t_ns > from && (one.first_ns || one.t_ns) <= to);
    const count = found.reduce((sum, one) => sum + (one.count ?? 1) / Math.max(1, Math.ceil((one.t_ns - (one.first_ns || one.t_ns)) / 60e9)), 0);
    return { count: Math.round(count), isWarning: found.some((one) => levelOf(one) === "warning") };
  });
}

export class EventsSection {
  constructor(device) {
    this.device = device;
    this.level = "all";
    this.whose = "this";
    this.groups = null;
    this.now_s = 0;
    this.begun_ns = 0;
    this.list = el("ol", { class: "events", id: "event-list" });
    this.minutes = el("div", { class: "minutes", role: "img" });
    this.last = el("p", { class: "help" });
    const level = segmented("event level", [["all", "All"], ["warning", "Warnings"]], "all", (value) => { this.level = value; this.draw(); });
    this.choice = el("div", { class: "choice" });
    this.showFor("this");
    const copyAll = button("Copy", async () => { await copy(this.text()); toast("Copied."); }, { kind: "quiet", glyph: "copy" });
    this.node = section("events", "Events", el("div", { class: "timebar" }, this.choice, level, el("span", { class: "push" }), copyAll), this.minutes, el("div", { class: "panel flush" }, this.list), this.last);
  }

  /** Show the events of this device (`this`) or of all devices (`every`). */
  showFor(whose) {
    this.whose = whose;
    this.choice.replaceChildren(segmented("events of", [["this", this.device], ["every", "All devices"]], whose, (value) => { this.whose = value; this.load(); }));
    this.load();
  }

  async load() {
    this.groups = null;
    this.early = [];
    this.since_ns = Infinity;
    const { whose } = this;
    try {
      const { events: found, since_ns } = await pastEvents(this.whose === "this" ? [this.device] : undefined);
      if (whose !== this.whose) return;
      this.since_ns = since_ns; // later than the start of imud if it removed old events
      const newest_ns = found.at(-1)?.t_ns ?? 0;
      this.groups = found.filter((one) => !isProgress(one));
      for (const event of this.early) if (event.t_ns > newest_ns) addEvent(this.groups, event);
    } catch (error) {
      this.groups = [];
      toast(error.message);
    }
    this.draw();
  }

  add(events) {
    for (const { t_s, device, event, message, detail } of events) {
      const one = { t_ns: t_s * 1e9, device, kind: event, message, detail };
      if ((this.whose === "this" && device !== this.device && device !== "") || isProgress(one)) continue;
      if (this.groups) addEvent(this.groups, one);
      else this.early.push(one);
    }
    this.draw();
  }

  onStatus(status, now_s) {
    const isFirst = !this.now_s;
    this.now_s = now_s;
    this.begun_ns = status.recent?.begun_ns ?? 0;
    const begun = this.begun_ns ? ` since imud started to read this device at ${timeOf(this.begun_ns / 1e9)}` : "";
    this.last.textContent = `imud keeps the last 1,000 events of each device${begun}. For older events, run: journalctl -u imud`;
    if (isFirst || Math.floor(now_s / 10) !== this.drawn_10s) this.draw();
  }

  shownGroups() {
    return joinAlarms(this.groups ?? []).filter((one) => this.level === "all" || levelOf(one) === "warning").reverse();
  }

  draw() {
    if (!this.groups || !this.now_s) return;
    this.drawn_10s = Math.floor(this.now_s / 10);
    const open = new Set([...this.list.querySelectorAll("details[open]")].map((one) => one.dataset.first));
    const rows = this.shownGroups().map((one) => this.row(one, open));
    this.list.replaceChildren(...(rows.length ? rows : [el("li", {}, el("p", { class: "help", text: "No events." }))]));
    const counts = perMinute(this.groups, this.now_s * 1e9, Math.max(this.begun_ns, this.since_ns));
    const most = Math.max(1, ...counts.map((one) => one?.count ?? 0));
    this.minutes.setAttribute("aria-label", `events per minute over the last hour, at most ${most}`);
    const bars = counts.map((one) => el("i", {
      class: one === null ? "unknown" : one.isWarning ? "warning" : "", title: one === null ? "unknown" : `${one.count} events`,
      css: { height: `${one?.count ? 6 + (44 * one.count) / most : 2}px` },
    }));
    const begun = counts.findIndex((one) => one !== null);
    this.minutes.replaceChildren(...bars, el("em", { text: "events per minute" }), el("span", { text: timeOf(this.now_s - 3600).slice(-8, -3) }),
      ...(begun > 0 ? [el("span", { class: "begun", text: this.since_ns > this.begun_ns + 60e9 ? "older events removed" : "imud started", css: { left: `${(100 * begun) / counts.length}%`, transform: begun > 15 ? "translateX(-100%)" : "none" } })] : []), el("span", { text: timeOf(this.now_s).slice(-8, -3) }));
  }

  row(one, open) {
    const level = levelOf(one);
    const [message, bytes] = messageOf(one);
    const detail = Object.entries({ ...one.detail, ...(bytes && { bytes }) });
    const first = String(one.first_ns || one.t_ns);
    const summary = one.count > 1 ? `Details, since ${timeOf((one.first_ns || one.t_ns) / 1e9)}` : "Details";
    return el("li", { class: level, "data-kind": one.kind }, icon(level === "warning" ? "degraded" : "about", level),
      el("div", {}, el("p", {}, el("b", { text: eventWords(one.kind) }), one.count > 1 && el("em", { text: `×${number(one.count)}` }), this.whose === "every" && el("span", { class: "tag", text: one.device || "imud" })),
        el("p", { text: message + spanOf(one) }),
        (detail.length > 0 || one.count > 1) && el("details", { open: open.has(`${one.kind}${first}`), "data-first": `${one.kind}${first}` }, el("summary", { text: summary }),
          detail.map(([name, value]) => el("code", { text: `${name}: ${shown(value)}` })))),
      el("time", { text: timeOf((one.to_ns ?? one.t_ns) / 1e9) }));
  }

  text() {
    return this.shownGroups().map((one) => `${timeOf(one.t_ns / 1e9, { date: true })} ${one.device || "imud"} ${one.kind}${one.count > 1 ? ` ×${one.count}` : ""}: ${one.message}${spanOf(one)}`).join("\n");
  }
}

/** Return the time span of an alarm; empty for other events. */
function spanOf({ open, to_ns, first_ns, t_ns }) {
  if (!open) return "";
  const from_ns = first_ns || t_ns;
  const from = timeOf(from_ns / 1e9);
  return open.size ? `, since ${from}, no end reported` : `, from ${from} to ${timeOf(to_ns / 1e9)} (${duration((to_ns - from_ns) / 1e9)})`;
}

function isProgress(one) {
  return one.kind === "calibration" && !["begin", "end"].includes(one.detail?.phase);
}
