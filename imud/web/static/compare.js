// Comparison of two devices on one time axis.

import { sorted } from "./condition.js";
import { Arrivals, pastOf } from "./past.js";
import { COLORS, ink, near, PlotGroup, RollingPlot, timeBar } from "./plots.js";
import { world } from "./state.js";
import { icon, segmented } from "./ui.js";
import { AXES, DEGREE, duration, el, number } from "./util.js";

const RATE_HZ = 20;
const CONVENTION = "enu-flu";
const SAME_S = 1; // maximum difference of the limits of two buckets of one time
const DRAW_MS = 1000; // time between two computations of the statistics
const LATE_S = 2; // time to wait for the values of B
const HOLE_S = 5 / RATE_HZ; // longest time between two values of B that is interpolated
const WAITING_MAX = 200; // number of buckets of B that wait for A
const DELAY_S = 60; // time span of the newest values that give the delay
const WEIGHT_MAX_S = 8; // largest weight of a value: the length of a bucket of the history
const LAGS_MAX = RATE_HZ; // largest delay in periods: 1 s
const CORRELATION_LEAST = 0.5;
const CORRELATION_FALL = 0.05; // a delay is clear if the correlation at other delays is lower by this
const KINDS = {
  euler_rad: { title: "Attitude", unit: "°", names: ["roll", "pitch", "yaw"], scale: 1 / DEGREE, isAngle: true },
  accel_m_s2: { title: "Acceleration", unit: "m/s²", names: AXES, scale: 1 },
  gyro_rad_s: { title: "Angular rate", unit: "°/s", names: AXES, scale: 1 / DEGREE },
};

/** Return the mean of of(pair), by the weights of the pairs. */
function mean(pairs, of) {
  let [sum, all] = [0, 0];
  for (const pair of pairs) {
    sum += pair[2] * of(pair);
    all += pair[2];
  }
  return sum / all;
}

/** Return the correlation of pairs; null without variation. */
function correlation(pairs) {
  const [a, b] = [0, 1].map((index) => mean(pairs, (one) => one[index]));
  const product = (i, j) => mean(pairs, (one) => (one[i] - [a, b][i]) * (one[j] - [a, b][j]));
  const scale = product(0, 0) * product(1, 1);
  return scale > 0 ? product(0, 1) / Math.sqrt(scale) : null;
}

/** Return the pairs of values that both rows contain, with the second row moved by `lag` places, and their weights. */
const pairsOf = (a, b, lag = 0, weights = []) =>
  a.map((one, index) => [one, b[index + lag] ?? null, weights[index] ?? 1]).filter(([one, other]) => one !== null && other !== null);

/** Return how much later b shows the motion of a, in places; null if it is not clear. */
export function delayOf(a, b) {
  const scores = Array.from({ length: 2 * LAGS_MAX + 1 }, (_, index) => {
    const pairs = pairsOf(a, b, index - LAGS_MAX);
    return pairs.length > 2 * LAGS_MAX ? correlation(pairs) ?? 0 : 0;
  });
  const at = scores.indexOf(Math.max(...scores));
  const [before, best, after] = [scores[at - 1], scores[at], scores[at + 1]];
  if (before === undefined || after === undefined || best < CORRELATION_LEAST || best - Math.min(...scores) < CORRELATION_FALL) return null;
  return at - LAGS_MAX + (before - after) / 2 / (before - 2 * best + after);
}

/** Return mean, rms and maximum from the mean of the differences, correlation and delay; null without two pairs. The delay is
 *  that of the values from index `even` on, which have equal distances. */
export function statistics(a, b, weights, even = 0) {
  const pairs = pairsOf(a, b, 0, weights);
  if (pairs.length < 2) return null;
  const middle = mean(pairs, ([one, other]) => one - other);
  const rms = Math.sqrt(mean(pairs, ([one, other]) => (one - other - middle) ** 2));
  const most = pairs.reduce((so, [one, other]) => Math.max(so, Math.abs(one - other - middle)), 0);
  return { mean: middle, rms, most, correlation: correlation(pairs), delay: delayOf(a.slice(even), b.slice(even)) };
}

export class Compare {
  constructor(main, stream, first, second) {
    this.stream = stream;
    this.names = [first, second];
    this.kind = "euler_rad";
    this.statuses = new Map();
    this.span_s = 30;
    this.isCentered = false;
    this.picks = el("div", { class: "picks" });
    this.tools = el("div");
    this.plotsBox = el("div", { class: "panel plots" });
    this.table = el("tbody");
    this.notes = el("ul", { class: "notes" });
    const head = ["", "mean", "rms", "maximum", "correlation", "delay"].map((text) => el("th", { text, scope: "col" }));
    this.help = el("p", { class: "help" });
    this.grid = el("div", { class: "compare-grid" }, this.plotsBox, el("div", {},
        el("div", { class: "panel" }, el("h3", { text: "Difference in the shown time range" }), el("div", { class: "scroll" }, el("table", { class: "plain figures-table" }, el("thead", {}, el("tr", {}, head)), this.table)), this.help),
        el("div", { class: "panel" }, el("h3", { text: "Notes" }), this.notes)));
    main.append(el("div", { class: "device-head" }, el("h1", { text: "Compare" })), this.picks, this.tools, this.grid);
    this.timer = setInterval(() => this.drawTable(), DRAW_MS);
    this.restart();
  }

