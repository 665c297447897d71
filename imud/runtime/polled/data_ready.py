"""The data-ready line of a polled device: an edge has the bus's thread read at once, and is the time of what was read.

    edge ──kernel stamp──▶ loop ──ReadySchedule.seen──▶ bus's thread: read ──▶ loop: drain, ReadyEdges.match ──▶ clock

The edges up to the end of a read are taken from the kernel before it is said which of them the read is of.
"""

from collections.abc import Sequence

import msgspec

from imud.contracts.lines import Edge, LineFactory, ReadySettings
from imud.contracts.polling import Poll
from imud.contracts.status import LinesStatus
from imud.event import EventKind
from imud.runtime.notices import Notices
from imud.runtime.polled.bus import Member
from imud.runtime.polled.ready_schedule import ReadySchedule
from imud.runtime.polled.schedule import Deadlines
from imud.signals.ready_edges import ReadyEdges
from imud.signals.watched_line import WatchedLine
from imud.units import NS_PER_S


class DataReady:
    """Owns the line of one device. Synchronization: the loop's thread only."""

    def __init__(
        self, device: str, settings: ReadySettings, maker: LineFactory, rate_hz: float, notices: Notices
    ) -> None:
        """`rate_hz` is that of the reads while no edges come."""
        self._rate_hz = rate_hz
        self._notices = notices
        self._now_ns = 0
        line = maker.make_input(_rising(settings), f"{device} data_ready", True)
        self.watched = WatchedLine(line, self._on_edges, _ignore, self._complain, lambda: self._now_ns)
        self.edges = ReadyEdges(settings, round(NS_PER_S / rate_hz))
        self._member: Member | None = None
        self._schedule: ReadySchedule | None = None
        self._told_by_edges = True
        self._closed = False

    def start(self, member: Member, polls: Sequence[Poll], counts: Deadlines, now_ns: int) -> None:
        """The device is found: read it."""
        self.watched.tick(now_ns)
        self.edges.restart()
        self._member = member
        self._schedule = ReadySchedule(self._rate_hz, now_ns, counts)
        member.start(polls, self._schedule)

    def close(self) -> None:
        """Let go of the line for good; may be called twice."""
        self.rest()
        self._closed = True
        self.watched.close()

    def rest(self) -> None:
        """It is read no more."""
        self._member = self._schedule = None

    def tick(self, now_ns: int) -> None:
        """Ten times a second: open the line if it is due, and say when edges stopped or came back."""
        self._now_ns = now_ns
        if not self._closed:
            self.watched.tick(now_ns)
        by_edges = self._schedule.by_edges if self._schedule is not None else self._told_by_edges
        if by_edges is not self._told_by_edges:
            self._told_by_edges = by_edges
            message = "edges are back: read at them" if by_edges else f"no edges: read at {self._rate_hz:g} Hz instead"
            self._tell(message, by_edges=by_edges)

    @property
    def expected_rate_hz(self) -> float:
        """Reads per second as things are."""
        by_edges = self._schedule is not None and self._schedule.by_edges
        return NS_PER_S / self.edges.interval_ns if by_edges else self._rate_hz

    def told(self, lines: LinesStatus) -> LinesStatus:
        """The status of the device's lines with this one."""
        watched = self.watched
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
            t_ns, interval_ns = edges[-1].t_ns, self.edges.interval_ns
            member.command(lambda: schedule.seen(t_ns, interval_ns))

    def _complain(self, problem: str) -> None:
        self._tell(problem)

    def _tell(self, message: str, **detail: bool) -> None:
        self._notices.tell(self._now_ns, EventKind.LINK, f"line data_ready: {message}", line="data_ready", **detail)


def _rising(settings: ReadySettings) -> ReadySettings:
    """The line with the wanted edge as its rising one: of that alone the kernel tells the direction for certain."""
    if settings.edge == "rising":
        return settings
    return msgspec.structs.replace(settings, active_low=not settings.active_low, edge="rising")


def _ignore(_active: bool | None) -> None:
    """The level says nothing that the edges do not."""
