// Rolling plots (uPlot). Each axis has a line through the minimum and a line through the maximum of each bucket, and the
// area between them. Thus peaks are visible at any rate.

import { el, number, setText } from "./util.js";

export const COLOURS = ["#d1495b", "#2e8b57", "#3a7bd5"];
const AREA = "40"; // opacity, in hexadecimal
const DRAW_MS = 66;
const HOLE_BUCKETS = 3; // number of periods without buckets that breaks the line

const dark = matchMedia("(prefers-color-scheme: dark)");
export const ink = () => (dark.matches ? "#a9b4c4" : "#5b6675");
export const grid = () => (dark.matches ? "#2b3443" : "#e4e8ee");

/** Return the labels of a linear axis. */
export function labels(_, splits) {
  return splits.map((at) => at.toLocaleString("en", { maximumFractionDigits: 6, useGrouping: false }).replace("-", "−"));
}

/** Return the labels of a logarithmic axis: only powers of ten. */
export function powers(_, splits) {
  return splits.map((at) => (at && Math.abs(Math.log10(at) - Math.round(Math.log10(at))) < 1e-9 ? String(Number(at.toPrecision(1))) : ""));
}

export class RollingPlot {
  /** axes: names of the lines; scale: what values are multiplied by; isAngle: a step over a half turn breaks the line;
   *  isLog: the axis is logarithmic. */
  constructor(id, title, unit, axes, { scale = 1, isAngle = false, isLog = false, decimals = 2 } = {}) {
    this.axes = axes;
    this.scale = scale;
    this.isAngle = isAngle;
    this.isLog = isLog;
    this.decimals = decimals;
    this.offset_s = null; // from the daemon's clock to UTC, constant after the first bucket
    this.values = axes.map((name, index) => {
      const value = el("output");
      const mark = el("i", { class: `mark axis${index}` });
      return { value, node: el("span", { class: "key" }, mark, el("b", { text: name }), value) };
    });
    const keys = el("div", { class: "keys" }, ...this.values.map((one) => one.node));
    this.box = el("div", { class: "plot" });
    this.node = el("section", { id, class: "panel" }, el("h2", {}, title, el("span", { class: "unit", text: ` ${unit}` })), keys, this.box);
    this.data = [[], ...axes.flatMap(() => [[], []])];
    this.drawn = 0;
    this.isDue = false;
    this.isVisible = true;
    this.newest = null;
    new IntersectionObserver((entries) => {
      this.isVisible = entries.at(-1).isIntersecting;
      this.draw();
    }).observe(this.box);
    new ResizeObserver(() => this.plot && this.box.clientWidth && this.plot.setSize(this.size())).observe(this.box);
  }

  size() {
    return { width: Math.max(this.box.clientWidth, 120), height: Math.max(this.box.clientHeight, 220) };
  }

  begin() {
    const axis = (more) => ({ stroke: ink, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1 }, ...more });
    const series = this.axes.flatMap((name, index) => {
      const line = { stroke: COLOURS[index], width: 1.25, points: { show: false }, spanGaps: false };
      return [{ ...line, label: `${name} maximum` }, { ...line, label: `${name} minimum` }];
    });
    const bands = this.axes.map((_, index) => ({ series: [1 + 2 * index, 2 + 2 * index], fill: COLOURS[index] + AREA }));
    const seconds = (_, splits) => splits.map((at) => new Date(at * 1000).toTimeString().slice(0, 8));
    this.plot = new uPlot(
      {
        ...this.size(), series: [{}, ...series], bands, legend: { show: false },
        cursor: { sync: { key: "time" }, drag: { x: false, y: false }, points: { show: false } },
        axes: [axis({ values: seconds, space: 80, size: 30 }), axis({ size: 52, values: this.isLog ? powers : labels })],
        scales: { y: this.isLog ? { distr: 3 } : {}, x: { time: true, range: () => [this.newest - this.span_s, this.newest] } },
        hooks: { setCursor: [() => this.showValues()] },
      },
      this.data, this.box,
    );
  }

  /** Add a bucket with its first and last time, and minimum and maximum per axis (null without values). */
  add(bucket, range, period_s, span_s) {
    this.span_s = span_s;
    this.offset_s ??= bucket.utc_s - bucket.last_s;
    const x = (bucket.first_s + bucket.last_s) / 2 + this.offset_s;
    const xs = this.data[0];
    const before = xs.at(-1);
    if (before !== undefined && x <= before) this.data.forEach((one) => (one.length = 0)); // the host has restarted
    else if (before !== undefined && x - before > HOLE_BUCKETS * Math.max(period_s, this.step_s ?? 0)) {
      this.push(before + period_s, null);
      this.step_s = undefined;
    } else if (before !== undefined) this.step_s = x - before;
    this.push(x, range);
    this.newest = x;
    let old = 0;
    while (xs[old] < x - span_s) old += 1;
    if (old) this.data.forEach((one) => one.splice(0, old));
    this.draw();
  }

  push(x, range) {
    this.data[0].push(x);
    this.axes.forEach((_, index) => {
      let least = range ? range[0][index] : null;
      let greatest = range ? range[1][index] : null;
      if (this.isAngle && range && this.isStep(index, least, greatest)) least = greatest = null;
      this.data[1 + 2 * index].push(greatest === null ? null : greatest * this.scale);
      this.data[2 + 2 * index].push(least === null ? null : least * this.scale);
    });
  }

  /** Return whether an angle passed ±180° in this bucket or since the previous bucket. */
  isStep(index, least, greatest) {
    const before = this.data[1 + 2 * index].at(-1);
    return greatest - least > Math.PI || (before !== null && before !== undefined && Math.abs(greatest - before / this.scale) > Math.PI);
  }

  clear() {
    this.data.forEach((one) => (one.length = 0));
    this.offset_s = null;
  }

  draw() {
    if (this.isDue || !this.isVisible || !this.data[0].length || !this.box.clientWidth) return;
    this.isDue = true;
    setTimeout(() => requestAnimationFrame(() => this.drawNow()), Math.max(0, this.drawn + DRAW_MS - performance.now()));
  }

  drawNow() {
    this.isDue = false;
    if (!this.data[0].length) return;
    if (!this.plot) this.begin();
    this.plot.setData(this.data);
    this.drawn = performance.now();
    this.showValues();
  }

  /** Show the values at the cursor, or the newest values. */
  showValues() {
    const at = this.plot?.cursor.idx ?? this.data[0].length - 1;
    this.values.forEach(({ value }, index) => {
      const [most, least] = [this.data[1 + 2 * index][at], this.data[2 + 2 * index][at]];
      const same = number(most, this.decimals) === number(least, this.decimals);
      setText(value, same ? number(most, this.decimals) : `${number(least, this.decimals)} … ${number(most, this.decimals)}`);
    });
  }

  close() {
    this.plot?.destroy();
  }
}