  /** Choose devices for absent names, and request their samples. */
  restart() {
    const names = sorted(world.devices).reverse().map((one) => one.name);
    this.names = this.names.map((name, index) => name || names.find((one) => one !== this.names[1 - index]) || "");
    if (!this.names[1] || this.names[0] === this.names[1]) this.names[1] = names.find((one) => one !== this.names[0]) ?? "";
    this.drawPicks(names);
    this.makePlots();
    const [a, b] = this.names;
    this.grid.hidden = this.tools.hidden = !a || !b;
    this.help.textContent = `rms and maximum are measured from the mean. A value of the history is the middle of the minimum and the maximum in its interval. Delay in the newest minute: ${b} shows the same motion this much later than ${a}; “–” if it is not clear. A red mark shows lost samples of either device.`;
    if (a && b) this.stream.look({ look: "device", device: a, other: b, rate_hz: RATE_HZ });
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

  makePlots() {
    this.closePlots();
    const { names, unit, isAngle, title } = KINDS[this.kind];
    this.waiting = this.names.map(() => []); // buckets that are not in the plots: [bucket, time, values of the axes]
    this.latest = [];
    this.arrivals = new Arrivals();
    this.group = new PlotGroup(this.span_s);
    const more = { isAngle, decimals: 2 };
    this.plots = names.map((name, axis) => new RollingPlot(`compare-${name}`, name, unit, this.names, { ...more, styles: [{ stroke: COLORS[axis], mark: `axis${axis}` }, { stroke: ink, dash: [6, 4], mark: "dashed" }] }, this.group));
    this.difference = new RollingPlot("compare-difference", `${this.names[0]} − ${this.names[1]}`, unit, names, { ...more, lanes: true }, this.group);
    this.plotsBox.replaceChildren(...[...this.plots, this.difference].map((one) => one.node));
    this.plotsBox.setAttribute("aria-label", `plots of ${title}`);
    const kinds = segmented("quantity", Object.entries(KINDS).map(([key, one]) => [key, one.title]), this.kind, (value) => { this.kind = value; this.restart(); });
    const offset = segmented("offset", [["no", "As measured"], ["yes", "Mean removed"]], this.isCentered ? "yes" : "no", (value) => { this.isCentered = value === "yes"; this.drawTable(); });
    this.tools.replaceChildren(timeBar(this.group, kinds, offset));
  }

  onMessage(message) {
    if (message.kind === "overview" && message.devices.length !== this.known) this.restart();
    if (message.kind === "status" && message.status) {
      this.statuses.set(message.device, message.status);
      this.drawNotes();
    }
    const index = message.kind === "samples" && message.convention && !this.group.isPaused ? this.names.indexOf(message.device) : -1;
    if (index >= 0) this.mark(message.buckets);
    for (const bucket of index < 0 ? [] : message.buckets) if (bucket[this.kind]) this.waiting[index].push([bucket, (bucket.first_s + bucket.last_s) / 2, this.values(index, bucket[this.kind])]);
    if (index >= 0) this.pair();
    if (index === 0) for (const bucket of message.buckets) if (this.arrivals.add(bucket)) this.restore(bucket.last_s);
  }

  /** Mark the lost samples of either device. */
  mark(buckets) {
    for (const plot of [...this.plots, this.difference]) for (const bucket of buckets) plot.mark(bucket);
  }

  /** Show the history of the daemon: the middle of minimum and maximum of each interval. */
  async restore(newest_s) {
    const { plots, kind } = this;
    const [a, b] = await pastOf(this.names, newest_s, { convention: CONVENTION }).catch(() => [[], []]); // the history is off
    if (plots !== this.plots) return; // the user chose another device or quantity
    const [buckets, others] = [a, b].map((all) => all.filter(([one]) => one[kind]));
    const [rows, latest] = [new Map(), []];
    let at = 0;
    for (const [bucket] of buckets) {
      while (others[at]?.[0].last_s < bucket.first_s) at += 1;
      const other = others[at]?.[0];
      const isSame = other && ["first_s", "last_s"].every((end) => Math.abs(other[end] - bucket[end]) <= SAME_S);
      rows.set(bucket, [this.values(0, bucket[kind], latest), isSame ? this.values(1, other[kind], latest) : [null, null, null]]);
    }
    const both = (values) => [values, values];
    plots.forEach((plot, axis) => plot.restore(buckets, (bucket) => both(rows.get(bucket).map((one) => one[axis]))));
    this.difference.restore(buckets, (bucket) => {
      const [one, other] = rows.get(bucket);
      return other[0] === null ? null : both(one.map((value, axis) => value - other[axis]));
    });
    this.mark(b.map(([one]) => one));
  }

  /** Return the middle of each range. An angle is at most half a turn from the previous angle of a device. */
  values(index, [least, greatest], latest = this.latest) {
    const { names, scale, isAngle } = KINDS[this.kind];
    const before = latest[index] ?? latest[1 - index];
    const found = names.map((_, axis) => {
      if (!isAngle) return ((least[axis] + greatest[axis]) / 2) * scale;
      const other = greatest[axis] - least[axis] > Math.PI ? greatest[axis] - 2 * Math.PI : greatest[axis];
      const angle = ((least[axis] + other) / 2) * scale;
      return before ? near(angle, before[axis]) : angle;
    });
    latest[index] = found;
    return found;
  }

  /** Add each bucket of A to the plots, with the interpolated value of B at its time. */
  pair() {
    const [a, b] = this.waiting;
    while (a.length) {
      const [bucket, t, values] = a[0];
      while (b.length > 1 && b[1][1] <= t) b.shift();
      const [before, after] = b;
      const isBetween = before && after && before[1] <= t && after[1] - before[1] <= HOLE_S;
      if (!after && !(before && before[1] > t) && a.at(-1)[1] - t < LATE_S) break; // B is later
      a.shift();
      const share = isBetween ? (t - before[1]) / (after[1] - before[1]) : 0;
      const others = values.map((_, axis) => (isBetween ? before[2][axis] + share * (after[2][axis] - before[2][axis]) : null));
      values.forEach((one, axis) => this.plots[axis].add(bucket, [[one, others[axis]], [one, others[axis]]], 1 / RATE_HZ));
      const difference = values.map((one, axis) => one - others[axis]);
      this.difference.add(bucket, isBetween ? [difference, difference] : null, 1 / RATE_HZ);
    }
    b.splice(0, Math.max(0, b.length - WAITING_MAX));
  }

  drawTable() {
    const { names, unit, isAngle } = KINDS[this.kind];
    if (document.hidden) return;
    const [from, to] = this.group.range(this.difference.newest);
    this.table.replaceChildren(...names.map((name, axis) => {
      const { data, stored } = this.plots[axis];
      const inRange = data[0].map((t, index) => index).filter((index) => data[0][index] >= from && data[0][index] <= to && data[1][index] !== null);
      const times = inRange.map((index) => data[0][index]);
      const [a, b] = [1, 3].map((line) => inRange.map((index) => data[line][index] && (data[line][index] + data[line + 1][index]) / 2));
      const even = Math.max(inRange.filter((index) => index < stored).length, inRange.length - DELAY_S * RATE_HZ);
      const found = statistics(a, b, times.map((t, index) => Math.min(t - (times[index - 1] ?? t), WEIGHT_MAX_S)), even);
      const moved = this.isCentered && found ? found.mean : 0;
      this.plots[axis].move([0, moved]);
      this.difference.move(Object.assign([...this.difference.offsets], { [axis]: -moved }));
      const texts = found ? [isAngle ? near(found.mean, 0) : found.mean, found.rms, found.most].map((one) => `${number(one, 2)} ${unit}`).concat(number(found.correlation, 3)) : ["–", "–", "–", "–"];
      const period_s = (times.at(-1) - times[even]) / (times.length - 1 - even);
      const delay = found && found.delay !== null ? `${number(found.delay * period_s * 1e3, 0)} ms` : "–";
      return el("tr", {}, el("th", { scope: "row", text: name }), [...texts, delay].map((text) => el("td", { text })));
    }));
  }

  drawNotes() {
    const [a, b] = this.names.map((name) => this.statuses.get(name));
    if (!a || !b) return;
    const rotated = this.names.filter((_, index) => [a, b][index].frame && [a, b][index].frame.convention !== CONVENTION);
    const isKnown = a.frame && b.frame;
    const axes = a.frame?.conventions?.[CONVENTION]?.frame;
    const notes = [
      [isKnown, isKnown ? `Both devices use the same axes${axes ? `: ${axes}` : ""} (${CONVENTION}).${rotated.length ? ` imud rotates the values of ${rotated.join(" and ")}.` : ""}` : "The axes of a device are not known."],
      [true, `Both devices use one clock, time stamp error ±${duration(a.clock.t_err_ns / 1e9)} and ±${duration(b.clock.t_err_ns / 1e9)}.`],
    ];
    [a, b].forEach((one, index) => one.condition?.condition === "missing" && notes.push([false, `${this.names[index]} is missing and sends no samples.`]));
    if ([a, b].some((one) => one.frame?.heading === "relative")) notes.push([false, "Yaw is measured from the direction at power-on of each device. Compare only changes of yaw."]);
    const drawn = JSON.stringify(notes);
    if (drawn !== this.drawn) this.notes.replaceChildren(...notes.map(([isOk, text]) => el("li", {}, icon(isOk ? "ok" : "degraded"), el("span", { text }))));
    this.drawn = drawn;
  }

  onPause() {
    this.group.pause();
    return true;
  }

  onTheme() {
    for (const plot of [...this.plots, this.difference]) plot.draw();
  }

  closePlots() {
    for (const plot of [...(this.plots ?? []), this.difference]) plot?.close();
  }

  close() {
    clearInterval(this.timer);
    this.closePlots();
  }
}
