"""Host clocks as one object: CLOCK_MONOTONIC, the offset of CLOCK_REALTIME, and the steering by an NTP client.

An NTP client slews CLOCK_MONOTONIC and CLOCK_REALTIME together, by up to 500 ppm (chronyd: 83,333 ppm). It steps only
CLOCK_REALTIME. Nothing slews or steps CLOCK_MONOTONIC_RAW. A reading of several clocks needs several calls. If the
thread is preempted between two calls, the difference of the clocks is too large. imud therefore keeps the result of a
fast reading. Each read of a device only checks the result with two calls:

    realtime minus raw, one read immediately after the other
        within TOLERANCE_NS of the kept result ──▶ kept result
        otherwise, or older than KEPT_NS ──▶ monotonic, realtime, raw, monotonic: the fastest of READINGS

A suspend stops CLOCK_MONOTONIC and CLOCK_MONOTONIC_RAW and steps CLOCK_REALTIME; CLOCK_BOOTTIME distinguishes a suspend
from a step. The next read of a device detects a step or the start of a slew. On a kernel without CLOCK_MONOTONIC_RAW
(not Linux), imud uses CLOCK_MONOTONIC and does not detect steering.
"""

import time
from bisect import bisect_right
from collections.abc import Callable
from functools import partial
from math import sqrt
from time import monotonic_ns, time_ns
from typing import Final

from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

EVEN_NS: Final = 1 * NS_PER_US  # change of the offset that imud ignores, in addition to the errors of the pairs, ns
# Maximum number of pairs: 4 s of a device at 1 kHz while CLOCK_MONOTONIC is slewed, otherwise hours
PAIRS_MOST: Final = 4096
RATE_NS: Final = 2 * NS_PER_S  # time span of the rate, ns; shorter if fewer pairs exist
# standard deviation of a uniform distribution with range 1
SIGMA_OF_RANGE: Final = 1 / sqrt(12)


