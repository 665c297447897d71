// Rolling plots (uPlot) of the minimum and the maximum of each bucket.

import { button, icon, segmented } from "./ui.js";
import { el, number, setText } from "./util.js";

const AREA = "40"; // opacity, in hexadecimal
const PERIOD_MS = 66;
const HOLE_BUCKETS = 3; // number of periods without buckets that breaks the line
const KEPT_S = 3600; // time span of the data that a plot keeps
const FINE_S = 600; // age at which a plot merges points
const MERGED_S = 6; // time span of a merged point
const LOCATED_PERIODS = 0.1; // largest time stamp error, in sample periods, with which a step of the time shows a lost sample
const COUNTED_S = 2; // time of samples that the sample rate can count
const MARK_S = 2; // least time between two marks: imud web gets the counts of lost samples once per second
const GAP_LEAST_S = 1; // least time without values that breaks the line of merged points
const MERGE_S = 60; // time span of the points that a plot merges together
const LANE_MARGIN = 0.12; // free share of the height of a lane, above and below its curve
const LABEL_MARGIN = 0.14; // share of the height of a lane without a label, so that the labels of two lanes do not overlap
const ZOOM_LEAST_S = 0.05; // least time range of a zoom
const TURN_DEG = 360;
const SPANS = [["10", "10 s"], ["30", "30 s"], ["600", "10 min"], ["3600", "1 h"]];
const STEP = 0.2; // share of the time range by which a key moves the cursor or zooms

const color = (name) => () => getComputedStyle(document.documentElement).getPropertyValue(name).trim() || "#888";
export const ink = color("--mute");
export const grid = color("--line");
const lostColor = color("--missing");
export const COLORS = [color("--x"), color("--y"), color("--z")];
export const hasPlots = "uPlot" in globalThis;

/** Return the node for a plot. Without uPlot, it contains the reason. */
export const plotBox = (attributes) =>
  hasPlots ? el("div", { class: "plot", role: "img", ...attributes }) : el("p", { class: "help", text: "Plots are not installed: imud was built without uPlot. Install npm, then build imud again." });

/** Time range of several plots: the newest `span_s`, or a zoomed range; their pause, and the sample rate of the device. */
export class PlotGroup {
  constructor(span_s) {
    Object.assign(this, { span_s, rate_hz: 0, zoomed: null, isPaused: false, plots: [], onChange: () => {} });
  }

  setSpan(span_s) {
    this.span_s = span_s;
    this.zoom(null);
  }

  /** range: first and last time in s; null for the newest `span_s`. */
  zoom(range) {
    if (range && (range[1] - range[0] < ZOOM_LEAST_S || range[1] - range[0] > KEPT_S)) return;
    this.zoomed = range;
    this.onChange();
    for (const plot of this.plots) plot.draw();
  }

  /** The owner of the plots adds no values during a pause. */
  pause() {
    this.isPaused = !this.isPaused;
    this.zoom(this.isPaused ? this.zoomed : null);
  }

  range(newest) {
    return this.zoomed ?? [newest - this.span_s, newest];
  }
}

/** Return a bar with the controls of a group. */
export function timeBar(group, ...more) {
  const pause = el("button", { type: "button", id: "pause", class: "quiet pause", onclick: () => group.pause() });
  const reset = button("Reset zoom", () => group.zoom(null), { kind: "quiet", glyph: "zoom" });
  group.onChange = () => {
    reset.hidden = !group.zoomed;
    pause.replaceChildren(icon(group.isPaused ? "play" : "pause"), el("span", { text: group.isPaused ? "Continue" : "Pause" }));
  };
  group.onChange();
  return el("div", { class: "timebar" }, segmented("time range", SPANS, String(group.span_s), (value) => group.setSpan(Number(value))), pause, reset, more);
}

/** Return an angle in degrees, moved by whole turns to at most half a turn from `to`. */
export const near = (angle, to) => angle - TURN_DEG * Math.round((angle - to) / TURN_DEG);

/** Return the labels of an angle: −180 to 180, also after whole turns. */
const degrees = (_, splits) => labels(_, splits.map((at) => near(at, 0))).map((text) => text.replace(/^−?180$/, "±180"));

/** Return the labels of a linear axis. */
export function labels(_, splits) {
  return splits.map((at) => at.toLocaleString("en", { maximumFractionDigits: 6, useGrouping: false }).replace("-", "−"));
}

