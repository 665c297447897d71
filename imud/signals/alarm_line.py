"""The ALARM line of a device: its level now, how often it was raised, and events at a bounded rate."""

from collections.abc import Sequence
from typing import Final

from imud.contracts.lines import Edge
from imud.event import EventKind, RaiseEvent
from imud.units import NS_PER_S

INTERVAL_NS: Final = NS_PER_S
"""An angle at the edge of its range makes a line that chatters: at most one event a second."""


class AlarmLine:
    """Watches one line, by what it is told. Synchronization: one thread."""

    def __init__(self, raise_event: RaiseEvent) -> None:
        self._raise_event = raise_event
        self.active: bool | None = None
        """Whether there is an alarm now; None while nobody knows."""
        self.raised = 0
        """How often it became active since the start, the level found at the beginning included."""
        self._changes = 0
        """Since the last event."""
        self._due_ns = 0

    def level(self, now_ns: int, active: bool) -> None:
        """The level was read: right after the line was opened, and again after edges were lost."""
        self._become(active)
        self.tick(now_ns)

    def edges(self, edges: Sequence[Edge]) -> None:
        """The line changed. An edge that only says what is known already is nothing new."""
        for edge in edges:
            self._become(edge.rising)
            self.tick(edge.t_ns)

    def unknown(self) -> None:
        """The line is gone or closed."""
        self.active = None

    def tick(self, now_ns: int) -> None:
        """Send what has gathered, if the last event is long enough ago. To be called now and then."""
        if not self._changes or now_ns < self._due_ns or self.active is None:
            return
        changes, self._changes, self._due_ns = self._changes, 0, now_ns + INTERVAL_NS
        words = "alarm" if self.active else "no alarm any more"
        often = f" (the line changed {changes} times)" if changes > 1 else ""
        self._raise_event(
            now_ns, EventKind.ALARM, words + often, active=self.active, raised=self.raised, changes=changes
        )

    def _become(self, active: bool) -> None:
        if active != self.active and (active or self.active is not None):  # no alarm at the beginning is no news
            self._changes += 1
            self.raised += active
        self.active = active
