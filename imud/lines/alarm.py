"""The ALARM line of a device: level, events at a bounded rate, and a check of its wiring."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from math import degrees
from typing import Final

from imud.contracts.lines import AlarmRange, AlarmRanges, Edge
from imud.model.event import EventKind, RaiseEvent
from imud.model.sample import Sample, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S

MARGIN_DEG: Final = 0.5
"""Within this distance of a limit either level is right: noise, rounding, and a possible hysteresis of the device."""
SETTLE_NS: Final = 200 * NS_PER_MS
"""Longest delay of the line behind the angle (assumed)."""
FAULT_NS: Final = 2 * NS_PER_S
"""A contradiction is reported after this time."""


class AlarmVerdict(StrEnum):
    """Result of the comparison."""

    UNKNOWN = "unknown"
    """Settings or angles are not known, or an angle is too near to its limit."""
    RIGHT = "right"
    """The level agrees with the angles."""
    STUCK_LOW = "stuck_low"
    """An angle is out of its range, and the line is low: not connected, another pin, or pulled down."""
    STUCK_HIGH = "stuck_high"
    """The line is high though no angle is out of its range: inverted, another pin, or pulled up."""
    OTHER_AXIS = "other_axis"
    """The line changes, and always agrees with roll and pitch exchanged. Needs the history that `AlarmCheck` has."""


def judge(ranges: Mapping[str, AlarmRange], euler_rad: Vector3 | None, level: bool) -> AlarmVerdict:
    """Compare the level of the line with the angles of one sample. Pure."""
    if not ranges or euler_rad is None:
        return AlarmVerdict.UNKNOWN
    expected = _expected(ranges, euler_rad)
    if expected is None:
        return AlarmVerdict.UNKNOWN
    if expected == level:
        return AlarmVerdict.RIGHT
    return AlarmVerdict.STUCK_LOW if expected else AlarmVerdict.STUCK_HIGH


class AlarmCheck:
    """Verdict over time: the line may lag behind the angle, so only lasting contradictions count. One thread."""

    def __init__(self, ranges: Mapping[str, AlarmRange]) -> None:
        """`ranges` by name of the axis."""
        self.verdict = AlarmVerdict.UNKNOWN
        """The present verdict."""
        self._ranges = dict(ranges)
        self._candidate = AlarmVerdict.UNKNOWN
        self._since_ns = 0
        self._levels: set[bool] = set()
        # whether the line has agreed for long where it would contradict with the axes exchanged
        self._axes_proven = False

    def add_sample(self, t_ns: int, euler_rad: Vector3 | None, level: bool) -> AlarmVerdict | None:
        """Compare a sample with the level of the line at its time; return the new verdict if it changed."""
        verdict = judge(self._ranges, euler_rad, level)
        if euler_rad is None or verdict is AlarmVerdict.UNKNOWN:
            return None
        self._levels.add(level)
        if verdict is not self._candidate:
            self._candidate, self._since_ns = verdict, t_ns
        needed_ns = SETTLE_NS if verdict is AlarmVerdict.RIGHT else FAULT_NS
        if t_ns - self._since_ns < needed_ns:
            return None
        roll, pitch, yaw = euler_rad
        exchanged = judge(self._ranges, (pitch, roll, yaw), level)
        if verdict is AlarmVerdict.RIGHT:
            self._axes_proven |= exchanged in (AlarmVerdict.STUCK_LOW, AlarmVerdict.STUCK_HIGH)
        elif exchanged is AlarmVerdict.RIGHT and len(self._levels) > 1 and not self._axes_proven:
            verdict = AlarmVerdict.OTHER_AXIS
        if verdict is self.verdict:
            return None
        self.verdict = verdict
        return verdict


def _expected(ranges: Mapping[str, AlarmRange], euler_rad: Vector3) -> bool | None:
    """Return the level that the line should have; None if a decisive angle is too near to its limit."""
    unsure = False
    for limits in ranges.values():
        if not limits.enabled:
            continue
        angle_deg = degrees(euler_rad[limits.euler_index])
        outside_deg = max(limits.low_deg - angle_deg, angle_deg - limits.high_deg)
        if outside_deg > MARGIN_DEG:
            return True
        unsure = unsure or outside_deg >= -MARGIN_DEG
    return None if unsure else False


INTERVAL_NS: Final = NS_PER_S
"""At most one event a second: an angle at its limit makes the line chatter."""
FRESH_NS: Final = 150 * NS_PER_MS
"""The level is compared with a sample no older than this; `tick` comes every 100 ms."""

# the fault by verdict, and what to check
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


class AlarmLine:
    """Level of the line, with its events. Synchronization: one thread."""

    def __init__(self, raise_event: RaiseEvent) -> None:
        self.active: bool | None = None
        """Whether there is an alarm now; None while the line is closed or gone."""
        self.raised = 0
        """Number of times that it became active, including an active level found at opening."""
        self._raise_event = raise_event
        self._changes = 0  # changes since the last event
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