/** Return the labels of a logarithmic axis: only powers of ten. */
export function powers(_, splits) {
  return splits.map((at) => (at && Math.abs(Math.log10(at) - Math.round(Math.log10(at))) < 1e-9 ? String(Number(at.toPrecision(1))) : ""));
}

/** Return the first and the last of the roundest values between least and most. */
function splitsOf(least, most) {
  const [lowest, highest] = [least + LABEL_MARGIN * (most - least), most - LABEL_MARGIN * (most - least)];
  const power = 10 ** Math.floor(Math.log10(most - least));
  for (const step of [5, 2, 1, 0.5, 0.2].map((one) => one * power)) {
    const [first, last] = [Math.ceil(lowest / step), Math.floor(highest / step)];
    if (last > first) return [first * step, last * step];
  }
  return [];
}

const isNumber = (value) => value !== null && value !== undefined;

/** Return whether samples between two buckets are lost. The step of the time shows it if the time stamps are good enough. */
export function isLossBetween(before, bucket, rate_hz) {
  if (bucket.seq - before.seq > bucket.count) return true;
  const steps = Math.round((bucket.last_s - before.last_s) * rate_hz);
  return bucket.t_err_s * rate_hz < LOCATED_PERIODS && steps > bucket.count && steps < COUNTED_S * rate_hz;
}

/** Return the indexes of the points without a neighbor. A line does not show them. */
const alone = ({ data }, line) => data[line].flatMap((one, at, all) => (isNumber(one) && !isNumber(all[at - 1]) && !isNumber(all[at + 1]) ? [at] : []));

/** Return the least and the greatest angle, moved by whole turns to the previous angle. A range of more than half a turn
 *  contains ±180: then the angles are between its ends in the other direction. */
function unwrapped([least, greatest], before) {
  const [from, to] = greatest - least > TURN_DEG / 2 ? [greatest, least + TURN_DEG] : [least, greatest];
  const moved = before === undefined ? to : near(to, before);
  return [from + moved - to, moved];
}

