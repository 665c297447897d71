"""When a device is read that shares a line with others and is to be read as often as the line allows: in turns.

Every device is due at once; who has waited longest comes first. Nothing can be late or missed. It stands in for a
`Schedule`.
"""

from imud.runtime.polled.schedule import Deadlines


class RoundRobin:
    """Turns instead of deadlines. Synchronization: the bus's thread."""

    __slots__ = ("counts", "due_ns", "period_ns")

    def __init__(self, begin_ns: int, counts: Deadlines) -> None:
        self.period_ns = 0
        """There is none."""
        self.counts = counts
        self.due_ns = begin_ns
        """When its last turn was over (CLOCK_MONOTONIC): the lowest of all members is next."""

    def begun(self, _start_ns: int) -> None:
        """Its turn begins."""
        self.counts.polls += 1

    def done(self, now_ns: int) -> None:
        """Its turn is over: behind all others."""
        self.due_ns = now_ns
