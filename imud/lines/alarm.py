"""ALARM line of a device: level, events at a limited rate, and a check of its wiring."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from math import degrees
from typing import Final

from imud.contracts.lines import AlarmRange, AlarmRanges, Edge
from imud.model.event import EventKind, RaiseEvent
from imud.model.sample import Sample, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S

# distance from a limit in which both levels are correct, degrees: noise, rounding and hysteresis of the device
MARGIN_DEG: Final = 0.5
SETTLE_NS: Final = 200 * NS_PER_MS  # maximum delay of the line behind the angle, ns (assumed)
FAULT_NS: Final = 2 * NS_PER_S  # duration of a contradiction before imud reports it, ns


class AlarmVerdict(StrEnum):
    """Result of the comparison of level and angles."""

    UNKNOWN = "unknown"  # settings or angles are unknown, or an angle is too close to its limit
    RIGHT = "right"  # the level agrees with the angles
    # An angle is out of its range, and the line is low: not connected, another pin, or pulled down.
    STUCK_LOW = "stuck_low"
    STUCK_HIGH = "stuck_high"  # the line is high, and no angle is out of its range: inverted, another pin, or pulled up
    # The line always agrees with roll and pitch exchanged. Only `AlarmCheck` finds this, because it needs the history.
    OTHER_AXIS = "other_axis"


def judge(ranges: Mapping[str, AlarmRange], euler_rad: Vector3 | None, level: bool) -> AlarmVerdict:
    """Compare the level of the line with the angles of one sample."""
    if not ranges or euler_rad is None:
        return AlarmVerdict.UNKNOWN
    expected = _expected(ranges, euler_rad)
    if expected is None:
        return AlarmVerdict.UNKNOWN
    if expected == level:
        return AlarmVerdict.RIGHT
    return AlarmVerdict.STUCK_LOW if expected else AlarmVerdict.STUCK_HIGH


class AlarmCheck:
    """Verdict over time. Only a lasting contradiction counts, because the line lags behind the angle."""

    def __init__(self, ranges: Mapping[str, AlarmRange]) -> None:
        """`ranges` contains the range of each axis."""
        self.verdict = AlarmVerdict.UNKNOWN
        self._ranges = dict(ranges)
        self._candidate = AlarmVerdict.UNKNOWN
        self._since_ns = 0
        self._levels: set[bool] = set()
        # the line agreed for long at angles at which exchanged axes would contradict
        self._axes_proven = False

    def add_sample(self, t_ns: int, euler_rad: Vector3 | None, level: bool) -> AlarmVerdict | None:
        """Compare a sample with the level of the line at its time. Return the new verdict if it changed, else None."""
        verdict = judge(self._ranges, euler_rad, level)
        if euler_rad is None or verdict is AlarmVerdict.UNKNOWN:
            return None
        self._levels.add(level)  # seen levels: a line that never changes is stuck
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
    """Return the expected level of the line; None if a decisive angle is too close to its limit."""
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


# Minimum time between two events, ns. An angle at its limit makes the line change rapidly.
INTERVAL_NS: Final = NS_PER_S
FRESH_NS: Final = 150 * NS_PER_MS  # Maximum age of a sample for the comparison, ns. `tick` runs every 100 ms.

# problem for each verdict, and the next step
_PROBLEMS: Final = {
    AlarmVerdict.STUCK_LOW: (
        "it is low while an angle is out of the range in the device settings ({ranges}): is the wire connected to the "
        "alarm pin ({pin})?"
    ),
    AlarmVerdict.STUCK_HIGH: (
        "it is high while no angle is out of the range in the device settings ({ranges}): is it inverted "
        "(active_low), or is the wire connected to another pin?"
    ),
    AlarmVerdict.OTHER_AXIS: (
        "it follows the other axis ({ranges}): does the mounting differ from the device settings ({mounting})?"
    ),
}


class AlarmLine:
    """Level of the line and its events. Synchronization: one thread."""

    def __init__(self, raise_event: RaiseEvent) -> None:
        self.active: bool | None = None  # whether an alarm is active; None while the line is closed or missing
        self.raised = 0  # number of alarms, including an alarm that is active when the line is opened
        self._raise_event = raise_event
        self._changes = 0  # changes of the level since the last event
        self._due_ns = 0  # time of the next event

    def on_level(self, now_ns: int, active: bool | None) -> None:
        """Process a level after the opening or after lost edges; None if the line is closed or missing."""
        if active is None:
            self.active = None
            return
        self._set_active(active)
        self.tick(now_ns)

    def on_edges(self, edges: Sequence[Edge]) -> None:
        """Process edges of the line. Ignore an edge to the present level."""
        for edge in edges:
            self._set_active(edge.rising)
            self.tick(edge.t_ns)

    def tick(self, now_ns: int) -> None:
        """Raise the pending event if the last event is at least INTERVAL_NS old."""
        if not self._changes or now_ns < self._due_ns or self.active is None:
            return
        changes, self._changes, self._due_ns = self._changes, 0, now_ns + INTERVAL_NS
        words = "alarm" if self.active else "alarm ended"
        often = f" (the line changed {changes} times)" if changes > 1 else ""
        self._raise_event(
            now_ns, EventKind.ALARM, words + often, active=self.active, raised=self.raised, changes=changes
        )

    def _set_active(self, active: bool) -> None:
        if active != self.active and (active or self.active is not None):  # an inactive level at opening: no event
            self._changes += 1
            self.raised += active
        self.active = active


class AlarmMonitor:
    """`AlarmLine` with a check against the samples. Synchronization: the event loop's thread only."""

    def __init__(self, raise_event: RaiseEvent) -> None:
        self.line = AlarmLine(raise_event)
        self.problem = ""  # reason why the wiring is wrong, one sentence; empty if no sign of a wrong wiring exists
        self._raise_event = raise_event
        self._ranges: AlarmRanges | None = None
        self._check = AlarmCheck({})

    def set_ranges(self, ranges: AlarmRanges | None) -> None:
        """Set the ranges that the line indicates. None disables the check."""
        if ranges != self._ranges:
            self._ranges, self.problem = ranges, ""
            self._check = AlarmCheck(ranges.by_axis if ranges is not None else {})

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Raise pending events, and compare the line with the newest sample. Call this method at 10 Hz."""
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