export class RollingPlot {
  /** axes: names of the lines; isAngle: degrees, the lines continue over ±180; lanes: each line has its own scale;
   *  styles: stroke, dash and mark (class of the name) of each line. */
  constructor(id, title, unit, axes, { scale = 1, isAngle = false, isLog = false, decimals = 2, lanes = false, styles = [] } = {}, group = new PlotGroup(30)) {
    Object.assign(this, { axes, title, scale, isAngle, isLog, decimals, group, lanes });
    this.styles = axes.map((_, index) => ({ stroke: COLORS[index], mark: `axis${index}`, ...styles[index] }));
    this.labels = isLog ? powers : isAngle ? degrees : labels;
    group.plots.push(this);
    this.offset_s = null; // from the daemon's clock to UTC, constant after the first bucket
    this.losses = []; // times of lost samples
    this.stored = 0; // number of the first points that are merged or from the history of the daemon
    this.hidden = new Set(); // indexes of hidden lines
    this.values = axes.map((name, index) => this.key(name, index));
    const keys = el("div", { class: "keys" }, this.values.map((one) => one.node));
    const scales = isLog || !hasPlots ? null : segmented(`scale of ${title}`, [["together", "Combined"], ["lanes", "Separate"]], this.lanes ? "lanes" : "together", (value) => this.setLanes(value === "lanes"));
    const onTouch = (event) => this.onTouch(event);
    this.box = plotBox({ tabindex: "0", "aria-label": `plot of ${title}; arrow keys move the cursor, plus and minus zoom`,
      onkeydown: (event) => this.onKey(event), ontouchstart: onTouch, ontouchmove: onTouch, ontouchend: onTouch });
    this.node = el("figure", { id, class: "chart" }, el("figcaption", {}, el("b", { text: title }), el("span", { class: "unit", text: unit }), keys, el("div", { class: "chart-tools" }, scales)), this.box);
    this.data = [[], ...axes.flatMap(() => [[], []])];
    this.offsets = axes.map(() => 0); // the plot shows each line with this offset
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

  /** Return the name and value of a line. A click hides the line. */
  key(name, index) {
    const value = el("output");
    const node = el("button", { type: "button", class: "key", "aria-pressed": "true", onclick: () => {
      const isShown = this.hidden.delete(index);
      if (!isShown) this.hidden.add(index);
      node.setAttribute("aria-pressed", String(isShown));
      for (const line of [1, 2]) this.plot?.setSeries(2 * index + line, { show: isShown });
    } }, el("i", { class: this.styles[index].mark }), el("b", { text: name }), value);
    return { value, node };
  }

  setLanes(is) {
    this.lanes = is;
    this.plot?.destroy();
    this.plot = null;
    this.draw();
  }

  size() {
    return { width: Math.max(this.box.clientWidth, 120), height: Math.max(this.box.clientHeight, 120) };
  }

  /** Return the name of the scale of a line. */
  scaleOf(index) {
    return this.lanes ? `y${index}` : "y";
  }

  begin() {
    const axis = (more) => ({ stroke: ink, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1 }, ...more });
    const series = this.axes.flatMap((name, index) => {
      const line = { stroke: this.styles[index].stroke, dash: this.styles[index].dash, width: 1.25, points: { show: false, filter: alone, size: 3 }, spanGaps: false, scale: this.scaleOf(index), show: !this.hidden.has(index) };
      return [{ ...line, label: `${name} maximum` }, { ...line, label: `${name} minimum` }];
    });
    const bands = this.styles.flatMap(({ stroke, dash }, index) => (dash ? [] : [{ series: [1 + 2 * index, 2 + 2 * index], fill: () => stroke() + AREA }]));
    const seconds = (_, splits) => splits.map((at) => new Date(at * 1000).toTimeString().slice(0, 8));
    const lanes = Object.fromEntries(this.axes.map((_, index) => [`y${index}`, { range: (_plot, least, most) => this.laneRange(index, least, most) }]));
    const upright = this.lanes ? { scale: "y0", size: 52, values: (_, splits) => splits.map(() => ""), grid: { show: false }, ticks: { show: false } } : { scale: "y", size: 52, values: this.labels };
    this.plot = new uPlot(
      {
        ...this.size(), series: [{}, ...series], bands, legend: { show: false },
        cursor: { sync: { key: "time" }, drag: { x: true, y: false, setScale: false }, points: { show: false } },
        axes: [axis({ values: seconds, space: 80, size: 30 }), axis(upright)],
        scales: { ...(this.lanes ? lanes : { y: this.isLog ? { distr: 3 } : {} }), x: { time: true, range: () => this.group.range(this.newest) } },
        hooks: { setCursor: [() => this.showValues()], setSelect: [(plot) => this.onSelect(plot)], draw: [(plot) => this.drawMore(plot)] },
      },
      this.data, this.box,
    );
  }

  /** Return a range that places the curve in its lane, the first at the top. */
  laneRange(index, least, most) {
    if (least === null || most === null) return [0, 1];
    const height = Math.max(most - least, 10 ** -this.decimals, 1e-9) * (1 + 2 * LANE_MARGIN);
    const bottom = (least + most - height) / 2;
    const below = this.axes.length - 1 - index;
    return [bottom - below * height, bottom + (this.axes.length - below) * height];
  }

  drawMore({ ctx, bbox, valToPos, scales }) {
    const pixels = devicePixelRatio || 1;
    ctx.save();
    ctx.font = `${11 * pixels}px system-ui, sans-serif`;
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    const count = this.axes.length;
    for (let index = 0; this.lanes && index < count; index += 1) {
      const { min, max } = scales[`y${index}`];
      if (min === null || min === undefined) continue;
      const bottom = min + ((count - 1 - index) * (max - min)) / count;
      const top = bottom + (max - min) / count;
      ctx.fillStyle = ink();
      for (const at of splitsOf(bottom, top)) ctx.fillText(this.labels(null, [at])[0], bbox.left - 6 * pixels, valToPos(at, `y${index}`, true));
      ctx.fillStyle = grid();
      if (index) ctx.fillRect(bbox.left, valToPos(top, `y${index}`, true), bbox.width, pixels);
    }
    ctx.fillStyle = lostColor();
    for (const at of this.losses) {
      const x = valToPos(at, "x", true);
      if (x >= bbox.left && x <= bbox.left + bbox.width) ctx.fillRect(x - pixels, bbox.top + bbox.height - 7 * pixels, 2 * pixels, 7 * pixels);
    }
    ctx.restore();
  }

