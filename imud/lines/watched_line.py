"""An input line that is kept open: a failure is reported once, and the line is opened again when that is possible."""

from collections.abc import Callable, Sequence
from typing import Final

from imud.contracts.lines import Edge, InputLine, InputOptions, LineFactory, OnEdges, WatchedInput, WatchLine
from imud.model.errors import LinkError
from imud.model.units import NS_PER_S

RETRY_NS: Final = 5 * NS_PER_S
"""Pause before a line is opened again: its chip may return, or another program may release it."""


class WatchedLine:
    """An input line that is kept open. Synchronization: the loop's thread only."""

    def __init__(
        self,
        line: InputLine,
        on_edges: OnEdges,
        on_level: Callable[[bool | None], None],
        report: Callable[[str], None],
        now_ns: Callable[[], int],
        *,
        watch: bool = True,
    ) -> None:
        """`on_level` receives the level after each opening and after lost edges, and None when the line is closed.

        `report` receives a message when the line fails for a new reason, and when it is open again. Without `watch` the
        loop does not wake up for edges; `drain` and `tick` deliver them.
        """
        self.line = line
        """The input itself."""
        self.problem = ""
        """Why the line is not open, one sentence; empty if it is."""
        self.edges = 0
        """Edges delivered since the start."""
        self._on_edges = on_edges
        self._on_level = on_level
        self._report = report
        self._now_ns = now_ns
        self._watch = watch
        self._is_open = False
        self._due_ns = 0
        self._lost = 0

    @property
    def edges_lost(self) -> int:
        """Edges that the kernel dropped since the start."""
        return self.line.edges_lost

    def tick(self, now_ns: int) -> None:
        """Open the line if that is due; read the level again if edges were lost. Call it at 10 Hz."""
        if not self._is_open:
            if now_ns >= self._due_ns:
                self._open(now_ns)
            return
        if not self._watch:
            self.line.drain()
        if self._is_open and self.line.edges_lost != self._lost:
            self._lost = self.line.edges_lost
            self._read_level()

    def drain(self) -> None:
        """Deliver the edges that the kernel has buffered. Does not block."""
        if self._is_open:
            self.line.drain()

    def close(self) -> None:
        """Release the line; may be called twice. The next `tick` opens it again."""
        self._is_open = False
        self._due_ns = 0
        self.line.close()
        self._on_level(None)

    def _open(self, now_ns: int) -> None:
        try:
            self.line.open()
            self.line.start(self._count_edges, self._end, self._watch)
        except LinkError as error:
            self.line.close()
            self._fail(error, now_ns)
            return
        self._is_open = True
        if self.problem:
            self.problem = ""
            self._report("watched again")
        self._read_level()

    def _count_edges(self, edges: Sequence[Edge]) -> None:
        self.edges += len(edges)
        self._on_edges(edges)

    def _read_level(self) -> None:
        try:
            self._on_level(self.line.level())
        except LinkError as error:
            self._end(error)

    def _end(self, error: LinkError) -> None:
        """Close the line, which is gone."""
        self.close()
        self._fail(error, self._now_ns())

    def _fail(self, error: LinkError, now_ns: int) -> None:
        self._due_ns = now_ns + RETRY_NS
        if str(error) != self.problem:
            self.problem = str(error)
            self._report(self.problem)


def watching(lines: LineFactory, now_ns: Callable[[], int]) -> WatchLine:
    """Return what keeps lines open that belong to no device."""

    def watch(settings: InputOptions, purpose: str, on_edges: OnEdges, report: Callable[[str], None]) -> WatchedInput:
        return WatchedLine(lines.make_input(settings, purpose, True), on_edges, lambda _level: None, report, now_ns)

    return watch
