// Amplitude spectral density of one vector, computed here from every sample (not from buckets): Welch's method with a
// Hann window, segments that overlap by a half, the mean of the newest of them, at the sample rate by the time stamps.

const SEGMENT_S = 4;
const POINTS_MIN = 128;
const POINTS_MAX = 4096;
const SEGMENTS_MAX = 8;

/** Fourier transform in place; lengths are powers of two. */
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

/** One-sided power spectral density of one segment, unit² / Hz; the mean is left out. */
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
    this.clear();
  }

  clear() {
    this.times = [];
    this.axes = [[], [], []];
    this.segments = [];
    this.points = 0;
    this.rate_hz = 0;
    this.newest = null;
    this.holes ??= 0;
  }

  /** Take a message `raw`; true where there is a new spectrum. */
  add(raw) {
    let isNew = false;
    raw.seq.forEach((seq, index) => {
      if (this.newest !== null && seq !== this.newest + 1) {
        const holes = this.holes + 1;
        this.clear();
        this.holes = holes; // samples before and after a hole are never taken together
      }
      this.newest = seq;
      this.times.push(raw.t_s[index]);
      this.axes.forEach((axis, number) => axis.push(raw.axes[number][index]));
      isNew = this.take() || isNew;
    });
    return isNew;
  }

  take() {
    const count = this.times.length;
    if (!this.points && count >= POINTS_MIN) {
      const rate_hz = (count - 1) / (this.times[count - 1] - this.times[0]);
      const wanted = 2 ** Math.floor(Math.log2(rate_hz * SEGMENT_S));
      this.points = Math.min(Math.max(wanted, POINTS_MIN), POINTS_MAX);
    }
    if (!this.points || count < this.points) return false;
    this.rate_hz = (this.points - 1) / (this.times[this.points - 1] - this.times[0]);
    this.segments.push(this.axes.map((axis) => density(axis.slice(0, this.points), this.rate_hz)));
    if (this.segments.length > SEGMENTS_MAX) this.segments.shift();
    this.times.splice(0, this.points / 2);
    this.axes.forEach((axis) => axis.splice(0, this.points / 2));
    return true;
  }

  /** Frequencies in Hz and, per axis, unit / √Hz. */
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
