"""The lower envelope of arrival times over device time: offset and skew of a device's clock, untouched by jitter.

What arrives is `y = truth + delay` with a delay that is never negative, so the truth lies on or under every point
(x = device time, y = arrival less wire time) and the points that were hardly delayed lie on it. An average follows the
mean delay and every burst; the lower convex hull does not.

Plan: each bin of device time keeps its lowest point above the present line; bins begin as single samples and double
in width until 64 of them cover about a minute; then the oldest goes. Whenever a bin opens, the lower hull over the
bins gives the line: its edge over a point at three quarters of the window. (The edge over the mean minimises the summed
distance, but is later to follow a crystal that drifts: its error at the newest end is 51 µs at 0.1 ppm/s and 64 s,
at three quarters 13 µs.) A sample costs one evaluation of a line and one comparison; the hull is paid once per bin.
"""

from math import inf, sqrt
from typing import Final

from imud.clock.corridor import corridor
from imud.units import NS_PER_S, NS_PER_US

BINS: Final = 64
BIN_LONGEST_NS: Final = NS_PER_S
"""64 s of window: long against the beat of two crystals with an adapter's timer, short against their warming up."""
SLOPE_LOWEST: Final = 1 / 1.07
SLOPE_HIGHEST: Final = 1 / 0.93
"""Host ns per device ns. Parts 4.08 % off nominal have been sold; past 7 % it is another tick, not a crystal."""
SUPPORT_AT: Final = 0.75
"""Where in the window the hull edge is taken."""
SPREAD_BINS: Final = 12
"""The line under n bins is off by their mean height times this over n, one sigma (found by simulation, loaded host)."""
RECENT_BINS: Final = 8
RECENT_NS: Final = 2 * NS_PER_S
"""What so many of the newest bins agree on, arriving over at least this time, is no delay of single messages."""
LATENCIES_NS: Final = (200 * NS_PER_US, 600 * NS_PER_US, 2000 * NS_PER_US, 6000 * NS_PER_US)
"""What polling and wake-up may add to the longest wait, tried in turn until some line fits."""


class _Bin:
    """The lowest point of a stretch of device time, and how long its messages waited, least and on average."""

    __slots__ = ("begin", "count", "lowest", "wait", "wait_least", "wait_most", "x", "y")

    def __init__(self, x: int, y: int, lowest: float, wait: float) -> None:
        self.begin = x
        self.x = x
        self.y = y
        self.lowest = lowest
        """Height of (x, y) above the line."""
        self.wait = wait
        """Sum over `count` messages of how long they waited, above the line."""
        self.wait_least = wait
        self.wait_most = wait
        self.count = 1

    def longest_wait(self) -> float:
        """How long the timer held the unluckiest message, without the stalls of the host.

        Waits that sweep the timer's period, or repeat in even steps, lie as far above their mean as the least lies
        below it; a stall adds little to a mean.
        """
        return min(2 * self.wait / self.count - self.wait_least, self.wait_most)


