import { AttitudeView, gravityOf } from "./attitude.js";
import { PlotGroup, RollingPlot, timeBar } from "./plots.js";
import { SpectrumPlot } from "./spectrum-plot.js";
import { icon, section, segmented, toggle } from "./ui.js";
import { AXES, DEGREE, duration, el, number, percent, setText } from "./util.js";

const RATES_HZ = [10, 20, 50];
const ANGLES = ["roll", "pitch", "yaw"];
const PLOTS = [
  ["accel_m_s2", "Acceleration", "m/s²", AXES, { decimals: 2, lanes: true }],
  ["gyro_rad_s", "Angular rate", "°/s", AXES, { scale: 1 / DEGREE, decimals: 1 }],
  ["euler_rad", "Attitude", "°", ANGLES, { scale: 1 / DEGREE, decimals: 1, isAngle: true, lanes: true }],
  ["mag_t", "Magnetic field", "µT", AXES, { scale: 1e6, decimals: 1 }],
];
const HEADINGS = {
  relative: "Yaw is measured from the direction at power-on. It is not a compass heading.",
  magnetic: "Heading: magnetic north.", true: "Heading: true north.",
};
const NO_HISTORY = "The plots begin with this page, because the history of imud is off. To keep the last hour, set socket: {history: true} in the configuration.";
const NO_ATTITUDE = "The device sends no attitude, so imud cannot subtract gravity.";

export class LiveSection {
  /** Call onLook() when the page needs other data. */
  constructor(name, onLook) {
    this.onLook = onLook;
    this.rate_hz = 20;
    this.isFree = false;
    this.frame = "ENU";
    this.group = new PlotGroup(30);
    this.plots = new Map(PLOTS.map(([member, title, ...more]) => [member, new RollingPlot(member, title, ...more, this.group)]));
    this.free = new RollingPlot("free_m_s2", "Acceleration without gravity", "m/s²", AXES, { decimals: 2 }, this.group);
    for (const plot of [...this.plots.values(), this.free]) plot.node.hidden = true;
    this.attitude = new AttitudeView();
    this.spectrum = new SpectrumPlot(onLook);
    this.figures = new Map(["Rate", "Lost in last minute", "Time stamp error", "Latency", "Temperature"].map((title) => [title, figure(title)]));
    this.node = section("live", "Live", el("dl", { class: "bigs" }, [...this.figures.values()].map((one) => one.node)), el("div", { class: "live-grid" }, this.orientation(), this.views()));
    this.node.querySelector(".section-head").append(this.tools());
  }

  orientation() {
    this.angles = ANGLES.map((name) => ({ name: el("span", { text: name }), value: el("output") }));
    this.heading = el("span");
    this.axes = el("p", { class: "help" });
    return el("div", { class: "panel orientation", id: "attitude3d" }, this.attitude.canvas,
      el("dl", { class: "attitude" }, this.angles.map(({ name, value }, axis) => el("div", {}, el("dt", {}, el("i", { class: `axis${axis}` }), name), el("dd", {}, value)))),
      el("p", { class: "help heading-note" }, icon("about"), this.heading), this.axes);
  }

  views() {
    const gravity = toggle("Without gravity", false, (is) => { this.isFree = is; this.showFree(); });
    this.gravity = gravity.querySelector("input");
    this.gravity.id = "without-gravity";
    this.gravity.disabled = true;
    this.gravityNote = el("p", { class: "help", text: NO_ATTITUDE });
    this.lost = el("p", { class: "help lost-note", hidden: true }, el("i"), "lost samples");
    this.noHistory = el("p", { class: "help", id: "no-history", hidden: true, text: NO_HISTORY });
    const all = [...this.plots.values()].map((one) => one.node);
    this.time = el("div", { class: "panel plots" }, el("div", { class: "plot-tools" }, gravity, this.gravityNote), all[0], this.free.node, all.slice(1), this.lost, this.noHistory);
    this.other = el("div", { class: "panel", id: "spectrum", hidden: true }, this.spectrum.node);
    return el("div", {}, this.time, this.other);
  }

  tools() {
    const kind = segmented("type of plot", [["time", "Over time"], ["spectrum", "Spectrum"]], "time", (value) => {
      this.time.hidden = value !== "time";
      this.other.hidden = value === "time";
    });
    const rates = el("select", { id: "rate", "aria-label": "points per second", onchange: (event) => this.setRate(Number(event.target.value)) }, RATES_HZ.map((one) => el("option", { value: one, text: `${one} Hz`, selected: one === this.rate_hz })));
    return timeBar(this.group, kind, rates);
  }

  setRate(rate_hz) {
    this.rate_hz = rate_hz;
    this.onLook();
  }

  showFree() {
    const hasAccel = this.plots.get("accel_m_s2").data[0].length > 0;
    this.free.node.hidden = !this.isFree || !hasAccel;
    this.plots.get("accel_m_s2").node.hidden = this.isFree || !hasAccel;
    this.redraw();
  }

