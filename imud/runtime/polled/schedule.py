"""When a device is read: at absolute deadlines, so that nothing drifts; deadlines that were not kept are counted.

Turns (`round_robin`) or data-ready edges (`ready_schedule`) can take the place of deadlines: all are a `Timetable`.
"""

from typing import Protocol

from imud.units import NS_PER_S

LATE_SHARE = 4
"""A read that begins later than a quarter of its period counts as late."""


class Deadlines:
    """How deadlines were kept, over all schedules of a device. Written by the bus's thread, read by any."""

    __slots__ = ("late", "missed", "polls", "sum_late_ns", "worst_ns")

    def __init__(self) -> None:
        self.polls = 0
        """Deadlines that were served, late or not."""
        self.late = 0
        """Of these, those served more than a quarter of a period late."""
        self.missed = 0
        """Deadlines that passed before the one before them was done: nothing was read for them."""
        self.sum_late_ns = 0
        """Time from deadline to read, summed over `polls`."""
        self.worst_ns = 0


class Timetable(Protocol):
    """Says when a device is read next."""

    due_ns: int
    """CLOCK_MONOTONIC; the lowest on a bus comes first."""

    def begun(self, start_ns: int, /) -> None:
        """That read begins."""
        ...

    def done(self, now_ns: int, /) -> None:
        """It is over: `due_ns` is that of the next."""
        ...


class Schedule:
    """Deadlines at `begin_ns` + n · period. Synchronization: the bus's thread."""

    __slots__ = ("_late_ns", "counts", "due_ns", "period_ns")

    def __init__(self, rate_hz: float, begin_ns: int, counts: Deadlines) -> None:
        self.period_ns = round(NS_PER_S / rate_hz)
        self._late_ns = self.period_ns // LATE_SHARE
        self.counts = counts
        self.due_ns = begin_ns
        """The next deadline (CLOCK_MONOTONIC)."""

    def begun(self, start_ns: int) -> None:
        """The read for the present deadline begins."""
        counts, late_ns = self.counts, start_ns - self.due_ns
        counts.polls += 1
        counts.sum_late_ns += late_ns
        counts.late += late_ns > self._late_ns
        counts.worst_ns = max(counts.worst_ns, late_ns)

    def done(self, now_ns: int) -> None:
        """It is over: go to the next deadline that can still be kept, and count those passed over."""
        due_ns, period_ns = self.due_ns + self.period_ns, self.period_ns
        if due_ns + period_ns <= now_ns:  # less late than a period, the next is still worth reading
            passed = (now_ns - due_ns) // period_ns
            self.counts.missed += passed
            due_ns += passed * period_ns
        self.due_ns = due_ns
