"""Fit of arrivals: offset and skew of a device's clock, from the lower envelope of arrival times over device time.

An arrival is `arrival_ns = truth + delay` (less the time on the wire). The delay is never negative. Therefore the truth
is on or below each point (device_ns, arrival_ns), and the points with a very small delay are on it. A mean follows the
mean delay and each burst of delays. The lower convex hull does not (Zhang, Liu, Xia: Clock synchronization algorithms
for network measurements, INFOCOM 2002).

Bins: each bin of device time keeps its lowest point above the present fit. A bin starts with one sample. The width of
the bins doubles until 64 bins cover about one minute, then the oldest bin is dropped. Each new bin changes the fit: the
new fit is the edge of the lower hull above a point at three quarters of the window. (The edge above the mean has the
smallest total distance, but it follows a drift of the crystal later: its error at the newest end is 51 µs at 0.1 ppm/s
and 64 s, and 13 µs at three quarters.) The cost is one evaluation of the fit and one comparison per sample, and one
hull per bin.

Latency timer of a USB adapter: a frame waits in the adapter for 0 to one period of the timer. The truth is below each
arrival, and above each arrival less this period. If the timer and the samples have a beat (100 Hz and 16 ms, or two
crystals with a difference of 30 ppm), the shortest wait increases slowly and falls back, once in a minute or an hour.
An envelope follows this movement. `feasible_lines` bounds the truth from both sides. The middle of the lines between
the bounds is the better estimate, and the spread of the lines is its error.
"""

from dataclasses import dataclass
from math import inf, log, sqrt
from typing import Final

from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

# 64 s of window: long compared to the beat of two crystals with an adapter's timer, short compared to their warm-up
BINS: Final = 64
BIN_LONGEST_NS: Final = NS_PER_S
# Limits of the slope, host ns per device ns. Devices with an error of 4.08 % exist. Above 7 %, the tick is different.
SLOPE_LOWEST: Final = 1 / 1.07
SLOPE_HIGHEST: Final = 1 / 0.93
SUPPORT_AT: Final = 0.75  # position of the hull edge in the window, as a share of the window
# a fit is known after this number of points, and after this time or number of periods of a latency timer
ENOUGH_POINTS: Final = 8
ENOUGH_SPAN_NS: Final = 100 * NS_PER_MS
ENOUGH_HOLDS: Final = 20
# error of a fit over n bins: mean distance of the bins, times this factor, divided by n (one sigma, from a simulation).
SPREAD_BINS: Final = 12
# newest bins, at least RECENT_NS long: a common delay of all of them is not a delay of single frames
RECENT_BINS: Final = 8
RECENT_NS: Final = 2 * NS_PER_S
KNOWN_SIGMAS: Final = 4  # maximum deviation of the slope from its known value, in standard errors
DRIFT_MOST: Final = 1e-6  # maximum change of a crystal's rate per second
# Delays of polling and wake-up in addition to the longest wait, ns. The fit uses the first delay with a feasible line.
LATENCIES_NS: Final = (200 * NS_PER_US, 600 * NS_PER_US, 2000 * NS_PER_US, 6000 * NS_PER_US)
# Factor for late frames. It multiplies the share of waits that the timer alone cannot explain, in periods of the timer.
# The longest wait is twice the mean less the shortest wait, and a busy host increases the mean. With exponentially
# distributed delays, twice their mean is at most this factor times the share.
LATE_FACTOR: Final = 4.0
HOLD_MESSAGES: Final = 32  # number of frames that show whether the reported timer period is correct
# longest timer that the fit assumes without a report, ns: the default of common adapters
HOLD_MOST_NS: Final = 16 * NS_PER_MS
# Mean of exponentially distributed values, divided by the mean of their lower half. The lower half contains no stalls.
LOWER_HALF: Final = 1 / (1 - log(2))

Point = tuple[float, float]  # device time and time, ns


