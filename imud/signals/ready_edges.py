"""Which data-ready edge the bytes of a read belong to: the newest before it began, if the read is not too late for it.

    edge 7        edge 8                 edge 9          edge 10
      │             │  ┌─read─┐            │               │ ┌─read─┐
      └─────────────┴──┴──────┴────────────┴───────────────┴─┴──────┘
                       is of edge 8                          is of edge 10; the values of 9 are lost

Told by kernel stamps after the fact, so it does not matter how late the host noticed an edge. Without I/O.
"""

from collections import deque
from collections.abc import Sequence
from math import hypot, sqrt
from typing import Final, NamedTuple

from imud.clock.aids import STAMP_FLOOR_NS
from imud.contracts.lines import Edge, ReadySettings
from imud.units import NS_PER_MS, NS_PER_US

QUIET_NS: Final = 500 * NS_PER_MS
"""So long without an edge: it is shorter than what makes a device silent."""
KEPT: Final = 1024
"""Edges that wait for the read they belong to: as many as the kernel keeps for a host that stalls."""
AGE_LIMIT: Final = 1.5
"""Another read of an edge that begins so many intervals after it may be of one that nobody saw: the wire broke."""
EITHER: Final = 1 / sqrt(2)
"""Root mean square of an error that is 0 or its bound, either as likely."""


class Stamp(NamedTuple):
    """When the bytes of a read were measured."""

    t_ns: int
    """CLOCK_MONOTONIC; never after the read began."""
    err_ns: int
    """One-sigma error of it."""
    number: int
    """`Edge.number`."""


class ReadyEdges:
    """The edges of one device's line. Synchronization: the loop's thread only."""

    def __init__(self, settings: ReadySettings, period_ns: int) -> None:
        """`period_ns` is the interval of edges to expect until two have come."""
        self.missed = 0
        """Edges whose values were never read: the next came first, or the kernel dropped them."""
        self.interval_ns = period_ns
        """Between the two newest edges."""
        self._offset_ns = round(settings.offset_us * NS_PER_US)
        self._error_ns = settings.bias_us * NS_PER_US / sqrt(3) + STAMP_FLOOR_NS
        self._edges: deque[Edge] = deque(maxlen=KEPT)
        self._newest: Edge | None = None
        self._read: int | None = None

    def take(self, edges: Sequence[Edge]) -> None:
        """Edges after which there are new values, oldest first."""
        for edge in edges:
            before, self._newest = self._newest, edge
            if before is not None:
                self.interval_ns = max(1, (edge.t_ns - before.t_ns) // max(1, edge.number - before.number))
            self._edges.append(edge)

    def restart(self) -> None:
        """Reading begins, perhaps of another device: edges before it are not missed."""
        self._read = None

    def of(self, start_ns: int, end_ns: int) -> Stamp | None:
        """The stamp of a read between these, whether it succeeded or not; None where no edge tells. Reads in order."""
        edges = self._edges
        while len(edges) > 1 and edges[1].t_ns <= start_ns:
            edges.popleft()
        if not edges or edges[0].t_ns > start_ns:
            return None
        t_ns, _, number = edges[0]
        limit_ns = AGE_LIMIT * self.interval_ns
        if self._read is not None and number != self._read:
            self.missed += max(0, number - self._read - 1)
            limit_ns = max(limit_ns, QUIET_NS)  # its first read: the host was late for it
        self._read = number
        if start_ns - t_ns > limit_ns:
            return None
        error_ns = self._error_ns
        if len(edges) > 1 and edges[1].t_ns <= end_ns:  # new values came while the old ones were read: which are these?
            error_ns = hypot(error_ns, EITHER * (edges[1].t_ns - t_ns))
        return Stamp(min(t_ns + self._offset_ns, start_ns), int(error_ns) + 1, number)
