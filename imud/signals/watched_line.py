"""One input line that is kept open: what it cannot do now is told once, and tried again."""

from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import Final

from imud.contracts.lines import Edge, InputLine, OnEdges
from imud.errors import LinkError
from imud.units import NS_PER_S

RETRY_NS: Final = 5 * NS_PER_S
"""A chip that is not there, or a line that another program has, may be free later."""


class WatchedLine:
    """Owns one input. Synchronization: the loop's thread only."""

    def __init__(
        self,
        line: InputLine,
        on_edges: OnEdges,
        on_level: Callable[[bool | None], None],
        complain: Callable[[str], None],
        *,
        watch: bool = True,
    ) -> None:
        """`on_level` is told the level after each opening and after edges were lost, and None when it is gone.

        Without `watch` the loop does not wake up for edges; they are taken by `drain`, and by `tick` when that is rare.
        """
        self.line = line
        self.problem = ""
        """Why it is not watched now, one sentence; empty when it is."""
        self.edges = 0
        """Edges delivered since the start."""
        self._on_edges = on_edges
        self._on_level = on_level
        self._complain = complain
        self._watch = watch
        self._is_open = False
        self._due_ns = 0
        self._lost = 0

    def tick(self, now_ns: int) -> None:
        """Open it if it is due; look at the level again where edges were lost."""
        if not self._is_open:
            if now_ns >= self._due_ns:
                self._open(now_ns)
            return
        if not self._watch:
            self.line.drain()
        if self._is_open and self.line.edges_lost != self._lost:
            self._lost = self.line.edges_lost
            self._ask()

    def drain(self) -> None:
        """Take now what the kernel has."""
        if self._is_open:
            self.line.drain()

    def close(self) -> None:
        """Let go of it; may be called twice. The next `tick` opens it again."""
        self._is_open = False
        self._due_ns = 0
        self.line.close()
        self._on_level(None)

    def _open(self, now_ns: int) -> None:
        try:
            self.line.open()
            self.line.start(self._take, self._end, self._watch)
        except LinkError as error:
            self.line.close()
            self._fail(error, now_ns)
            return
        self._is_open = True
        if self.problem:
            self.problem = ""
            self._complain("watched again")
        self._ask()

    def _take(self, edges: Sequence[Edge]) -> None:
        self.edges += len(edges)
        self._on_edges(edges)

    def _ask(self) -> None:
        try:
            self._on_level(self.line.level())
        except LinkError as error:
            self._end(error)

    def _end(self, error: LinkError) -> None:
        """It is gone."""
        self.close()
        self._fail(error, monotonic_ns())

    def _fail(self, error: LinkError, now_ns: int) -> None:
        self._due_ns = now_ns + RETRY_NS
        if str(error) != self.problem:
            self.problem = str(error)
            self._complain(self.problem)
