// Amplitude spectral density of a vector from all samples: Welch's method with a Hann window and half overlap.

import { FILL_MOST, filled, gridOf } from "./grid.js";

const SEGMENT_S = 4;
const POINTS_MIN = 128;
const POINTS_MAX = 4096;
const SEGMENTS_MAX = 8;
const RATE_STEP = 0.02; // relative change of the rate that restarts the spectrum

/** Fourier transform in place. The length is a power of two. */
export function fft(re, im) {
  const n = re.length;
  for (let i = 1, j = 0; i < n; i += 1) {
    let bit = n >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [re[i], re[j]] = [re[j], re[i]];
      [im[i], im[j]] = [im[j], im[i]];
    }
  }
  for (let size = 2; size <= n; size <<= 1) {
    const half = size >> 1;
    const angle = (-2 * Math.PI) / size;
    for (let k = 0; k < half; k += 1) {
      const [cos, sin] = [Math.cos(angle * k), Math.sin(angle * k)];
      for (let i = k; i < n; i += size) {
        const j = i + half;
        const [a, b] = [re[j] * cos - im[j] * sin, re[j] * sin + im[j] * cos];
        [re[j], im[j]] = [re[i] - a, im[i] - b];
        re[i] += a;
        im[i] += b;
      }
    }
  }
}

/** Return the one-sided power spectral density of a segment, unit² / Hz. */
export function density(values, rate_hz) {
  const n = values.length;
  const mean = values.reduce((sum, value) => sum + value, 0) / n;
  const re = new Float64Array(n);
  const im = new Float64Array(n);
  let weight = 0;
  for (let i = 0; i < n; i += 1) {
    const window = 0.5 - 0.5 * Math.cos((2 * Math.PI * i) / n);
    re[i] = (values[i] - mean) * window;
    weight += window * window;
  }
  fft(re, im);
  const power = new Float64Array(n / 2 + 1);
  for (let k = 0; k <= n / 2; k += 1) {
    const sides = k === 0 || k === n / 2 ? 1 : 2;
    power[k] = (sides * (re[k] * re[k] + im[k] * im[k])) / (rate_hz * weight);
  }
  return power;
}

export class Spectrum {
  constructor() {
    this.gaps = 0; // number of gaps that restarted the spectrum
    this.missing = 0; // number of filled samples in shorter gaps
    this.isLocated = true;
    this.begin([], [], [[], [], []]);
  }

  begin(times, numbers, axes) {
    [this.times, this.numbers, this.axes] = [times, numbers, axes];
    this.segments = [];
    this.points = 0;
    this.rate_hz = 0;
  }

  /** Process a message `raw`. Return true if there is a new spectrum. */
  add(raw) {
    let isNew = false;
    raw.seq.forEach((seq, index) => {
      if (raw.t_s[index] <= this.times.at(-1)) {
        this.begin([], [], [[], [], []]); // the host has restarted
        this.gaps += 1;
      }
      this.times.push(raw.t_s[index]);
      this.numbers.push(seq);
      this.axes.forEach((axis, number) => axis.push(raw.axes[number][index]));
      isNew = this.take() || isNew;
    });
    return isNew;
  }

  take() {
    const count = this.times.length;
    if (count < Math.max(this.points, POINTS_MIN)) return false;
    const grid = gridOf(this.times, this.numbers);
    this.isLocated = grid.isLocated;
    const longs = grid.steps.flatMap((step, index) => (step > FILL_MOST + 1 ? [index + 1] : []));
    const isOther = this.segments.length > 0 && Math.abs(grid.rate_hz / this.rate_hz - 1) > RATE_STEP;
    if (longs.length || isOther) {
      this.gaps += longs.length;
      const from = isOther ? count : longs.at(-1);
      this.begin(this.times.slice(from), this.numbers.slice(from), this.axes.map((axis) => axis.slice(from)));
      return false;
    }
    this.rate_hz = grid.rate_hz;
    if (!this.points) {
      const wanted = 2 ** Math.floor(Math.log2(grid.rate_hz * SEGMENT_S));
      this.points = Math.min(Math.max(wanted, POINTS_MIN), POINTS_MAX);
      if (count < this.points) return false;
    }
    this.transform(grid.steps);
    return true;
  }

    transform(steps) {
    const places = [0];
    for (const step of steps) places.push(places.at(-1) + step);
    this.segments.push(this.axes.map((axis) => density(filled(places, axis, this.points), this.rate_hz)));
    if (this.segments.length > SEGMENTS_MAX) this.segments.shift();
    const kept = places.findIndex((place) => place >= this.points / 2);
    this.missing += places[kept] - kept;
    for (const values of [this.times, this.numbers, ...this.axes]) values.splice(0, kept);
  }

  /** Return the frequencies in Hz, and for each axis the density in unit / √Hz. */
  result() {
    const bins = this.points / 2 + 1;
    const frequencies = Array.from({ length: bins }, (_, k) => (k * this.rate_hz) / this.points);
    const axes = [0, 1, 2].map((axis) =>
      Array.from({ length: bins }, (_, k) =>
        Math.sqrt(this.segments.reduce((sum, segment) => sum + segment[axis][k], 0) / this.segments.length),
      ),
    );
    return { frequencies, axes };
  }
}
