import { session } from "./state.js";
import { CoverageSphere, cellDirection, coveredCells } from "./sphere.js";
import { button, icon, section, toast } from "./ui.js";
import { AXES, call, DEGREE, el, marked, number, quantity, setText, span, timeOf } from "./util.js";

const SAVED_ON_REQUEST = "until power-off, unless it is saved";

/** Words for a save: imud cannot read the flash, so that the reply of the device does not verify the save. */
const afterSave = (kept) => kept === SAVED_ON_REQUEST ? ". The save to flash is not verified: imud cannot read the flash" : " and saved";
const STEPS = ["Prepare", "Turn", "Check", "Save"];
const TURN_RAD = 2 * Math.PI;
const SIDES = [
  ["top", 2, 1, "Turn the device upside down: the top of the sphere is still empty."],
  ["bottom", 2, -1, "Turn the device with its upper side up: the bottom of the sphere is still empty."],
  ["+x", 0, 1, "Turn the device so that its x axis points down."], ["-x", 0, -1, "Turn the device so that its x axis points up."],
  ["+y", 1, 1, "Turn the device so that its y axis points down."], ["-y", 1, -1, "Turn the device so that its y axis points up."],
];

/** Return the sentence for the user and the cells to measure next. */
export function instruction(detail) {
  if (detail.cells === undefined) return { words: "Do not touch the device.", next: [] };
  const covered = coveredCells(detail.cells);
  const open = SIDES.map(([, axis, sign, words]) => {
    const cells = covered.map((is, cell) => [is, cellDirection(cell)[axis] * sign, cell]).filter(([, along]) => along > 0.6);
    const next = cells.filter(([is]) => !is).map(([, , cell]) => cell);
    return { words, next, share: next.length / Math.max(1, cells.length) };
  });
  const worst = open.reduce((best, one) => (one.share > best.share ? one : best));
  if (worst.share > 0.5) return worst;
  const turns = AXES.map((axis) => [axis, detail[`turned_${axis}_rad`] ?? 0]);
  const [axis, angle] = turns.reduce((least, one) => (one[1] < least[1] ? one : least));
  const next = covered.flatMap((is, cell) => (is ? [] : [cell]));
  if (angle < TURN_RAD) return { words: `Turn the device around its ${axis} axis: ${number(angle / DEGREE)}° of 360°.`, next };
  return { words: "Turn the device slowly in all directions.", next };
}

const dayOf = (utc_ns) => new Date(utc_ns / 1e6).toLocaleDateString("en-GB", { day: "numeric", month: "short" });
const title = (kind) => kind.charAt(0).toUpperCase() + kind.slice(1).replaceAll("_", " ");

export class CalibrationSection {
  constructor(device) {
    this.device = device;
    this.infos = [];
    this.status = null; // member `calibration` of the status
    this.isOwn = false;
    this.ended_ns = 0; // start of the calibration of the newest reply
    this.isReplied = false; // whether the reply to this page has shown the result, before the event of the end
    this.now_s = 0;
    this.progress = el("p", { class: "instruction", id: "calibration-instruction", role: "status" });
    this.message = el("p", { class: "help", id: "calibration-progress" });
    this.title = el("h3");
    this.who = el("p", { class: "help" });
    this.stop = button("Stop", () => this.end(), { kind: "danger small" });
    this.stop.id = "calibration-stop";
    this.steps = el("ol", { class: "steps" });
    this.sphere = new CoverageSphere();
    this.percent = el("b");
    this.bar = el("progress", { max: 1, "aria-label": "progress of the calibration" });
    this.measures = el("dl", { class: "measures" });
    this.turns = el("div", { class: "turns" });
    const legend = el("p", { class: "legend-line" }, el("span", {}, el("i", { class: "sw-ok" }), "measured"), el("span", {}, el("i", { class: "sw-next" }), "measure next"));
    this.turning = el("div", { class: "running-grid", hidden: true }, this.sphere.canvas,
      el("div", {}, el("div", { class: "progress" }, this.percent, el("span", { text: "%" }), this.bar), this.measures, this.turns, legend));
    this.running = el("div", { class: "panel running", hidden: true },
      el("div", { class: "running-head" }, el("div", {}, this.title, this.who), this.stop), this.steps, this.progress, this.message, this.turning);
    this.result = el("div", { class: "result", id: "calibration-result", role: "status" });
    this.list = el("div", { class: "panel flush" });
    this.node = section("calibration", "Calibration", this.running, this.result, this.list);
    this.load();
  }

