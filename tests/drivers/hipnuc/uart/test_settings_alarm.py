"""Ranges of the ALARM pin from the settings, of the simulated device and by hand."""

import pytest

from imud.contracts.lines import AlarmRange, AlarmRanges
from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.drivers.hipnuc.uart.replies import parse_report
from imud.drivers.hipnuc.uart.settings import alarm_ranges, report_values, shown
from imud.sim.hipnuc.uart_settings import AlarmSetting, ModuleSettings


def x(low_deg: float, high_deg: float, enabled: bool = True) -> dict[str, AlarmRange]:
    """X is pitch."""
    return {"X": AlarmRange(1, low_deg, high_deg, enabled)}


def y(low_deg: float, high_deg: float, enabled: bool = True) -> dict[str, AlarmRange]:
    """Y is roll."""
    return {"Y": AlarmRange(0, low_deg, high_deg, enabled)}


@pytest.mark.manual("B 2.2.4 alarm range")
def test_the_modules_own_lines_are_read() -> None:
    settings = ModuleSettings(alarm_x=AlarmSetting(-5, 5.5, False), alarm_y=AlarmSetting(-30.25, 12, True))
    report = parse_report([*settings.user_lines(), "OK"]).values
    assert DRIVER.alarm_ranges is not None
    assert DRIVER.alarm_ranges(report_values(report)) == AlarmRanges(
        {**x(-5, 5.5, False), **y(-30.25, 12)}, "PMUX5", "URFR"
    )


@pytest.mark.parametrize(
    ("line", "value"),
    [("COORD 4", "4"), ("COORD=4", "4"), ("IMU_COORD: 04", "4"), ("CONFIG IMU COORD 2", "2"), ("COORD: 0", "0"),
     ("COORDS=4", None), ("", None)],
)  # fmt: skip
def test_coordinates_select_axes_and_the_angles_of_the_alarm(line: str, value: str | None) -> None:
    """COORD 4 makes roll the angle about the x axis, which the alarm of X watches."""
    settings = ModuleSettings(alarm_x=AlarmSetting(-5, 5.5, False), alarm_y=AlarmSetting(-30.25, 12, True))
    report = parse_report([*settings.user_lines(), line])
    raw = {**report.values, **{f"USRCONFIG {n}": other for n, other in enumerate(filter(None, report.other), 1)}}
    assert report_values(raw).get("coordinates") == value
    sent = DRIVER.sent_axes(shown(raw))
    assert (sent.navigation_frame == "NWU") == (value == "4")
    assert bool(sent.problem) == (value == "2")
    by_axis = alarm_ranges(report_values(raw)).by_axis
    assert (by_axis["X"].euler_index, by_axis["Y"].euler_index) == ((0, 1) if value == "4" else (1, 0))


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("PMUX5", "Y,-5,5,0,1", y(-5, 5)), ("ALARM X", " +1.5 , 2 , 0 , 0 ", x(1.5, 2, False)),
        ("pmux5_y", "-5,5,0,1", y(-5, 5)), ("IO_ALARM", "x,-5,5,0,1", x(-5, 5)), ("PMUX5", "IO9", {}),
        ("PMUX5", "-5,5,0,1", {}),  # the axis is missing
        ("ALARM_X", "-5,5,0,2", {}), ("ALARM_X", "-5,5,1", {}), ("URFR", "1,0,0,0,1,0,0,0,1", {}),
    ],
)  # fmt: skip
def test_other_forms(name: str, value: str, expected: dict[str, AlarmRange]) -> None:
    assert alarm_ranges(report_values({name: value})).by_axis == expected
