"""Matching of reads with data-ready edges: a read belongs to the newest edge before it, unless it is too late for it.

    edge 7        edge 8                 edge 9          edge 10
      │             │  ┌─read─┐            │               │ ┌─read─┐
      └─────────────┴──┴──────┴────────────┴───────────────┴─┴──────┘
                       of edge 8                             of edge 10; the values of 9 are lost

Matched by kernel time stamps afterwards, so that the host's delay in noticing an edge has no effect. Without I/O.
"""

from collections import deque
from collections.abc import Sequence
from math import hypot, sqrt
from typing import Final, NamedTuple

from imud.clock.steering import STAMP_FLOOR_NS
from imud.contracts.lines import Edge, ReadySettings
from imud.units import NS_PER_MS, NS_PER_US

QUIET_NS: Final = 500 * NS_PER_MS
"""Edges count as stopped after this time, which is shorter than what makes a device silent."""
KEPT: Final = 1024
"""Capacity of the buffer of edges without a read: that of the kernel's event buffer."""
AGE_LIMIT: Final = 1.5
"""A further read of an edge that begins later than this, in intervals, may belong to an unseen edge: the wire broke."""
EITHER: Final = 1 / sqrt(2)
"""Root mean square of an error that is 0 or its bound with equal probability."""


class Stamp(NamedTuple):
    """Instant of measurement of the values that were read."""

    t_ns: int
    """CLOCK_MONOTONIC; not after the begin of the read."""
    err_ns: int
    """One-sigma error of `t_ns`."""
    number: int
    """`Edge.number`."""


class ReadyEdges:
    """Edges of one data-ready line. Synchronization: the loop's thread only."""

    def __init__(self, settings: ReadySettings, period_ns: int) -> None:
        """`period_ns` is the expected interval of edges, used until two have come."""
        self.missed = 0
        """Edges without a read: the next edge came first, or the kernel dropped the edge."""
        self.interval_ns = period_ns
        """Interval of the two newest edges."""
        self._offset_ns = round(settings.offset_us * NS_PER_US)
        self._error_ns = settings.bias_us * NS_PER_US / sqrt(3) + STAMP_FLOOR_NS
        self._edges: deque[Edge] = deque(maxlen=KEPT)
        self._newest: Edge | None = None
        self._read: int | None = None

    def on_edges(self, edges: Sequence[Edge]) -> None:
        """Add edges after which new values can be read, oldest first."""
        for edge in edges:
            before, self._newest = self._newest, edge
            if before is not None:
                self.interval_ns = max(1, (edge.t_ns - before.t_ns) // max(1, edge.number - before.number))
            self._edges.append(edge)

    def restart(self) -> None:
        """Begin to read, possibly another device: earlier edges do not count as missed."""
        self._read = None

    def match(self, start_ns: int, end_ns: int) -> Stamp | None:
        """Return the stamp of a read from `start_ns` to `end_ns`, failed or not; None without edge. In order only."""
        edges = self._edges
        while len(edges) > 1 and edges[1].t_ns <= start_ns:
            edges.popleft()
        if not edges or edges[0].t_ns > start_ns:
            return None
        t_ns, _, number = edges[0]
        limit_ns = AGE_LIMIT * self.interval_ns
        if self._read is not None and number != self._read:
            self.missed += max(0, number - self._read - 1)
            limit_ns = max(limit_ns, QUIET_NS)  # the first read of an edge: the host was late
        self._read = number
        if start_ns - t_ns > limit_ns:
            return None
        error_ns = self._error_ns
        if len(edges) > 1 and edges[1].t_ns <= end_ns:  # new values during the read: either
            newest_ns = max(edge.t_ns for edge in edges if edge.t_ns <= end_ns)
            error_ns = hypot(error_ns, EITHER * (newest_ns - t_ns))
        return Stamp(min(t_ns + self._offset_ns, start_ns), int(error_ns) + 1, number)
