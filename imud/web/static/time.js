import { PlotGroup, RollingPlot } from "./plots.js";
import { section } from "./ui.js";
import { duration, el, number, setText } from "./util.js";

const SYNC = {
  arrival: "the arrival times of the bytes", regression: "the device time, fitted to the arrival times", edge: "the device time, fitted to pulses",
  utc: "the device time, which the device synchronizes to UTC",
};
const PARTS = { arrivals: "Arrivals", link: "Link", adapter: "Adapter", device: "Device", poll: "Read", pulses: "Pulses", utc: "UTC", other: "Other" };
const seconds = (ns) => duration(ns / 1e9);

export class TimeSection {
  constructor() {
    this.group = new PlotGroup(600);
    this.stamps = new RollingPlot("stamps", "Time stamp error and latency", "ms", ["time stamp error", "latency"], { scale: 1e3, decimals: 3, isLog: true }, this.group);
    this.lead = el("p", { class: "lead" });
    this.chain = el("ol", { class: "chain" });
    this.more = el("p", { class: "help" });
    this.list = el("ol", { class: "histogram" });
    this.note = el("p", { class: "help" });
    this.bars = [];
    this.node = section("time", "Time", this.lead, this.chain, this.more, el("div", { class: "two" }, el("div", { class: "panel" }, this.stamps.node),
      el("div", { class: "panel", id: "latency" }, el("h3", { text: "Delay from measurement to publication" }), this.list, this.note)));
  }

  add(bucket, period_s) {
    const stamp = [bucket.t_err_s, bucket.latency_s];
    this.stamps.add(bucket, [stamp, stamp], period_s);
  }

  restore(buckets) {
    this.stamps.restore(buckets, ({ t_err_s, latency_s }) => [[t_err_s, latency_s], [t_err_s, latency_s]]);
  }

  draw({ status, latency_bounds_s }) {
    const { clock } = status;
    const source = SYNC[clock.sync] ?? clock.sync;
    const parts = clock.parts ?? [];
    const main = parts.length ? ` Main cause: ${parts[0].message} ${parts[0].next}` : "";
    setText(this.lead, `The time stamp error is ±${seconds(clock.t_err_ns)} (one sigma). The time stamps come from ${source}.${main}`);
    const rate = status.expected_rate_hz ? `${number(status.expected_rate_hz)} Hz` : "rate not known";
    const timer = clock.hold_ns ? ` Latency timer of the USB adapter: ${seconds(clock.hold_ns)}.` : "";
    const utc = clock.reference_error_ns ? `±${seconds(clock.reference_error_ns)}` : "not known";
    setText(this.more, `Device clock: ${rate}, ${number(clock.skew_ppm, 2)} ppm. Spread of the arrival times: ±${seconds(clock.residual_ns)}.${timer} Batching in imud: ${seconds(status.hold_ns)}. UTC error of the host: ${utc}.`);
    const drawn = JSON.stringify(parts);
    if (drawn !== this.drawn) this.chain.replaceChildren(...parts.map((one) => el("li", {}, el("b", { text: PARTS[one.name] ?? one.name }), el("span", { class: "help", text: one.message }), el("output", { text: `±${seconds(one.value_ns)}` }))));
    this.drawn = drawn;
    this.drawHistogram(status, latency_bounds_s);
  }

  drawHistogram(status, bounds_s) {
    const counts = status.latency_buckets;
    const all = counts.reduce((a, b) => a + b, 0);
    const most = Math.max(...counts, 1);
    if (this.bars.length !== counts.length) {
      this.bars = counts.map((_, index) => {
        const bound = bounds_s[index];
        const name = bound === undefined ? `> ${duration(bounds_s.at(-1))}` : `≤ ${duration(bound)}`;
        const [bar, share] = [el("b"), el("output")];
        return { bar, share, node: el("li", {}, el("span", { text: name }), el("i", {}, bar), share) };
      });
      this.list.replaceChildren(...this.bars.map((one) => one.node));
    }
    counts.forEach((count, index) => {
      this.bars[index].bar.style.width = `${(100 * count) / most}%`;
      this.bars[index].node.dataset.count = count;
      setText(this.bars[index].share, all ? `${number((100 * count) / all, 1)} %` : "–");
    });
    const mean = all ? duration(status.latency_sum_ns / 1e9 / all) : "–";
    setText(this.note, `${number(all)} samples since start, mean ${mean} from measurement to publication`);
  }

  redraw() {
    this.stamps.draw();
  }

  close() {
    this.stamps.close();
  }
}