class Envelope:
    """A line from device time to host time under all points. Times are int ns, `slope` is host ns per device ns."""

    __slots__ = (
        "_bins",
        "_open",
        "_until",
        "_wait_most",
        "_width",
        "count",
        "error_ns",
        "held_count",
        "held_ns",
        "hidden_ns",
        "hold_ns",
        "recent_ns",
        "residual_ns",
        "shift_ns",
        "slope",
        "slope_error",
        "x_fit",
        "x_ref",
        "y_ref",
    )

    def __init__(self, x: int, y: int, hold_ns: int = 0) -> None:
        self.x_ref = x
        self.y_ref = y
        self.slope = 1.0
        self.x_fit = x
        """Device time of the newest fit."""
        self.count = 1
        """Points taken."""
        self.error_ns = 0.0
        """One-sigma error of the line at its newest end, as far as the spread of the points shows it."""
        self.slope_error = 0.07
        self.residual_ns = 0.0
        """Root mean square height of the bins' lowest points above the line."""
        self.recent_ns = 0.0
        """Height of the lowest point of the newest bins: more than spread, if the device's clock stood still."""
        self.hold_ns = hold_ns
        self._wait_most = float(hold_ns + LATENCIES_NS[0])
        self.held_ns = float(hold_ns)
        """Longest pause between messages that a read can end in, at most `hold_ns`."""
        self.held_count = 1
        """So many messages cannot all be followed by whole others in their reads."""
        self.hidden_ns = float(hold_ns)
        """Width of what a latency timer leaves open at the newest end (`corridor`)."""
        self.shift_ns = hold_ns / 2
        """How far under the line the middle of that is."""
        self._width = 0
        self._until = x + 1
        self._open = _Bin(x, y, 0.0, 0.0)
        self._bins = [self._open]

    @property
    def span_ns(self) -> int:
        """Device time between the oldest and the newest bin."""
        return self._open.x - self._bins[0].x

    def at(self, x: int) -> float:
        """The line, relative to `y_ref`."""
        return self.slope * (x - self.x_ref)

    def add(self, x: int, y: int, trailing_ns: int, height: float) -> bool:
        """Take a point `height` above the line; x never falls. Returns whether the line changed."""
        self.count += 1
        wait = height + trailing_ns
        if wait > self._wait_most:  # noqa: PLR1730 - a call of min() costs 60 ns on the sample path
            wait = self._wait_most  # the truth is under the line: a timer alone cannot have held it for longer
        if x >= self._until:
            bin_ = _Bin(x, y, height, wait)
            self._bins.append(bin_)
            self._open = bin_
            if len(self._bins) > BINS:
                self._make_room()
            self._until = x + max(self._width, 1)
            self._fit(x)
            return True
        bin_ = self._open
        bin_.count += 1
        bin_.wait += wait
        if wait < bin_.wait_least:
            bin_.wait_least = wait
        elif wait > bin_.wait_most:
            bin_.wait_most = wait
        if height < bin_.lowest:
            bin_.lowest = height
            bin_.x = x
            bin_.y = y
        return False

    def _make_room(self) -> None:
        bins = self._bins
        if self._width >= BIN_LONGEST_NS:
            del bins[0]
            return
        newest = bins.pop()
        self._bins = [_merged(bins[i], bins[i + 1]) for i in range(0, BINS, 2)]
        self._bins.append(newest)
        self._width = min((newest.begin - bins[0].begin) // (BINS // 2), BIN_LONGEST_NS)

    def _fit(self, x: int) -> None:
        """Lay the line under the bins again."""
        bins = self._bins
        origin = bins[0]
        x0, y0 = origin.x, origin.y
        hull = lower_hull([(float(b.x - x0), float(b.y - y0)) for b in bins])
        slope, dx, dy = _edge_over(hull, SUPPORT_AT * (bins[-1].x - x0), SLOPE_LOWEST, SLOPE_HIGHEST)
        self._move(x0 + int(dx), y0 + int(dy), slope)
        self._judge(x)
        if self.hold_ns:
            self._look_through_timer(x)

    def _look_through_timer(self, x: int) -> None:
        """Replace the line by the middle of what the timer leaves open."""
        x0 = self._bins[0].x
        ceiling = lower_hull([(float(b.x - x0), b.lowest) for b in self._bins])
        floor = [(float(b.x - x0), -f) for b, f in zip(self._bins, self._floors(), strict=True)]
        floor = [(xf, -f) for xf, f in lower_hull(floor)]
        for latency_ns in LATENCIES_NS:
            found = corridor(ceiling, [(xf, f - latency_ns) for xf, f in floor], float(x - x0))
            if found is not None:
                break
        else:
            self.hidden_ns = float(min(self.hold_ns, LATENCIES_NS[-1]))
            self.shift_ns = self.hidden_ns / 2
            return
        slope = (found.slope_lowest + found.slope_highest) / 2
        slope = min(max(self.slope + slope, SLOPE_LOWEST), SLOPE_HIGHEST) - self.slope
        xc, y = min(ceiling, key=lambda p: p[1] - slope * p[0])
        self.hidden_ns = found.highest_ns - found.lowest_ns + latency_ns - LATENCIES_NS[0]
        self.shift_ns = y + slope * (x - x0 - xc) - (found.highest_ns + found.lowest_ns) / 2
        self.slope_error += (found.slope_highest - found.slope_lowest) / 4
        touch = x0 + int(xc)
        self._move(touch, self.y_ref + int(self.at(touch) + y), self.slope + slope)

    def _floors(self) -> list[float]:
        """What the truth is not under, bin by bin: the longest wait less the timer, and the least less the pause.

        A bin that stands out above its two neighbours on either side was stalled, and is brought down to them.
        """
        hold, held, enough = self.hold_ns, self.held_ns, self.held_count
        floors = [
            max(b.longest_wait() - hold, b.lowest - held if b.count >= enough else -hold - held) for b in self._bins
        ]
        padded = [-inf, -inf, *floors, -inf, -inf]
        return [min(f, max(padded[i : i + 2] + padded[i + 3 : i + 5])) for i, f in enumerate(floors)]

    def _move(self, x_ref: int, y_ref: int, slope: float) -> None:
        """Change the line, and with it all heights above it."""
        x_old, y_old, slope_old = self.x_ref, self.y_ref, self.slope
        self.x_ref, self.y_ref, self.slope = x_ref, y_ref, slope
        for b in self._bins:
            lowest = b.y - y_ref - slope * (b.x - x_ref)
            was = b.y - y_old - slope_old * (b.x - x_old)
            b.wait += (lowest - was) * b.count
            b.wait_least += lowest - was
            b.wait_most += lowest - was
            b.lowest = lowest

    def _judge(self, x: int) -> None:
        """How well the line is known, from the heights of the bins above it."""
        bins = self._bins
        n = len(bins)
        mean = sum(b.lowest for b in bins) / n
        self.residual_ns = sqrt(sum(b.lowest * b.lowest for b in bins) / n)
        recent = bins[-RECENT_BINS:]
        self.recent_ns = min(b.lowest for b in recent) if recent[-1].y - recent[0].y > RECENT_NS else 0.0
        self.error_ns = mean * min(1.0, SPREAD_BINS / n) + (0.0 if self.hold_ns else self.recent_ns)
        span = bins[-1].x - bins[0].x
        self.slope_error = min(0.07, 2e-6 + 4 * self.error_ns / span) if n > 2 and span else 0.07
        self.x_fit = x


def _merged(a: _Bin, b: _Bin) -> _Bin:
    """Two neighbouring bins as one."""
    low = a if a.lowest <= b.lowest else b
    merged = _Bin(low.x, low.y, low.lowest, a.wait + b.wait)
    merged.begin = a.begin
    merged.wait_least = min(a.wait_least, b.wait_least)
    merged.wait_most = max(a.wait_most, b.wait_most)
    merged.count = a.count + b.count
    return merged


def lower_hull(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Lower convex hull of points in order of x (Andrew's monotone chain)."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) >= 2:
            (xa, ya), (xb, yb) = hull[-2], hull[-1]
            if (yb - ya) * (x - xa) < (y - ya) * (xb - xa):
                break
            hull.pop()
        hull.append((x, y))
    return hull


def _edge_over(hull: list[tuple[float, float]], x: float, lowest: float, highest: float) -> tuple[float, float, float]:
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
