"""Detection of several devices with the same address, from frames without a counter.

Each device sends a kind of frame with its own period and phase. The frames of several devices are therefore several
*series* of equal distances (`series_of`). The frames of one device can look like several series. imud excludes these
cases:

- A delayed frame leaves a hole in the series, so the frames are not more than the periods of the fastest series.
- A gateway sends frames of several periods together. Frames immediately after each other are one series.
- Frames at nearly equal distances are one series: a bus delays frames, and the timer of a device has a resolution.

Devices of equal rates whose phases differ by an equal part of the period look like one faster device. Their values
show them (`ValueOrder`).
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Container, Sequence, Sized
from itertools import chain, pairwise
from math import isfinite, remainder, tau
from statistics import median, mode
from typing import Final, NamedTuple

from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS

WINDOW: Final = 64  # number of frames of a kind that imud examines together
WINDOWS: Final = 2  # number of consecutive windows with the same result that start or end a conflict
SERIES_MOST: Final = 4  # maximum number of devices; the delays of one device can have a longer pattern
LEAST: Final = 8  # minimum number of frames of a series
COVERED: Final = 0.8  # minimum share of the periods of a series with a frame
FULL: Final = 0.85  # minimum shares: of the periods of all series with a frame, of the frames that are in a series
TOLERANCE: Final = 1 / 9  # maximum deviation of a frame from its series, in mean distances
FOLLOW: Final = 1 / 4  # share of the deviation by which the next frame is expected later
# Maximum distance of frames that arrive together: in mean distances, and in ns
TOGETHER, TOGETHER_NS = 0.2, 2 * NS_PER_MS
EQUAL: Final = 0.01  # maximum relative difference of two equal periods
IN_ORDER: Final = 0.9  # minimum share of the frames of one device whose SID is between its neighbours
EXTRAS: Final = 24  # number of extra frames of slow devices that imud examines together
QUESTION: Final = "do two or more devices on the bus have this address?"
EXTRAS_END: Final = 4  # number of periods without an extra frame after which the conflict has ended


class FrameSeries(NamedTuple):
    """Frames at equal distances."""

    period_ns: int
    times_ns: Sequence[int]  # arrival times
    periods: int  # number of periods from the first frame to the end of the examined time


def series_of(times_ns: Sequence[int]) -> tuple[Sequence[FrameSeries], Sequence[int]]:
    """Return the series of arrival times, the shortest period first, and the remaining times."""
    left, found = list(times_ns), list[FrameSeries]()
    half = len(left) // 2
    mean_ns = (sum(left[-half:]) - sum(left[:half])) // (half * (len(left) - half))
    limit_ns = int(TOLERANCE * mean_ns)
    late_ns = [t_ns - count * mean_ns for count, t_ns in enumerate(left)]
    if not limit_ns:
        return [], left
    if max(late_ns) - min(late_ns) <= 2 * limit_ns:
        return [FrameSeries(mean_ns, left, len(left))], []
    while len(left) >= LEAST and len(found) < SERIES_MOST and (one := _first_series(left, limit_ns)):
        found.append(one)
        taken = set(one.times_ns)
        left = [t_ns for t_ns in left if t_ns not in taken]
    return found, left


def _first_series(times_ns: Sequence[int], limit_ns: int) -> FrameSeries | None:
    """Return the series with the shortest period that starts near the first time; None if there is none."""
    starts = range(min(3, len(times_ns)))
    steps = {(times_ns[last] - times_ns[first], first) for first in starts for last in range(first + 1, first + LEAST)
             if last < len(times_ns)}  # fmt: skip
    span_ns = times_ns[-1] - times_ns[0]
    for step_ns, first in sorted(steps, key=lambda step: (round(step[0] / limit_ns), step[1])):
        if step_ns > 2 * limit_ns and (LEAST - 1) * step_ns <= span_ns:
            taken, last, periods = _follow(times_ns, first, step_ns, limit_ns)
            if len(taken) >= max(COVERED * periods, LEAST):
                return FrameSeries((taken[-1] - taken[0]) // last, taken, periods)
    return None


def _follow(times_ns: Sequence[int], first: int, step_ns: int, limit_ns: int) -> tuple[list[int], int, int]:
    """Return the times of a series, the number of steps to its last time, and the number of periods to the end."""
    begin_ns = times_ns[first]
    taken, due_ns, steps, last = [begin_ns], begin_ns + step_ns, 0, 0
    # a series without enough frames for its periods is no result: one long pause contains thousands of periods
    steps_max = int(len(times_ns) / COVERED) + 1
    while due_ns <= times_ns[-1] + limit_ns and steps <= steps_max:
        steps += 1
        place = bisect_left(times_ns, due_ns)
        near_ns = min(times_ns[max(place - 1, 0) : place + 1], key=lambda t_ns: abs(t_ns - due_ns))
        if abs(near_ns - due_ns) <= limit_ns and near_ns > taken[-1]:
            taken.append(near_ns)
            last = steps
            due_ns += int(FOLLOW * (near_ns - due_ns))
            if steps >= LEAST // 2:
                step_ns = (near_ns - begin_ns) // steps
        due_ns += step_ns
    return taken, last, steps + 1


class _Watch:
    """Arrivals of one kind of frame. Synchronization: one thread."""

    __slots__ = ("_extras_ns", "_frames", "_windows", "periods_ns", "slow_ns")

    def __init__(self) -> None:
        self.periods_ns: Sequence[int] = ()  # periods of the devices, in a window; empty for one device
        self.slow_ns: Sequence[int] = ()  # the same with devices that send few frames in a window
        self._windows = 0  # number of consecutive windows that contradict `periods_ns`
        self._frames: list[tuple[int, int | None]] = []  # arrival times and SIDs of the window
        self._extras_ns: deque[int] = deque(maxlen=2 * EXTRAS)

    def add(self, t_ns: int, sid: int | None) -> None:
        """Add a frame."""
        self._frames.append((t_ns, sid))
        if len(self._frames) == WINDOW:
            frames, self._frames = sorted(self._frames, key=lambda frame: frame[0]), []
            self._examine([t_ns for t_ns, _ in frames], _in_order([sid for _, sid in frames]))

    def _examine(self, times_ns: Sequence[int], in_order: Sequence[bool]) -> None:
        span_ns = times_ns[-1] - times_ns[0]
        together_ns = min(TOGETHER * span_ns / WINDOW, TOGETHER_NS)
        pairs = [pair for pair in pairwise(times_ns) if pair[1] - pair[0] < together_ns]
        alone = sorted(set(times_ns).difference(after for _, after in pairs))
        series, left = series_of(alone) if len(alone) > LEAST else ((), alone)
        found: Sequence[int] = ()
        if sum(in_order) < IN_ORDER * WINDOW and (len(series) != 1 or len(left) > (1 - FULL) * len(alone)):
            found = _periods_of(series_of(times_ns)[0], times_ns, set(chain(*pairs)))
        self._windows = self._windows + 1 if bool(found) is not bool(self.periods_ns) else 0
        if self._windows >= WINDOWS or (found and self.periods_ns):
            self.periods_ns, self._windows = found, 0
        fast_ns = series[0].period_ns if series else 0
        if not series or len(series[0].times_ns) < max(FULL * series[0].periods, COVERED * len(alone)):
            self._extras_ns.clear()
        elif not found:
            others = {t_ns for one in series[1:] for t_ns in one.times_ns}.union(left)
            extras = [t_ns for t_ns, is_in in zip(times_ns, in_order, strict=True) if t_ns in others and not is_in]
            if len(extras) < 2 * (len(alone) - span_ns / fast_ns - 1):
                self._extras_ns += extras
        self._examine_extras(fast_ns, times_ns[-1])

    def _examine_extras(self, fast_ns: int, now_ns: int) -> None:
        """Look for the devices that send few frames in a window."""
        times_ns = self._extras_ns
        self.slow_ns = ()
        if len(times_ns) < EXTRAS:
            return
        series, _ = series_of(sorted(times_ns))  # the arrival times of a forged recording can fall
        found = _periods_of([FrameSeries(0, (), 0), *series], times_ns, ())
        if found and now_ns - times_ns[-1] > EXTRAS_END * found[-1]:
            times_ns.clear()
        elif found:
            self.slow_ns = (fast_ns, *found[1:])


def _in_order(sids: Sequence[int | None]) -> Sequence[bool]:
    """Return for each frame whether its SID continues the SID before, and the next SID continues its SID."""
    steps = [None if a is None or b is None else b - a for a, b in pairwise(sids)]
    usual = mode(steps)
    if not usual:
        return [False] * len(sids)
    return [before == after == usual for before, after in pairwise([usual, *steps, usual])]


def _periods_of(series: Sequence[FrameSeries], times_ns: Sized, together: Container[int]) -> Sequence[int]:
    """Return the periods of several devices, the shortest first; an empty sequence for one device.

    `together`: frames that arrived immediately before or after another frame: at most one series.
    """
    apart = [one for one in series if 2 * sum(t_ns in together for t_ns in one.times_ns) <= len(one.times_ns)]
    apart += [one for one in series if one not in apart][:1]
    taken, periods = sum(len(one.times_ns) for one in series), sum(one.periods for one in series)
    if len(apart) < 2 or taken < FULL * max(periods, len(times_ns)):
        return ()
    # delayed frames of one device leave holes in the fastest series
    fastest = series[0]
    others = len(times_ns) - len(fastest.times_ns)
    if 2 * (fastest.periods - len(fastest.times_ns)) > others or _are_even(apart):
        return ()
    return sorted(one.period_ns for one in apart)


def _are_even(series: Sequence[FrameSeries]) -> bool:
    """Return whether series of equal periods have even phases: they can be one device with unsteady frames."""
    period_ns, begin_ns, count = series[0].period_ns, series[0].times_ns[0] if series[0].times_ns else 0, len(series)
    if any(abs(one.period_ns - period_ns) > EQUAL * period_ns for one in series):
        return False
    step_ns = period_ns / count
    phases_ns = sorted(median((t_ns - begin_ns + step_ns / 2) % period_ns for t_ns in one.times_ns) for one in series)
    late_ns = [phase_ns - place * step_ns for place, phase_ns in enumerate(phases_ns)]
    return max(late_ns) - min(late_ns) <= 2 * TOLERANCE * step_ns


# --- values of devices whose frames have equal distances --------------------------------------------------------

VALUES: Final = 256  # number of values in a fixed order after which several devices have the same address
SETTLE: Final = 32  # number of values over which the order is averaged
ANGLE_LEAST_RAD, ACCEL_LEAST_M_S2 = 0.02, 5.0  # minimum differences of the values of two devices; vibration is smaller
STABLE: Final = 4  # minimum ratio of the difference of the devices to the change of each device


class _Order:
    """Numbers of several devices that arrive in a fixed order. Synchronization: one thread."""

    __slots__ = ("_mean", "_place", "count")

    def __init__(self, devices: int) -> None:
        self.count = 0  # number of numbers in a fixed order
        self._mean = [0.0] * devices  # mean difference of the number of each device to the mean of all devices
        self._place = 0

    @property
    def is_found(self) -> bool:
        return self.count >= VALUES

    def add(self, numbers: Sequence[float], least: float) -> None:
        """Add the last of `numbers`. `least`: minimum difference of the numbers of two devices."""
        mean, place, count = self._mean, self._place, self.count
        newest = numbers[-len(mean) :]
        offset = newest[-1] - sum(newest) / len(newest)
        spread = max(newest) - min(newest)
        self._place = (place + 1) % len(mean)
        change = offset - mean[place]
        mean[place] += change / min(count // len(mean) + 1, SETTLE)
        if spread >= least and (STABLE * abs(change) < spread or count < len(mean)):
            self.count = min(count + 1, 2 * VALUES)
        elif count:
            self.count -= 1 if self.is_found else count


class ValueOrder:
    """Values of consecutive samples that repeat in a fixed order. Synchronization: one thread."""

    def __init__(self) -> None:
        self._least = ANGLE_LEAST_RAD, ANGLE_LEAST_RAD, ACCEL_LEAST_M_S2
        self._newest = [deque([0.0] * SERIES_MOST, maxlen=SERIES_MOST) for _ in self._least]
        self._orders = [[_Order(devices) for devices in range(2, SERIES_MOST + 1)] for _ in self._least]
        self._counts = [False] * len(self._orders)  # whether an order of the kind has numbers
        self._yaw = 0.0

    @property
    def is_found(self) -> bool:
        return any(order.is_found for orders in self._orders for order in orders)

    def add(self, m: Measurement) -> None:
        """Add a measurement."""
        if m.euler_rad is not None:
            roll, pitch, yaw = m.euler_rad
            if isfinite(yaw):
                self._yaw += remainder(yaw - self._yaw, tau)
                self._add(0, self._yaw)
            self._add(1, roll + 2 * pitch)
        if m.accel_m_s2 is not None:
            x, y, z = m.accel_m_s2
            self._add(2, x + 2 * y + 3 * z)

    def _add(self, kind: int, number: float) -> None:
        if not isfinite(number):
            return
        newest, least = self._newest[kind], self._least[kind]
        newest.append(number)
        if self._counts[kind] or max(newest) - min(newest) >= least:  # usually the values of one device are near
            numbers = list(newest)
            for order in self._orders[kind]:
                order.add(numbers, least)
            self._counts[kind] = any(order.count for order in self._orders[kind])


class SameAddress:
    """Detection of several devices with the address of one device. Synchronization: one thread."""

    def __init__(self) -> None:
        self._watches: dict[int, _Watch] = {}
        self._values = ValueOrder()

    @property
    def problem(self) -> str:
        """Address conflict that the frames show, one sentence; empty without a conflict."""
        for watch in self._watches.values():
            if periods_ns := watch.periods_ns or watch.slow_ns:
                periods = ", ".join(f"{period_ns / NS_PER_MS:.1f} ms" for period_ns in periods_ns)
                return f"frames arrive in {len(periods_ns)} series with the periods {periods}; {QUESTION}"
        if self._values.is_found:
            return f"the values of consecutive samples repeat in a fixed order; {QUESTION}"
        return ""

    def add_frame(self, kind: int, t_ns: int, sid: int | None) -> None:
        """Add a frame that is not a repetition by the bus."""
        watch = self._watches.get(kind)
        if watch is None:
            watch = self._watches[kind] = _Watch()
        watch.add(t_ns, sid)

    def add_values(self, m: Measurement) -> None:
        """Add a measurement."""
        self._values.add(m)