class _Bin:
    """Lowest point in an interval of device time, with the shortest and the mean wait of its frames."""

    __slots__ = (
        "arrival_ns", "begin_ns", "count", "device_ns", "late", "late_ns", "lowest", "wait", "wait_least", "wait_most",
    )  # fmt: skip

    def __init__(self, device_ns: int, arrival_ns: int, lowest: float, wait: float) -> None:
        self.begin_ns = device_ns
        self.device_ns = device_ns
        self.arrival_ns = arrival_ns
        self.lowest = lowest  # distance of (device_ns, arrival_ns) above the fit, ns
        self.wait = wait  # sum of the waits of `count` frames above the fit, ns
        self.wait_least = wait
        self.wait_most = wait
        self.count = 1
        self.late = 0  # number of frames that waited for longer than the timer can hold them
        self.late_ns = 0.0  # Sum of the waits in excess of the timer, ns. `wait` does not contain it.

    def longest_wait(self) -> float:
        """Return the longest wait in the timer without stalls of the host, ns."""
        # Waits that cover the period of the timer evenly are symmetric: the longest wait is as far above the mean as
        # the shortest is below. A stall changes the mean only slightly.
        return min(2 * self.wait / self.count - self.wait_least, self.wait_most)

    def merged(self, after: "_Bin") -> "_Bin":
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
    """Line from device time to host time below all arrivals. Times are ns (int), `slope` is host ns per device ns.

    The value at `device_ns` is `ref_arrival_ns + slope * (device_ns - ref_device_ns)`. The clock computes it without a
    call.
    """

    __slots__ = (
        "_begin_ns", "_bins", "_hull", "_hull_bins", "_open", "_pause_count", "_pause_ns", "_slope_known",
        "_slope_known_error", "_width_ns", "count", "error_ns", "fitted_ns", "hidden_ns", "hold_ns",
        "measured_hold_ns", "recent_ns", "ref_arrival_ns", "ref_device_ns", "residual_ns", "shift_ns", "slope",
        "slope_error", "until_ns",
        "wait_most",
    )  # fmt: skip

    def __init__(
        self, device_ns: int, arrival_ns: int, hold_ns: int = 0, slope: float = 1.0, slope_error: float = 0.07
    ) -> None:
        """Start at the first arrival. An earlier fit can supply `slope` and its one-sigma error."""
        self.ref_device_ns = device_ns
        self.ref_arrival_ns = arrival_ns
        self.slope = slope
        self._slope_known, self._slope_known_error = slope, KNOWN_SIGMAS * slope_error
        self._begin_ns = device_ns
        self.fitted_ns = device_ns  # device time of the newest change of the fit, ns
        self.count = 1  # number of arrivals
        self.error_ns = 0.0  # one-sigma error of the fit at its newest end, from the spread of the points, ns
        self.slope_error = slope_error
        self.residual_ns = 0.0  # root mean square distance of the lowest points above the fit, ns
        # Distance of the lowest point of the newest bins above the fit, ns. It is large if the device's clock stopped.
        self.recent_ns = 0.0
        self.hold_ns = hold_ns  # period of the adapter's latency timer, ns; 0 without a timer
        # width of the feasible lines at the newest end, ns: the part that a latency timer hides
        self.hidden_ns = float(hold_ns)
        self.shift_ns = hold_ns / 2  # distance from the fit down to the middle of the feasible lines, ns
        # measured period of the timer, ns, if most frames wait for longer than `hold_ns`; else 0
        self.measured_hold_ns = 0
        self.wait_most = float(hold_ns + LATENCIES_NS[0])
        self._pause_ns = float(hold_ns)
        self._pause_count = 1
        self._width_ns = 0
        # Device time of the next bin, ns. The arrival at or after this time changes the fit.
        self.until_ns = device_ns + 1
        self._open = _Bin(device_ns, arrival_ns, 0.0, 0.0)
        self._bins = [self._open]
        # lower hull over the first `_hull_bins` bins, which no longer change, relative to the point of the oldest bin
        self._hull: list[Point] = []
        self._hull_bins = 0

    @property
    def span_ns(self) -> int:
        return self._open.device_ns - self._bins[0].device_ns

    def is_known(self, least_ns: int) -> bool:
        """Return whether the fit has enough points, over at least `least_ns`."""
        return self.count >= ENOUGH_POINTS and self.span_ns >= max(least_ns, ENOUGH_HOLDS * self.hold_ns)

    def set_pause(self, pause_ns: float, count: int) -> None:
        """Set the longest pause between frames at which a read can end: at most the period of the timer."""
        # Of `count` consecutive frames, at least one is the last frame of its read.
        self._pause_ns, self._pause_count = pause_ns, count

    def add_arrival(self, device_ns: int, arrival_ns: int, trailing_ns: int, above_ns: float) -> bool:
        """Add an arrival `above_ns` above the fit. Return whether the fit changed. `device_ns` must not fall.
        `trailing_ns` is the time on the wire of the bytes after the frame in the same read."""
        self.count += 1
        wait = above_ns + trailing_ns
        late_ns = 0.0
        if wait > self.wait_most:
            late_ns = wait - self.wait_most
            wait = self.wait_most  # the truth is below the fit: the timer alone cannot cause this wait
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

    def open_bin(self) -> tuple[int, int, float, float, float, float, int, int, float]:
        """Return the state of the newest bin. The C kernel changes this state."""
        b = self._open
        return (
            b.device_ns, b.arrival_ns, b.lowest, b.wait, b.wait_least, b.wait_most, b.count, b.late, b.late_ns,
        )  # fmt: skip

    def set_open_bin(self, state: tuple[int, int, float, float, float, float, int, int, float], added: int) -> None:
        """Set the state of the newest bin after `added` arrivals. They do not change the fit."""
        b = self._open
        b.device_ns, b.arrival_ns, b.lowest, b.wait, b.wait_least, b.wait_most, b.count, b.late, b.late_ns = state
        self.count += added

    def _make_room(self) -> None:
        """Drop the oldest bin. If the bins are short, merge pairs of bins instead."""
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
        """Return the maximum deviation from the slope of the previous fit. It grows with the age of that fit."""
        return self._slope_known_error + DRIFT_MOST * (device_ns - self._begin_ns) / NS_PER_S

    def _look_through_timer(self, device_ns: int) -> None:
        """Replace the fit by the middle of the feasible lines."""
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
        else:  # no line fits: a stall of the host, keep the fit
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
        """Return the lower bound of the truth in each bin."""
        # The bound is the longest wait less the timer, or the shortest wait less the pause. The longest wait is useless
        # if the host stalled. The shortest wait is useless if almost no frame was in time. A bound far above the fit
        # belongs to a bin that was delayed as a whole.
        hold, pause, enough = self.hold_ns, self._pause_ns, self._pause_count
        held = hold + LATE_FACTOR * hold * self._count_late()
        none = -hold - pause
        floors = []
        for b in self._bins:
            longest = b.longest_wait() - held if b.late_ns <= hold * b.count else none
            least = b.lowest - pause if b.count - b.late >= enough else none
            floor = max(longest, least)
            floors.append(floor if floor <= self.wait_most else none)
        # a bin above its two neighbors on both sides was stalled: use the bound of the neighbors
        padded = [-inf, -inf, *floors, -inf, -inf]
        return [min(f, max(padded[i : i + 2] + padded[i + 3 : i + 5])) for i, f in enumerate(floors)]

    def _count_late(self) -> float:
        """Return the share of frames that waited for longer than the timer. If most did, measure the timer."""
        bins, count = self._bins, sum([b.count for b in self._bins])
        late, late_ns = sum([b.late for b in bins]), sum([b.late_ns for b in bins])
        if 2 * late > count >= HOLD_MESSAGES and late_ns < late * HOLD_MOST_NS:  # otherwise the host stalled
            mean_ns = (sum([b.wait for b in bins]) + late_ns) / count
            # evenly distributed waits have a mean of half a period; periods are powers of two, in ms
            hold_ns = NS_PER_MS
            while hold_ns < 2 * mean_ns and hold_ns < HOLD_MOST_NS:
                hold_ns *= 2
            self.measured_hold_ns = max(hold_ns, self.hold_ns)
        return late / count

    def _move(self, ref_device_ns: int, ref_arrival_ns: int, slope: float) -> None:
        x_old, y_old, slope_old = self.ref_device_ns, self.ref_arrival_ns, self.slope
        self.ref_device_ns, self.ref_arrival_ns, self.slope = ref_device_ns, ref_arrival_ns, slope
        for b in self._bins:
            b.lowest = lowest = b.arrival_ns - ref_arrival_ns - slope * (b.device_ns - ref_device_ns)
            if not self.hold_ns:  # waits matter only with a timer
                continue
            was = b.arrival_ns - y_old - slope_old * (b.device_ns - x_old)
            change = lowest - was
            b.wait += change * (b.count - b.late)
            b.wait_least += change
            b.wait_most += change
            if b.late:
                b.late_ns += change * b.late
                if b.late_ns < 0.0:  # the old fit was too low
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
    """Return the lower convex hull of points that are sorted by x (Andrew's monotone chain)."""
    hull: list[Point] = []
    extend_lower_hull(hull, points)
    return hull


def extend_lower_hull(hull: list[Point], points: list[Point]) -> None:
    """Add points to a lower hull. The points are sorted by x and to the right of the hull."""
    for x, y in points:
        while len(hull) >= 2:
            (xa, ya), (xb, yb) = hull[-2], hull[-1]
            if (yb - ya) * (x - xa) < (y - ya) * (xb - xa):
                break
            hull.pop()
        hull.append((x, y))


def _edge_over(hull: list[Point], x: float, lowest: float, highest: float) -> tuple[float, float, float]:
    """Return (slope, x, y): slope of the hull's edge above `x`, limited to two bounds, and a point of this line."""
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
    """All lines between an upper and a lower bound."""

    lowest_ns: float  # lowest value of these lines at the newest point, ns
    highest_ns: float
    slope_lowest: float
    slope_highest: float


def feasible_lines(
    upper: list[Point], lower: list[Point], x: float, flattest: float = -1.0, steepest: float = 1.0
) -> FeasibleLines | None:
    """Return the lines below all points of `upper` and above all points of `lower`; None if no line exists.

    The lines are evaluated at `x`. Their slopes are between `flattest` and `steepest`. Each pair of corners of the two
    convex chains bounds the slope. With about ten corners in each chain, this is exact and fast.
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
