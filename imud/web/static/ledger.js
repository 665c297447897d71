import { section } from "./ui.js";
import { el, number, percent, setText } from "./util.js";

const BARS = [
  ["bytes", "Bytes", (one) => one.bytes_in, [
    ["in valid frames", "bytes_in_good_frames", "good"], ["in damaged frames", "bytes_in_bad_frames", "bad"],
    ["skipped", "bytes_skipped", "warn"], ["not processed yet", "bytes_pending", "wait"],
  ]],
  ["frames", "Valid frames", (one) => one.frames_good, [
    ["in samples", "frames_in_samples", "good"], ["in replies", "frames_in_replies", "other"],
    ["ignored", "frames_ignored", "warn"], ["not processed yet", "frames_pending", "wait"],
  ]],
  ["samples", "Samples", null, [
    ["published", "samples", "good"], ["not sent by the device", "lost_gap_device", "warn"], ["lost in damaged frames", "lost_crc", "bad"],
    ["lost in kernel buffer overruns", "lost_overrun", "bad2"], ["lost in full queues", "lost_queue", "bad3"],
  ]],
];
const LOSSES = [
  ["lost_crc", "In damaged frames", "Check the cable and its ground"],
  ["lost_gap_device", "Not sent by the device", "Use a lower output rate or a higher bit rate"],
  ["lost_overrun", "Kernel buffer overruns", "Reduce the load of this host"],
  ["lost_queue", "Full queues in imud", "Reduce the load of this host, or use a lower output rate"],
];

export class LedgerSection {
  constructor() {
    this.bars = BARS.map(makeBar);
    this.lead = el("p", { class: "lead" });
    this.losses = LOSSES.map(([cause, name, next]) => {
      const cells = ["recent", "all", "next"].map(() => el("td"));
      return { cause, next, cells, node: el("tr", { "data-cause": cause }, el("th", { scope: "row", text: name }), cells) };
    });
    const head = ["Lost samples", "last minute", "since start", "next step"].map((text) => el("th", { text, scope: "col" }));
    const table = el("table", { class: "plain" }, el("thead", {}, el("tr", {}, head)), el("tbody", {}, this.losses.map((one) => one.node)));
    this.gaps = el("p", { class: "help" });
    this.node = section("ledger", "Ledger", this.lead, el("div", { class: "two" }, el("div", { class: "panel ledger" }, this.bars.map((one) => one.node)), el("div", { class: "panel" }, table, this.gaps)));
  }

  draw({ status, bytes_open, frames_open }) {
    for (const bar of this.bars) drawBar(bar, status.ledger);
    const closes = bytes_open === 0 && frames_open === 0;
    this.node.dataset.closes = String(closes);
    setText(this.lead, `imud counts every byte, frame and sample. ${closes ? "All bytes and frames are accounted for." : `The ledger does not balance: ${number(bytes_open)} bytes, ${number(frames_open)} frames.`}`);
    this.lead.classList.toggle("wrong", !closes);
    const recent = status.recent?.lost ?? {};
    for (const { cause, next, cells, node } of this.losses) {
      const all = status.ledger[cause] ?? 0;
      setText(cells[0], number(recent[cause] ?? 0));
      setText(cells[1], number(all));
      setText(cells[2], all ? next : "");
      node.classList.toggle("none", !all);
    }
    const unknown = status.ledger.lost_unknown ?? 0;
    setText(this.gaps, unknown ? `${number(unknown)} ${unknown === 1 ? "gap" : "gaps"} of unknown size since start.` : "");
  }
}

function makeBar([id, title, whole, parts]) {
  const sum = el("span", { class: "help sum" });
  const bar = el("div", { class: "bar", id: `bar-${id}`, role: "img" });
  const legend = el("ul", { class: "legend" });
  const made = parts.map(([name, field, kind]) => {
    const [piece, count, share] = [el("i", { class: `part p-${kind}`, title: name }), el("b"), el("span", { class: "help" })];
    const item = el("li", {}, el("i", { class: `p-${kind}` }), name, count, share);
    bar.append(piece);
    legend.append(item);
    return { name, field, piece, count, share, item, isGood: kind === "good" };
  });
  return { whole, made, sum, bar, node: el("div", { class: "ledger-bar" }, el("div", { class: "ledger-head" }, el("b", { text: title }), sum), bar, legend) };
}

function drawBar({ whole, made, sum, bar }, ledger) {
  const parts = made.map(({ field }) => ledger[field] ?? 0);
  const all = parts.reduce((a, b) => a + b, 0);
  const total = whole ? whole(ledger) : all;
  made.forEach(({ piece, count, share, item, isGood }, index) => {
    piece.style.flexGrow = String(parts[index]);
    piece.hidden = parts[index] === 0;
    piece.dataset.count = parts[index];
    item.hidden = parts[index] === 0 && !isGood;
    setText(count, number(parts[index]));
    setText(share, total && parts[index] < total ? `${percent((100 * parts[index]) / total)} %` : "");
  });
  bar.dataset.total = total;
  bar.setAttribute("aria-label", made.map(({ name }, index) => `${name} ${parts[index]}`).join(", "));
  const open = total - all;
  setText(sum, `total ${number(total)}${open ? `; ${number(open)} unaccounted for` : ""}`);
  sum.classList.toggle("wrong", open !== 0);
}
