"""The fit of arrivals: offset and skew of a device's clock from the lower envelope of arrival times over device time.

An arrival is `arrival_ns = truth + delay` (less the time on the wire) with a delay that is never negative, so the truth
lies on or under every point (device_ns, arrival_ns), and the points that were hardly delayed lie on it. An average
follows the mean delay and every burst; the lower convex hull does not (Zhang, Liu, Xia: Clock synchronization
algorithms for network measurements, INFOCOM 2002).

Plan: each bin of device time keeps its lowest point above the present fit; bins begin as single samples and double
in width until 64 of them cover about a minute; then the oldest goes. Whenever a bin opens, the lower hull over the
bins gives the fit: its edge over a point at three quarters of the window. (The edge over the mean minimises the summed
distance, but is later to follow a crystal that drifts: its error at the newest end is 51 µs at 0.1 ppm/s and 64 s,
at three quarters 13 µs.) A sample costs one evaluation of the fit and one comparison; the hull is paid once per bin.

Latency timers (USB adapters): a message waits in the adapter between nothing and the timer's period, so the truth lies
under every arrival and above every arrival less that period. Where the timer beats with the samples (100 Hz on 16 ms,
or two crystals 30 ppm apart) the shortest wait creeps from nothing to the step between phases and falls back, once in
a minute or an hour, and an envelope alone follows it. `feasible_lines` bounds the truth from both sides; the middle of
the lines between the bounds is the better estimate, and their spread is the error.
"""

from dataclasses import dataclass
from math import inf, log, sqrt
from typing import Final

from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

BINS: Final = 64
BIN_LONGEST_NS: Final = NS_PER_S
"""64 s of window: long against the beat of two crystals with an adapter's timer, short against their warming up."""
SLOPE_LOWEST: Final = 1 / 1.07
SLOPE_HIGHEST: Final = 1 / 0.93
"""Host ns per device ns. Parts 4.08 % off nominal have been sold; past 7 % it is another tick, not a crystal."""
SUPPORT_AT: Final = 0.75
"""Position of the chosen hull edge, as a share of the window."""
ENOUGH_POINTS: Final = 8
ENOUGH_SPAN_NS: Final = 100 * NS_PER_MS
ENOUGH_HOLDS: Final = 20
"""A fit is known from this number of points on, and this time or number of periods of a latency timer."""
SPREAD_BINS: Final = 12
"""A fit under n bins is off by their mean distance times this over n, one sigma (by simulation, loaded host)."""
RECENT_BINS: Final = 8
RECENT_NS: Final = 2 * NS_PER_S
"""Number of the newest bins, over at least this time, whose common delay is no delay of single messages."""
KNOWN_SIGMAS: Final = 4
"""A slope that was known is within so many of its errors."""
DRIFT_MOST: Final = 1e-6
"""Change of a crystal's rate in a second, at most."""
LATENCIES_NS: Final = (200 * NS_PER_US, 600 * NS_PER_US, 2000 * NS_PER_US, 6000 * NS_PER_US)
"""Allowances for polling and wake-up on top of the longest wait, tried in turn until some line fits."""
LATE_FACTOR: Final = 4.0
"""Longest waits are twice the mean less the least, and a busy host is in the mean: with delays that fall off
exponentially twice their mean is at most so many times the share of waits that the timer alone cannot explain, in
periods of the timer."""
HOLD_MESSAGES: Final = 32
"""Number of messages that show whether the timer is what it was said to be."""
HOLD_MOST_NS: Final = 16 * NS_PER_MS
"""Longest timer that is believed without having been reported: the default of the common adapters."""
LOWER_HALF: Final = 1 / (1 - log(2))
"""Mean of exponentially distributed values over the mean of their lower half, which stalls are not in."""

Point = tuple[float, float]
"""(device ns, ns)."""


