// Guided calibrations with the sphere of directions that were covered, and the actions of a device.

import { call, el, number, shown } from "./util.js";
import { rotate } from "./attitude.js";

const SIZE = 220;
const TILT = [0.88, -0.36, 0.12, 0.28]; // how the sphere is looked at: a quaternion
const ORDERS = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
const SIZES = [0.85, 0.48, 0.2];

/** The middle of cell 0 … 47: an octant by signs (bit 0: x < 0), then the order of the absolute values. */
export function cellDirection(cell) {
  const order = ORDERS[cell % ORDERS.length];
  const octant = Math.floor(cell / ORDERS.length);
  const direction = [0, 0, 0];
  order.forEach((axis, rank) => (direction[axis] = (octant >> axis) & 1 ? -SIZES[rank] : SIZES[rank]));
  return direction;
}

/** Which cells a mask of 48 bits in hexadecimal has. */
export function coveredCells(mask) {
  const bits = BigInt(`0x${mask || "0"}`);
  return Array.from({ length: 48 }, (_, cell) => Boolean((bits >> BigInt(cell)) & 1n));
}

export class CoverageSphere {
  constructor() {
    this.canvas = el("canvas", { width: SIZE, height: SIZE, role: "img", "aria-label": "directions that were covered" });
  }

  draw(mask) {
    const covered = coveredCells(mask);
    this.canvas.dataset.covered = covered.filter(Boolean).length;
    const context = this.canvas.getContext("2d");
    const style = getComputedStyle(this.canvas);
    context.clearRect(0, 0, SIZE, SIZE);
    context.strokeStyle = style.getPropertyValue("--line");
    context.beginPath();
    context.arc(SIZE / 2, SIZE / 2, SIZE * 0.42, 0, 2 * Math.PI);
    context.stroke();
    const points = covered.map((is, cell) => ({ is, at: rotate(TILT, cellDirection(cell)) }));
    points.sort((a, b) => a.at[1] - b.at[1]);
    for (const { is, at: [x, depth, z] } of points) {
      context.globalAlpha = 0.35 + 0.325 * (depth + 1);
      context.fillStyle = style.getPropertyValue(is ? "--good" : "--line");
      context.beginPath();
      context.arc(SIZE / 2 + x * SIZE * 0.42, SIZE / 2 - z * SIZE * 0.42, is ? 8 : 5, 0, 2 * Math.PI);
      context.fill();
    }
    context.globalAlpha = 1;
  }
}

export class CalibrationView {
  constructor(device, session) {
    this.device = device;
    this.session = session;
    this.list = el("div");
    this.progress = el("p", { id: "calibration-progress", role: "status" });
    this.sphere = new CoverageSphere();
    this.result = el("div", { class: "result" });
    this.save = el("input", { type: "checkbox" });
    this.stop = el("button", { type: "button", text: "Stop", hidden: true, onclick: () => this.end() });
    this.node = el("div", {}, this.list, this.progress, this.sphere.canvas, el("div", { class: "buttons" }, this.stop), this.result);
    this.sphere.canvas.hidden = true;
    this.load();
  }

  async load() {
    try {
      const found = await call("calibrations", { device: this.device });
      const entries = found.map((one) => this.entry(one));
      const save = this.session.control && found.length ? [el("label", {}, this.save, " save a verified result")] : [];
      this.list.replaceChildren(...entries, ...save, ...(found.length ? [] : [el("p", { class: "quiet", text: "This device has none." })]));
    } catch (error) {
      this.list.replaceChildren(el("p", { class: "quiet", text: error.message }));
    }
  }

  entry(one) {
    const steps = el("ol", {}, ...one.instructions.map((words) => el("li", { text: words })));
    const begin = el("button", { type: "button", text: `Begin ${one.kind}`, onclick: () => this.begin(one.kind) });
    const words = this.session.control ? begin : el("p", { class: "quiet", text: "Log in to begin it." });
    return el("details", {}, el("summary", { text: `${one.kind}: ${one.help}` }), steps,
      el("p", { class: "quiet", text: `The result lasts ${one.kept}. Manual, section ${one.section}.` }), words);
  }

  async begin(kind) {
    this.result.replaceChildren();
    this.progress.textContent = `calibration ${kind} begins`;
    this.stop.hidden = false;
    try {
      const done = await call("calibrate", { device: this.device, kind, save: this.save.checked });
      const words = done.verified ? `${kind} is verified${done.saved ? " and saved" : ""}` : done.problem;
      const checks = done.checks.map((one) => el("li", { text: `${one.name} ${number(one.value, 4)} ${one.unit}, at most ${number(one.limit, 4)}: ${one.passed ? "passed" : "not passed"}` }));
      this.result.replaceChildren(el("p", { class: done.verified ? "good" : "problem", text: words }), el("ul", {}, ...checks));
    } catch (error) {
      this.result.replaceChildren(el("p", { class: "problem", text: error.message }));
    }
    this.stop.hidden = true;
    this.progress.textContent = "";
  }

  async end() {
    try {
      await call("stop_calibration", { device: this.device });
    } catch (error) {
      this.progress.textContent = error.message;
    }
  }

  /** Show an event of the kind `calibration`, whoever began it. */
  onEvent(event) {
    const { detail } = event;
    this.progress.textContent = event.message;
    if (detail.cells !== undefined) {
      this.sphere.canvas.hidden = false;
      this.sphere.draw(detail.cells);
    }
    if (detail.field_t) this.progress.textContent += `; field ${number(detail.field_t * 1e6, 1)} µT, residual ${number(detail.residual * 100, 1)} %`;
  }
}

export class ActionsView {
  constructor(device, session) {
    this.device = device;
    this.session = session;
    this.list = el("div");
    this.result = el("div", { class: "result" });
    this.node = el("div", {}, this.list, this.result);
    this.load();
  }

  async load() {
    try {
      const found = await call("actions", { device: this.device });
      const entries = found.map((one) => this.entry(one));
      this.list.replaceChildren(...entries, ...(found.length ? [] : [el("p", { class: "quiet", text: "This device has none." })]));
    } catch (error) {
      this.list.replaceChildren(el("p", { class: "quiet", text: error.message }));
    }
  }

  entry(action) {
    const inputs = action.parameters.map((one) => {
      const input = el("input", { type: "text", size: 12, placeholder: one.default ?? "", "aria-label": one.name });
      return { ...one, input, node: el("label", {}, `${one.name} (${one.values}) `, input) };
    });
    const run = el("button", { type: "button", text: `Run ${action.name}`, onclick: () => this.run(action, inputs) });
    const risk = action.risk ? [el("p", { class: "problem", text: action.risk })] : [];
    const words = this.session.control ? run : el("p", { class: "quiet", text: "Log in to run it." });
    return el("details", {}, el("summary", { text: `${action.name}: ${action.help}` }), ...risk, ...inputs.map((one) => one.node), words);
  }

  async run(action, inputs) {
    if (action.risk && !confirm(`${action.risk}; run ${action.name}?`)) return;
    const values = {};
    for (const { name, input } of inputs) {
      if (!input.value.trim()) continue;
      try {
        values[name] = JSON.parse(input.value);
      } catch {
        values[name] = input.value.trim();
      }
    }
    this.result.replaceChildren(el("p", { text: `${action.name}…` }));
    try {
      const answer = await call("command", { device: this.device, name: action.name, arguments: values });
      this.result.replaceChildren(el("p", { class: "good", text: `${action.name} is done${answer === null ? "" : `: ${shown(answer)}`}` }));
    } catch (error) {
      this.result.replaceChildren(el("p", { class: "problem", text: error.message }));
    }
  }
}
