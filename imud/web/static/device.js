// The page of one device. On a phone, each section is a screen.

import { AboutSection } from "./about.js";
import { CalibrationSection } from "./calibration.js";
import { ConditionView, deviceLink } from "./condition.js";
import { EventsSection } from "./events.js";
import { LedgerSection } from "./ledger.js";
import { LiveSection } from "./live.js";
import { Arrivals, pastOf } from "./past.js";
import { SettingsSection } from "./settings.js";
import { SECTIONS } from "./shell.js";
import { TimeSection } from "./time.js";
import { button, icon, toast } from "./ui.js";
import { byId, clock, copy, el, setText, span } from "./util.js";

const PHONE = matchMedia("(max-width: 820px)");
const HISTORY_OFF = "the history is off";

export class DevicePage {
  constructor(main, name, stream, shell) {
    Object.assign(this, { name, stream, shell, main });
    this.about = el("p", { class: "help" });
    this.activity = el("a", { class: "chip activity", href: deviceLink(name, "calibration"), hidden: true });
    this.condition = new ConditionView(name);
    this.trouble = el("p", { class: "problem", hidden: true });
    this.missing = missingHelp();
    this.live = new LiveSection(name, () => this.look());
    this.time = new TimeSection(this.live.group);
    this.ledger = new LedgerSection();
    this.events = new EventsSection(name);
    this.aboutSection = new AboutSection(name);
    this.settings = new SettingsSection(name);
    this.calibration = new CalibrationSection(name);
    Object.assign(this, { plots: this.live.plots, spectrum: this.live.spectrum });
    const parts = [this.live, this.time, this.ledger, this.settings, this.calibration, this.events, this.aboutSection];
    this.sections = el("div", { class: "sections" }, parts.map((one) => one.node));
    const head = el("div", { class: "device-head" }, el("div", {}, el("h1", { text: name }), this.about), el("div", { class: "chips" }, this.activity));
    main.append(head, this.condition.node, this.trouble, this.missing, this.sections);
    this.arrivals = new Arrivals();
    this.spy();
    this.look();
    this.restore();
  }

  look() {
    this.stream.look({ look: "device", device: this.name, rate_hz: this.live.rate_hz, spectrum: this.live.spectrum.member });
  }

  onSession() {
    this.settings.onSession();
    this.calibration.onSession();
    this.aboutSection.load();
    this.onRestart(); // before a login, imud web may refuse the reads
  }

  onRestart() {
    this.events.load();
    this.settings.load();
    this.calibration.load();
    this.restore();
  }

  /** Show the history of the daemon in the plots. */
  async restore() {
    if (this.isRestoring) return;
    this.isRestoring = true;
    try {
      const [buckets] = await pastOf([this.name]);
      for (const part of [this.live, this.time]) part.restore(buckets);
      this.live.showHistory(true);
    } catch (error) {
      if (error.message.includes(HISTORY_OFF)) this.live.showHistory(false);
    } finally {
      this.isRestoring = false;
    }
  }

  onPause() {
    this.live.group.pause();
    return true;
  }

  onTheme() {
    this.live.redraw();
    this.time.redraw();
    this.calibration.redraw();
  }

  onMessage(message) {
    if (message.kind === "events") {
      this.events.add(message.events);
      for (const one of message.events) if (one.device === this.name && one.event === "calibration") this.calibration.onEvent(one);
    }
    if (message.device !== this.name) return;
    if (message.kind === "status") this.showStatus(message);
    if (message.kind === "raw") this.live.addRaw(message);
    if (message.kind === "samples" && !message.convention && message.rate_hz === this.live.rate_hz && !this.live.group.isPaused) {
      for (const bucket of message.buckets) {
        this.live.add(bucket);
        this.time.add(bucket, 1 / message.rate_hz);
        if (this.arrivals.add(bucket, this.isRestoring)) this.restore();
      }
    }
  }

  showStatus(message) {
    const { status, now_s } = message;
    this.status = message;
    clock.offset_s = Date.now() / 1000 - now_s;
    this.trouble.hidden = Boolean(status);
    setText(this.trouble, status ? "" : `The configuration of the daemon does not contain ${this.name}.`);
    if (!status) return this.condition.draw(null, now_s);
    setText(this.about, [status.identity.product ?? "unknown product", status.driver, status.link].filter(Boolean).join(" · "));
    this.condition.draw(status.condition, now_s);
    const isMissing = status.condition?.condition === "missing";
    this.missing.hidden = !isMissing;
    this.live.node.hidden = this.time.node.hidden = isMissing; // a missing device has no figures
    const { work } = status;
    this.activity.hidden = !work;
    if (work) this.activity.replaceChildren(icon("calibration"), `${work.name} is running, started ${span(now_s - work.begun_ns / 1e9)} ago by ${work.by}`);
    for (const part of [this.live, this.time, this.ledger, this.aboutSection]) part.draw(message);
    this.events.onStatus(status, now_s);
    this.settings.onStatus(status);
    this.calibration.onStatus(status, now_s);
    return undefined;
  }

  /** Show a section, and in it a setting. */
  go(id, item) {
    const here = SECTIONS.some(([one]) => one === id) ? id : "live";
    for (const node of this.sections.children) node.classList.toggle("here", node.id === here);
    this.shell.mark(here);
    if (PHONE.matches && !item) scrollTo(0, 0);
    else if (id) byId(here)?.scrollIntoView({ block: "start" });
    else scrollTo(0, 0);
    this.settings.goTo(here === "settings" ? item : "");
    if (here === "events" && item === "all") this.events.showFor("every");
    this.settings.drawBar();
    this.live.redraw();
    this.time.redraw();
  }

  /** Mark the visible section in the rail. */
  spy() {
    const inView = new Set();
    this.observer = new IntersectionObserver((entries) => {
      for (const entry of entries) inView[entry.isIntersecting ? "add" : "delete"](entry.target);
      const first = [...this.sections.children].find((node) => inView.has(node));
      if (first && !PHONE.matches) this.shell.mark(first.id);
    }, { rootMargin: "-120px 0px -55% 0px" });
    for (const node of this.sections.children) this.observer.observe(node);
  }

  close() {
    this.observer.disconnect();
    this.live.close();
    this.time.close();
  }
}

function missingHelp() {
  const code = (text) => el("div", { class: "code" }, el("code", { text }), button("", async () => { await copy(text); toast("Copied."); }, { kind: "quiet bare", glyph: "copy", label: `copy ${text}` }));
  return el("section", { class: "panel help-steps", id: "missing", hidden: true }, el("h2", { text: "How to find the device" }), el("ol", {},
    el("li", { text: "Check that the cable is plugged in at both ends, and that the LED of the device is on." }),
    el("li", {}, "List the connected devices:", code("imud probe")),
    el("li", {}, "If the device has another port, write the name of the port into the configuration. Then run:", code("systemctl reload imud"))),
  el("p", { class: "help", text: "imud searches for the device every second. This page updates automatically when imud finds the device." }));
}