class _Bin:
    """The lowest point in an interval of device time, with the least and the mean wait of its messages."""

    __slots__ = (
        "arrival_ns", "begin_ns", "count", "device_ns", "late", "late_ns", "lowest", "wait", "wait_least", "wait_most",
    )  # fmt: skip

    def __init__(self, device_ns: int, arrival_ns: int, lowest: float, wait: float) -> None:
        self.begin_ns = device_ns
        self.device_ns = device_ns
        self.arrival_ns = arrival_ns
        self.lowest = lowest
        """Distance of (device_ns, arrival_ns) above the fit."""
        self.wait = wait
        """Sum over `count` messages of how long they waited, above the fit."""
        self.wait_least = wait
        self.wait_most = wait
        self.count = 1
        self.late = 0
        """Number of messages that waited for longer than the timer can hold them."""
        self.late_ns = 0.0
        """By how much, in all; `wait` is without that."""

    def longest_wait(self) -> float:
        """Longest time that the timer held a message, without the stalls of the host.

        Waits that sweep the timer's period, or repeat in even steps, lie as far above their mean as the least lies
        below it; a stall adds little to a mean.
        """
        return min(2 * self.wait / self.count - self.wait_least, self.wait_most)

    def merged(self, after: "_Bin") -> "_Bin":
        """Merge this bin with its neighbour."""
        low = self if self.lowest <= after.lowest else after
        merged = _Bin(low.device_ns, low.arrival_ns, low.lowest, self.wait + after.wait)
        merged.begin_ns = self.begin_ns
        merged.wait_least = min(self.wait_least, after.wait_least)
        merged.wait_most = max(self.wait_most, after.wait_most)
        merged.count = self.count + after.count
        merged.late = self.late + after.late
        merged.late_ns = self.late_ns + after.late_ns
        return merged


