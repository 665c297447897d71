"""What the alarm line should say by settings and angles, on the simulated module and by hand."""

from math import radians

import pytest

from imud.devices.hipnuc.uart.replies import parse_report
from imud.sample import Vector3
from imud.signals.alarm_check import (
    FAULT_NS,
    MARGIN_DEG,
    SETTLE_NS,
    AlarmCheck,
    AlarmRange,
    AlarmVerdict,
    alarm_settings,
    judge,
)
from imud.sim.hipnuc.uart.settings import AlarmSetting, ModuleSettings
from imud.units import NS_PER_MS

BOTH = {"X": AlarmRange(-10, 10, True), "Y": AlarmRange(-5, 5, True)}
ONLY_Y = {"X": AlarmRange(-10, 10, False), "Y": AlarmRange(-5, 5, True)}


def angles(x_deg: float, y_deg: float) -> Vector3:
    """Roll is about Y, pitch about X."""
    return radians(y_deg), radians(x_deg), radians(77)


def test_the_modules_own_lines_are_read() -> None:
    settings = ModuleSettings(alarm_x=AlarmSetting(-5, 5.5, False), alarm_y=AlarmSetting(-30.25, 12, True))
    told = parse_report([*settings.user_lines(), "OK"]).values
    assert alarm_settings(told) == {"X": AlarmRange(-5, 5.5, False), "Y": AlarmRange(-30.25, 12, True)}


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("PMUX5", "Y,-5,5,0,1", {"Y": AlarmRange(-5, 5, True)}),
        ("ALARM X", " +1.5 , 2 , 0 , 0 ", {"X": AlarmRange(1.5, 2, False)}),
        ("pmux5_y", "-5,5,0,1", {"Y": AlarmRange(-5, 5, True)}),
        ("IO_ALARM", "x,-5,5,0,1", {"X": AlarmRange(-5, 5, True)}),
        ("PMUX5", "IO9", {}),
        ("PMUX5", "-5,5,0,1", {}),  # which axis?
        ("ALARM_X", "-5,5,0,2", {}),
        ("ALARM_X", "-5,5,1", {}),
        ("URFR", "1,0,0,0,1,0,0,0,1", {}),
    ],
)
def test_other_forms(name: str, value: str, expected: dict[str, AlarmRange]) -> None:
    assert alarm_settings({name: value}) == expected


@pytest.mark.parametrize(
    ("ranges", "euler_rad", "level", "verdict"),
    [
        (BOTH, angles(0, 0), False, AlarmVerdict.RIGHT),
        (BOTH, angles(0, 0), True, AlarmVerdict.STUCK_HIGH),
        (BOTH, angles(0, -6), True, AlarmVerdict.RIGHT),
        (BOTH, angles(12, 12), False, AlarmVerdict.STUCK_LOW),
        (BOTH, angles(-12, 0), False, AlarmVerdict.STUCK_LOW),
        (BOTH, angles(7, 0), True, AlarmVerdict.STUCK_HIGH),
        (ONLY_Y, angles(20, 0), False, AlarmVerdict.RIGHT),
        (ONLY_Y, angles(20, 0), True, AlarmVerdict.STUCK_HIGH),
        (BOTH, angles(9.6, 0), False, AlarmVerdict.UNKNOWN),
        (BOTH, angles(9.6, 7), False, AlarmVerdict.STUCK_LOW),
        (BOTH, angles(10.4, 0), True, AlarmVerdict.UNKNOWN),
        (BOTH, None, True, AlarmVerdict.UNKNOWN),
        ({}, angles(0, 0), True, AlarmVerdict.UNKNOWN),
    ],
)
def test_verdicts(ranges: dict[str, AlarmRange], euler_rad: Vector3 | None, level: bool, verdict: AlarmVerdict) -> None:
    assert judge(ranges, euler_rad, level) is verdict


def test_at_the_limit_either_level_is_right() -> None:
    for at in (-5, 5):
        for off in (-0.9, 0.9):
            assert judge(ONLY_Y, angles(0, at + off * MARGIN_DEG), True) is AlarmVerdict.UNKNOWN
    assert judge(ONLY_Y, angles(0, 5 + 1.1 * MARGIN_DEG), True) is AlarmVerdict.RIGHT
    assert judge(ONLY_Y, angles(0, -5 + 1.1 * MARGIN_DEG), False) is AlarmVerdict.RIGHT


def test_only_what_lasts_is_told_and_once() -> None:
    check, told = AlarmCheck(ONLY_Y), []
    step_ns = 10 * NS_PER_MS
    for number in range(1000):
        out = 100 <= number < 200 or number >= 300
        level = 103 <= number < 203  # it lags, and from 300 on the wire is broken
        change = check.take(number * step_ns, angles(0, 9.0 if out else 0.0), level)
        if change:
            told.append((number, change))
    assert told == [
        (SETTLE_NS // step_ns, AlarmVerdict.RIGHT),
        (300 + FAULT_NS // step_ns, AlarmVerdict.STUCK_LOW),
    ]
    assert check.verdict is AlarmVerdict.STUCK_LOW


def run(levels_of_y: bool, *, stuck: bool = False) -> AlarmVerdict:
    """A device that tilts about X, then about Y; its line follows the tilt about Y, or that about X, or nothing."""
    check = AlarmCheck(ONLY_Y)
    for number in range(4000):
        x_deg, y_deg = (9.0, 0.0) if number % 2000 < 500 else (0.0, 9.0) if number % 2000 < 1000 else (0.0, 0.0)
        level = not stuck and (y_deg if levels_of_y else x_deg) > 5
        check.take(number * 10 * NS_PER_MS, angles(x_deg, y_deg), level)
        if number % 2000 == 900:
            verdict = check.verdict
    return verdict


def test_exchanged_axes_are_told_from_a_line_that_is_not_connected() -> None:
    assert run(levels_of_y=True) is AlarmVerdict.RIGHT
    assert run(levels_of_y=False) is AlarmVerdict.OTHER_AXIS
    assert run(levels_of_y=True, stuck=True) is AlarmVerdict.STUCK_LOW


def test_a_line_that_never_changed_is_not_blamed_on_the_axes() -> None:
    check = AlarmCheck(ONLY_Y)
    for number in range(1000):
        check.take(number * 10 * NS_PER_MS, angles(0, 9), level=False)
    assert check.verdict is AlarmVerdict.STUCK_LOW