  async load() {
    try {
      this.infos = await call("calibrations", { device: this.device });
      this.drawList();
    } catch (error) {
      this.list.replaceChildren(el("p", { class: "help empty", text: error.message }));
    }
  }

  onSession() {
    this.drawList();
    this.showRunning();
  }

  redraw(detail = this.detail) {
    this.detail = detail;
    if (detail) this.sphere.draw(detail.cells, instruction(detail).next);
  }

  drawList() {
    const none = el("p", { class: "help empty", text: "This device has no calibrations." });
    this.list.replaceChildren(...(this.infos.length ? this.infos.map((one) => this.entry(one)) : [none]));
  }

  entry(one) {
    const isBusy = !this.running.hidden;
    const { last } = one;
    const words = isBusy && this.kind === one.kind ? "running" : last ? `${dayOf(last.utc_ns)}, ${last.verified ? "verified" : "not verified"}${!last.saved ? "" : one.kept === SAVED_ON_REQUEST ? ", save not verified" : ", saved"}` : "not done yet";
    const save = one.kept === SAVED_ON_REQUEST ? el("input", { type: "checkbox" }) : null;
    const begin = button(`Start ${one.kind}`, () => this.begin(one.kind, save?.checked ?? false), { kind: "primary", disabled: isBusy });
    const control = el("div", { class: "buttons" }, begin, save && el("label", { class: "check" }, save, "save a verified result"), isBusy && el("span", { class: "help", text: "only one calibration at a time" }));
    const problem = last?.problem && el("p", { class: "help", text: `Last calibration: ${last.problem}` });
    return el("details", { class: "calibration", "data-kind": one.kind },
      el("summary", {}, el("div", {}, el("b", { text: title(one.kind) }), el("p", { class: "help" }, marked(one.help))), el("span", { class: `last ${last?.verified ? "" : "never"}`, text: words })),
      el("ol", { class: "todo" }, one.instructions.map((text) => el("li", { text }))), problem,
      el("p", { class: "help", text: `The result is kept: ${one.kept}. Manual: section ${one.section}.` }),
      session.control ? control : el("p", { class: "help", text: "Log in to start it." }));
  }

  async begin(kind, save) {
    this.isOwn = true;
    this.isReplied = false;
    this.kind = kind;
    this.result.replaceChildren();
    this.showRunning(true);
    try {
      const done = await call("calibrate", { device: this.device, kind, save });
      const checks = done.checks.map((one) => el("li", {}, icon(one.passed ? "ok" : "missing"),
        el("span", {}, `${one.name} ${quantity(one.value, one.unit)}, at most ${quantity(one.limit, one.unit)}: `, el("b", { text: one.passed ? "passed" : "not passed" }))));
      const words = done.verified ? `${kind} is verified${done.saved ? afterSave(done.kept) : ""}` : `${kind}: ${done.problem}`;
      this.result.replaceChildren(el("div", { class: "panel" }, el("p", { class: done.verified ? "fine-result" : "wrong", text: words }), el("ul", { class: "outcome" }, checks),
        done.device && el("p", { class: "help", text: `The device reports: ${done.device}` }), !done.saved && el("p", { class: "help", text: `The result is kept: ${done.kept}.` })));
    } catch (error) {
      this.result.replaceChildren(el("p", { class: "wrong", text: error.message }));
    }
    this.isOwn = false;
    this.isReplied = true;
    this.ended_ns = this.status?.begun_ns ?? 0;
    this.showRunning(false);
    this.load();
  }

  async end() {
    try {
      await call("stop_calibration", { device: this.device });
    } catch (error) {
      toast(error.message);
    }
  }

