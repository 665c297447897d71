// Settings of a device: declared, actual, difference. After a login also new values: a plan first, then the change.

import { call, el, shown } from "./util.js";

export class SettingsView {
  constructor(device, session) {
    this.device = device;
    this.session = session;
    this.inputs = new Map();
    this.known = "";
    this.state = el("p", { class: "quiet" });
    this.table = el("tbody");
    this.result = el("div", { class: "result" });
    this.save = el("input", { type: "checkbox", id: "settings-save" });
    this.tools = el("div", { class: "buttons" },
      el("button", { type: "button", text: "Plan changes", onclick: () => this.plan(this.given()) }),
      el("button", { type: "button", text: "Plan declared", onclick: () => this.plan(null) }),
      el("label", {}, this.save, " save to the device's flash"));
    const names = ["setting", "declared", "actual", "new value"].map((name) => el("th", { text: name }));
    this.head = names.at(-1);
    const table = el("table", {}, el("thead", {}, el("tr", {}, ...names)), this.table);
    const again = el("button", { type: "button", text: "Read again", onclick: () => this.load(this.session.control) });
    this.node = el("div", {}, this.state, el("div", { class: "scroll" }, table), el("div", { class: "buttons" }, again), this.tools, this.result);
    this.load();
  }

  /** Load the settings again if their status changed, for example after a replug. The input fields keep their text. */
  onStatus(status) {
    const known = JSON.stringify([status.state, status.declared, status.settings]);
    if (known === this.known) return;
    this.known = known;
    this.load(false, new Map([...this.inputs].map(([name, input]) => [name, input.value])));
  }

  /** Load the settings. fresh: read them from the device, which needs a login. texts: texts of the input fields, by name. */
  async load(fresh = false, texts = new Map()) {
    try {
      this.show(await call("settings.get", fresh ? { device: this.device, fresh } : { device: this.device }), texts);
    } catch (error) {
      this.state.textContent = String(error.message);
    }
  }

  show(report, texts) {
    const { status, settings } = report;
    const words = [`declared and actual: ${status.state}`, status.problem, `${status.flash_writes} writes to flash by imud`];
    this.state.textContent = words.filter(Boolean).join("; ");
    const control = this.session.control;
    this.tools.hidden = this.head.hidden = !control;
    this.inputs = new Map();
    this.table.replaceChildren(...settings.map((one) => {
      const unit = one.unit ? ` ${one.unit}` : "";
      const name = el("td", {}, el("b", { text: one.name }), el("p", { class: "quiet", text: `${one.description} (${one.values}; ${one.effect})` }));
      const cells = [name, el("td", { text: shown(one.declared) }), el("td", { text: shown(one.actual) + (one.actual === null ? "" : unit) })];
      if (control) {
        const input = el("input", { type: "text", "aria-label": `new value of ${one.name}`, size: 10, value: texts.get(one.name) ?? "" });
        if (one.declarable) this.inputs.set(one.name, input);
        cells.push(el("td", {}, one.declarable ? input : null));
      }
      return el("tr", { class: one.differs ? "differs" : null, "data-setting": one.name }, ...cells);
    }));
  }

  /** Return the values of the input fields: JSON (numbers, true, false, lists), or text. */
  given() {
    const found = {};
    for (const [name, input] of this.inputs) {
      if (!input.value.trim()) continue;
      try {
        found[name] = JSON.parse(input.value);
      } catch {
        found[name] = input.value.trim();
      }
    }
    return found;
  }

  async plan(settings) {
    const asked = { device: this.device, save: this.save.checked };
    if (settings) asked.settings = settings;
    try {
      const plan = await call("settings.plan", asked);
      const steps = plan.steps.map((step) => el("li", { text: `${step.name}: ${shown(step.before)} → ${shown(step.value)}` }));
      const left = Object.entries(plan.left_out).map(([name, why]) => el("li", { text: `${name} is not written: ${why}` }));
      const words = plan.steps.length ? "Planned changes:" : "No change is necessary.";
      const apply = el("button", { type: "button", text: "Apply", onclick: () => this.apply(asked) });
      this.result.replaceChildren(el("p", { text: words }), el("ul", {}, ...steps, ...left),
        ...(plan.advice ? [el("p", { text: plan.advice })] : []),
        ...(plan.risk ? [el("p", { class: "problem", text: plan.risk })] : []), ...(plan.steps.length ? [apply] : []));
    } catch (error) {
      this.result.replaceChildren(el("p", { class: "problem", text: error.message }));
    }
  }

  async apply(asked) {
    this.result.replaceChildren(el("p", { text: "Writing…" }));
    try {
      const done = await call("settings.apply", asked);
      const steps = done.steps.map((step) => el("li", { text: `${step.name} = ${shown(step.value)}: ${step.outcome}${step.message ? ` (${step.message})` : ""}` }));
      const words = done.problem || `Done${done.saved ? ", and saved" : ""}.`;
      this.result.replaceChildren(el("p", { class: done.problem ? "problem" : "good", text: words }), el("ul", {}, ...steps),
        ...[done.not_saved, done.advice].filter(Boolean).map((text) => el("p", { text })));
    } catch (error) {
      this.result.replaceChildren(el("p", { class: "problem", text: error.message }));
    }
    this.load();
  }
}
