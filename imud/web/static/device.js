// View of one device.

import { aboutRows } from "./about.js";
import { AttitudeView } from "./attitude.js";
import { ActionsView, CalibrationView } from "./control.js";
import { LatencyView, LedgerView } from "./ledger.js";
import { RollingPlot } from "./plots.js";
import { SettingsView } from "./settings.js";
import { SpectrumPlot } from "./spectrum-plot.js";
import { AXES, DEGREE, el, facts, number, panel, setText } from "./util.js";

const RATES_HZ = [10, 20, 50];
const SPANS_S = [10, 30, 60];
const EVENTS_KEPT = 200;

const PLOTS = [
  ["accel_m_s2", "Accelerometer", "m/s²", AXES, { decimals: 2 }],
  ["gyro_rad_s", "Gyroscope", "°/s", AXES, { scale: 1 / DEGREE, decimals: 1 }],
  ["mag_t", "Magnetometer", "µT", AXES, { scale: 1e6, decimals: 1 }],
  ["euler_rad", "Attitude", "°", ["roll", "pitch", "yaw"], { scale: 1 / DEGREE, decimals: 1, isAngle: true }],
];

export class DevicePage {
  constructor(main, name, stream, session) {
    this.name = name;
    this.stream = stream;
    this.session = session;
    this.rate_hz = 20;
    this.span_s = 30;
    this.isPaused = false;
    this.frame = "ENU";
    this.offset_s = null; // from the daemon's clock to wall-clock time
    this.plots = new Map(PLOTS.map(([member, title, ...more]) => [member, new RollingPlot(member, title, ...more)]));
    this.stamps = new RollingPlot("stamps", "Time stamps", "ms", ["time stamp error", "latency"], { scale: 1e3, decimals: 3, isLog: true });
    for (const plot of this.plots.values()) plot.node.hidden = true;
    this.attitude = new AttitudeView();
    this.spectrum = new SpectrumPlot(() => this.look());
    this.ledger = new LedgerView();
    this.latency = new LatencyView();
    this.about = el("div");
    this.events = el("ol", { class: "events", id: "event-list" });
    this.state = el("span", { class: "pill" });
    this.trouble = el("p", { class: "problem", hidden: true });
    this.control = el("div", { class: "control" });
    main.append(this.head(), this.trouble, this.panels(), this.control);
    this.onSession();
    this.look();
  }

  head() {
    const rate = select("rate", RATES_HZ, this.rate_hz, "Hz", (value) => {
      this.rate_hz = value;
      this.clear();
      this.look();
    });
    const span = select("span", SPANS_S, this.span_s, "s", (value) => (this.span_s = value));
    this.pause = el("button", { type: "button", id: "pause", text: "Pause", onclick: () => this.onPause() });
    const back = el("a", { href: "#/", class: "back", text: "← Devices" });
    const title = el("div", { class: "title" }, back, el("h1", { text: this.name }), this.state);
    return el("div", { class: "device-head" }, title, el("div", { class: "buttons" }, rate, span, this.pause));
  }

  panels() {
    this.angles = el("p", { class: "angles" });
    const block = panel("attitude3d", "Orientation", this.attitude.canvas, this.angles);
    const plots = [...this.plots.values()].map((plot) => plot.node);
    return el("div", { class: "grid" }, block, ...plots, panel("spectrum", "Spectrum", this.spectrum.node), this.stamps.node,
      panel("latency", "Latency", this.latency.node), panel("ledger", "Ledger", this.ledger.node),
      panel("about", "Status", this.about), panel("events", "Events", this.events));
  }

  look() {
    this.stream.look({ look: "device", device: this.name, rate_hz: this.rate_hz, spectrum: this.spectrum.member });
  }

  /** Make the panels that depend on the login. */
  onSession() {
    this.calibration = new CalibrationView(this.name, this.session);
    this.settings = new SettingsView(this.name, this.session);
    this.control.replaceChildren(
      panel("settings", "Settings", this.settings.node),
      panel("calibration", "Calibration", this.calibration.node),
      panel("actions", "Commands", new ActionsView(this.name, this.session).node));
  }