  onEvent({ message, detail }) {
    if (detail.kind) this.kind = detail.kind;
    if (detail.phase === "begin") this.isReplied = false;
    if (this.isReplied && detail.cells !== undefined) this.showTurning(detail);
    if (this.isReplied) return; // an event from the time before the reply
    setText(this.message, message);
    if (detail.phase === "end") {
      if (!this.isOwn) {
        this.result.replaceChildren(el("p", { class: detail.verified ? "fine-result" : "wrong", text: message + (detail.saved ? afterSave(this.infos.find((one) => one.kind === detail.kind)?.kept) : "") }));
        this.load();
      }
      this.showRunning(false);
    } else {
      if (this.running.hidden && !this.isOwn) this.result.replaceChildren();
      this.showRunning(true);
      this.showProgress(detail);
    }
  }

  onStatus(status, now_s) {
    this.now_s = now_s;
    const before = this.status;
    const isOld = status.calibration?.begun_ns <= this.ended_ns; // a status from the time before the reply
    this.status = isOld ? null : status.calibration;
    if (!this.status) {
      if (before && !this.isOwn) this.showRunning(false);
      return;
    }
    this.isReplied = false; // another calibration, also if its first event did not arrive
    this.kind = this.status.kind;
    setText(this.message, this.status.message);
    this.showRunning(true);
    this.showProgress({ phase: this.status.phase, ...this.status.progress });
  }

  showRunning(is = !this.running.hidden) {
    const isChanged = is === this.running.hidden;
    this.running.hidden = !is;
    this.stop.hidden = !session.control;
    if (is) {
      setText(this.title, `${title(this.kind ?? "")} calibration is running`);
      const { begun_ns, limit_ns, by } = this.status ?? {};
      const limit = limit_ns ? `, stops after ${span(limit_ns / 1e9)}` : "";
      setText(this.who, begun_ns ? `started${by ? ` by ${by}` : ""} at ${timeOf(begun_ns / 1e9)}, ${span(this.now_s - begun_ns / 1e9)} ago${limit}` : "");
    } else {
      this.turning.hidden = true;
      setText(this.progress, "");
      this.status = null;
    }
    if (isChanged) this.drawList();
  }

  showProgress(detail) {
    const at = { turn: 1, check: 2, save: 3 }[detail.phase] ?? 0;
    this.steps.replaceChildren(...STEPS.map((words, index) =>
      el("li", { class: index < at ? "done" : index === at ? "now" : "", "aria-current": index === at ? "step" : null }, el("i", {}, index < at && icon("ok")), words)));
    if (detail.phase !== undefined || detail.cells !== undefined) setText(this.progress, instruction(detail).words);
    this.turning.hidden = detail.cells === undefined;
    if (detail.cells === undefined) return;
    this.showTurning(detail);
  }

  showTurning(detail) {
    if (detail.cells !== this.cells) {
      this.cells = detail.cells;
      this.redraw(detail);
      if (navigator.userActivation?.hasBeenActive) navigator.vibrate?.(60);
    }
    this.bar.value = detail.progress ?? 0;
    setText(this.percent, number(100 * (detail.progress ?? 0)));
    const shown = [
      ["Directions measured", quantity(detail.coverage, ""), "of the sphere"],
      ["Magnetic field", detail.field_t ? quantity(detail.field_t, "T") : "unknown", "Earth: 22 to 67 µT"],
      ["Residual", detail.field_t ? quantity(detail.residual, "") : "unknown", ""],
      ["Device reports", detail.device || "–", ""],
    ];
    this.measures.replaceChildren(...shown.map(([name, value, more]) => el("div", {}, el("dt", { text: name }), el("dd", {}, el("b", { text: value }), el("span", { class: "help", text: ` ${more}` })))));
    this.turns.replaceChildren(...AXES.map((axis, index) => {
      const angle = detail[`turned_${axis}_rad`] ?? 0;
      const bar = el("b", { class: `axis${index}`, css: { width: `${Math.min(100, (100 * angle) / TURN_RAD)}%` } });
      return el("div", { class: angle >= TURN_RAD ? "good" : "" }, el("span", { text: `around ${axis}` }), el("i", {}, bar), el("output", { text: `${number(angle / DEGREE)}°` }));
    }));
  }
}
