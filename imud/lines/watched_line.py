"""Input line that imud keeps open. It reports a failure once, and opens the line again when possible."""

from collections.abc import Sequence
from typing import Final

from imud.contracts.lines import Edge, InputLine, InputOptions, LineFactory, LineOwner, WatchedInput, WatchLine
from imud.host.clock import HostClock
from imud.model.errors import LinkError
from imud.model.units import NS_PER_S

# pause before imud opens a line again, ns: its chip may return, or another program may release it
RETRY_NS: Final = 5 * NS_PER_S


class WatchedLine:
    """Input line that imud keeps open. Synchronization: the event loop's thread only."""

    def __init__(self, line: InputLine, key: str, owner: LineOwner, host: HostClock, *, watch: bool = True) -> None:
        """The event loop wakes up for edges if `watch` is true. Otherwise `drain` and `tick` deliver them."""
        self.line = line
        self.problem = ""  # reason why the line is closed, one sentence; empty if it is open
        self.edges = 0  # number of edges since the start
        self._key = key
        self._owner = owner
        self._host = host
        self._watch = watch
        self._is_open = False
        self._due_ns = 0
        self._lost = 0

    @property
    def edges_lost(self) -> int:
        """Return the number of edges that the kernel dropped since the start."""
        return self.line.edges_lost

    def tick(self, now_ns: int) -> None:
        """Open the line if due. Read the level again after lost edges. Call this method at 10 Hz."""
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
        """Deliver the edges in the kernel's buffer. Do not block."""
        if self._is_open:
            self.line.drain()

    def close(self) -> None:
        """Release the line. The next `tick` opens it again. A second call does nothing."""
        self._is_open = False
        self._due_ns = 0
        self.line.close()
        self._owner.on_level(self._key, None)

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
            self._owner.on_line_report(self._key, "watched again")
        self._read_level()

    def _count_edges(self, edges: Sequence[Edge]) -> None:
        self.edges += len(edges)
        self._owner.on_edges(self._key, edges)

    def _read_level(self) -> None:
        try:
            self._owner.on_level(self._key, self.line.level())
        except LinkError as error:
            self._end(error)

    def _end(self, error: LinkError) -> None:
        self.close()
        self._fail(error, self._host.now_ns())

    def _fail(self, error: LinkError, now_ns: int) -> None:
        self._due_ns = now_ns + RETRY_NS
        if str(error) != self.problem:
            self.problem = str(error)
            self._owner.on_line_report(self._key, self.problem)


def watching(lines: LineFactory, host: HostClock) -> WatchLine:
    """Return a function that keeps lines open that belong to no device."""

    def watch(settings: InputOptions, purpose: str, owner: LineOwner) -> WatchedInput:
        return WatchedLine(lines.make_input(settings, purpose, True), purpose, owner, host)

    return watch