  onSelect(plot) {
    const { left, width } = plot.select;
    if (width < 5) return;
    const [from, to] = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
    plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.group.zoom([from, to]);
  }

  onKey(event) {
    if (!this.plot) return;
    const [from, to] = this.group.range(this.newest);
    const width = this.plot.over.clientWidth;
    const at = this.plot.cursor.left >= 0 ? this.plot.cursor.left : width;
    if (event.key === "0") this.group.zoom(null);
    else if (event.key === "+" || event.key === "-") {
      const half = ((to - from) / 2) * (event.key === "+" ? 1 - STEP : 1 / (1 - STEP));
      this.group.zoom([(from + to) / 2 - half, (from + to) / 2 + half]);
    } else if (event.key === "ArrowLeft" || event.key === "ArrowRight")
      this.plot.setCursor({ left: Math.min(width - 1, Math.max(0, at + (event.key === "ArrowLeft" ? -1 : 1) * Math.max(1, width / 200))), top: 10 });
    else return;
    event.preventDefault();
  }

  /** Zoom with two fingers. */
  onTouch(event) {
    if (event.touches.length !== 2 || !this.plot) {
      this.pinched = null;
      return;
    }
    event.preventDefault();
    const { left, width } = this.plot.over.getBoundingClientRect();
    const [one, other] = [...event.touches].map((touch) => (touch.clientX - left) / width).sort((a, b) => a - b);
    const [from, to] = this.group.range(this.newest);
    this.pinched ??= [one, other].map((share) => from + share * (to - from));
    const [a, b] = this.pinched;
    const span_s = (b - a) / (other - one);
    this.group.zoom([a - one * span_s, a + (1 - one) * span_s]);
  }

  /** Add a bucket with its first and last time, and minimum and maximum per axis (null without values). */
  add(bucket, range, period_s) {
    this.offset_s ??= bucket.utc_s - bucket.last_s;
    const x = (bucket.first_s + bucket.last_s) / 2 + this.offset_s;
    const xs = this.data[0];
    const before = xs.at(-1);
    if (before !== undefined && x <= before) this.data.forEach((one) => (one.length = this.stored = 0)); // the host has restarted
    else if (before !== undefined && x - before > HOLE_BUCKETS * Math.max(period_s, this.step_s ?? 0)) {
      this.push(before + period_s, null);
      this.step_s = undefined;
    } else if (before !== undefined) this.step_s = x - before;
    if (this.last && isLossBetween(this.last, bucket, this.group.rate_hz)) {
      this.losses.push(x); // the place of the gap is exact
      if (xs.length && isNumber(this.data[1].at(-1))) this.push((xs.at(-1) + x) / 2, null);
    }
    this.mark(bucket);
    this.last = bucket;
    this.push(x, range);
    this.newest = x;
    if (xs[this.stored] < x - FINE_S - MERGE_S) this.merge();
    this.draw();
  }

  /** Mark the lost samples that the ledger counted in a bucket, unless a mark is near. */
  mark({ lost, gaps, first_s, last_s }, near_s = MARK_S) {
    const x = (first_s + last_s) / 2 + this.offset_s;
    if ((lost || gaps) && !this.losses.some((one) => Math.abs(one - x) < near_s)) this.losses.push(x);
  }

  merge() {
    const xs = this.data[0];
    const isGap = (at) => xs[at + 1] - xs[at - 1] > GAP_LEAST_S && this.data.every((one, line) => !line || one[at] === null);
    const merged = this.data.map(() => []);
    const slot = (at) => Math.floor(xs[at] / MERGED_S);
    let end = this.stored;
    while (xs[end] < this.newest - FINE_S) {
      const first = end;
      while (xs[end] < this.newest - FINE_S && slot(end) === slot(first) && isGap(end) === isGap(first)) end += 1;
      const part = this.data.map((one) => one.slice(first, end).filter((value) => value !== null));
      merged[0].push((part[0][0] + part[0].at(-1)) / 2);
      this.axes.forEach((_, index) => {
        const isKept = part[1 + 2 * index].length > 0;
        merged[1 + 2 * index].push(isKept ? Math.max(...part[1 + 2 * index]) : null);
        merged[2 + 2 * index].push(isKept ? Math.min(...part[2 + 2 * index]) : null);
      });
    }
    this.data.forEach((one, line) => one.splice(this.stored, end - this.stored, ...merged[line]));
    this.stored += merged[0].length;
    let old = 0;
    while (xs[old] < this.newest - KEPT_S) old += 1;
    this.data.forEach((one) => one.splice(0, old));
    this.stored -= old;
    this.losses = this.losses.filter((one) => one >= xs[0]);
  }

