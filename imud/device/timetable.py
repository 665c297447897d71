"""Times of the reads of one polled device: at deadlines, in turns, or at the edges of a data-ready line."""

from collections import deque
from collections.abc import Sequence
from typing import Final, Protocol

from imud.model.units import NS_PER_S
from imud.sampling.path import QUIET_NS

LATE_SHARE: Final = 4  # a read counts as late if its delay exceeds the period divided by this number
QUIET_INTERVALS: Final = 3  # number of missing edges after which imud reads at deadlines
UNMATCHED_MOST: Final = 64  # maximum number of reads without a known edge. imud does not count older reads.


class Deadlines:
    """Counters of the deadlines of a device, over all of its schedules."""

    __slots__ = ("late", "missed", "polls", "sum_late_ns", "worst_ns")

    def __init__(self) -> None:
        self.polls = 0  # number of deadlines with a read
        self.late = 0  # number of late reads
        self.missed = 0  # number of deadlines without a read, because the previous read lasted too long
        self.sum_late_ns = 0  # sum of the delays of all reads, ns
        self.worst_ns = 0  # maximum delay of a read, ns

    def served(self, late_ns: int, limit_ns: int) -> None:
        """Count a read. It is late if its delay exceeds `limit_ns`."""
        self.polls += 1
        self.sum_late_ns += late_ns
        self.late += late_ns > limit_ns
        self.worst_ns = max(self.worst_ns, late_ns)


class Timetable(Protocol):
    """Times of the reads of a device."""

    due_ns: int  # CLOCK_MONOTONIC of the next read. The bus serves the device with the lowest value first.

    def begun(self, start_ns: int, /) -> None:
        """Count a read that starts."""
        ...

    def done(self, now_ns: int, /) -> None:
        """Set `due_ns` to the next read after the end of a read."""
        ...


class Schedule:
    """Deadlines at `begin_ns` + n · period. Synchronization: the bus's thread."""

    __slots__ = ("_late_ns", "counts", "due_ns", "period_ns")

    def __init__(self, rate_hz: float, begin_ns: int, counts: Deadlines) -> None:
        self.period_ns = round(NS_PER_S / rate_hz)
        self._late_ns = self.period_ns // LATE_SHARE
        self.counts = counts
        self.due_ns = begin_ns  # CLOCK_MONOTONIC of the next deadline

    def begun(self, start_ns: int) -> None:
        self.counts.served(start_ns - self.due_ns, self._late_ns)

    def done(self, now_ns: int) -> None:
        """Set the next deadline. Count the deadlines that have passed without a read."""
        due_ns, period_ns = self.due_ns + self.period_ns, self.period_ns
        if due_ns + period_ns <= now_ns:  # a read that is late by less than a period is still useful
            passed = (now_ns - due_ns) // period_ns
            self.counts.missed += passed
            due_ns += passed * period_ns
        self.due_ns = due_ns


class RoundRobin:
    """Turns in place of deadlines: every device is always due, and the device with the longest wait is first.
    Synchronization: the bus's thread."""

    __slots__ = ("counts", "due_ns", "period_ns")

    def __init__(self, begin_ns: int, counts: Deadlines) -> None:
        self.period_ns = 0
        self.counts = counts
        self.due_ns = begin_ns  # CLOCK_MONOTONIC at the end of the device's last turn

    def begun(self, _start_ns: int) -> None:
        self.counts.polls += 1

    def done(self, now_ns: int) -> None:
        """Move the device behind all other devices after its turn."""
        self.due_ns = now_ns


class ReadySchedule:
    """Edges in place of deadlines. Synchronization: the bus's thread; any thread may read `by_edges`.

    The first read is immediate, because a line that stays active until a read makes no edge before the first read.
    The thread can notice an edge (`noticed`) before the loop has its time (`on_edges`). Either call causes the read.
    """

    __slots__ = (
        "_deadlines", "_edge_ns", "_interval_ns", "_pending", "_start_ns", "_starts", "_unstamped",
        "by_edges", "counts", "due_ns",
    )  # fmt: skip

    def __init__(self, rate_hz: float, begin_ns: int, counts: Deadlines) -> None:
        """`rate_hz` is the rate of the deadlines if there are no edges."""
        self._deadlines = Schedule(rate_hz, begin_ns, counts)
        self._interval_ns = self._deadlines.period_ns
        self._edge_ns = begin_ns  # CLOCK_MONOTONIC of the newest edge, or of the start
        self._start_ns = 0  # CLOCK_MONOTONIC of the start of the newest read
        self._pending = True  # whether the newest edge still needs a read
        self._unstamped = False  # whether the time of the pending edge is unknown
        self._starts: deque[int] = deque(maxlen=UNMATCHED_MOST)  # starts of the reads of such edges, oldest first
        self.counts = counts
        self.by_edges = True  # whether edges cause the reads; False: deadlines
        self.due_ns = begin_ns  # CLOCK_MONOTONIC of the pending edge or of the deadline

    @property
    def period_ns(self) -> int:
        """Present time between two reads, ns."""
        return self._interval_ns if self.by_edges else self._deadlines.period_ns

    def noticed(self, now_ns: int) -> None:
        """Read immediately: an edge has arrived, and its time is unknown."""
        if self.by_edges:
            self._pending = self._unstamped = True
            self.due_ns = self._edge_ns = now_ns

    def has_read(self, t_ns: int) -> bool:
        """Return whether a read started after this edge. Any thread may call it."""
        return t_ns <= self._start_ns

    def on_edges(self, times_ns: Sequence[int], interval_ns: int) -> None:
        """Process edges, oldest first. `interval_ns` is the time between the two newest edges."""
        t_ns = times_ns[-1]
        self._count_reads(times_ns, interval_ns)
        if not self.by_edges and t_ns - self._edge_ns > QUIET_NS:  # a single edge can be a disturbance
            self._edge_ns = t_ns
            return
        self.by_edges = True
        self._edge_ns, self._interval_ns = t_ns, interval_ns
        if t_ns > self._start_ns:
            self._pending, self._unstamped, self.due_ns = True, False, t_ns
        elif not self._unstamped:
            self._wait()

    def begun(self, start_ns: int) -> None:
        """Count a read that starts. Without a pending edge, change to deadlines."""
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
        if self.by_edges:
            self._wait()
        else:
            self._deadlines.done(now_ns)
            self.due_ns = self._deadlines.due_ns

    def _count_reads(self, times_ns: Sequence[int], interval_ns: int) -> None:
        """Count the reads of noticed edges. Each read belongs to the newest edge before its start."""
        starts, at = self._starts, 0
        while starts and at < len(times_ns):
            start_ns, edge_ns = starts.popleft(), 0
            while at < len(times_ns) and times_ns[at] <= start_ns:
                edge_ns, at = times_ns[at], at + 1
            if edge_ns:  # a read without an edge is not counted
                self.counts.served(start_ns - edge_ns, interval_ns // LATE_SHARE)

    def _wait(self) -> None:
        self._pending = False
        self.due_ns = self._edge_ns + max(QUIET_NS, QUIET_INTERVALS * self._interval_ns)
