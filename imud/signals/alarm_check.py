"""Check of the ALARM line against the angles of the samples, which finds wiring faults.

The line should be active while an angle is outside the range that the device is set to. The driver reads the ranges
from the device's settings (`Driver.alarm_ranges`); without them nothing is checked. If the line contradicts the angles,
but agrees with roll and pitch exchanged, the verdict is OTHER_AXIS.
"""

from collections.abc import Mapping
from enum import StrEnum
from math import degrees
from typing import Final

from imud.contracts.lines import AlarmRange
from imud.sample import Vector3
from imud.units import NS_PER_MS, NS_PER_S

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
        self._axes_proven = False
        """Whether the line has agreed for long where it would contradict with the axes exchanged."""

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
