// Regular grid of the samples from their time stamps. imud/analysis/series.py explains the method.

export const FILL_MOST = 4; // maximum number of adjacent lost samples that are filled; more end a run
const SCATTER_MOST = 0.2; // maximum scatter of the time stamps, in periods, at which a single lost sample is visible
const STEP_FOR_PERIOD = 4; // periods per step: device time in whole ms makes single steps irregular
const REFINEMENTS = 4;
const PAUSE_S = 1; // a silence of this length ends a run for any scatter

function median(values) {
  const sorted = Float64Array.from(values).sort();
  const middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}

const differences = (values) => Array.from({ length: values.length - 1 }, (_, index) => values[index + 1] - values[index]);
const whole = (ratio) => Math.max(Math.round(ratio), 1);

function scatterOf(residuals) {
  const middle = median(residuals);
  return (1.4826 * median(residuals.map((one) => Math.abs(one - middle)))) / Math.SQRT2;
}

/** Return the least-squares period of the parts between long gaps. */
function slope(times, steps) {
  let [above, below] = [0, 0];
  for (let first = 0, end = 1; end <= times.length; end += 1) {
    if (end < times.length && steps[end - 1] <= FILL_MOST + 1) continue;
    const places = [0];
    for (let index = first + 1; index < end; index += 1) places.push(places.at(-1) + steps[index - 1]);
    const part = times.slice(first, end).map((time) => time - times[first]);
    const [x, y] = [places, part].map((values) => values.reduce((a, b) => a + b, 0) / values.length);
    places.forEach((place, index) => {
      above += (place - x) * (part[index] - y);
      below += (place - x) ** 2;
    });
    first = end;
  }
  return above / below;
}

/** times: time stamps in s; numbers: `seq`; steps: periods between two samples; isLocated: whether the time stamps show a single
 *  lost sample. */
export function gridOf(times, numbers) {
  const steps_s = differences(times);
  const far = times.slice(STEP_FOR_PERIOD).map((time, index) => time - times[index]);
  let period_s = median(far) / STEP_FOR_PERIOD;
  let steps = [];
  for (let round = 0; round < REFINEMENTS; round += 1) {
    steps = steps_s.map((step_s) => whole(step_s / period_s));
    period_s = slope(times, steps);
  }
  const scatter_s = scatterOf(steps_s.map((step_s, index) => step_s - steps[index] * period_s));
  const isLocated = scatter_s <= SCATTER_MOST * period_s;
  if (!isLocated) {
    const jumps = differences(numbers);
    const usual = median(jumps); // 4 for a vector in every fourth sample
    const short_s = steps_s.filter((step_s) => step_s <= PAUSE_S);
    if (short_s.length) period_s = short_s.reduce((sum, step_s) => sum + step_s, 0) / short_s.length;
    steps = steps_s.map((step_s, index) => (step_s > PAUSE_S ? whole(step_s / period_s) : whole(jumps[index] / usual)));
  }
  return { rate_hz: 1 / slope(times, steps), steps, scatter_s, isLocated };
}

/** Return values at 0 … count - 1 from the values at `places`. A natural cubic spline fills the gaps. */
export function filled(places, values, count) {
  if (places[count - 1] === count - 1) return values.slice(0, count);
  const bends = secondDerivatives(places, values);
  const found = new Array(count);
  for (let place = 0, right = 1; place < count; place += 1) {
    while (places[right] < place) right += 1;
    const left = right - 1;
    const width = places[right] - places[left];
    const [a, b] = [(places[right] - place) / width, (place - places[left]) / width];
    const bend = ((a ** 3 - a) * bends[left] + (b ** 3 - b) * bends[right]) * (width ** 2 / 6);
    found[place] = a * values[left] + b * values[right] + bend;
  }
  return found;
}

function secondDerivatives(places, values) {
  const n = places.length;
  const bends = new Float64Array(n);
  const upper = new Float64Array(n);
  for (let i = 1; i < n - 1; i += 1) {
    const [before, after] = [places[i] - places[i - 1], places[i + 1] - places[i]];
    const bend = 6 * ((values[i + 1] - values[i]) / after - (values[i] - values[i - 1]) / before);
    const pivot = 2 * (before + after) - before * upper[i - 1];
    upper[i] = after / pivot;
    bends[i] = (bend - before * bends[i - 1]) / pivot;
  }
  for (let i = n - 2; i > 0; i -= 1) bends[i] -= upper[i] * bends[i + 1];
  return bends;
}
