"""Level of the ALARM line compared with the angles: verdicts on one sample, and over time."""

from math import radians

import pytest

from imud.contracts.lines import AlarmRange
from imud.lines.alarm import AlarmCheck, AlarmVerdict, judge
from imud.model.sample import Vector3
from imud.model.units import NS_PER_MS

FAULT_NS = 2 * 10**9
MARGIN_DEG = 0.5
SETTLE_NS = 200 * 10**6

ROLL, PITCH = 0, 1
BOTH = {"X": AlarmRange(PITCH, -10, 10, True), "Y": AlarmRange(ROLL, -5, 5, True)}
ONLY_Y = {"X": AlarmRange(PITCH, -10, 10, False), "Y": AlarmRange(ROLL, -5, 5, True)}


def angles(x_deg: float, y_deg: float) -> Vector3:
    """Roll is about Y, pitch about X."""
    return radians(y_deg), radians(x_deg), radians(77)


@pytest.mark.parametrize(
    ("ranges", "euler_rad", "level", "verdict"),
    [
        (BOTH, angles(0, 0), False, AlarmVerdict.RIGHT), (BOTH, angles(0, 0), True, AlarmVerdict.STUCK_HIGH),
        (BOTH, angles(0, -6), True, AlarmVerdict.RIGHT), (BOTH, angles(12, 12), False, AlarmVerdict.STUCK_LOW),
        (BOTH, angles(-12, 0), False, AlarmVerdict.STUCK_LOW), (BOTH, angles(7, 0), True, AlarmVerdict.STUCK_HIGH),
        (ONLY_Y, angles(20, 0), False, AlarmVerdict.RIGHT), (ONLY_Y, angles(20, 0), True, AlarmVerdict.STUCK_HIGH),
        (BOTH, angles(9.6, 0), False, AlarmVerdict.UNKNOWN), (BOTH, angles(9.6, 7), False, AlarmVerdict.STUCK_LOW),
        (BOTH, angles(10.4, 0), True, AlarmVerdict.UNKNOWN), (BOTH, None, True, AlarmVerdict.UNKNOWN),
        ({}, angles(0, 0), True, AlarmVerdict.UNKNOWN),
    ],
)  # fmt: skip
@pytest.mark.manual("B 2.2.4 alarm level")
def test_verdicts(ranges: dict[str, AlarmRange], euler_rad: Vector3 | None, level: bool, verdict: AlarmVerdict) -> None:
    assert judge(ranges, euler_rad, level) is verdict


def test_at_the_limit_either_level_is_right() -> None:
    for at in (-5, 5):
        for off in (-0.9, 0.9):
            assert judge(ONLY_Y, angles(0, at + off * MARGIN_DEG), True) is AlarmVerdict.UNKNOWN
    assert judge(ONLY_Y, angles(0, 5 + 1.1 * MARGIN_DEG), True) is AlarmVerdict.RIGHT
    assert judge(ONLY_Y, angles(0, -5 + 1.1 * MARGIN_DEG), False) is AlarmVerdict.RIGHT


def test_a_lasting_contradiction_is_reported_once() -> None:
    check, changes = AlarmCheck(ONLY_Y), []
    step_ns = 10 * NS_PER_MS
    for number in range(1000):
        out = 100 <= number < 200 or number >= 300
        level = 103 <= number < 203  # it lags; the wire is broken from 300 on
        change = check.add_sample(number * step_ns, angles(0, 9.0 if out else 0.0), level)
        if change:
            changes.append((number, change))
    assert changes == [(SETTLE_NS // step_ns, AlarmVerdict.RIGHT), (300 + FAULT_NS // step_ns, AlarmVerdict.STUCK_LOW)]
    assert check.verdict is AlarmVerdict.STUCK_LOW


def run(levels_of_y: bool, *, stuck: bool = False) -> AlarmVerdict:
    """A device that tilts about X, then about Y. Its line follows the tilt about Y, the tilt about X, or no tilt."""
    check = AlarmCheck(ONLY_Y)
    for number in range(4000):
        x_deg, y_deg = (9.0, 0.0) if number % 2000 < 500 else (0.0, 9.0) if number % 2000 < 1000 else (0.0, 0.0)
        level = not stuck and (y_deg if levels_of_y else x_deg) > 5
        check.add_sample(number * 10 * NS_PER_MS, angles(x_deg, y_deg), level)
        if number % 2000 == 900:
            verdict = check.verdict
    return verdict


def test_exchanged_axes_are_distinguished_from_a_line_that_is_not_connected() -> None:
    assert run(levels_of_y=True) is AlarmVerdict.RIGHT
    assert run(levels_of_y=False) is AlarmVerdict.OTHER_AXIS
    assert run(levels_of_y=True, stuck=True) is AlarmVerdict.STUCK_LOW
    check = AlarmCheck(ONLY_Y)
    for number in range(1000):
        check.add_sample(number * 10 * NS_PER_MS, angles(0, 9), level=False)
    assert check.verdict is AlarmVerdict.STUCK_LOW