class SteadyTime:
    """Conversion between CLOCK_MONOTONIC and steady time; equal without pairs. Synchronization: none."""

    __slots__ = ("_base_ns", "_even", "_monotonic", "_offsets", "_steady", "even_from_ns", "offset_ns")

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget all pairs."""
        self.offset_ns = 0  # CLOCK_MONOTONIC minus steady time at the newest pair
        # Steady time after which `offset_ns` is exact within 1 µs. Later times need no call.
        self.even_from_ns = -1 << 63
        self._base_ns = 0  # steady time minus CLOCK_MONOTONIC_RAW
        self._steady: list[int] = []
        self._monotonic: list[int] = []
        self._offsets: list[int] = []
        self._even = 0  # index of the pair at `even_from_ns`

    def add_pair(self, monotonic_ns: int, raw_ns: int, held_raw_ns: int = 0, error_ns: int = 0) -> None:
        """Add a reading of CLOCK_MONOTONIC and CLOCK_MONOTONIC_RAW at the same instant, within `error_ns`. At
        `held_raw_ns`, the offset was still the offset of the newest pair. Ignored if it is older than that pair."""
        if not self._steady:
            self._base_ns = monotonic_ns - raw_ns
        elif self._steady[-1] < held_raw_ns + self._base_ns < raw_ns + self._base_ns:
            self._append(held_raw_ns + self._base_ns, self._offsets[-1])
        self._append(raw_ns + self._base_ns, monotonic_ns - raw_ns - self._base_ns)
        offsets, even, most_ns = self._offsets, self._even, EVEN_NS + 2 * error_ns
        self.offset_ns = offset_ns = offsets[-1]
        while abs(offsets[even] - offset_ns) > most_ns:
            even += 1
        self._even, self.even_from_ns = even, self._steady[even]

    def steady_ns(self, monotonic_ns: int) -> int:
        """Return the steady time at `monotonic_ns` of CLOCK_MONOTONIC, past or future."""
        return monotonic_ns - self._offset(self._monotonic, monotonic_ns)

    def monotonic_ns(self, steady_ns: int) -> int:
        """Return CLOCK_MONOTONIC at a steady time, past or future."""
        return steady_ns + self._offset(self._steady, steady_ns)

    def error_ns(self, steady_ns: int) -> float:
        """Return the one-sigma error of a conversion. The time of a rate change between two pairs is not known."""
        steady, offsets = self._steady, self._offsets
        after = bisect_right(steady, steady_ns)
        if not 1 < after < len(steady):
            return 0.0
        rates = [
            (offsets[i] - offsets[i - 1]) / (steady[i] - steady[i - 1])
            for i in range(after - 1, min(after + 2, len(steady)))
        ]
        return (max(rates) - min(rates)) * (steady[after] - steady[after - 1]) * SIGMA_OF_RANGE

    @property
    def rate(self) -> float:
        """Rate of CLOCK_MONOTONIC relative to steady time minus 1, over the last RATE_NS."""
        steady, offsets = self._steady, self._offsets
        if len(steady) < 2:
            return 0.0
        first = max(bisect_right(steady, steady[-1] - RATE_NS) - 1, 0)
        return (offsets[-1] - offsets[first]) / (steady[-1] - steady[first])

    def _append(self, steady_ns: int, offset_ns: int) -> None:
        steady, monotonic, offsets = self._steady, self._monotonic, self._offsets
        if len(steady) >= PAIRS_MOST:
            del steady[: PAIRS_MOST // 2], monotonic[: PAIRS_MOST // 2], offsets[: PAIRS_MOST // 2]
            self._even = max(self._even - PAIRS_MOST // 2, 0)
        if steady and steady_ns <= steady[-1]:  # two readings of the clock within one tick
            steady_ns = steady[-1] + 1
        steady.append(steady_ns)
        monotonic.append(steady_ns + offset_ns)
        offsets.append(offset_ns)

    def _offset(self, times: list[int], at_ns: int) -> int:
        """Return the offset at a time. `times` contains the times of the pairs by one of the clocks."""
        offsets = self._offsets
        after = bisect_right(times, at_ns)
        # later than the newest pair: constant offset
        if after == len(times):
            return self.offset_ns
        # earlier than the oldest pair
        if not after:
            return offsets[0]
        before_ns, before = times[after - 1], offsets[after - 1]
        return before + (offsets[after] - before) * (at_ns - before_ns) // (times[after] - before_ns)


UNSTEERED: Final = SteadyTime()  # Steady time of a clock without steering. No caller adds pairs to it.

READINGS: Final = 5  # maximum number of readings in one measurement
# Time between the two readings of CLOCK_MONOTONIC, ns, below which imud uses a reading immediately
TIGHT_NS: Final = 1 * NS_PER_US
# Change of the difference that imud ignores, in addition to the error of the measurement, ns
TOLERANCE_NS: Final = 1 * NS_PER_US
# time after which imud measures again
KEPT_NS: Final = 1 * NS_PER_S


# Minimum lead of CLOCK_BOOTTIME over CLOCK_MONOTONIC that counts as a suspend, ns
SUSPENDED_NS: Final = 100 * NS_PER_MS


def kernel_clock(name: str) -> Callable[[], int]:
    """Return a function that reads CLOCK_`name`; CLOCK_MONOTONIC if the clock does not exist."""
    try:
        read = partial(time.clock_gettime_ns, getattr(time, f"CLOCK_{name}"))
        read()
    except (AttributeError, OSError):
        return monotonic_ns
    return read


class HostClock:
    """Reader of the host clocks. Synchronization: `now_ns` and `kept_utc_offset_ns` from any thread, all other
    methods from one thread."""

    __slots__ = (
        "_asleep_ns", "_boottime_ns", "_due_ns", "_held_ns", "_least_ns", "_most_ns", "_offset_ns", "_raw_ns",
        "_realtime_ns", "error_ns", "now_ns", "on_measured", "steady", "suspends",
    )  # fmt: skip

    def __init__(
        self,
        monotonic_ns: Callable[[], int] = monotonic_ns,
        realtime_ns: Callable[[], int] = time_ns,
        raw_ns: Callable[[], int] | None = None,
        boottime_ns: Callable[[], int] | None = None,
    ) -> None:
        """`raw_ns` reads a clock without steering, `boottime_ns` a clock that continues during a suspend. None:
        CLOCK_MONOTONIC_RAW and CLOCK_BOOTTIME. With `raw_ns` only, imud does not detect a suspend."""
        self.now_ns = monotonic_ns  # CLOCK_MONOTONIC, ns
        self.error_ns = 0  # maximum error of the kept offset, ns: half of the duration of its measurement
        # CLOCK_MONOTONIC relative to a time without steering, as of the last `utc_offset_ns`
        self.steady: Final = SteadyTime()
        self._realtime_ns = realtime_ns
        self._raw_ns = raw_ns or kernel_clock("MONOTONIC_RAW")
        self._boottime_ns = boottime_ns or (monotonic_ns if raw_ns else kernel_clock("BOOTTIME"))
        self.suspends = 0  # number of suspends since the first reading, as of the last `utc_offset_ns`
        # Receives each pair of `steady` after a measurement: CLOCK_MONOTONIC, raw, and held raw
        self.on_measured: Callable[[int, int, int], None] | None = None
        self._asleep_ns = self._boottime_ns() - monotonic_ns()
        self._offset_ns = 0
        self._least_ns, self._most_ns = 1, 0  # empty range: the first read measures
        self._held_ns = 0
        self._due_ns = -1 << 63

    @property
    def is_steering_seen(self) -> bool:
        """Whether the host has a clock without steering."""
        return self._raw_ns is not self.now_ns

    def utc_offset_ns(self) -> int:
        """Return CLOCK_REALTIME minus CLOCK_MONOTONIC, ns. Update `steady`. Call this method between a reading of
        CLOCK_MONOTONIC and its conversion by `steady`."""
        realtime, raw = self._realtime_ns, self._raw_ns  # a call of a function in an attribute of `self` is slower
        ahead_ns = realtime() - (raw_ns := raw())
        if self._least_ns <= ahead_ns <= self._most_ns and raw_ns < self._due_ns:
            self._held_ns = raw_ns
        else:
            self._measure()
        return self._offset_ns

    def kept_utc_offset_ns(self) -> int:
        """Return the result of the last `utc_offset_ns`, without a reading. Any thread may call this method."""
        return self._offset_ns

    def utc_ns(self) -> int:
        """Return CLOCK_REALTIME, ns."""
        return self.now_ns() + self.utc_offset_ns()

    def kept(self) -> tuple[int, int]:
        """Return the kept value of CLOCK_REALTIME minus CLOCK_MONOTONIC, ns, and the number of suspends."""
        return self._offset_ns, self.suspends

    def _measure(self) -> None:
        now_ns, realtime_ns, raw_ns = self.now_ns, self._realtime_ns, self._raw_ns
        best_ns = best_monotonic_ns = best_realtime_ns = best_raw_ns = 0
        for number in range(READINGS):
            before_ns, real, raw, after_ns = now_ns(), realtime_ns(), raw_ns(), now_ns()
            took_ns = after_ns - before_ns
            if number == 0 or took_ns < best_ns:
                best_ns, best_monotonic_ns = took_ns, (before_ns + after_ns) // 2
                best_realtime_ns, best_raw_ns = real, raw
            if best_ns <= TIGHT_NS:
                break
        error_ns, offset_ns = (best_ns + 1) // 2, best_realtime_ns - best_monotonic_ns
        if error_ns <= self.error_ns or abs(offset_ns - self._offset_ns) > error_ns + self.error_ns:
            self._offset_ns = offset_ns  # more exact measurement, or a step of CLOCK_REALTIME
        self.error_ns = error_ns
        held_ns = self._held_ns
        self.steady.add_pair(best_monotonic_ns, best_raw_ns, held_ns, error_ns)
        ahead_ns, tolerance_ns = best_realtime_ns - best_raw_ns, TOLERANCE_NS + best_ns
        self._least_ns, self._most_ns = ahead_ns - tolerance_ns, ahead_ns + tolerance_ns
        self._held_ns, self._due_ns = best_raw_ns, best_raw_ns + KEPT_NS
        asleep_ns = self._boottime_ns() - now_ns()  # a preemption makes the difference smaller, never larger
        self.suspends += asleep_ns > self._asleep_ns + SUSPENDED_NS
        self._asleep_ns = max(self._asleep_ns, asleep_ns)
        if self.on_measured is not None:
            self.on_measured(best_monotonic_ns, best_raw_ns, held_ns)
