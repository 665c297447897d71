// Settings. Edits stay in the browser until the user applies them.

import { agrees, changed, control, isObject, said, same, words } from "./fields.js";
import { closeDialog, showDialog } from "./shell.js";
import { editsOf, keepEdits, session } from "./state.js";
import { button, icon, section, segmented, toast, toggle } from "./ui.js";
import { byId, call, command, copy, el, marked, timeOf } from "./util.js";

const GROUPS = { measurement: "Measurement", output: "Output", pins: "Pins and alarm", connection: "Connection" };
const AFTER_RESTART = "after save and restart";

export class SettingsSection {
  constructor(device) {
    this.device = device;
    this.edits = editsOf(device);
    this.wrong = new Set(); // settings with an invalid value in a field
    this.rows = new Map();
    this.all = [];
    this.known = "";
    this.only = "all";
    this.lead = el("p", { class: "lead" });
    this.locked = el("p", { class: "locked" }, icon("lock"), el("span", { text: "Read only. Log in to change settings." }));
    this.groups = el("div");
    this.again = button("Read again", () => this.load(true), { kind: "quiet", glyph: "undo" });
    this.save = button("Save to flash", () => this.saveAll(), { kind: "small", glyph: "save" });
    const filter = segmented("filter of the settings", [["all", "All"], ["look", "Changed or different"]], "all", (value) => { this.only = value; this.filter(); });
    this.node = section("settings", "Settings", this.lead, el("div", { class: "timebar" }, filter, el("span", { class: "push" }), this.save, this.again), this.locked, this.groups);
  }

  onSession() {
    this.draw();
  }

  onStatus(status) {
    const known = JSON.stringify([status.state, status.declared, status.settings]);
    if (known === this.known) return;
    this.known = known;
    this.load();
  }

  /** fresh: read the settings from the device, which needs a login. */
  async load(fresh = false) {
    try {
      this.report = await call("settings.get", fresh ? { device: this.device, fresh } : { device: this.device });
      if (fresh) toast("imud read the settings again.");
      this.draw();
    } catch (error) {
      if (fresh) toast(error.message);
      else this.lead.textContent = error.message;
    }
  }

  draw() {
    this.locked.hidden = this.again.disabled = false;
    this.locked.hidden = session.control;
    this.again.disabled = !session.control;
    if (!this.report) return;
    this.all = this.report.settings;
    for (const name of [...this.edits.keys()]) if (!this.all.some((one) => one.name === name)) this.edits.delete(name);
    this.drawLead();
    const focused = document.activeElement?.closest?.(".setting")?.id;
    this.groups.replaceChildren(...Object.entries(GROUPS).map(([group, title]) => {
      const found = this.all.filter((one) => one.group === group);
      return found.length ? el("div", { class: "panel setting-group" }, el("h3", { text: title }), found.map((one) => this.row(one))) : "";
    }));
    if (focused) document.querySelector(`#${focused} :is(input, select, button)`)?.focus();
    this.filter();
    this.drawBar();
  }

  drawLead() {
    const { status } = this.report;
    const off = this.all.filter((one) => one.differs).length;
    const unsaved = this.all.filter((one) => !one.differs && this.isUnsaved(one)).length;
    const found = [off && `${off} setting${off === 1 ? " differs" : "s differ"} from the configuration`, unsaved && `${unsaved} setting${unsaved === 1 ? " is" : "s are"} not saved`].filter(Boolean).join(", ");
    const read = status.read_ns ? `Read from the device at ${timeOf(status.read_ns / 1e9)}. ` : "Not read from the device yet. ";
    const isUnsaved = status.unsaved && !Object.keys(status.lost_at_power_off).length;
    this.save.hidden = !isUnsaved || !session.control;
    const change = isUnsaved ? "A change is not saved, and the value in flash is unknown. " : "";
    this.lead.textContent = `${read}${change}${found ? `${found}. ` : ""}${status.problem}`;
  }

  filter() {
    for (const one of this.all) this.rows.get(one.name).node.hidden = this.only === "look" && !(one.differs || this.isUnsaved(one) || this.edits.has(one.name));
    for (const group of this.groups.children) group.hidden = !group.querySelector(".setting:not([hidden])");
  }

