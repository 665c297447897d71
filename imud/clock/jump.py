"""Whether a message so far before or behind the line says that the device's clock jumped, or only that it waited."""

from typing import Final

from imud.clock.envelope import SLOPE_HIGHEST, Envelope
from imud.units import NS_PER_MS, NS_PER_S

EARLY_NS: Final = 5 * NS_PER_MS
EARLY_SIGMAS: Final = 10
"""A stamp that lies this far ahead of its own arrival says that the device's clock jumped."""
FIRST_EARLY_NS: Final = NS_PER_S
"""The same before a line counts: the first message may have waited that long in a buffer."""
LATE_NS: Final = NS_PER_S // 2
LATE_READS: Final = 3
"""Messages may queue up while the host is busy; in so many reads over a second, it is the device's clock."""


class Jump:
    """Early messages are a jump at once, late ones when they stay late."""

    __slots__ = ("_since_ns", "late_reads")

    def __init__(self) -> None:
        self._since_ns = 0
        self.late_reads = 0
        """Reads in a row that were late; 0 while all is well."""

    def early(self, envelope: Envelope, height: float, elapsed_ns: int, error_ns: float | None) -> bool:
        """Whether a message `height` (negative) above the line came before it could; no `error_ns`: a young line."""
        if error_ns is None:
            return height < -FIRST_EARLY_NS - (SLOPE_HIGHEST - 1) * (elapsed_ns + envelope.span_ns)
        return height < -EARLY_SIGMAS * error_ns - EARLY_NS - 4 * envelope.slope_error * elapsed_ns

    def late(self, envelope: Envelope, height: float, elapsed_ns: int, t_rx_ns: int, *, new_read: bool) -> bool:
        """Whether messages have been late for so long that they are not late."""
        if height < LATE_NS + envelope.slope_error * elapsed_ns:
            self.late_reads = 0
            return False
        if not self.late_reads:
            self._since_ns = t_rx_ns
        self.late_reads += new_read
        return self.late_reads >= LATE_READS and t_rx_ns - self._since_ns > NS_PER_S
