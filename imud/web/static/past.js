// History of the daemon in the plots: buckets of the last hour.

import { call } from "./util.js";

const HOUR = { span_s: 3600, points: 500, period_s: 8 };
const RECENT = { span_s: 600, points: 1000, period_s: 1 }; // more points than seconds, so that each second has a point
const GAP_S = 5; // time without buckets after which the page requests the history
const OVERLAP_S = 2.5; // time of buckets before this request; the history then ends after the first of them

/** Return a list of [bucket, length in s] for each device. The buckets of all devices have the same limits if `newest_s` is
 *  given. more: other parameters of `history`. */
export async function pastOf(devices, newest_s, more = {}) {
  const get = async ({ span_s, points }, end_s) => {
    const from = end_s > span_s ? { from_ns: Math.floor(end_s - span_s) * 1e9 } : {};
    return (await call("history", { devices, points, ...from, ...more })).devices;
  };
  const hour = await get(HOUR, newest_s);
  const last_s = newest_s ?? hour[devices[0]].at(-1)?.last_s ?? 0;
  const recent = await get(RECENT, last_s);
  return devices.map((name) => {
    const end_s = (recent[name].at(-1)?.last_s ?? 0) - 1; // the newest second is not complete
    const older = hour[name].filter((one) => one.last_s < Math.floor(last_s - RECENT.span_s)).map((one) => [one, HOUR.period_s]);
    return [...older, ...recent[name].filter((one) => one.last_s < end_s).map((one) => [one, RECENT.period_s])];
  });
}

/** Buckets of the stream, which the history must reach. */
export class Arrivals {
  constructor() {
    Object.assign(this, { begun_s: NaN, last_s: -Infinity });
  }

  /** Note a bucket. Return true if the page should request the history: it is new, was hidden or not connected. */
  add({ first_s, last_s }, isBusy = false) {
    if (first_s - this.last_s > GAP_S || last_s < this.last_s) this.begun_s = first_s;
    this.last_s = last_s;
    if (isBusy || !(last_s - this.begun_s > OVERLAP_S)) return false;
    this.begun_s = NaN;
    return true;
  }
}
