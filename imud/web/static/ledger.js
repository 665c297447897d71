// The ledger as bars with parts that add up, and the histogram of latencies.

import { duration, el, number, setText } from "./util.js";

const BARS = [
  ["bytes", "Bytes", (one) => one.bytes_in, [
    ["in good frames", "bytes_in_good_frames", "good"], ["in bad frames", "bytes_in_bad_frames", "bad"],
    ["skipped", "bytes_skipped", "warn"], ["pending", "bytes_pending", "wait"],
  ]],
  ["frames", "Good frames", (one) => one.frames_good, [
    ["in samples", "frames_in_samples", "good"], ["in replies", "frames_in_replies", "other"],
    ["ignored", "frames_ignored", "warn"], ["pending", "frames_pending", "wait"],
  ]],
  ["samples", "Samples measured", null, [
    ["published", "samples", "good"], ["lost (device)", "lost_gap_device", "warn"], ["lost (CRC)", "lost_crc", "bad"],
    ["lost (overrun)", "lost_overrun", "bad2"], ["dropped (queue)", "lost_queue", "bad3"],
  ]],
];

export class LedgerView {
  constructor() {
    this.node = el("div", { class: "ledger" });
    this.bars = BARS.map(([id, title, whole, parts]) => {
      const sum = el("p", { class: "sum" });
      const bar = el("div", { class: "bar", id: `bar-${id}` });
      const legend = el("ul", { class: "legend" });
      const made = parts.map(([name, field, kind]) => {
        const piece = el("span", { class: `part ${kind}`, title: name });
        const count = el("b");
        const item = el("li", {}, el("i", { class: `mark ${kind}` }), `${name} `, count);
        bar.append(piece);
        legend.append(item);
        return { field, piece, count, item };
      });
      this.node.append(el("h3", { text: title }), bar, legend, sum);
      return { title, whole, made, sum, bar };
    });
  }

  draw({ status, bytes_open, frames_open }) {
    const ledger = status.ledger;
    for (const { whole, made, sum, bar } of this.bars) {
      const parts = made.map(({ field }) => ledger[field]);
      const all = parts.reduce((a, b) => a + b, 0);
      const total = whole ? whole(ledger) : all;
      made.forEach(({ piece, count, item }, index) => {
        piece.style.flexGrow = String(parts[index]);
        piece.hidden = parts[index] === 0;
        piece.dataset.count = parts[index];
        setText(count, number(parts[index]));
        item.classList.toggle("none", parts[index] === 0);
      });
      bar.dataset.total = total;
      const open = total - all;
      setText(sum, whole ? `${number(total)} received; ${open ? `${number(open)} unaccounted for` : "the parts add up"}` : `${number(total)} in total`);
      sum.classList.toggle("problem", open !== 0);
    }
    this.node.dataset.closes = String(bytes_open === 0 && frames_open === 0);
  }
}

export class LatencyView {
  constructor() {
    this.list = el("ol", { class: "histogram" });
    this.note = el("p", { class: "quiet" });
    this.node = el("div", {}, this.list, this.note);
    this.bars = [];
  }

  draw({ status, latency_bounds_s }) {
    const counts = status.latency_buckets;
    const all = counts.reduce((a, b) => a + b, 0);
    const most = Math.max(...counts, 1);
    if (this.bars.length !== counts.length) {
      this.bars = counts.map((_, index) => {
        const bound = latency_bounds_s[index];
        const name = bound === undefined ? `> ${duration(latency_bounds_s.at(-1))}` : `≤ ${duration(bound)}`;
        const bar = el("span", { class: "part good" });
        const share = el("span", { class: "share" });
        return { bar, share, node: el("li", {}, el("span", { class: "name", text: name }), el("span", { class: "room" }, bar), share) };
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
}
