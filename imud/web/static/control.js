// Guided calibrations with the sphere of covered directions, and the commands of a device.

import { CoverageSphere } from "./sphere.js";
import { call, DEGREE, el, facts, marked, number, quantity, shown } from "./util.js";

const SAVED_ON_REQUEST = "until power-off, unless it is saved";

export class CalibrationView {
  constructor(device, session) {
    this.device = device;
    this.session = session;
    this.list = el("div");
    this.begins = [];
    this.progress = el("p", { id: "calibration-progress", role: "status" });
    this.bar = el("progress", { max: 1, value: 0, "aria-label": "progress of the calibration" });
    this.sphere = new CoverageSphere();
    this.details = el("div", { class: "grow" });
    this.turning = el("div", { class: "turning", hidden: true }, this.sphere.canvas, this.details);
    this.stop = el("button", { type: "button", id: "calibration-stop", text: "Stop", onclick: () => this.end() });
    this.running = el("div", { class: "running", hidden: true }, this.progress, this.bar);
    this.result = el("div", { class: "result", id: "calibration-result" });
    this.node = el("div", {}, this.running, this.turning, this.result, this.list);
    this.load();
  }

  async load() {
    try {
      const found = await call("calibrations", { device: this.device });
      this.list.replaceChildren(...found.map((one) => this.entry(one)), ...(found.length ? [] : [el("p", { class: "quiet", text: "This device has no calibrations." })]));
    } catch (error) {
      this.list.replaceChildren(el("p", { class: "quiet", text: error.message }));
    }
  }

  entry(one) {
    const steps = el("ol", {}, ...one.instructions.map((words) => el("li", { text: words })));
    const save = one.kept === SAVED_ON_REQUEST ? el("input", { type: "checkbox" }) : null;
    const begin = el("button", { type: "button", text: `Start ${one.kind}`, onclick: () => this.begin(one.kind, save?.checked ?? false) });
    begin.disabled = !this.running.hidden;
    this.begins.push(begin);
    const control = el("div", { class: "buttons" }, begin, save && el("label", {}, save, " save a verified result"));
    const words = this.session.control ? control : el("p", { class: "quiet", text: "Log in to start it." });
    return el("details", { "data-kind": one.kind }, el("summary", {}, el("b", { text: one.kind }), ": ", ...marked(one.help)), steps,
      el("p", { class: "quiet", text: `The result is kept: ${one.kept}. Manual, section ${one.section}.` }), words);
  }

  /** Show whether a calibration runs, also if another client started it. */
  setRunning(is) {
    this.running.hidden = !is;
    for (const button of this.begins) button.disabled = is;
    if (is && this.session.control && !this.stop.isConnected) this.running.append(this.stop);
  }

  async begin(kind, save) {
    this.prepare(`calibration ${kind} starts`);
    this.isOwn = true;
    try {
      const done = await call("calibrate", { device: this.device, kind, save });
      const checks = done.checks.map((one) => {
        const words = `${one.name} ${quantity(one.value, one.unit)}, at most ${quantity(one.limit, one.unit)}: `;
        return el("li", { text: words }, el("b", { class: one.passed ? "good" : "problem", text: one.passed ? "passed" : "not passed" }));
      });
      const words = done.verified ? `${kind} is verified${done.saved ? " and saved" : ""}` : `${kind}: ${done.problem}`;
      const device = done.device ? [el("p", { class: "quiet", text: `The device reports: ${done.device}` })] : [];
      this.result.replaceChildren(el("p", { class: done.verified ? "good" : "problem", text: words }), el("ul", {}, ...checks), ...device);
    } catch (error) {
      this.result.replaceChildren(el("p", { class: "problem", text: error.message }));
    }
    this.setRunning(false);
  }

  prepare(words) {
    this.isOwn = false; // the reply to the own request contains more than the event of the end, which may arrive later
    this.result.replaceChildren();
    this.turning.hidden = true;
    this.bar.removeAttribute("value"); // the progress is unknown
    this.progress.textContent = words;
    this.setRunning(true);
  }

