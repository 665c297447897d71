"""Whether the alarm line says what the device should say by its settings and its angles: a wiring fault shows.

HiPNUC, manual 2.2.4: `CONFIG PMUX5 AXIS,MIN,MAX,THR,ENABLE`; the line is high outside MIN … MAX degrees. How LOG
USRCONFIG prints that is in no source. Read are lines that name the alarm and hold the values in the command's order,
for example `ALARM_X: -5,5,0,1` or `PMUX5: Y,-5,5,0,1`; others leave the axis unknown, and then nothing is checked.
X is taken for the turn about X (pitch), Y for that about Y (roll): assumed. Where the other way round explains a line
that contradicts, the verdict says so.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import degrees
from typing import Final

from imud.sample import Vector3
from imud.units import NS_PER_MS, NS_PER_S

MARGIN_DEG: Final = 0.5
"""So near to a limit either level is right: noise, rounding, and a hysteresis that the manual does not mention."""
SETTLE_NS: Final = 200 * NS_PER_MS
"""The device may take so long to follow its angle (assumed)."""
FAULT_NS: Final = 2 * NS_PER_S
"""A contradiction that lasts so long is told."""

_NUMBER = r"[-+]?[0-9]+(?:\.[0-9]*)?"
_NAME: Final = re.compile(r"(?:PMUX5|.*ALARM)(?:[_ ]?([XY]))?", re.IGNORECASE)
_VALUES: Final = re.compile(
    rf"(?:([XY])\s*,\s*)?({_NUMBER})\s*,\s*({_NUMBER})\s*,\s*{_NUMBER}\s*,\s*([01])", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class AlarmRange:
    """What one axis is set to, degrees."""

    low_deg: float
    high_deg: float
    enabled: bool


def alarm_settings(settings: Mapping[str, str]) -> dict[str, AlarmRange]:
    """Ranges by axis (`X`, `Y`) out of the device's settings as read back; axes that they do not tell are missing."""
    ranges: dict[str, AlarmRange] = {}
    for name, value in settings.items():
        named, values = _NAME.fullmatch(name.strip()), _VALUES.fullmatch(value.strip())
        if not named or not values:
            continue
        axis = (values[1] or named[1] or "").upper()
        if axis:
            ranges[axis] = AlarmRange(float(values[2]), float(values[3]), values[4] == "1")
    return ranges


class AlarmVerdict(StrEnum):
    """What a level of the line means."""

    UNKNOWN = "unknown"
    """Settings or angles are not known, or an angle is too near to its limit."""
    RIGHT = "right"
    STUCK_LOW = "stuck_low"
    """An angle is out of its range, and the line is low: not connected, another pin, or pulled down."""
    STUCK_HIGH = "stuck_high"
    """No angle is out of its range, and the line is high: inverted, another pin, or pulled up."""
    OTHER_AXIS = "other_axis"
    """The line changes, and is always as it should be if the device's X and Y are exchanged: how is it mounted? Only
    `AlarmCheck` can tell."""


def judge(ranges: Mapping[str, AlarmRange], euler_rad: Vector3 | None, level: bool) -> AlarmVerdict:
    """Compare the line's level with one sample's angles. Pure."""
    if not ranges or euler_rad is None:
        return AlarmVerdict.UNKNOWN
    expected = _expected(ranges, {"X": degrees(euler_rad[1]), "Y": degrees(euler_rad[0])})
    if expected is None:
        return AlarmVerdict.UNKNOWN
    if expected == level:
        return AlarmVerdict.RIGHT
    return AlarmVerdict.STUCK_LOW if expected else AlarmVerdict.STUCK_HIGH


class AlarmCheck:
    """Verdicts over time: the line may lag, so only what lasts is told. Synchronization: one thread."""

    def __init__(self, ranges: Mapping[str, AlarmRange]) -> None:
        self.ranges = dict(ranges)
        self.verdict = AlarmVerdict.UNKNOWN
        """What holds now."""
        self._candidate = AlarmVerdict.UNKNOWN
        self._since_ns = 0
        self._levels: set[bool] = set()
        self._axes_proven = False
        """Whether the line was right for long where it would be wrong with the axes exchanged."""

    def take(self, t_ns: int, euler_rad: Vector3 | None, level: bool) -> AlarmVerdict | None:
        """One sample with the line's level at its time; returns the new verdict when it changed."""
        verdict = judge(self.ranges, euler_rad, level)
        if euler_rad is None or verdict is AlarmVerdict.UNKNOWN:
            return None
        self._levels.add(level)
        if verdict is not self._candidate:
            self._candidate, self._since_ns = verdict, t_ns
        needed_ns = SETTLE_NS if verdict is AlarmVerdict.RIGHT else FAULT_NS
        if t_ns - self._since_ns < needed_ns:
            return None
        roll, pitch, yaw = euler_rad
        exchanged = judge(self.ranges, (pitch, roll, yaw), level)
        if verdict is AlarmVerdict.RIGHT:
            self._axes_proven |= exchanged in (AlarmVerdict.STUCK_LOW, AlarmVerdict.STUCK_HIGH)
        elif exchanged is AlarmVerdict.RIGHT and len(self._levels) > 1 and not self._axes_proven:
            verdict = AlarmVerdict.OTHER_AXIS
        if verdict is self.verdict:
            return None
        self.verdict = verdict
        return verdict


def _expected(ranges: Mapping[str, AlarmRange], angles_deg: Mapping[str, float]) -> bool | None:
    """The level that the line should have; None where an angle that decides is too near to its limit.

    An axis that is not told counts as one that is off.
    """
    unsure = False
    for axis, angle_deg in angles_deg.items():
        limits = ranges.get(axis)
        if limits is None or not limits.enabled:
            continue
        outside_deg = max(limits.low_deg - angle_deg, angle_deg - limits.high_deg)
        if outside_deg > MARGIN_DEG:
            return True
        unsure = unsure or outside_deg >= -MARGIN_DEG
    return None if unsure else False
