// The even grid of samples from their time stamps, by the rule of imud/analysis/series.py (`imud spectrum`): the true rate,
// which samples are missing, and where a run ends. What never reached imud leaves no step in `seq`, only one in time.

export const FILL_MOST = 4; // missing samples in a row that are filled; more end a run
const SCATTER_MOST = 0.2; // scatter of the stamps, in periods, up to which a missing sample is located
const STEP_FOR_PERIOD = 4; // device time in whole ms makes single steps uneven
const REFINEMENTS = 4;
const PAUSE_S = 1; // silence of so long ends a run whatever the stamps scatter by

function median(values) {
  const sorted = Float64Array.from(values).sort();
  const middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}

const differences = (values) => Array.from({ length: values.length - 1 }, (_, index) => values[index + 1] - values[index]);
const whole = (ratio) => Math.max(Math.round(ratio), 1);

/** Standard deviation of one stamp, from those of differences of two, without outliers. */
function scatterOf(residuals) {
  const middle = median(residuals);
  return (1.4826 * median(residuals.map((one) => Math.abs(one - middle)))) / Math.SQRT2;
}

/** Least-squares period, of the parts between long gaps: a pause need not be whole periods. */
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

/** times: stamps in s, rising, more than STEP_FOR_PERIOD; numbers: `seq` of the samples. steps: periods from each sample
 *  to the next, 1 where none is missing; isLocated: whether the stamps are good enough to see a single missing sample.
 *  Where they are not, only a step in `numbers` or a silence says that samples are missing. */
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
    const usual = median(jumps); // a vector that only each fourth sample has steps by 4
    steps = steps_s.map((step_s, index) => (step_s > PAUSE_S ? whole(step_s / period_s) : whole(jumps[index] / usual)));
  }
  return { rate_hz: 1 / slope(times, steps), steps, scatter_s, isLocated };
}

/** Values at places 0 … count - 1 from those at `places` (rising from 0 to count - 1 or more): the missing ones by a
 *  natural cubic spline, since a straight line would take power from a vibration. */
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

/** Of the natural cubic spline, at its knots: a tridiagonal system, solved forwards and backwards. */
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