  isUnsaved(setting) { return setting.saved_state === "differs" || (setting.name in this.report.status.lost_at_power_off && setting.saved_state === "unknown"); }

  row(setting) {
    const box = el("div", { class: "control" });
    const state = el("div", { class: "states" });
    const id = `more-${setting.name}`;
    const details = [setting.description && `${setting.description}.`, `The change takes effect ${setting.effect}.`, `Key in the configuration: ${setting.name}.`, setting.section && `Manual: section ${setting.section}.`];
    const text = el("p", { class: "help more", id, hidden: true, text: details.filter(Boolean).join(" ") });
    const more = el("button", { type: "button", class: "quiet bare ask", "aria-label": `more about ${setting.title}`, "aria-expanded": "false", "aria-controls": id, onclick: () => {
      text.hidden = !text.hidden;
      more.setAttribute("aria-expanded", String(!text.hidden));
    } }, icon("about"));
    const node = el("div", { class: "setting", id: `setting-${setting.name}`, "data-setting": setting.name },
      el("div", { class: "what" }, el("div", { class: "title-line" }, el("b", { text: setting.title }), more), setting.help && el("p", { class: "help", text: setting.help }), text), box, state);
    this.rows.set(setting.name, { node, box, state });
    this.fill(setting);
    return node;
  }

  value(setting) { return this.edits.has(setting.name) ? this.edits.get(setting.name) : setting.actual; }

  set(setting, value, isRedrawn = false) {
    this.wrong.delete(setting.name);
    if (same(value, setting.actual)) this.edits.delete(setting.name);
    else this.edits.set(setting.name, value);
    if (isRedrawn) this.fill(setting);
    else this.fillState(setting);
    this.changed();
  }

  changed() {
    keepEdits();
    this.drawBar();
  }

  fill(setting) {
    const { box } = this.rows.get(setting.name);
    const value = this.value(setting);
    const hadFocus = box.contains(document.activeElement);
    if (!setting.declarable) box.replaceChildren(el("output", { class: "read", text: said(value, setting.unit) }));
    else box.replaceChildren(control(setting, value, {
      disabled: !session.control,
      onChange: (next, isRedrawn) => this.set(setting, next, isRedrawn),
      onInvalid: () => {
        this.wrong.add(setting.name);
        this.fillState(setting);
        this.drawBar();
      },
    }));
    if (hadFocus) box.querySelector("input, select, button")?.focus();
    this.fillState(setting);
  }

  fillState(setting) {
    const { node, state } = this.rows.get(setting.name);
    const isEdited = this.edits.has(setting.name);
    const [isOff, isUnsaved] = [setting.differs, this.isUnsaved(setting)];
    node.classList.toggle("edited", isEdited);
    node.classList.toggle("off", !isEdited && (isOff || isUnsaved));
    if (this.wrong.has(setting.name)) state.replaceChildren(el("p", { class: "help wrong", text: "invalid value" }), this.undo(setting));
    else if (isEdited) state.replaceChildren(...this.editParts(setting));
    else if (isOff || isUnsaved) state.replaceChildren(...this.differenceParts(setting, isOff, isUnsaved));
    else state.replaceChildren(this.fine(setting));
  }

  undo(setting) {
    return button("", () => this.set(setting, setting.actual, true), { kind: "quiet bare", glyph: "undo", label: `undo the change of ${setting.title}` });
  }

  editParts(setting) {
    const { actual, unit, effect, connection } = setting;
    const value = this.edits.get(setting.name);
    return [
      el("div", { class: "change" }, el("s", { text: said(changed(value, actual), unit) }), icon("arrow"), el("b", { text: said(changed(actual, value), unit) }), this.undo(setting)),
      ...(effect === AFTER_RESTART ? [el("p", { class: "help", text: "takes effect after save and restart" })] : []),
      ...(connection ? [el("p", { class: "help", text: "imud may not find the device after this change." })] : []),
    ];
  }

