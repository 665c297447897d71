"""The ALARM line of a device: level, events at a bounded rate, and a check of its wiring."""

from collections.abc import Sequence
from typing import Final

from imud.contracts.lines import AlarmRanges, Edge
from imud.event import EventKind, RaiseEvent
from imud.sample import Sample
from imud.signals.alarm_check import AlarmCheck, AlarmVerdict
from imud.units import NS_PER_MS, NS_PER_S

INTERVAL_NS: Final = NS_PER_S
"""At most one event a second: an angle at its limit makes the line chatter."""
FRESH_NS: Final = 150 * NS_PER_MS
"""The level is compared with a sample no older than this; `tick` comes every 100 ms."""

_PROBLEMS: Final = {
    AlarmVerdict.STUCK_LOW: (
        "it is low while an angle is out of the range that the device is set to ({ranges}): is the wire connected, "
        "and to the pin that has the alarm ({pin})?"
    ),
    AlarmVerdict.STUCK_HIGH: (
        "it is high while no angle is out of the range that the device is set to ({ranges}): is it inverted "
        "(active_low), or the wire of another pin?"
    ),
    AlarmVerdict.OTHER_AXIS: (
        "it does what the other axis should do ({ranges}): is the device mounted as its settings say ({mounting})?"
    ),
}
"""The fault by verdict, and what to check."""


class AlarmLine:
    """Level of the line, with its events. Synchronization: one thread."""

    def __init__(self, raise_event: RaiseEvent) -> None:
        self.active: bool | None = None
        """Whether there is an alarm now; None while the line is closed or gone."""
        self.raised = 0
        """Number of times that it became active, including an active level found at opening."""
        self._raise_event = raise_event
        self._changes = 0
        """Changes since the last event."""
        self._due_ns = 0

    def on_level(self, now_ns: int, active: bool | None) -> None:
        """Process a level that was read, after opening or after lost edges; None: the line is closed or gone."""
        if active is None:
            self.active = None
            return
        self._set_active(active)
        self.tick(now_ns)

    def on_edges(self, edges: Sequence[Edge]) -> None:
        """Process edges of the line. An edge to the level that it has already is no change."""
        for edge in edges:
            self._set_active(edge.rising)
            self.tick(edge.t_ns)

    def tick(self, now_ns: int) -> None:
        """Raise the pending event once the last one is INTERVAL_NS old."""
        if not self._changes or now_ns < self._due_ns or self.active is None:
            return
        changes, self._changes, self._due_ns = self._changes, 0, now_ns + INTERVAL_NS
        words = "alarm" if self.active else "no alarm any more"
        often = f" (the line changed {changes} times)" if changes > 1 else ""
        self._raise_event(
            now_ns, EventKind.ALARM, words + often, active=self.active, raised=self.raised, changes=changes
        )

    def _set_active(self, active: bool) -> None:
        if active != self.active and (active or self.active is not None):  # an inactive level at opening is no event
            self._changes += 1
            self.raised += active
        self.active = active


class AlarmMonitor:
    """An `AlarmLine` that is checked against the samples. Synchronization: the loop's thread only."""

    def __init__(self, raise_event: RaiseEvent) -> None:
        self.line = AlarmLine(raise_event)
        self.problem = ""
        """Why the line cannot be wired correctly, one sentence; empty if nothing indicates that."""
        self._raise_event = raise_event
        self._ranges: AlarmRanges | None = None
        self._check = AlarmCheck({})

    def set_ranges(self, ranges: AlarmRanges | None) -> None:
        """Set what the line should indicate; None: not known, which ends the check."""
        if ranges != self._ranges:
            self._ranges, self.problem = ranges, ""
            self._check = AlarmCheck(ranges.by_axis if ranges is not None else {})

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Raise pending events, and compare the line with the device's newest sample. Call it at 10 Hz."""
        self.line.tick(now_ns)
        active = self.line.active
        if newest is None or active is None or now_ns - newest.t_rx_ns > FRESH_NS:
            return
        verdict = self._check.add_sample(newest.t_ns, newest.euler_rad, active)
        if verdict is None or self._ranges is None:
            return
        before, self.problem = self.problem, _problem(verdict, self._ranges)
        if self.problem or before:
            message = f"line alarm: {self.problem or 'it agrees with the angles again'}"
            self._raise_event(now_ns, EventKind.ALARM, message, active=active, verdict=str(verdict))


def _problem(verdict: AlarmVerdict, ranges: AlarmRanges) -> str:
    shown = ", ".join(
        f"{axis} {limits.low_deg:g} to {limits.high_deg:g}°" if limits.enabled else f"{axis} off"
        for axis, limits in sorted(ranges.by_axis.items())
    )
    template = _PROBLEMS.get(verdict, "")
    return template.format(ranges=shown, pin=ranges.pin_setting, mounting=ranges.mounting_setting)
