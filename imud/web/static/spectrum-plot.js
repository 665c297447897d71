// Plot of the spectrum, with the frequency of the highest peak.

import { COLORS, grid, hasPlots, ink, plotBox, powers } from "./plots.js";
import { Spectrum } from "./spectrum.js";
import { AXES, el, number, setText } from "./util.js";

const UNITS = { accel_m_s2: "m/s²/√Hz", gyro_rad_s: "rad/s/√Hz", mag_t: "T/√Hz" };
const NAMES = { accel_m_s2: "accelerometer", gyro_rad_s: "gyroscope", mag_t: "magnetometer" };

/** Return a sentence about lost samples. */
function gapWords({ missing, gaps, isLocated }) {
  const again = `restarted at ${number(gaps)} longer ${gaps === 1 ? "gap" : "gaps"}`;
  const words = missing ? `${number(missing)} lost samples filled, ${again}` : gaps ? `Restarted at ${number(gaps)} ${gaps === 1 ? "gap" : "gaps"}` : "No sample is lost";
  return isLocated ? `${words}.` : `${words}. The time stamps scatter too much to show a single lost sample.`;
}

const OFF = "Choose a vector. imud web then sends each of its samples, and this page computes the spectrum.";

export class SpectrumPlot {
  /** Call onChoice(member) when the user chooses a vector; "" for no vector. */
  constructor(onChoice) {
    this.spectrum = new Spectrum();
    const choices = Object.entries(NAMES).map(([member, name]) => el("option", { value: member, text: name }));
    this.choice = el("select", { id: "spectrum-of", "aria-label": "spectrum of" }, el("option", { value: "", text: "off" }), ...choices);
    this.choice.addEventListener("change", () => {
      this.clear();
      this.box.hidden = !this.member;
      setText(this.note, this.member ? "collecting samples" : OFF);
      onChoice(this.member);
    });
    this.note = el("p", { class: "help", text: OFF });
    this.box = plotBox({ "aria-label": "plot of the spectrum; its highest peaks are below" });
    this.node = el("div", { class: "fill" }, el("div", { class: "buttons" }, this.choice), this.box, this.note);
    this.box.hidden = true;
    new ResizeObserver(() => this.plot && this.box.clientWidth && this.plot.setSize(this.size())).observe(this.box);
  }

  get member() {
    return this.choice.value;
  }

  size() {
    return { width: Math.max(this.box.clientWidth, 120), height: Math.max(this.box.clientHeight, 220) };
  }

  clear() {
    this.spectrum = new Spectrum();
    this.plot?.destroy();
    this.plot = null;
    this.data = null;
  }

  add(raw) {
    if (raw.member !== this.member) return;
    if (this.spectrum.add(raw)) this.draw();
    else if (!this.data) setText(this.note, `collecting samples: ${this.spectrum.times.length}`);
  }

  draw() {
    const { frequencies, axes } = this.spectrum.result();
    // without frequency 0: the mean is subtracted
    this.data = [frequencies.slice(1), ...axes.map((axis) => axis.slice(1).map((value) => value || null))];
    if (!this.plot && hasPlots) this.begin();
    this.plot?.setData(this.data);
    const peaks = axes.map((axis) => {
      const at = axis.reduce((best, value, k) => (k > 1 && value > axis[best] ? k : best), Math.min(2, axis.length - 1));
      return { frequency: frequencies[at], value: axis[at] };
    });
    this.peaks = peaks;
    const words = peaks.map((one, axis) => `${AXES[axis]} ${number(one.frequency, 2)} Hz`).join(", ");
    const { points, rate_hz, segments } = this.spectrum;
    setText(this.note,
      `Highest peaks: ${words}. From all samples at ${number(rate_hz, 2)} Hz (by the time stamps): Hann window, ${points} points, ` +
      `mean of ${segments.length} segments, resolution ${number(rate_hz / points, 2)} Hz. ${gapWords(this.spectrum)}`);
  }

  begin() {
    const axis = { stroke: ink, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1 } };
    this.plot = new uPlot(
      {
        ...this.size(), legend: { show: false }, cursor: { drag: { x: true, y: false } },
        series: [{}, ...COLORS.map((stroke) => ({ stroke, width: 1.25, points: { show: false } }))],
        axes: [{ ...axis, label: "Hz", labelSize: 18, labelFont: "12px system-ui" }, { ...axis, size: 62, label: UNITS[this.member], labelSize: 18, labelFont: "12px system-ui", values: powers }],
        scales: { x: { time: false }, y: { distr: 3 } },
      },
      this.data, this.box,
    );
  }

  close() {
    this.plot?.destroy();
  }
}
