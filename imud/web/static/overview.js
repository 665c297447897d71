// Overview of all devices.

import { DEGREE, duration, el, length, number, setText } from "./util.js";

const FACTS = [
  ["rate", (row) => `${number(row.rate_hz, 1)} Hz`],
  ["attitude", (row) => (row.euler_rad ? row.euler_rad.map((one) => number(one / DEGREE, 1)).join(" / ") + "°" : "–")],
  ["|a|", (row) => (row.accel_m_s2 ? `${number(length(row.accel_m_s2), 2)} m/s²` : "–")],
  ["|ω|", (row) => (row.gyro_rad_s ? `${number(length(row.gyro_rad_s) / DEGREE, 1)} °/s` : "–")],
  ["time stamp", (row) => (row.sync ? `±${duration(row.t_err_s)}, ${row.sync}` : "–")],
  ["lost", (row) => number(row.lost)],
  ["age", (row) => duration(row.age_s)],
  ["temperature", (row) => (row.temperature_c === null ? "–" : `${number(row.temperature_c, 1)} °C`)],
];

export class Overview {
  constructor(main, stream) {
    this.summary = el("p", { id: "summary", class: "quiet" });
    this.grid = el("div", { class: "cards" });
    this.none = el("p", { class: "quiet", hidden: true, text: "The configuration contains no devices. Add one with: imud setup" });
    main.append(el("h1", { text: "Devices" }), this.summary, this.none, this.grid);
    this.cards = new Map();
    stream.look({ look: "overview" });
  }

  onMessage(message) {
    if (message.kind !== "overview") return;
    const well = message.devices.filter((row) => row.is_well).length;
    setText(this.summary, `${well} of ${message.devices.length} devices run without a problem; the daemon has ${message.clients} ${message.clients === 1 ? "client" : "clients"}`);
    this.none.hidden = message.devices.length > 0;
    const names = message.devices.map((row) => row.name);
    if (names.join("\n") !== [...this.cards.keys()].join("\n")) {
      this.cards = new Map(message.devices.map((row) => [row.name, makeCard(row.name)]));
      this.grid.replaceChildren(...[...this.cards.values()].map((card) => card.node));
    }
    for (const row of message.devices) draw(this.cards.get(row.name), row);
  }

  close() {}
}

function makeCard(name) {
  const state = el("span", { class: "pill" });
  const notes = el("p", { class: "notes" });
  const values = new Map(FACTS.map(([fact]) => [fact, el("dd")]));
  const list = el("dl", { class: "facts" });
  for (const [fact, value] of values) list.append(el("dt", { text: fact }), value);
  const about = el("p", { class: "quiet" });
  const head = el("div", { class: "card-head" }, el("strong", { text: name }), state);
  const node = el("a", { class: "card", href: `#/device/${encodeURIComponent(name)}` }, head, about, notes, list);
  return { node, state, notes, values, about };
}

function draw(card, row) {
  setText(card.state, row.state);
  card.state.className = `pill ${row.is_well ? "good" : "bad"}`;
  setText(card.about, [row.identity.product, row.driver, row.link].filter(Boolean).join(" · "));
  const notes = [row.problem];
  if (!row.closes) notes.push("the ledger does not balance");
  if (row.differs) notes.push("settings differ from the declared settings");
  if (row.alarm) notes.push("ALARM is active");
  setText(card.notes, notes.filter(Boolean).join("; "));
  for (const [fact, text] of FACTS) setText(card.values.get(fact), text(row));
}