  add(bucket) {
    const period_s = 1 / this.rate_hz;
    for (const [member, plot] of this.plots) {
      const isNew = plot.node.hidden && bucket[member] && !(member === "accel_m_s2" && this.isFree);
      if (isNew) plot.node.hidden = false;
      if (bucket[member] || plot.data[0].length) plot.add(bucket, bucket[member] ?? null, period_s);
    }
    this.lost.hidden = !this.plots.get("accel_m_s2").losses.length;
    const { quat_wxyz, accel_m_s2, euler_rad } = bucket;
    if (quat_wxyz) {
      if (!this.group.isPaused) this.attitude.set(quat_wxyz, this.frame);
      this.gravity.disabled = false;
      this.gravityNote.hidden = true;
    }
    const gravity = quat_wxyz && accel_m_s2 ? gravityOf(quat_wxyz, this.frame) : null;
    this.free.add(bucket, gravity && accel_m_s2.map((one) => one.map((value, axis) => value - gravity[axis])), period_s);
    if (euler_rad) euler_rad[1].forEach((one, axis) => setText(this.angles[axis].value, `${number(one / DEGREE, 1)}°`));
  }

  /** Gravity needs the attitude of each sample, so its plot has no history. */
  restore(buckets) {
    for (const [member, plot] of this.plots) {
      if (!buckets.some(([bucket]) => bucket[member])) continue;
      if (!(member === "accel_m_s2" && this.isFree)) plot.node.hidden = false;
      plot.restore(buckets, (bucket) => bucket[member] ?? null);
    }
  }

  showHistory(is) {
    this.noHistory.hidden = is;
  }

  addRaw(message) {
    if (!this.group.isPaused) this.spectrum.add(message);
  }

  draw({ status, is_stale }) {
    this.isStale = is_stale;
    this.node.classList.toggle("stale-values", is_stale);
    if (is_stale) this.removeValues();
    this.frame = status.navigation_frame || "ENU";
    this.group.rate_hz = status.expected_rate_hz;
    const heading = status.frame?.heading;
    this.attitude.isCompass = heading === "true" || heading === "magnetic";
    setText(this.angles[2].name, this.attitude.isCompass ? "heading" : "yaw");
    setText(this.heading, HEADINGS[heading] ?? "The reference of yaw is not known.");
    setText(this.axes, status.frame ? `Axes: ${status.frame.frame}` : "");
    if (!this.attitude.quaternion) this.attitude.draw();
    this.drawFigures(status);
  }

  /** Remove the values of the last sample: no new sample arrives. */
  removeValues() {
    for (const { value } of this.angles) setText(value, "–");
    this.attitude.clear();
  }

  drawFigures(status) {
    const { recent, clock } = status;
    const isMissing = status.condition?.condition === "missing";
    const lost = Object.values(recent?.lost ?? {}).reduce((a, b) => a + b, 0);
    const share = recent && recent.samples + lost ? (100 * lost) / (recent.samples + lost) : null;
    const count = status.latency_buckets.reduce((a, b) => a + b, 0);
    const set = (title, value, unit, isBad = false) => this.figures.get(title).set(isMissing ? "" : value, isMissing ? "" : unit, isBad);
    const codes = (status.condition?.reasons ?? []).map((one) => one.code);
    const [error, errorUnit = ""] = duration(clock.t_err_ns / 1e9).split(" ");
    const [mean, meanUnit = ""] = duration(count ? status.latency_sum_ns / 1e9 / count : null).split(" ");
    const isOld = this.isStale;
    set("Rate", number(status.rate_hz, 1), status.expected_rate_hz ? `of ${number(status.expected_rate_hz, Math.abs(status.expected_rate_hz % 1) < 0.05 ? 0 : 1)} Hz` : "Hz", codes.includes("rate"));
    set("Lost in last minute", share === null ? "" : percent(share), share === null ? "" : "%", codes.includes("lost"));
    set("Time stamp error", isOld ? "–" : `±${error}`, isOld ? "" : errorUnit, codes.includes("time-error"));
    set("Latency", isOld ? "–" : mean, isOld ? "" : meanUnit);
    if (isOld) set("Temperature", "–", "");
    else set("Temperature", status.temperature_c === null ? "" : number(status.temperature_c, 1), status.temperature_c === null ? "not sent" : "°C");
  }

  redraw() {
    this.attitude.draw();
    for (const plot of [...this.plots.values(), this.free]) plot.draw();
  }

  close() {
    for (const plot of [...this.plots.values(), this.free, this.spectrum]) plot.close();
  }
}

function figure(title) {
  const [value, unit] = [el("b"), el("span")];
  const node = el("div", {}, el("dt", { text: title }), el("dd", {}, value, unit));
  return {
    node,
    set(text, unitText, isBad) {
      setText(value, text);
      setText(unit, unitText ? ` ${unitText}` : "");
      node.classList.toggle("bad", isBad);
    },
  };
}