  differenceParts(setting, isOff, isUnsaved) {
    const line = (name, value, isBad) => el("div", { class: `state ${isBad ? "bad" : ""}` }, el("dt", { text: name }), el("dd", { text: value }));
    const { declared, actual, saved, saved_state, unit } = setting;
    const flash = saved_state === "unknown" ? "unknown" : said(saved, unit);
    const parts = [el("dl", { class: "three" }, declared !== null && line("declared", said(declared, unit), isOff), line("on device", said(actual, unit), isOff), line("in flash", flash, isUnsaved))];
    if (isUnsaved) parts.push(el("p", { class: "lost", text: saved_state === "unknown" ? "Changed, not saved to flash." : "Lost at power-off." }));
    if (isOff && session.control) parts.push(button("Use the declared value", () => this.set(setting, isObject(declared) ? { ...actual, ...declared } : declared, true), { kind: "small" }));
    if (!isOff && isUnsaved && session.control) parts.push(button("Save to flash", () => this.saveAll(), { kind: "small", glyph: "save" }));
    return parts;
  }

  fine(setting) {
    if (!setting.readable) return el("p", { class: "fine" }, el("span", { text: "the device does not report it" }));
    if (setting.declared === null) return el("p", { class: "fine plain" }, el("span", { text: setting.declarable ? "not declared" : "" }));
    return el("p", { class: "fine" }, icon("ok"), el("span", { text: setting.saved_state === "unknown" ? "as declared, in flash: unknown" : "as declared" }));
  }

  /** Show a setting that the address names. */
  goTo(name) {
    const node = name && byId(`setting-${name}`);
    this.wanted = node ? "" : name;
    if (!node) return;
    node.scrollIntoView({ block: "center" });
    node.classList.remove("flash");
    void node.offsetWidth; // starts the animation again
    node.classList.add("flash");
  }

  drawBar() {
    if (this.wanted) this.goTo(this.wanted);
    const bar = byId("bar");
    const count = new Set([...this.edits.keys(), ...this.wrong]).size;
    bar.hidden = !count;
    if (!count) return;
    const restarts = this.all.some((one) => this.edits.has(one.name) && one.effect === AFTER_RESTART);
    const [wrong] = this.wrong;
    const note = wrong ? `${words(wrong)}: invalid value` : `${this.device}: stored only in this browser${restarts ? ", restart needed" : ""}`;
    bar.replaceChildren(el("div", {}, el("b", { text: `${count} ${count === 1 ? "change" : "changes"} not applied` }), el("span", { class: "help", text: note })),
      button("Discard", () => this.discard(), { kind: "quiet" }), button("Review", () => this.review(), { kind: "primary", disabled: !this.report || this.wrong.size > 0 || !session.control }));
  }

  discard() {
    this.edits.clear();
    this.wrong.clear();
    for (const one of this.all) this.fill(one);
    this.changed();
  }

  given() {
    return Object.fromEntries(this.all.filter((one) => this.edits.has(one.name)).map((one) => [one.name, changed(one.actual, this.edits.get(one.name))]));
  }

  async review(save = true) {
    const asked = { device: this.device, settings: this.given(), save };
    const body = el("div", { class: "review-body" }, el("p", { text: "imud plans the changes…" }));
    const buttons = el("div", { class: "buttons" }, button("Back", closeDialog));
    const count = Object.keys(asked.settings).length;
    showDialog("review", el("h2", { text: `${count === 1 ? "1 change" : `${count} changes`} for ${this.device}` }), body, buttons);
    try {
      const plan = await call("settings.plan", asked);
      body.replaceChildren(...this.planParts(plan, save));
      if (plan.steps.length) buttons.append(button(plan.restart ? "Apply and restart" : "Apply", () => this.apply(asked, body, buttons), { kind: "primary" }));
    } catch (error) {
      body.replaceChildren(el("p", { class: "wrong", role: "alert", text: error.message }));
    }
  }

