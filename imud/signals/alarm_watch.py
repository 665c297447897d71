"""The ALARM line of a device and what is known of it: its level, its events, whether it can be wired right."""

from collections.abc import Mapping, Sequence
from typing import Final

from imud.contracts.lines import Edge
from imud.event import EventKind, RaiseEvent
from imud.sample import Sample
from imud.signals.alarm_check import AlarmCheck, AlarmRange, AlarmVerdict, alarm_settings
from imud.signals.alarm_line import AlarmLine
from imud.units import NS_PER_MS

FRESH_NS: Final = 150 * NS_PER_MS
"""The level now is compared with angles no older than this: looks are 100 ms apart."""

_WORDS: Final = {
    AlarmVerdict.STUCK_LOW: (
        "it is low while an angle is out of the range that the device is set to ({ranges}): is the wire connected, "
        "and to the pin that has the alarm (PMUX5)?"
    ),
    AlarmVerdict.STUCK_HIGH: (
        "it is high while no angle is out of the range that the device is set to ({ranges}): is it inverted "
        "(active_low), or the wire of another pin?"
    ),
    AlarmVerdict.OTHER_AXIS: (
        "it does what the other axis should do ({ranges}): is the device mounted as its settings say (URFR)?"
    ),
}
"""What is wrong, and what to look at."""


class AlarmWatch:
    """Follows one line, by what it is told. Synchronization: the loop's thread only."""

    def __init__(self, raise_event: RaiseEvent) -> None:
        self.line = AlarmLine(raise_event)
        self.problem = ""
        """Why the line cannot be right, one sentence; empty while nothing says so."""
        self._raise_event = raise_event
        self._check = AlarmCheck({})

    def settings(self, settings: Mapping[str, str]) -> None:
        """What the device is set to, as read back."""
        ranges = alarm_settings(settings)
        if ranges != self._check.ranges:
            self._check, self.problem = AlarmCheck(ranges), ""

    def edges(self, edges: Sequence[Edge]) -> None:
        """The line changed."""
        self.line.edges(edges)

    def level(self, now_ns: int, active: bool | None) -> None:
        """The level was read; None: nobody knows it any more."""
        if active is None:
            self.line.unknown()
        else:
            self.line.level(now_ns, active)

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Ten times a second, with the device's newest sample: tell what has gathered, compare the line with it."""
        self.line.tick(now_ns)
        active = self.line.active
        if newest is None or active is None or now_ns - newest.t_rx_ns > FRESH_NS:
            return
        verdict = self._check.take(newest.t_ns, newest.euler_rad, active)
        if verdict is None:
            return
        before, words = self.problem, _WORDS.get(verdict, "")
        self.problem = words.format(ranges=_ranges(self._check.ranges))
        if self.problem or before:
            message = f"line alarm: {self.problem or 'it agrees with the angles again'}"
            self._raise_event(now_ns, EventKind.ALARM, message, active=active, verdict=str(verdict))


def _ranges(ranges: Mapping[str, AlarmRange]) -> str:
    return ", ".join(
        f"{axis} {limits.low_deg:g} to {limits.high_deg:g}°" if limits.enabled else f"{axis} off"
        for axis, limits in sorted(ranges.items())
    )
