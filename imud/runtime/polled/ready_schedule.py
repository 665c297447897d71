"""When a device with a data-ready line is read: at its edges, and at deadlines while there are none.

    edges ──none for QUIET_NS, and for three intervals──▶ deadlines ──two within QUIET_NS──▶ edges

It is a `Timetable`. The first read is at once: a line that stays active until it is read makes no edge before that.
"""

from typing import Final

from imud.runtime.polled.schedule import LATE_SHARE, Deadlines, Schedule
from imud.signals.ready_edges import QUIET_NS

QUIET_INTERVALS: Final = 3


class ReadySchedule:
    """Edges instead of deadlines. Synchronization: the bus's thread; `by_edges` is read by any."""

    __slots__ = ("_deadlines", "_edge_ns", "_interval_ns", "_pending", "_start_ns", "by_edges", "counts", "due_ns")

    def __init__(self, rate_hz: float, begin_ns: int, counts: Deadlines) -> None:
        """`rate_hz` is that of the deadlines."""
        self._deadlines = Schedule(rate_hz, begin_ns, counts)
        self._interval_ns = self._deadlines.period_ns
        self._edge_ns = begin_ns
        """The newest edge, or the beginning."""
        self._start_ns = 0
        """When the newest read began."""
        self._pending = True
        """Whether the newest edge was not read yet."""
        self.counts = counts
        self.by_edges = True
        """False while deadlines take the place of edges."""
        self.due_ns = begin_ns
        """The edge that is to be read, or the deadline (CLOCK_MONOTONIC)."""

    @property
    def period_ns(self) -> int:
        """Time between two reads, as it is now."""
        return self._interval_ns if self.by_edges else self._deadlines.period_ns

    def seen(self, t_ns: int, interval_ns: int) -> None:
        """The newest edge, and the time between it and the one before."""
        if not self.by_edges and t_ns - self._edge_ns > QUIET_NS:  # one alone may be a disturbance
            self._edge_ns = t_ns
            return
        self.by_edges = True
        self._edge_ns, self._interval_ns = t_ns, interval_ns
        if t_ns > self._start_ns:
            self._pending, self.due_ns = True, t_ns
        else:
            self._wait()

    def begun(self, start_ns: int) -> None:
        """A read begins: of the newest edge, or since there is none."""
        self._start_ns = start_ns
        if self.by_edges and not self._pending:
            self.by_edges = False
            self._deadlines.due_ns = start_ns
        if not self.by_edges:
            self._deadlines.begun(start_ns)
            return
        counts, late_ns = self.counts, start_ns - self.due_ns
        counts.polls += 1
        counts.sum_late_ns += late_ns
        counts.late += late_ns > self._interval_ns // LATE_SHARE
        counts.worst_ns = max(counts.worst_ns, late_ns)

    def done(self, now_ns: int) -> None:
        """It is over: wait for the next edge or deadline."""
        if self.by_edges:
            self._wait()
        else:
            self._deadlines.done(now_ns)
            self.due_ns = self._deadlines.due_ns

    def _wait(self) -> None:
        self._pending = False
        self.due_ns = self._edge_ns + max(QUIET_NS, QUIET_INTERVALS * self._interval_ns)