  planParts(plan, save) {
    const rows = plan.steps.map((step) => {
      const setting = this.all.find((one) => one.name === step.name);
      const differs = setting && !agrees(setting.declared, step.value);
      return el("tr", {}, el("th", { scope: "row", text: setting?.title ?? words(step.name) }), el("td", {}, el("s", { text: said(step.before, setting?.unit) })), el("td", {}, icon("arrow", "to")),
        el("td", {}, el("b", { text: said(step.value, setting?.unit) }), el("p", { class: "help", text: `takes effect ${step.effect}` }), differs && el("p", { class: "lost", text: `configuration: ${said(setting.declared, setting.unit)}` })));
    });
    const left = Object.entries(plan.left_out).map(([name, why]) => el("li", { text: `${words(name)} is not written: ${why}` }));
    const { flash_writes, flash_writes_day } = this.report.status;
    const note = save ? `This uses 1 write to the flash of the device (${flash_writes} by imud, ${flash_writes_day} in the last 24 hours).` : "The device loses these changes at power-off.";
    return [
      rows.length ? el("table", { class: "plain" }, el("tbody", {}, rows)) : el("p", { text: "No change is necessary." }), left.length ? el("ul", {}, left) : "",
      toggle("Keep after power-off", save, (is) => this.review(is)), el("p", { class: "help", text: note }),
      ...[plan.risk, plan.advice].filter(Boolean).map((text) => el("p", { class: "warnbox" }, icon("attention"), el("span", { text }))),
    ];
  }

  async apply(asked, body, buttons) {
    body.replaceChildren(el("p", { role: "status", text: "imud writes the settings…" }));
    buttons.replaceChildren();
    let parts;
    try {
      const done = await call("settings.apply", asked);
      parts = this.outcomeParts(done);
      for (const step of done.steps) if (!["not applied", "not done"].includes(step.outcome)) this.edits.delete(step.name);
    } catch (error) {
      parts = [el("p", { class: "wrong", role: "alert", text: error.message })];
    }
    body.replaceChildren(...parts);
    buttons.replaceChildren(button("Close", closeDialog, { kind: "primary" }));
    await this.load();
    this.changed();
  }

  outcomeParts(done) {
    const isGood = (one) => !["not applied", "not done"].includes(one.outcome);
    const titles = Object.fromEntries(this.all.map((one) => [one.name, one.title]));
    const steps = done.steps.map((one) => el("li", {}, icon(isGood(one) ? "ok" : "missing", isGood(one) ? "done" : "not done"), `${titles[one.name] ?? one.name}: ${one.outcome}${one.message ? ` (${one.message})` : ""}`));
    const others = Object.fromEntries(done.steps.filter((one) => isGood(one) && !agrees(this.all.find((each) => each.name === one.name)?.declared, one.value)).map((one) => [one.name, one.value]));
    const inFlash = (one) => this.all.find((each) => each.name === one.name) ?? {};
    const lost = done.steps.filter((one) => isGood(one) && !(inFlash(one).saved_state !== "unknown" && same(inFlash(one).saved, one.value)));
    const loses = lost.some((one) => inFlash(one).saved_state === "unknown") ? "may lose" : "loses";
    const atPowerOff = lost.length ? `Applied. The device ${loses} ${lost.map((one) => `“${titles[one.name] ?? one.name}”`).join(", ")} at power-off.` : "Applied. The flash already contains these values.";
    const is = (outcome) => done.steps.some((one) => one.outcome === outcome);
    const saved = done.restarted && is("verified") && !is("not applied") ? "Applied and saved to flash." : "Applied. The save to flash is not verified: imud cannot read the flash.";
    const result = done.problem || (done.saved ? saved : atPowerOff);
    return [
      el("ol", { class: "outcome" }, steps), el("p", { class: done.problem ? "wrong" : "", role: "status", id: "outcome" }, el("b", { text: result })),
      ...(!done.saved && !done.problem && lost.length ? [button("Save to flash", () => this.saveAll(), { glyph: "save" })] : []),
      ...[done.restart_doubt && `The restart is not verified: ${done.restart_doubt}.`, done.advice, done.not_saved].filter(Boolean).map((text) => el("p", { class: "help" }, marked(text))),
      ...(Object.keys(others).length ? [el("p", { text: "Update the configuration:" }), button("Copy as YAML", async () => { await copy(yaml(others)); toast("Copied."); }, { glyph: "copy" })] : []),
    ];
  }

  async saveAll() {
    closeDialog();
    toast(await command(this.device, "save", "Save"));
    this.load();
  }
}

/** Return settings in the notation of the configuration. JSON values are YAML. */
function yaml(values) {
  return `settings:\n${Object.entries(values).map(([name, value]) => `  ${name}: ${JSON.stringify(value)}`).join("\n")}\n`;
}
