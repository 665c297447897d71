"""The host's two clocks as one object: CLOCK_MONOTONIC, and how far CLOCK_REALTIME is ahead of it.

The kernel slews both clocks together, so their difference changes only when the wall clock is stepped. A reading of
the pair takes two calls; a thread that is preempted between them would see the difference too large by the time it was
away. So a difference that was measured tightly is kept, and what is read later only checks it, at the cost of one call:

    realtime now, less a monotonic reading made just before:
        0 to CHECK_NS above the kept difference ──▶ the kept one
        outside, or kept for KEPT_NS ──▶ monotonic, realtime, monotonic: the tightest of READINGS

A step of the wall clock by more than CHECK_NS is therefore seen by the next reading, a smaller one within KEPT_NS.
"""

from collections.abc import Callable
from time import monotonic_ns, time_ns
from typing import Final

from imud.units import NS_PER_S, NS_PER_US

READINGS: Final = 5
"""Most readings of one measurement."""
TIGHT_NS: Final = 1 * NS_PER_US
"""A reading whose two readings of CLOCK_MONOTONIC are no further apart is used at once."""
CHECK_NS: Final = 100 * NS_PER_US
"""From a read to the end of its decoding; longer costs a new measurement and nothing else."""
KEPT_NS: Final = 1 * NS_PER_S


class HostClock:
    """Reader of the host's clocks. Synchronization: `now_ns` any thread, the rest one thread."""

    __slots__ = ("_due_ns", "_least_ns", "_most_ns", "_offset_ns", "_realtime_ns", "error_ns", "now_ns")

    def __init__(
        self, monotonic_ns: Callable[[], int] = monotonic_ns, realtime_ns: Callable[[], int] = time_ns
    ) -> None:
        self.now_ns = monotonic_ns
        """CLOCK_MONOTONIC, ns."""
        self.error_ns = 0
        """Bound of the error of the kept difference, ns: half of the time that its measurement took."""
        self._realtime_ns = realtime_ns
        self._offset_ns = self._least_ns = self._most_ns = 0
        self._due_ns = -1 << 63

    def utc_offset_ns(self, just_now_ns: int) -> int:
        """CLOCK_REALTIME minus CLOCK_MONOTONIC, ns; `just_now_ns` is CLOCK_MONOTONIC as it was read last."""
        seen_ns = self._realtime_ns() - just_now_ns
        if just_now_ns >= self._due_ns or not self._least_ns <= seen_ns <= self._most_ns:
            self._measure()
        return self._offset_ns

    def _measure(self) -> None:
        now_ns, realtime_ns = self.now_ns, self._realtime_ns
        best_ns = after_ns = 0
        for number in range(READINGS):
            before_ns = now_ns()
            real_ns = realtime_ns()
            after_ns = now_ns()
            took_ns = after_ns - before_ns
            if number == 0 or took_ns < best_ns:
                best_ns, self._offset_ns = took_ns, real_ns - (before_ns + after_ns) // 2
            if best_ns <= TIGHT_NS:
                break
        self.error_ns = (best_ns + 1) // 2
        self._least_ns, self._most_ns = self._offset_ns - TIGHT_NS, self._offset_ns + CHECK_NS
        self._due_ns = after_ns + KEPT_NS
