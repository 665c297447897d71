"""Divided pulses (SOUT_DIV), each with the sample it belongs to: cameras are triggered by them."""

from collections import deque
from collections.abc import Iterable
from typing import Final

from imud.clock.pulses import Stamp
from imud.contracts.timing import Mark

REACH: Final = 0.5
"""Share of a period; a sample further off is another one."""
KEPT: Final = 1024
"""Marks that nobody takes, and pulses whose sample does not come."""


class Marks:
    """Pulses that wait for their sample, and those that have it."""

    __slots__ = ("_waiting", "found")

    def __init__(self) -> None:
        self._waiting: deque[Stamp] = deque(maxlen=KEPT)
        self.found: deque[Mark] = deque(maxlen=KEPT)

    def give(self, pulses: Iterable[Stamp]) -> None:
        """Rising edges in their order, before the messages that follow them."""
        self._waiting.extend(pulses)

    def take(self, t_ns: int, seq: int, period_ns: float) -> None:
        """Sample `seq`, whose pulse was or would have been at `t_ns`; samples in their order."""
        waiting, reach = self._waiting, REACH * period_ns
        if not period_ns:
            return
        while waiting and waiting[0][0] < t_ns + reach:
            at_ns, number = waiting.popleft()
            self.found.append(Mark(at_ns, number, seq if at_ns >= t_ns - reach else None))
