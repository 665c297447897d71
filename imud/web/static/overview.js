import { deviceLink, known, reasonList, sinceWords, sorted } from "./condition.js";
import { eventWords, messageOf, pastEvents } from "./events.js";
import { CONDITION_WORDS, icon } from "./ui.js";
import { DEGREE, duration, el, number, percent, setText, timeOf } from "./util.js";

const COUNTED = { missing: (n) => `${n} missing`, attention: (n) => `${n} need${n === 1 ? "s" : ""} attention`, degraded: (n) => `${n} degraded`, ok: (n) => `${n} OK` };
const FILTER_FROM = 9; // number of devices from which a field filters by name
const EVENTS_SHOWN = 5;
const ROW_MOST = 3; // number of tiles in a single row
const LOST_PERCENT = 0.1;
const RATE_SHARE = 0.02;

export function verdict(rows) {
  const counts = Object.fromEntries(Object.keys(COUNTED).map((one) => [one, rows.filter((row) => known(row.state) === one).length]));
  const bad = rows.length - counts.ok;
  const worst = Object.keys(COUNTED).find((one) => counts[one]) ?? "ok";
  const all = rows.length === 1 ? "The device is OK" : `All ${rows.length} devices are OK`;
  const words = bad ? `${bad} of ${rows.length} device${rows.length === 1 ? "" : "s"} ${bad === 1 ? "has" : "have"} a problem` : all;
  return { counts, worst, words: rows.length ? words : "The configuration contains no devices" };
}

function strip(history) {
  const said = history.filter(Boolean);
  const ok = said.filter((one) => one === "ok").length;
  return el("div", { class: "strip", role: "img", "aria-label": `last hour: OK in ${ok} minutes, unknown in ${history.length - said.length}` }, history.map((one) => el("i", { class: `h-${one ?? "none"}` })));
}

function figures(row) {
  const [error, unit] = duration(row.t_err_s).split(" ");
  const isSlow = row.expected_rate_hz > 0 && Math.abs(row.rate_hz / row.expected_rate_hz - 1) > RATE_SHARE;
  const shown = [
    ["rate", number(row.rate_hz, 1), row.expected_rate_hz ? `of ${number(row.expected_rate_hz, 0)} Hz` : "Hz", isSlow],
    ["lost, 1 min", percent(row.lost_percent ?? 0), "%", row.lost_percent > LOST_PERCENT],
    row.t_err_s !== null && ["time error", `±${error}`, unit ?? "", false],
    row.temperature_c !== null && ["temp.", number(row.temperature_c, 0), "°C", false],
  ];
  return el("dl", { class: "figures" }, shown.filter(Boolean).map(([name, value, unit_, isBad]) =>
    el("div", { class: isBad ? "bad" : "" }, el("dt", { text: name }), el("dd", {}, el("b", { text: value }), el("span", { text: ` ${unit_}` })))));
}

const about = (row) => [row.identity.product, row.driver, row.link].filter(Boolean).join(" · ");

function card(row, now_s) {
  const since = el("span", { text: ` ${sinceWords(row.since_s, now_s)}` });
  const head = el("div", { class: "card-head" }, icon(row.state), el("div", {}, el("h3", { text: row.name }), el("p", { class: "cond", text: CONDITION_WORDS[row.state] }, since)));
  const foot = row.state === "missing" ? el("p", { class: "help", text: about(row) }) : figures(row);
  return el("a", { class: `card k-${row.state}`, href: deviceLink(row.name), "data-device": row.name }, head, reasonList(row.reasons, 3), row.work && el("p", { class: "help", text: row.work }),
    el("div", { class: "card-foot" }, foot, strip(row.history), el("p", { class: "strip-label" }, el("span", { text: "1 h ago" }), el("span", { text: "now" }))));
}

function line(row) {
  const turn = row.heading === "relative" ? "yaw" : "heading";
  const angles = row.euler_rad ? row.euler_rad.map((one) => `${number(one / DEGREE, 1)}°`).join("  ") : "";
  return el("a", { class: "row k-ok", href: deviceLink(row.name), "data-device": row.name }, icon("ok", row.state), el("div", { class: "row-name" }, el("h3", { text: row.name }), el("p", { class: "help", text: row.work || about(row) })),
    el("div", { class: "row-angles" }, angles && el("span", { class: "help", text: `roll, pitch, ${turn}` }), el("output", { class: "angles", text: angles })), figures(row), el("div", { class: "row-strip" }, strip(row.history)));
}