class ArrivalFit:
    """A line from device time to host time under all arrivals. Times are int ns, `slope` is host ns per device ns.

    Its value at `device_ns` is `ref_arrival_ns + slope * (device_ns - ref_device_ns)`; the sample path computes that
    itself, without a call.
    """

    __slots__ = (
        "_begin_ns", "_bins", "_hull", "_hull_bins", "_open", "_pause_count", "_pause_ns", "_slope_known",
        "_slope_known_error", "_wait_most", "_width_ns", "count", "error_ns", "fitted_ns", "hidden_ns", "hold_ns",
        "measured_hold_ns", "recent_ns", "ref_arrival_ns", "ref_device_ns", "residual_ns", "shift_ns", "slope",
        "slope_error", "until_ns",
    )  # fmt: skip

    def __init__(
        self, device_ns: int, arrival_ns: int, hold_ns: int = 0, slope: float = 1.0, slope_error: float = 0.07
    ) -> None:
        """Begin at a first arrival; `slope` may be known, with its one-sigma error, from an earlier fit."""
        self.ref_device_ns = device_ns
        self.ref_arrival_ns = arrival_ns
        self.slope = slope
        self._slope_known, self._slope_known_error = slope, KNOWN_SIGMAS * slope_error
        self._begin_ns = device_ns
        self.fitted_ns = device_ns
        """Device time of the newest change of the fit."""
        self.count = 1
        """Number of arrivals."""
        self.error_ns = 0.0
        """One-sigma error of the fit at its newest end, as far as the spread of the points shows it."""
        self.slope_error = slope_error
        self.residual_ns = 0.0
        """Root mean square distance of the bins' lowest points above the fit."""
        self.recent_ns = 0.0
        """Distance of the lowest point of the newest bins: more than spread, if the device's clock stood still."""
        self.hold_ns = hold_ns
        """Period of the adapter's latency timer; 0 for none."""
        self.hidden_ns = float(hold_ns)
        """Width of what a latency timer leaves open at the newest end (`feasible_lines`)."""
        self.shift_ns = hold_ns / 2
        """Distance from the fit down to the middle of the feasible lines, ns."""
        self.measured_hold_ns = 0
        """How long the adapter holds messages, where most wait for longer than it was said to hold them; else 0."""
        self._wait_most = float(hold_ns + LATENCIES_NS[0])
        self._pause_ns = float(hold_ns)
        self._pause_count = 1
        self._width_ns = 0
        self.until_ns = device_ns + 1
        """Device time from which on an arrival begins a new bin, with which the fit changes."""
        self._open = _Bin(device_ns, arrival_ns, 0.0, 0.0)
        self._bins = [self._open]
        # lower hull over the first `_hull_bins` bins, which change no more; from the point of the oldest
        self._hull: list[Point] = []
        self._hull_bins = 0

    @property
    def span_ns(self) -> int:
        """Device time between the oldest and the newest bin."""
        return self._open.device_ns - self._bins[0].device_ns

    def is_known(self, least_ns: int) -> bool:
        """Whether there are enough points, over `least_ns` or more."""
        return self.count >= ENOUGH_POINTS and self.span_ns >= max(least_ns, ENOUGH_HOLDS * self.hold_ns)

    def set_pause(self, pause_ns: float, count: int) -> None:
        """Set the longest pause between messages that a read can end in, at most the timer's period.

        `count` messages cannot all be followed by whole others in their reads.
        """
        self._pause_ns, self._pause_count = pause_ns, count

    def add_arrival(self, device_ns: int, arrival_ns: int, trailing_ns: int, above_ns: float) -> bool:
        """Add an arrival `above_ns` above the fit; `device_ns` never falls. Return whether the fit changed.

        Bytes of `trailing_ns` on the wire followed the message in the same read.
        """
        self.count += 1
        wait = above_ns + trailing_ns
        late_ns = 0.0
        if wait > self._wait_most:
            late_ns = wait - self._wait_most
            wait = self._wait_most  # the truth is under the fit: a timer alone cannot have held it for longer
        if device_ns >= self.until_ns:
            bin_ = _Bin(device_ns, arrival_ns, above_ns, wait)
            self._bins.append(bin_)
            self._open = bin_
            if late_ns:
                bin_.late, bin_.late_ns = 1, late_ns
            if len(self._bins) > BINS:
                self._make_room()
            self.until_ns = device_ns + max(self._width_ns, 1)
            self._fit(device_ns)
            return True
        bin_ = self._open
        bin_.count += 1
        bin_.wait += wait
        if late_ns:
            bin_.late += 1
            bin_.late_ns += late_ns
        if wait < bin_.wait_least:
            bin_.wait_least = wait
        elif wait > bin_.wait_most:
            bin_.wait_most = wait
        if above_ns < bin_.lowest:
            bin_.lowest = above_ns
            bin_.device_ns = device_ns
            bin_.arrival_ns = arrival_ns
        return False

    def _make_room(self) -> None:
        """Drop the oldest bin, or merge pairs of them while they are short."""
        bins = self._bins
        self._hull.clear()
        self._hull_bins = 0
        if self._width_ns >= BIN_LONGEST_NS:
            del bins[0]
            return
        newest = bins.pop()
        self._bins = [bins[i].merged(bins[i + 1]) for i in range(0, BINS, 2)]
        self._bins.append(newest)
        self._width_ns = min((newest.begin_ns - bins[0].begin_ns) // (BINS // 2), BIN_LONGEST_NS)

    def _fit(self, device_ns: int) -> None:
        """Fit the line to the bins again."""
        bins = self._bins
        origin = bins[0]
        x0, y0 = origin.device_ns, origin.arrival_ns
        points = [(float(b.device_ns - x0), float(b.arrival_ns - y0)) for b in bins[self._hull_bins :]]
        extend_lower_hull(self._hull, points[:-1])
        self._hull_bins = len(bins) - 1
        hull = self._hull.copy()
        extend_lower_hull(hull, points[-1:])
        known, error = self._slope_known, self._slope_error_known(device_ns)
        lowest, highest = max(known - error, SLOPE_LOWEST), min(known + error, SLOPE_HIGHEST)
        slope, dx, dy = _edge_over(hull, SUPPORT_AT * (bins[-1].device_ns - x0), lowest, highest)
        self._move(x0 + int(dx), y0 + int(dy), slope)
        self._judge(device_ns)
        if self.hold_ns:
            self._look_through_timer(device_ns)

    def _slope_error_known(self, device_ns: int) -> float:
        """How far the slope can be from that of the fit before: less sure the longer ago that was."""
        return self._slope_known_error + DRIFT_MOST * (device_ns - self._begin_ns) / NS_PER_S

    def _look_through_timer(self, device_ns: int) -> None:
        """Replace the fit by the middle of the lines that the timer leaves open."""
        x0 = self._bins[0].device_ns
        upper = lower_hull([(float(b.device_ns - x0), b.lowest) for b in self._bins])
        lower = [(float(b.device_ns - x0), -f) for b, f in zip(self._bins, self._floors(), strict=True)]
        lower = [(xl, -f) for xl, f in lower_hull(lower)]
        error = self._slope_error_known(device_ns)
        flattest = max(self._slope_known - error - self.slope, -1.0)
        steepest = min(self._slope_known + error - self.slope, 1.0)
        for latency_ns in LATENCIES_NS:
            found = feasible_lines(
                upper, [(xl, f - latency_ns) for xl, f in lower], float(device_ns - x0), flattest, steepest
            )
            if found is not None:
                break
        else:
            self.hidden_ns = float(min(self.hold_ns, LATENCIES_NS[-1]))
            self.shift_ns = self.hidden_ns / 2
            return
        slope = (found.slope_lowest + found.slope_highest) / 2
        slope = min(max(self.slope + slope, SLOPE_LOWEST), SLOPE_HIGHEST) - self.slope
        xu, yu = min(upper, key=lambda p: p[1] - slope * p[0])
        self.hidden_ns = found.highest_ns - found.lowest_ns + latency_ns - LATENCIES_NS[0]
        self.shift_ns = yu + slope * (device_ns - x0 - xu) - (found.highest_ns + found.lowest_ns) / 2
        self.slope_error += (found.slope_highest - found.slope_lowest) / 4
        touch_ns = x0 + int(xu)
        above_ref = self.slope * (touch_ns - self.ref_device_ns)
        self._move(touch_ns, self.ref_arrival_ns + int(above_ref + yu), self.slope + slope)

    def _floors(self) -> list[float]:
        """Lower bounds of the truth, bin by bin: the longest wait less the timer, and the least less the pause.

        The longest wait shows nothing where the host stood still, the least nothing where hardly a message came in
        time, and a bound far above the fit is of a bin that was late as a whole. A bin that stands out above its two
        neighbours on either side was stalled, and is brought down to them.
        """
        hold, pause, enough = self.hold_ns, self._pause_ns, self._pause_count
        held = hold + LATE_FACTOR * hold * self._count_late()
        none = -hold - pause
        floors = []
        for b in self._bins:
            longest = b.longest_wait() - held if b.late_ns <= hold * b.count else none
            least = b.lowest - pause if b.count - b.late >= enough else none
            floor = max(longest, least)
            floors.append(floor if floor <= self._wait_most else none)
        padded = [-inf, -inf, *floors, -inf, -inf]
        return [min(f, max(padded[i : i + 2] + padded[i + 3 : i + 5])) for i, f in enumerate(floors)]

    def _count_late(self) -> float:
        """Return the share of messages that waited for more than the timer; measure that where most did.

        Waits that sweep a timer's period are half of it on the average. The periods of timers are powers of two, in ms.
        """
        bins, count = self._bins, sum([b.count for b in self._bins])
        late, late_ns = sum([b.late for b in bins]), sum([b.late_ns for b in bins])
        if 2 * late > count >= HOLD_MESSAGES and late_ns < late * HOLD_MOST_NS:  # or the host stood still
            mean_ns = (sum([b.wait for b in bins]) + late_ns) / count
            hold_ns = NS_PER_MS
            while hold_ns < 2 * mean_ns and hold_ns < HOLD_MOST_NS:
                hold_ns *= 2
            self.measured_hold_ns = max(hold_ns, self.hold_ns)
        return late / count

    def _move(self, ref_device_ns: int, ref_arrival_ns: int, slope: float) -> None:
        """Change the line, and with it all distances above it."""
        x_old, y_old, slope_old = self.ref_device_ns, self.ref_arrival_ns, self.slope
        self.ref_device_ns, self.ref_arrival_ns, self.slope = ref_device_ns, ref_arrival_ns, slope
        for b in self._bins:
            b.lowest = lowest = b.arrival_ns - ref_arrival_ns - slope * (b.device_ns - ref_device_ns)
            if not self.hold_ns:  # waits show something of a timer only
                continue
            was = b.arrival_ns - y_old - slope_old * (b.device_ns - x_old)
            change = lowest - was
            b.wait += change * (b.count - b.late)
            b.wait_least += change
            b.wait_most += change
            if b.late:
                b.late_ns += change * b.late
                if b.late_ns < 0.0:  # the fit was too low when they came
                    b.late, b.late_ns = 0, 0.0

    def _judge(self, device_ns: int) -> None:
        """Estimate the error of the fit from the distances of the bins above it."""
        bins = self._bins
        n = len(bins)
        lowest = sorted([b.lowest for b in bins])
        half = (n + 1) // 2
        mean = sum(lowest) / n
        spread = min(mean, LOWER_HALF * sum(lowest[:half]) / half)
        self.residual_ns = sqrt(sum([ns * ns for ns in lowest]) / n)
        recent = bins[-RECENT_BINS:]
        recent_span_ns = recent[-1].arrival_ns - recent[0].arrival_ns
        self.recent_ns = min(b.lowest for b in recent) if recent_span_ns > RECENT_NS else 0.0
        share, late_ns = min(1.0, SPREAD_BINS / n), 0.0 if self.hold_ns else self.recent_ns
        self.error_ns = spread * share + late_ns
        span = bins[-1].device_ns - bins[0].device_ns
        most = self._slope_error_known(device_ns) / KNOWN_SIGMAS
        self.slope_error = min(most, 2e-6 + 4 * (mean * share + late_ns) / span) if n > 2 and span else most
        self.fitted_ns = device_ns


def lower_hull(points: list[Point]) -> list[Point]:
    """Lower convex hull of points in order of x (Andrew's monotone chain)."""
    hull: list[Point] = []
    extend_lower_hull(hull, points)
    return hull


def extend_lower_hull(hull: list[Point], points: list[Point]) -> None:
    """Add points to a lower hull, in order of x and right of it."""
    for x, y in points:
        while len(hull) >= 2:
            (xa, ya), (xb, yb) = hull[-2], hull[-1]
            if (yb - ya) * (x - xa) < (y - ya) * (xb - xa):
                break
            hull.pop()
        hull.append((x, y))


def _edge_over(hull: list[Point], x: float, lowest: float, highest: float) -> tuple[float, float, float]:
    """Slope of the hull's edge over `x`, held between two bounds, and a point (x, y) of the line under the hull."""
    if len(hull) < 2:
        return (lowest + highest) / 2, *hull[0]
    i = 1
    while i < len(hull) - 1 and hull[i][0] < x:
        i += 1
    (xa, ya), (xb, yb) = hull[i - 1], hull[i]
    slope = (yb - ya) / (xb - xa)
    if lowest <= slope <= highest:
        return slope, xa, ya
    slope = min(max(slope, lowest), highest)
    xa, ya = min(hull, key=lambda p: p[1] - slope * p[0])
    return slope, xa, ya


@dataclass(frozen=True, slots=True)
class FeasibleLines:
    """All lines between an upper and a lower bound, evaluated at the newest point."""

    lowest_ns: float
    """Lowest value of any such line there."""
    highest_ns: float
    slope_lowest: float
    slope_highest: float


def feasible_lines(
    upper: list[Point], lower: list[Point], x: float, flattest: float = -1.0, steepest: float = 1.0
) -> FeasibleLines | None:
    """Return the lines under all points of `upper` and above all of `lower` up to `x`; None where there are none.

    Their slopes are between `flattest` and `steepest`.

    The points are the corners of two convex chains; every pair of them bounds the slope, so with some ten corners each
    this is exact and cheap.
    """
    for xu, yu in upper:
        for xl, yl in lower:
            room, apart = yu - yl, xu - xl
            if apart > 0:
                steepest = min(steepest, room / apart)
            elif apart < 0:
                flattest = max(flattest, room / apart)
            elif room < 0:
                return None
    if flattest > steepest:
        return None
    highest = min(y + steepest * (x - xu) for xu, y in upper)
    lowest = max(y + flattest * (x - xl) for xl, y in lower)
    return FeasibleLines(lowest, highest, flattest, steepest)
