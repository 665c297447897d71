"""The data-ready line of a polled device: an edge triggers a read, and dates what was read.

    edge ──▶ bus's thread: ReadySchedule.noticed, read ──▶ loop: drain, ReadyEdges.match ──▶ clock
      └─kernel stamp──▶ loop ──ReadySchedule.on_edges──▶ bus's thread: read, or how late the read was

The bus's thread waits for the line itself, so that a loop that is busy does not delay a read. It takes nothing from the
line: what the loop has taken before, the loop tells it, as all edges of a line without a descriptor. The edges up to
the end of a read are drained from the kernel before one of them is assigned to the read.
"""

from collections.abc import Callable, Sequence

import msgspec

from imud.clock import SampleClock
from imud.contracts.lines import Edge, LineFactory, ReadySettings
from imud.contracts.polling import Poll
from imud.contracts.status import LinesStatus
from imud.event import EventKind
from imud.runtime.notices import Notices
from imud.runtime.polled.bus import BusMember
from imud.runtime.polled.schedule import Deadlines, ReadySchedule
from imud.sample import Sample
from imud.signals.ready_edges import ReadyEdges
from imud.signals.watched_line import WatchedLine
from imud.units import NS_PER_S


class DataReady:
    """The data-ready line of one device, an attachment of it. Synchronization: the loop's thread only."""

    def __init__(
        self,
        device: str,
        settings: ReadySettings,
        lines: LineFactory,
        rate_hz: float,
        notices: Notices,
        now_ns: Callable[[], int],
    ) -> None:
        """`lines` makes the line; `rate_hz` is that of the reads while no edges come."""
        self._rate_hz = rate_hz
        self._notices = notices
        self._now_ns = now_ns
        line = lines.make_input(_rising(settings), f"{device} data_ready", True)
        self._watched = WatchedLine(line, self._on_edges, self._on_level, self._report, now_ns)
        self.edges = ReadyEdges(settings, round(NS_PER_S / rate_hz))
        """The edges, for the path that dates reads by them."""
        self._member: BusMember | None = None
        self._schedule: ReadySchedule | None = None
        self._watched_fd = -1
        """The line's descriptor while the bus's thread waits for it."""
        self._reported_by_edges = True
        self._closed = False

    # --- the attachment ----------------------------------------------------------------------------------------------

    def start(self, clock: SampleClock) -> None:
        """No-op: `read` begins the reads."""

    def tick(self, now_ns: int, _newest: Sample | None) -> None:
        """Open the line if it is due, and report when edges stopped or came back."""
        if not self._closed:
            self._watched.tick(now_ns)
        by_edges = self._schedule.by_edges if self._schedule is not None else self._reported_by_edges
        if by_edges is not self._reported_by_edges:
            self._reported_by_edges = by_edges
            message = "edges are back: read at them" if by_edges else f"no edges: read at {self._rate_hz:g} Hz instead"
            self._raise_event(message, by_edges=by_edges)

    def stop(self) -> None:
        """Edges cause no more reads; may be called twice."""
        self._unwatch()
        self._member = self._schedule = None

    def close(self) -> None:
        """Release the line; may be called twice."""
        self.stop()
        self._closed = True
        self._watched.close()

    # --- reads -------------------------------------------------------------------------------------------------------

    def read(self, member: BusMember, polls: Sequence[Poll], counts: Deadlines, now_ns: int) -> None:
        """Read the device at its edges from now on; how that succeeds is counted in `counts`."""
        self._unwatch()
        self._watched.tick(now_ns)
        self.edges.restart()
        self._member = member
        self._schedule = ReadySchedule(self._rate_hz, now_ns, counts)
        self._watch()
        member.start(polls, self._schedule)

    def drain(self) -> None:
        """Process the edges that the kernel has."""
        self._watched.drain()

    # --- state -------------------------------------------------------------------------------------------------------

    @property
    def expected_rate_hz(self) -> float:
        """Reads per second as things are."""
        by_edges = self._schedule is not None and self._schedule.by_edges
        return NS_PER_S / self.edges.interval_ns if by_edges else self._rate_hz

    def add_status(self, lines: LinesStatus) -> LinesStatus:
        """Return the status of the device's lines with this one."""
        watched = self._watched
        return msgspec.structs.replace(
            lines,
            problems={**lines.problems, "data_ready": watched.problem} if watched.problem else lines.problems,
            edges={**lines.edges, "data_ready": watched.edges},
            edges_lost={**lines.edges_lost, "data_ready": watched.line.edges_lost},
        )

    def _on_edges(self, edges: Sequence[Edge]) -> None:
        self.edges.on_edges(edges)
        member, schedule = self._member, self._schedule
        if member is not None and schedule is not None:
            times_ns, interval_ns = [edge.t_ns for edge in edges], self.edges.interval_ns
            tell = member.note if schedule.has_read(times_ns[-1]) else member.command
            tell(lambda: schedule.on_edges(times_ns, interval_ns))

    def _on_level(self, active: bool | None) -> None:
        """Follow the line, which was opened, or closed (None); its level adds nothing to the edges."""
        if active is None:
            self._unwatch()
        else:
            self._watch()

    def _watch(self) -> None:
        """Have the bus's thread wait for the line, if it is open and that is possible."""
        member, schedule, fd = self._member, self._schedule, self._watched.line.fileno()
        if member is not None and schedule is not None and self._watched_fd < 0:
            now_ns = self._now_ns
            if member.watch(fd, lambda: schedule.noticed(now_ns())):
                self._watched_fd = fd

    def _unwatch(self) -> None:
        if self._watched_fd >= 0 and self._member is not None:
            self._member.unwatch(self._watched_fd)
        self._watched_fd = -1

    def _report(self, problem: str) -> None:
        self._raise_event(problem)

    def _raise_event(self, message: str, **detail: bool) -> None:
        words = f"line data_ready: {message}"
        self._notices.raise_event(self._now_ns(), EventKind.LINK, words, line="data_ready", **detail)


def _rising(settings: ReadySettings) -> ReadySettings:
    """Return settings whose rising edge is the wanted one: of that alone the kernel reports the direction reliably."""
    if settings.edge == "rising":
        return settings
    return msgspec.structs.replace(settings, active_low=not settings.active_low, edge="rising")