export class Overview {
  constructor(main, stream) {
    this.stream = stream;
    this.title = el("h1");
    this.tally = el("div", { class: "tally" });
    this.verdict = el("section", { id: "summary", class: "verdict", role: "status" }, this.title, this.tally);
    this.filter = el("input", { type: "search", id: "filter", "aria-label": "filter by name", placeholder: "Filter by name", hidden: true, oninput: () => this.draw() });
    this.none = el("p", { class: "help", hidden: true, text: "Add a device with: imud setup" });
    this.cards = el("div", { class: "cards" });
    this.group = el("h2", { class: "group", text: "OK" });
    this.rows = el("div", { class: "rows" });
    this.happened = el("ol", { class: "happened", id: "recent-events" });
    this.all = el("a", { text: "All events", hidden: true });
    main.append(this.verdict, this.filter, this.none, this.cards, this.group, this.rows, el("div", { class: "pair" }, el("h2", { class: "group", text: "Recent events" }), this.all), this.happened);
    stream.look({ look: "overview" });
    this.loadEvents();
  }

  async loadEvents() {
    try {
      this.events = (await pastEvents(undefined, EVENTS_SHOWN)).events;
      this.drawEvents();
    } catch {
      this.happened.replaceChildren();
    }
  }

  drawEvents() {
    const shown = (this.events ?? []).slice(-EVENTS_SHOWN).reverse();
    this.happened.replaceChildren(...shown.map((one) => el("li", {}, el("time", { text: timeOf(one.t_ns / 1e9) }), el("b", { text: one.device || "imud" }),
      el("span", {}, eventWords(one.kind), one.count > 1 && el("em", { text: ` ×${number(one.count)}` }), el("span", { class: "help", text: ` ${messageOf(one)[0]}` })))));
  }

  onRestart() {
    this.loadEvents();
  }

  onSession() {
    this.loadEvents();
  }

  onMessage(message) {
    if (message.kind === "events" && message.events.some((one) => one.event !== "calibration" && one.event !== "mark")) this.loadEvents();
    if (message.kind !== "overview") return;
    this.world = message;
    this.draw();
    if (this.isTimed !== true) this.drawEvents(); // the first message gives the offset of the clock
    this.isTimed = true;
  }

  draw() {
    const { devices, now_s } = this.world;
    const { counts, words, worst } = verdict(devices);
    setText(this.title, words);
    this.verdict.className = `verdict v-${worst}`;
    const tally = JSON.stringify(counts);
    if (tally !== this.counted) this.tally.replaceChildren(...Object.entries(COUNTED).filter(([key]) => counts[key]).map(([key, say]) => el("span", {}, icon(key), say(counts[key]))));
    this.counted = tally;
    this.none.hidden = devices.length > 0;
    this.all.hidden = !devices.length;
    if (devices.length) this.all.href = deviceLink(sorted(devices)[0].name, "events", "all");
    this.filter.hidden = devices.length < FILTER_FROM;
    const wanted = this.filter.hidden ? "" : this.filter.value.trim().toLowerCase();
    const rows = sorted(devices).filter((one) => one.name.toLowerCase().includes(wanted));
    const [bad, good] = [rows.filter((one) => known(one.state) !== "ok"), rows.filter((one) => known(one.state) === "ok")];
    replaceKeepingFocus(this.cards, bad.map((one) => card(one, now_s)));
    replaceKeepingFocus(this.rows, good.map(line));
    this.group.hidden = !good.length;
  }

  close() {}
}

function replaceKeepingFocus(box, nodes) {
  const name = box.contains(document.activeElement) ? document.activeElement.dataset.device : null;
  const before = [...box.children];
  if (before.length === nodes.length && before.every((one, index) => one.dataset.device === nodes[index].dataset.device && one.className === nodes[index].className))
    nodes.forEach((one, index) => before[index].textContent !== one.textContent && before[index].replaceChildren(...one.childNodes));
  else box.replaceChildren(...nodes);
  if (name) [...box.children].find((one) => one.dataset.device === name)?.focus();
}

export class Wall {
  constructor(main, stream) {
    this.title = el("h1");
    this.verdict = el("section", { id: "summary", class: "verdict" }, this.title, el("a", { class: "button", href: "#/", text: "Close" }));
    this.bad = el("div", { class: "wall" });
    this.good = el("div", { class: "wall wall-ok" });
    main.append(this.verdict, this.bad, this.good);
    stream.look({ look: "overview" });
  }

  onMessage({ kind, devices }) {
    if (kind !== "overview") return;
    const { words, worst } = verdict(devices);
    setText(this.title, words);
    this.verdict.className = `verdict v-${worst}`;
    const rows = sorted(devices);
    for (const [box, isOk] of [[this.bad, false], [this.good, true]]) {
      const shown = rows.filter((one) => (known(one.state) === "ok") === isOk);
      box.hidden = !shown.length;
      box.style.setProperty("--columns", shown.length > ROW_MOST ? Math.ceil(Math.sqrt(shown.length)) : shown.length);
      box.replaceChildren(...shown.map(tile));
    }
  }

  close() {}
}

function tile(row) {
  const state = known(row.state);
  return el("a", { class: `tile k-${state}`, href: deviceLink(row.name), "data-device": row.name }, icon(state), el("h2", { text: row.name }), el("p", { class: "cond", text: CONDITION_WORDS[state] }),
    el("p", { class: "why", text: row.reasons[0]?.message ?? `${number(row.rate_hz, 0)} Hz` }));
}
