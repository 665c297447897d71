"""Schedules of reads: at absolute deadlines, in turns with other devices, or at the edges of a data-ready line.

Deadlines (`Schedule`) do not drift; those that were not kept are counted. Turns (`RoundRobin`) are for a line that
several devices share and that is to be used as much as it allows. Edges (`ReadySchedule`) fall back to deadlines:

    edges ──none for QUIET_NS, and for three intervals──▶ deadlines ──two within QUIET_NS──▶ edges
"""

from collections import deque
from collections.abc import Sequence
from typing import Final, Protocol

from imud.signals.ready_edges import QUIET_NS
from imud.units import NS_PER_S

LATE_SHARE: Final = 4
"""A read that begins later than a quarter of its period counts as late."""
QUIET_INTERVALS: Final = 3
UNMATCHED_MOST: Final = 64
"""Reads whose edges are not known yet; the oldest are forgotten, and not counted."""


class Deadlines:
    """Counters of kept and missed deadlines, over all schedules of a device."""

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
        """Longest time from deadline to read."""

    def served(self, late_ns: int, limit_ns: int) -> None:
        """Count a read by its delay after its deadline; longer than `limit_ns` is late."""
        self.polls += 1
        self.sum_late_ns += late_ns
        self.late += late_ns > limit_ns
        self.worst_ns = max(self.worst_ns, late_ns)


class Timetable(Protocol):
    """Timetable of a device's reads."""

    due_ns: int
    """CLOCK_MONOTONIC; the lowest on a bus comes first."""

    def begun(self, start_ns: int, /) -> None:
        """Count the read that begins."""
        ...

    def done(self, now_ns: int, /) -> None:
        """Set `due_ns` to that of the next read: one is over."""
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
        """Count the read for the present deadline."""
        self.counts.served(start_ns - self.due_ns, self._late_ns)

    def done(self, now_ns: int) -> None:
        """Go to the next deadline that can still be kept, and count those passed over."""
        due_ns, period_ns = self.due_ns + self.period_ns, self.period_ns
        if due_ns + period_ns <= now_ns:  # less late than a period, the next is still worth reading
            passed = (now_ns - due_ns) // period_ns
            self.counts.missed += passed
            due_ns += passed * period_ns
        self.due_ns = due_ns


class RoundRobin:
    """Turns instead of deadlines: every device is due at once, the one that waited longest comes first. Nothing is late
    or missed. Synchronization: the bus's thread."""

    __slots__ = ("counts", "due_ns", "period_ns")

    def __init__(self, begin_ns: int, counts: Deadlines) -> None:
        self.period_ns = 0
        """No-op: there are no deadlines."""
        self.counts = counts
        self.due_ns = begin_ns
        """End of the device's last turn (CLOCK_MONOTONIC): the lowest of all members is next."""

    def begun(self, _start_ns: int) -> None:
        """Count the turn that begins."""
        self.counts.polls += 1

    def done(self, now_ns: int) -> None:
        """Queue behind all other devices: the turn is over."""
        self.due_ns = now_ns


class ReadySchedule:
    """Edges instead of deadlines. The first read is at once: a line that stays active until it is read makes no edge
    before that. Synchronization: the bus's thread; `by_edges` is read by any thread.

    An edge may be noticed (`noticed`) before its stamp is known (`on_edges`): one of both causes the read.
    """

    __slots__ = (
        "_deadlines", "_edge_ns", "_interval_ns", "_pending", "_start_ns", "_starts", "_unstamped",
        "by_edges", "counts", "due_ns",
    )  # fmt: skip

    def __init__(self, rate_hz: float, begin_ns: int, counts: Deadlines) -> None:
        """`rate_hz` is that of the deadlines."""
        self._deadlines = Schedule(rate_hz, begin_ns, counts)
        self._interval_ns = self._deadlines.period_ns
        self._edge_ns = begin_ns
        """The newest edge, or the beginning."""
        self._start_ns = 0
        """Begin of the newest read."""
        self._pending = True
        """Whether the newest edge was not read yet."""
        self._unstamped = False
        """Whether the stamp of the edge that is to be read is not known yet."""
        self._starts: deque[int] = deque(maxlen=UNMATCHED_MOST)
        """Begins of reads of such edges, oldest first."""
        self.counts = counts
        self.by_edges = True
        """False while deadlines take the place of edges."""
        self.due_ns = begin_ns
        """The edge that is to be read, or the deadline (CLOCK_MONOTONIC)."""

    @property
    def period_ns(self) -> int:
        """Time between two reads, as it is now."""
        return self._interval_ns if self.by_edges else self._deadlines.period_ns

    def noticed(self, now_ns: int) -> None:
        """Read at once: an edge came, whose stamp is not known yet."""
        if self.by_edges:
            self._pending = self._unstamped = True
            self.due_ns = self._edge_ns = now_ns

    def has_read(self, t_ns: int) -> bool:
        """Whether a read began after this edge. From any thread."""
        return t_ns <= self._start_ns

    def on_edges(self, times_ns: Sequence[int], interval_ns: int) -> None:
        """Note edges, oldest first, and the time between the two newest."""
        t_ns = times_ns[-1]
        self._count_reads(times_ns, interval_ns)
        if not self.by_edges and t_ns - self._edge_ns > QUIET_NS:  # one alone may be a disturbance
            self._edge_ns = t_ns
            return
        self.by_edges = True
        self._edge_ns, self._interval_ns = t_ns, interval_ns
        if t_ns > self._start_ns:
            self._pending, self._unstamped, self.due_ns = True, False, t_ns
        elif not self._unstamped:
            self._wait()

    def begun(self, start_ns: int) -> None:
        """Count a read that begins: of the newest edge, or since there is none."""
        self._start_ns = start_ns
        if self.by_edges and not self._pending:
            self.by_edges = False
            self._deadlines.due_ns = start_ns
        if not self.by_edges:
            self._deadlines.begun(start_ns)
            return
        if self._unstamped:
            self._unstamped = False
            self._starts.append(start_ns)
        else:
            self.counts.served(start_ns - self.due_ns, self._interval_ns // LATE_SHARE)

    def done(self, now_ns: int) -> None:
        """Wait for the next edge or deadline."""
        if self.by_edges:
            self._wait()
        else:
            self._deadlines.done(now_ns)
            self.due_ns = self._deadlines.due_ns

    def _count_reads(self, times_ns: Sequence[int], interval_ns: int) -> None:
        """Count reads of edges that were noticed, by their stamps: each is of the newest edge before it."""
        starts, at = self._starts, 0
        while starts and at < len(times_ns):
            start_ns, edge_ns = starts.popleft(), 0
            while at < len(times_ns) and times_ns[at] <= start_ns:
                edge_ns, at = times_ns[at], at + 1
            if edge_ns:  # else it is of none
                self.counts.served(start_ns - edge_ns, interval_ns // LATE_SHARE)

    def _wait(self) -> None:
        self._pending = False
        self.due_ns = self._edge_ns + max(QUIET_NS, QUIET_INTERVALS * self._interval_ns)
