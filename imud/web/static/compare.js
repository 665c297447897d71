// Two devices on one time axis: both curves of each axis, and the statistics of their difference.

import { sorted } from "./condition.js";
import { COLOURS, grid, ink, labels, PlotGroup } from "./plots.js";
import { world } from "./state.js";
import { icon, segmented } from "./ui.js";
import { AXES, DEGREE, duration, el, number } from "./util.js";

const RATE_HZ = 20;
const KEPT_S = 60;
const DRAW_MS = 200;
const KINDS = {
  euler_rad: { title: "Attitude", unit: "°", names: ["roll", "pitch", "yaw"], scale: 1 / DEGREE, isAngle: true },
  accel_m_s2: { title: "Acceleration", unit: "m/s²", names: AXES, scale: 1 },
  gyro_rad_s: { title: "Angular rate", unit: "°/s", names: AXES, scale: 1 / DEGREE },
};

/** Return mean, rms and maximum from the mean of the differences, and the correlation; null without two pairs. */
export function statistics(pairs) {
  if (pairs.length < 2) return null;
  const mean = (values) => values.reduce((sum, one) => sum + one, 0) / values.length;
  const [a, b] = [pairs.map((one) => one[0]), pairs.map((one) => one[1])];
  const difference = pairs.map(([one, other]) => one - other);
  const [middle, ma, mb] = [mean(difference), mean(a), mean(b)];
  const power = (values, from) => mean(values.map((one) => (one - from) ** 2));
  const both = Math.sqrt(power(a, ma) * power(b, mb));
  return {
    mean: middle, rms: Math.sqrt(power(difference, middle)), most: Math.max(...difference.map((one) => Math.abs(one - middle))),
    correlation: both > 0 ? mean(pairs.map(([one, other]) => (one - ma) * (other - mb))) / both : null,
  };
}

/** Return an angle, moved by whole turns to less than half a turn from `to`. */
const near = (angle, to) => angle - 360 * Math.round((angle - to) / 360);

export class Compare {
  constructor(main, stream, first, second) {
    this.stream = stream;
    this.names = [first, second];
    this.kind = "euler_rad";
    this.statuses = new Map();
    this.group = new PlotGroup(30);
    this.picks = el("div", { class: "picks" });
    this.plotsBox = el("div", { class: "panel plots" });
    this.table = el("tbody");
    this.notes = el("ul", { class: "notes" });
    const kinds = segmented("quantity", Object.entries(KINDS).map(([key, one]) => [key, one.title]), this.kind, (value) => { this.kind = value; this.restart(); });
    const head = ["", "mean", "rms", "maximum", "correlation"].map((text) => el("th", { text, scope: "col" }));
    main.append(el("div", { class: "device-head" }, el("h1", { text: "Compare" })), this.picks, el("div", { class: "timebar" }, kinds),
      el("div", { class: "compare-grid" }, this.plotsBox, el("div", {},
        el("div", { class: "panel" }, el("h3", { text: "Difference in the shown time range" }), el("table", { class: "plain figures-table" }, el("thead", {}, el("tr", {}, head)), this.table), el("p", { class: "help", text: "rms and maximum are measured from the mean." })),
        el("div", { class: "panel" }, el("h3", { text: "Notes" }), this.notes))));
    this.timer = setInterval(() => this.draw(), DRAW_MS);
    this.restart();
  }

  /** Choose devices for absent names, and request their samples. */
  restart() {
    const names = sorted(world.devices).reverse().map((one) => one.name);
    this.names = this.names.map((name, index) => name || names.find((one) => one !== this.names[1 - index]) || "");
    if (!this.names[1] || this.names[0] === this.names[1]) this.names[1] = names.find((one) => one !== this.names[0]) ?? "";
    this.data = this.names.map(() => []); // [time, values of the axes]
    for (const plot of this.plots ?? []) plot.destroy();
    this.plots = null;
    this.drawPicks(names);
    if (this.names.every(Boolean)) this.stream.look({ look: "device", device: this.names[0], other: this.names[1], rate_hz: RATE_HZ });
    else this.stream.look({ look: "overview" });
  }

  drawPicks(names) {
    const pick = (index) => el("label", { class: "pick" }, el("i", { class: index ? "dashed" : "" }), el("select", { "aria-label": `device ${"AB"[index]}`, onchange: (event) => {
      this.names[index] = event.target.value;
      location.hash = `#/compare/${this.names.map(encodeURIComponent).join("/")}`;
    } }, [...names].sort().map((one) => el("option", { value: one, text: one, selected: one === this.names[index] }))));
    this.picks.replaceChildren(...(names.length < 2 ? [el("p", { class: "help", text: "A comparison needs two devices." })] : [pick(0), el("span", { class: "help", text: "with" }), pick(1)]));
    this.known = names.length;
  }