  async end() {
    try {
      await call("stop_calibration", { device: this.device });
    } catch (error) {
      this.progress.textContent = error.message;
    }
  }

  /** Show an event of the kind `calibration`, also if another client started it. */
  onEvent({ message, detail }) {
    if (detail.phase === "begin" && this.running.hidden) this.prepare(message);
    this.progress.textContent = message;
    if (detail.phase === "end") {
      this.setRunning(false);
      if (!this.isOwn) this.result.replaceChildren(el("p", { class: detail.verified ? "good" : "problem", text: message + (detail.saved ? " and saved" : "") }));
    } else {
      this.setRunning(true);
    }
    if (detail.cells === undefined) return;
    this.turning.hidden = false;
    this.sphere.draw(detail.cells);
    this.bar.value = detail.progress ?? 0;
    this.details.replaceChildren(facts(turningRows(detail)));
  }
}

function turningRows(detail) {
  const turned = ["x", "y", "z"].map((axis) => [`turned about ${axis}`, `${number((detail[`turned_${axis}_rad`] ?? 0) / DEGREE)}° of 360°`]);
  return [
    ["directions", `${quantity(detail.coverage, "")} of the sphere`], ...turned,
    ["field", detail.field_t ? quantity(detail.field_t, "T") : "unknown"],
    ["residual", detail.field_t ? quantity(detail.residual, "") : "unknown"],
    ["device reports", detail.device || "–"],
  ];
}

export class ActionsView {
  constructor(device, session) {
    this.device = device;
    this.session = session;
    this.list = el("div", { class: "list" });
    this.result = el("div", { class: "result" });
    this.node = el("div", {}, this.result, this.list);
    this.load();
  }

  async load() {
    try {
      const found = await call("actions", { device: this.device });
      const entries = found.map((one) => this.entry(one));
      this.list.replaceChildren(...entries, ...(found.length ? [] : [el("p", { class: "quiet", text: "This device has no commands." })]));
    } catch (error) {
      this.list.replaceChildren(el("p", { class: "quiet", text: error.message }));
    }
  }

  entry(verb) {
    const inputs = verb.parameters.map((one) => {
      const input = el("input", { type: "text", size: 12, placeholder: one.default ?? "", "aria-label": one.name });
      return { ...one, input, node: el("label", {}, `${one.name} (${one.values}) `, input) };
    });
    const run = el("button", { type: "button", text: `Run ${verb.name}`, onclick: () => this.run(verb, inputs) });
    const risk = verb.risk ? [el("p", { class: "problem", text: verb.risk })] : [];
    const words = this.session.control ? run : el("p", { class: "quiet", text: "Log in to run it." });
    return el("details", {}, el("summary", {}, el("b", { text: verb.name }), ": ", ...marked(verb.help)), ...risk, ...inputs.map((one) => one.node), words);
  }

  async run(verb, inputs) {
    if (verb.risk && !confirm(`${verb.risk}; run ${verb.name}?`)) return;
    const values = {};
    for (const { name, input } of inputs) {
      if (!input.value.trim()) continue;
      try {
        values[name] = JSON.parse(input.value);
      } catch {
        values[name] = input.value.trim();
      }
    }
    this.result.replaceChildren(el("p", { text: `${verb.name}…` }));
    try {
      const answer = await call("command", { device: this.device, name: verb.name, arguments: values });
      const texts = answer && typeof answer === "object" && "evidence" in answer
        ? [`${verb.name}: ${answer.verified ? "verified" : "sent, not verified"}: ${answer.evidence}`,
          answer.result === null ? "" : shown(answer.result), answer.not_saved]
        : [`${verb.name} is done${answer === null ? "" : `: ${shown(answer)}`}`];
      this.result.replaceChildren(...texts.filter(Boolean).map((text) => el("p", { class: "good", text })));
    } catch (error) {
      this.result.replaceChildren(el("p", { class: "problem", text: error.message }));
    }
  }
}