  /** Insert buckets of the history, [bucket, length in s] each, in place of the points of this time. rangeOf(bucket)
   *  returns minimum and maximum per axis. */
  restore(buckets, rangeOf) {
    if (!buckets.length) return;
    const live = this.data;
    const { utc_s, last_s } = buckets.at(-1)[0];
    this.offset_s ??= utc_s - last_s;
    const [first, last] = [buckets[0][0].first_s, last_s].map((one) => one + this.offset_s);
    const [begin, end] = [first, last].map((x, index) => live[0].filter((one) => (index ? one <= x : one < x)).length);
    this.data = live.map((one) => one.slice(0, begin));
    this.losses = this.losses.filter((one) => one < first || one > last);
    if (begin && first - live[0][begin - 1] > HOLE_BUCKETS * buckets[0][1]) this.push((live[0][begin - 1] + first) / 2, null);
    let before = null;
    for (const [bucket, period_s] of buckets) {
      if (before && bucket.first_s - before.last_s > period_s) this.push(before.last_s + this.offset_s, null);
      this.mark(bucket, 0);
      this.push((bucket.first_s + bucket.last_s) / 2 + this.offset_s, rangeOf(bucket));
      before = bucket;
    }
    this.stored = this.data[0].length;
    this.data = this.data.map((one, line) => {
      const rest = live[line].slice(end);
      const [before, after] = [one.findLast(isNumber), rest.find(isNumber)];
      const turns = this.isAngle && line && isNumber(before) && isNumber(after) ? near(after, before) - after : 0;
      return one.concat(turns ? rest.map((value) => (value === null ? null : value + turns)) : rest);
    });
    this.newest = Math.max(this.newest ?? last, last);
    if (this.stored === this.data[0].length) this.step_s = 1; // the incomplete second is no gap
    this.draw();
  }

  push(x, range) {
    this.data[0].push(x);
    this.axes.forEach((_, index) => {
      const lines = [this.data[2 + 2 * index], this.data[1 + 2 * index]];
      let ends = range?.map((vector) => vector[index] ?? null) ?? [null, null];
      if (ends.includes(null)) ends = [null, null];
      else ends = ends.map((value) => value * this.scale);
      if (this.isAngle && ends[0] !== null) ends = unwrapped(ends, lines[1].findLast(isNumber));
      lines.forEach((line, side) => line.push(ends[side]));
    });
  }

  clear() {
    this.data.forEach((one) => (one.length = 0));
    this.offset_s = null;
    this.losses = [];
    this.stored = 0;
    this.last = null;
  }

  move(offsets) {
    this.offsets = offsets;
    this.draw();
  }

  draw() {
    if (this.isDue || !this.isVisible || !this.data[0].length || !this.box.clientWidth) return;
    this.isDue = true;
    setTimeout(() => requestAnimationFrame(() => this.drawNow()), Math.max(0, this.drawn + PERIOD_MS - performance.now()));
  }

  drawNow() {
    this.isDue = false;
    if (!this.data[0].length) return;
    if (!this.plot && hasPlots) this.begin();
    const move = (one, line) => (line ? one.map((value) => (value === null ? null : value + this.offsets[(line - 1) >> 1])) : one);
    this.plot?.setData(this.offsets.some(Boolean) ? this.data.map(move) : this.data);
    this.drawn = performance.now();
    this.showValues();
  }

  /** Show the values at the cursor, or the newest values. */
  showValues() {
    const shown = this.plot?.data ?? this.data;
    const at = this.plot?.cursor.idx ?? shown[0].length - 1;
    this.values.forEach(({ value }, index) => {
      const [most, least] = [1, 2].map((line) => shown[line + 2 * index][at]).map((one) => (this.isAngle && isNumber(one) ? near(one, 0) : one));
      const same = number(most, this.decimals) === number(least, this.decimals);
      setText(value, same ? number(most, this.decimals) : `${number(least, this.decimals)} … ${number(most, this.decimals)}`);
    });
  }

  close() {
    this.plot?.destroy();
  }
}