  onRestart() {
    this.onSession();
  }

  onPause() {
    this.isPaused = !this.isPaused;
    setText(this.pause, this.isPaused ? "Continue" : "Pause");
  }

  onMessage(message) {
    if (message.kind === "events") this.addEvents(message.events);
    if (message.device !== this.name) return;
    if (message.kind === "status") this.showStatus(message);
    if (this.isPaused) return;
    if (message.kind === "samples" && message.rate_hz === this.rate_hz) message.buckets.forEach((bucket) => this.add(bucket));
    if (message.kind === "raw") this.spectrum.add(message);
  }

  add(bucket) {
    const period_s = 1 / this.rate_hz;
    this.setOffset(bucket.utc_s - bucket.last_s);
    for (const [member, plot] of this.plots) {
      if (bucket[member]) plot.node.hidden = false;
      if (!plot.node.hidden) plot.add(bucket, bucket[member] ?? null, period_s, this.span_s);
    }
    const stamp = [bucket.t_err_s, bucket.latency_s];
    this.stamps.add(bucket, [stamp, stamp], period_s, this.span_s);
    if (bucket.quat_wxyz) this.attitude.set(bucket.quat_wxyz, this.frame);
    if (bucket.euler_rad) {
      const names = ["roll", "pitch", "yaw"];
      setText(this.angles, bucket.euler_rad[1].map((one, axis) => `${names[axis]} ${number(one / DEGREE, 1)}°`).join("  "));
    }
  }

  clear() {
    for (const plot of [...this.plots.values(), this.stamps]) plot.clear();
  }

  showStatus(message) {
    const { status } = message;
    this.status = message;
    const condition = status?.condition?.condition;
    setText(this.state, condition ?? "removed");
    this.state.className = `pill ${condition === "ok" ? "good" : "bad"}`;
    const reasons = condition === "ok" ? [] : (status?.condition?.reasons ?? []);
    const trouble = status ? reasons.map((one) => `${one.message} ${one.next}`).join(" ") : `the configuration of the daemon does not contain ${this.name}`;
    setText(this.trouble, trouble);
    this.trouble.hidden = !trouble;
    this.setOffset(Date.now() / 1000 - message.now_s);
    if (!status) return;
    this.frame = status.navigation_frame || "ENU";
    if (!this.attitude.quaternion) this.attitude.draw();
    this.ledger.draw(message);
    this.latency.draw(message);
    this.about.replaceChildren(facts(aboutRows(message)));
    this.settings.onStatus(status);
  }

  addEvents(events) {
    for (const event of events) {
      if (event.device !== this.name && event.device !== "") continue;
      if (event.event === "calibration") this.calibration.onEvent(event);
      if (event.event === "calibration" && !["begin", "end"].includes(event.detail.phase)) continue; // twice a second
      const words = el("span", { text: event.message });
      const when = el("time", { "data-t": event.t_s, text: this.clockTime(event.t_s) });
      this.events.prepend(el("li", { "data-kind": event.event }, when, el("b", { text: event.event }), words));
    }
    while (this.events.childElementCount > EVENTS_KEPT) this.events.lastChild.remove();
  }

  /** Set the offset from the first sample, or from the first status if no sample arrived. */
  setOffset(offset_s) {
    if (this.offset_s !== null) return;
    this.offset_s = offset_s;
    for (const when of this.events.querySelectorAll("time")) when.textContent = this.clockTime(Number(when.dataset.t));
  }

  /** Return the local time of day of a time of the daemon's clock. */
  clockTime(t_s) {
    if (this.offset_s === null) return "";
    const at = new Date((t_s + this.offset_s) * 1000);
    return `${at.toTimeString().slice(0, 8)}.${String(at.getMilliseconds()).padStart(3, "0")}`;
  }

  close() {
    for (const plot of [...this.plots.values(), this.stamps, this.spectrum]) plot.close();
  }
}

function select(id, values, chosen, unit, onChange) {
  const options = values.map((value) => el("option", { value, text: `${value} ${unit}`, selected: value === chosen }));
  return el("select", { id, "aria-label": id, onchange: (event) => onChange(Number(event.target.value)) }, ...options);
}
