"""Steady time: CLOCK_MONOTONIC without its steering, and the conversion between the two.

Steady time runs as CLOCK_MONOTONIC_RAW and begins with the value of CLOCK_MONOTONIC. A clock of a device is fitted
against it, because a line from device time to a clock that is slewed is no line. `offset` = CLOCK_MONOTONIC less steady
time is known at pairs of readings, and linear between them:

    offset            ┌── pair     a pair wherever the offset has changed by a µs, after one of the last time
          ────────────┘            at which it was as before; a time between two pairs is interpolated
           steady time ──▶

Most times that are converted are some ms old, and most hosts are steered by some ppm: then the offset of the newest
pair holds, at the cost of an addition (`even_from_ns`). After the newest pair the offset is its own: whoever reads the
clocks adds a pair as soon as that is wrong. Nothing here reads a clock.
"""

from bisect import bisect_right
from math import sqrt
from typing import Final

from imud.units import NS_PER_S, NS_PER_US

EVEN_NS: Final = 1 * NS_PER_US
"""Change of the offset that may be left out, beside the errors of the pairs."""
PAIRS_MOST: Final = 4096
"""4 s of a device at 1 kHz while CLOCK_MONOTONIC is slewed, hours otherwise. Half of them go at a time."""
RATE_NS: Final = 2 * NS_PER_S
"""The rate is that of so much time, or of as much as is known."""
SIGMA_OF_RANGE: Final = 1 / sqrt(12)


class SteadyTime:
    """Conversion between CLOCK_MONOTONIC and steady time. Without pairs they are the same. Synchronization: none."""

    __slots__ = ("_base_ns", "_even", "_monotonic", "_offsets", "_steady", "even_from_ns", "offset_ns")

    def __init__(self) -> None:
        self.offset_ns = 0
        """CLOCK_MONOTONIC minus steady time at the newest pair."""
        self.even_from_ns = -1 << 63
        """Steady time from which `offset_ns` holds within a µs: what is later needs no call."""
        self._base_ns = 0
        """Steady time minus CLOCK_MONOTONIC_RAW."""
        self._steady: list[int] = []
        self._monotonic: list[int] = []
        self._offsets: list[int] = []
        self._even = 0
        """The pair at `even_from_ns`."""

    def add_pair(self, monotonic_ns: int, raw_ns: int, held_raw_ns: int = 0, error_ns: int = 0) -> None:
        """Add a reading of CLOCK_MONOTONIC and CLOCK_MONOTONIC_RAW at the same instant, within `error_ns`.

        At `held_raw_ns`, if that is later than the newest pair, the offset was still that of the newest pair.
        """
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
        """Return the steady time at which CLOCK_MONOTONIC was, or will be, `monotonic_ns`."""
        return monotonic_ns - self._offset(self._monotonic, monotonic_ns)

    def monotonic_ns(self, steady_ns: int) -> int:
        """Return what CLOCK_MONOTONIC was, or will be, at a steady time."""
        return steady_ns + self._offset(self._steady, steady_ns)

    def error_ns(self, steady_ns: int) -> float:
        """Return the one-sigma error of a conversion: when the rate changed between two pairs is not known."""
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
        """How much faster than steady time CLOCK_MONOTONIC ran over the last RATE_NS, per second."""
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
        if steady and steady_ns <= steady[-1]:  # a clock that is read faster than it ticks
            steady_ns = steady[-1] + 1
        steady.append(steady_ns)
        monotonic.append(steady_ns + offset_ns)
        offsets.append(offset_ns)

    def _offset(self, times: list[int], at_ns: int) -> int:
        """Return the offset at a time of `times`, which are those of the pairs by one of the clocks."""
        offsets = self._offsets
        after = bisect_right(times, at_ns)
        if after == len(times):
            return self.offset_ns
        if not after:
            return offsets[0]
        before_ns, before = times[after - 1], offsets[after - 1]
        return before + (offsets[after] - before) * (at_ns - before_ns) // (times[after] - before_ns)


UNSTEERED: Final = SteadyTime()
"""Of a clock that nothing steers, or of which nothing is known. Nobody adds pairs to it."""
