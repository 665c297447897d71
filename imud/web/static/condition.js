import { button, CONDITION_WORDS, CONDITIONS, icon } from "./ui.js";
import { el, marked, span } from "./util.js";

export const known = (state) => (CONDITIONS.includes(state) ? state : "ok"); // a device of a recording has no condition

/** Return the devices, the worst condition first. */
export const sorted = (rows) => [...rows].sort((a, b) => CONDITIONS.indexOf(known(a.state)) - CONDITIONS.indexOf(known(b.state)));

export const deviceLink = (name, ...parts) => `#/device/${[name, ...parts].map(encodeURIComponent).join("/")}`;

export const sinceWords = (since_s, now_s) => (since_s === null || since_s === undefined ? "" : `for ${span(now_s - since_s)}`);

const LINKS = {
  live: "Show values", time: "Show time", ledger: "Show lost samples", settings: "Show settings", calibration: "Calibrate",
  events: "Show events", about: "Show details",
};

export function reasonLink(device, reason) {
  if (reason.setting) return [deviceLink(device, "settings", reason.setting), "Show setting"];
  return [deviceLink(device, reason.section), LINKS[reason.section] ?? "Show details"];
}

/** Return the reasons for a card: the first with its next step, then the others. */
export function reasonList(reasons, most) {
  const [first, ...others] = reasons;
  if (!first) return null;
  const rest = reasons.length - most;
  return el("ul", { class: "reasons" },
    el("li", {}, el("p", { text: first.message }), first.next && el("p", { class: "next" }, icon("arrow"), el("span", {}, marked(first.next)))),
    others.slice(0, most - 1).map((one) => el("li", { class: "other" }, el("p", { text: one.message }))),
    rest > 0 && el("li", { class: "rest", text: `and ${rest} more` }),
    others.length > 0 && el("li", { class: "rest phone-rest", text: `and ${others.length} more` }));
}

export class ConditionView {
  constructor(device) {
    this.device = device;
    this.shown = el("div");
    this.news = el("p", { class: "unseen", role: "status" }); // for screen readers
    this.node = el("div", { id: "condition" }, this.shown, this.news);
    this.drawn = this.told = "";
    this.isUnfolded = false;
  }

  /** Announce the condition if it or the kinds of its reasons change. A number in a reason changes more often. */
  tell({ condition, reasons }) {
    const told = [condition, ...reasons.map((one) => one.code)].join();
    if (this.told && told !== this.told) this.news.textContent = `${this.device}: ${CONDITION_WORDS[condition]}. ${reasons[0]?.message ?? ""}`;
    this.told = told;
  }

  draw(condition, now_s) {
    if (condition) this.tell(condition);
    const drawn = JSON.stringify([condition?.condition, condition?.reasons]);
    if (drawn !== this.drawn) {
      this.drawn = drawn;
      this.since = el("span");
      this.shown.replaceChildren(condition ? this.box(condition) : "");
    }
    if (condition) this.since.textContent = sinceWords(condition.since_ns / 1e9, now_s);
  }

  box({ condition, reasons }) {
    if (condition === "ok")
      return el("p", { class: "all-well" }, icon("ok"), el("span", {}, el("b", { text: "OK" }), ` ${reasons.map((one) => one.message).join(" ")}`));
    const head = el("p", { class: "condition-head" }, icon(condition), el("b", { text: CONDITION_WORDS[condition] }), this.since);
    const box = el("section", { class: `condition k-${condition} ${this.isUnfolded ? "unfolded" : ""}`, "aria-label": "condition" }, head, reasons.map((one) => this.reason(one, condition)));
    if (reasons.length > 1 && !this.isUnfolded)
      box.append(button(`${reasons.length - 1} more`, (event) => {
        this.isUnfolded = true;
        box.classList.add("unfolded");
        event.currentTarget.remove();
      }, { kind: "quiet small unfold", glyph: "down" }));
    return box;
  }

  reason(one, condition) {
    const [href, words] = reasonLink(this.device, one);
    const link = condition !== "missing" && el("a", { class: "button small", href, "aria-label": `${words}: ${one.message}` }, icon("next"), el("span", { text: words }));
    return el("div", { class: "reason", "data-code": one.code }, el("p", { class: "why", text: one.message }), el("p", { class: "next" }, marked(one.next)), link);
  }
}
