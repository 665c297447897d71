"""How often the bursts of a device come, and how many did not come at all: told by time, because nothing counts them.

A burst that is late may have been held up together with those behind it, which then come sooner than the rate allows
and make up for it; only lateness that stays is loss. So the answer comes two bursts after the gap.
"""

from statistics import median
from typing import Final

from imud.units import NS_PER_MS, NS_PER_S

SILENCE_NS: Final = NS_PER_S
"""A longer gap is silence of the device, not loss."""
PERIOD_LEAST_NS: Final = NS_PER_MS
"""No device sends faster than 1 kHz."""
STEADY_BURSTS: Final = 2
"""So many bursts at the usual distance show that nothing more is made up for."""
ODD_BURSTS: Final = 8
"""So many distances in a row that are all shorter, or all longer, and within 1/4 of each other, are another rate."""
SMOOTHING: Final = 16
"""Weight of what is known of the period against one more distance."""


class Cadence:
    """Period and missing bursts of one device. Synchronization: one thread."""

    __slots__ = ("_late_ns", "_newest_ns", "_odd_ns", "_silent", "_steady", "period_ns")

    def __init__(self, period_ns: int, newest_ns: int) -> None:
        """`newest_ns`: arrival of the newest burst."""
        self.period_ns = max(period_ns, PERIOD_LEAST_NS)
        """Between two bursts."""
        self._newest_ns = newest_ns
        self._late_ns = 0
        """Lateness that may still be made up for."""
        self._silent = False
        self._steady = 0
        self._odd_ns: list[int] = []

    @property
    def is_late(self) -> bool:
        """Whether a gap is not settled yet."""
        return self._late_ns > 0

    def begin(self, t_ns: int) -> tuple[int, int]:
        """A burst begins to arrive: returns how many bursts are now known to be missing in a gap before it (`is_late`
        since), and how many of those are loss."""
        step_ns, period_ns = t_ns - self._newest_ns, self.period_ns
        self._newest_ns = t_ns
        if 4 * step_ns > 5 * period_ns:
            self._long(step_ns)
            return 0, 0
        if 4 * step_ns < 3 * period_ns:
            self._short(step_ns)
            return 0, 0
        self.period_ns += (step_ns - period_ns) // SMOOTHING
        self._odd_ns.clear()
        if not self._late_ns:
            return 0, 0
        self._late_ns += min(0, step_ns - period_ns)
        self._steady += 1
        return self._settle() if self._steady >= STEADY_BURSTS else (0, 0)

    def _long(self, step_ns: int) -> None:
        self._late_ns += step_ns - self.period_ns
        self._silent |= step_ns > SILENCE_NS
        self._steady = 0
        self._take_odd(step_ns, 1)

    def _short(self, step_ns: int) -> None:
        made_up_ns = self.period_ns - step_ns
        self._steady = 0
        if self._late_ns:
            self._late_ns = max(0, self._late_ns - made_up_ns)
            self._odd_ns.clear()
        else:
            self._take_odd(step_ns, -1)

    def _take_odd(self, step_ns: int, side: int) -> None:
        """Another rate is taken over; what was late by the old one was not."""
        odd = self._odd_ns
        if odd and ((odd[0] - self.period_ns) * side < 0 or 4 * abs(step_ns - odd[0]) > odd[0]):
            odd.clear()
        odd.append(step_ns)
        if len(odd) >= ODD_BURSTS:
            self.period_ns = max(int(median(odd)), PERIOD_LEAST_NS)
            self._late_ns, self._silent = 0, False
            odd.clear()

    def _settle(self) -> tuple[int, int]:
        missed = (2 * self._late_ns + self.period_ns) // (2 * self.period_ns)
        lost = 0 if self._silent else missed
        self._late_ns, self._silent, self._steady = 0, False, 0
        return missed, lost