  onMessage(message) {
    if (message.kind === "overview" && message.devices.length !== this.known) this.restart();
    if (message.kind === "status" && message.status) {
      this.statuses.set(message.device, message.status);
      this.drawNotes();
    }
    if (message.kind !== "samples") return;
    const index = this.names.indexOf(message.device);
    const kind = KINDS[this.kind];
    for (const bucket of index < 0 ? [] : message.buckets) {
      const range = bucket[this.kind];
      if (!range) continue;
      this.offset_s ??= bucket.utc_s - bucket.last_s;
      const before = this.data[index].at(-1)?.[1] ?? this.data[1 - index].at(-1)?.[1];
      const values = kind.names.map((_, axis) => {
        const half = range[1][axis] - range[0][axis] > Math.PI && kind.isAngle ? range[1][axis] : (range[0][axis] + range[1][axis]) / 2;
        return kind.isAngle && before ? near(half * kind.scale, before[axis]) : half * kind.scale;
      });
      this.data[index].push([(bucket.first_s + bucket.last_s) / 2 + this.offset_s, values]);
      while (this.data[index][0][0] < this.data[index].at(-1)[0] - KEPT_S) this.data[index].shift();
    }
  }

  /** Return the pairs of values of one axis: each bucket of A with the interpolated value of B. */
  pairs(axis, from) {
    const [a, b] = this.data;
    let at = 0;
    const found = [];
    for (const [t, values] of a) {
      while (at + 1 < b.length && b[at + 1][0] < t) at += 1;
      const [before, after] = [b[at], b[at + 1]];
      if (t < from || !after || before[0] > t || after[0] - before[0] > 5 / RATE_HZ) continue;
      const share = (t - before[0]) / (after[0] - before[0]);
      found.push([values[axis], before[1][axis] + share * (after[1][axis] - before[1][axis]), t]);
    }
    return found;
  }

  draw() {
    const newest = Math.max(...this.data.map((one) => one.at(-1)?.[0] ?? 0));
    if (!newest || document.hidden) return;
    this.plots ??= this.makePlots();
    const from = newest - this.group.span_s;
    const kind = KINDS[this.kind];
    this.newest = newest;
    kind.names.forEach((name, axis) => {
      const tables = this.data.map((rows) => [rows.map((one) => one[0]), rows.map((one) => one[1][axis])]);
      this.plots[axis].setData(uPlot.join(tables));
    });
    const rows = kind.names.map((name, axis) => {
      const found = statistics(this.pairs(axis, from));
      const texts = found ? [found.mean, found.rms, found.most].map((one) => `${number(one, 2)} ${kind.unit}`).concat(number(found.correlation, 3)) : ["–", "–", "–", "–"];
      return el("tr", {}, el("th", { scope: "row", text: name }), texts.map((text) => el("td", { text })));
    });
    this.table.replaceChildren(...rows);
  }

  makePlots() {
    const kind = KINDS[this.kind];
    this.plotsBox.replaceChildren();
    const axis = { stroke: ink, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1 } };
    const seconds = (_, splits) => splits.map((at) => new Date(at * 1000).toTimeString().slice(0, 8));
    return kind.names.map((name, index) => {
      const box = el("div", { class: "plot", role: "img", "aria-label": `plot of ${name} of both devices` });
      this.plotsBox.append(el("figure", { class: "chart" }, el("figcaption", {}, el("b", { text: name }), el("span", { class: "unit", text: kind.unit })), box));
      const line = { width: 1.4, points: { show: false }, spanGaps: true };
      return new uPlot({
        width: Math.max(box.clientWidth, 120), height: 168, legend: { show: false }, cursor: { sync: { key: "compare" }, drag: { x: false, y: false } },
        series: [{}, { ...line, label: this.names[0], stroke: COLOURS[index] }, { ...line, label: this.names[1], stroke: ink, dash: [6, 4] }],
        axes: [{ ...axis, values: seconds, space: 80, size: 30 }, { ...axis, size: 52, values: labels }],
        scales: { x: { time: true, range: () => [this.newest - this.group.span_s, this.newest] } },
      }, [[], [], []], box);
    });
  }

  drawNotes() {
    const [a, b] = this.names.map((name) => this.statuses.get(name));
    if (!a || !b) return;
    const isSame = a.frame?.frame === b.frame?.frame && a.frame?.convention === b.frame?.convention;
    const notes = [
      [isSame, isSame ? `Both devices use the same axes: ${a.frame?.frame ?? "unknown"}.` : `The axes differ: ${this.names[0]} ${a.frame?.frame ?? "unknown"}, ${this.names[1]} ${b.frame?.frame ?? "unknown"}. Set convention in the configuration.`],
      [true, `Both devices use one clock, time stamp error ±${duration(a.clock.t_err_ns / 1e9)} and ±${duration(b.clock.t_err_ns / 1e9)}.`],
    ];
    if ([a, b].some((one) => one.frame?.heading === "relative")) notes.push([false, "Yaw is measured from the direction at power-on of each device. Compare only changes of yaw."]);
    const drawn = JSON.stringify(notes);
    if (drawn !== this.drawn) this.notes.replaceChildren(...notes.map(([isOk, text]) => el("li", {}, icon(isOk ? "ok" : "degraded"), el("span", { text }))));
    this.drawn = drawn;
  }

  onTheme() {
    for (const plot of this.plots ?? []) plot.redraw();
  }

  close() {
    clearInterval(this.timer);
    for (const plot of this.plots ?? []) plot.destroy();
  }
}
