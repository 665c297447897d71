"""Alerts of the flight recorder: which are saved, and when. No I/O: time is an argument."""

from collections import deque
from typing import Final, NamedTuple

from imud.units import NS_PER_S

HOUR_NS: Final = 3600 * NS_PER_S


class Alert(NamedTuple):
    """Something that is to be saved."""

    t_ns: int
    """CLOCK_MONOTONIC."""
    device: str
    """Empty for one of no device."""
    reason: str
    """What happened, one sentence."""


class AlertGate:
    """Decides on alerts: one at a time, for what follows it is in the same snapshot, and so many an hour.

    Synchronization: one thread.
    """

    def __init__(self, after_ns: int, per_hour: int) -> None:
        """`after_ns`: a snapshot is saved so long after its alert."""
        self.pending: Alert | None = None
        """The alert whose snapshot is to be saved."""
        self.left_out = 0
        """Alerts that were not saved since the last that was, because there were too many."""
        self.left_out_total = 0
        """The same since the start."""
        self._after_ns = after_ns
        self._per_hour = per_hour
        self._accepted: deque[int] = deque()
        """Times of those within an hour."""

    def add(self, alert: Alert) -> bool:
        """Take an alert; return False for the first one that is left out."""
        if self.pending is not None:
            return True
        accepted = self._accepted
        while accepted and alert.t_ns - accepted[0] >= HOUR_NS:
            accepted.popleft()
        if len(accepted) >= self._per_hour:
            self.left_out += 1
            self.left_out_total += 1
            return self.left_out > 1
        accepted.append(alert.t_ns)
        self.pending = alert
        self.left_out = 0
        return True

    def take_due(self, now_ns: int, *, at_once: bool = False) -> Alert | None:
        """Return the alert whose snapshot is to be saved now, once; with `at_once` also one that is not due yet."""
        alert = self.pending
        if alert is None or (now_ns - alert.t_ns < self._after_ns and not at_once):
            return None
        self.pending = None
        return alert
