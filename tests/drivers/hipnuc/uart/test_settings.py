"""Settings of a HiPNUC device: read by name and as text, written, read back, saved, on every simulated variant."""

from itertools import product
from typing import Any

import msgspec
import pytest

from imud import config
from imud.config.schema import TABLES
from imud.contracts import lines as contract
from imud.contracts.command import Target
from imud.contracts.lines import AlarmRange, DeviceLines, DividedOptions, InputOptions, SoutOptions
from imud.contracts.setting import Effect, combined
from imud.drivers.hipnuc.uart import settings as uart_settings
from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.drivers.hipnuc.uart.replies import parse_report
from imud.drivers.hipnuc.uart.settings import SETTINGS, alarm_ranges, report_values, shown
from imud.model.errors import BadArgument, ConfigError
from imud.sim.hipnuc.uart_settings import VARIANTS, AlarmSetting, Behaviour, ModuleSettings, Output
from tests.support.simulated_modules import HipnucLine, hardware_of

TABLE = SETTINGS.table
DELIVERED = {
    "output": {"hi91": 100, "hi92": 0}, "mode": "6-axis", "mounting": "level", "magnetic_calibration": True,
    "pins": {"sin": 1, "sout": 2, "led": 5, "sout_div": 6, "alarm": 9}, "sout_divisor": 8,
    "alarm": {axis: {"min_deg": -5.0, "max_deg": 5.0, "enabled": False} for axis in "xy"},
    "magnetometer_bias": [0.0, 0.0, 0.0], "baud": 115200,
}  # fmt: skip


def read(line: HipnucLine) -> dict[str, Any]:
    """Return the settings that the table reads, as JSON values."""
    reports = line.run(SETTINGS.read(Target(None, line.baud), None))
    values: dict[str, Any] = msgspec.to_builtins(combined(reports).values)
    return values


@pytest.mark.manual("B 3.2 factory output", "B 2.2.4 when CONFIG acts")
def test_factory_settings_and_the_table() -> None:
    line = HipnucLine()
    assert read(line) == DELIVERED
    for name, value in DELIVERED.items():
        assert TABLE[name].agrees(value, value)
    for name, setting in TABLE.items():
        info = msgspec.inspect.type_info(setting.type)
        assert isinstance(info, msgspec.inspect.Metadata), name
        assert (info.extra or {})["section"]
        assert (info.extra_json_schema or {})["description"]
    assert [name for name, setting in TABLE.items() if setting.effect is Effect.AFTER_RESTART] == [
        "mounting",
        "coordinates",
    ]
    assert [name for name, setting in TABLE.items() if setting.connection] == ["baud"] == [*TABLE][-1:]
    line = HipnucLine()
    setting = TABLE["output_enabled"]
    assert setting.write is not None
    assert not setting.readable
    line.run(setting.write(Target(None, 115200), False))
    line.wait(50)
    assert line.wait(200) == []
    line.run(setting.write(Target(None, 115200), True))
    assert len(line.wait(200)) == pytest.approx(20, abs=2)


def test_the_same_in_words_with_units_and_lines_of_an_unknown_form_unchanged() -> None:
    settings = ModuleSettings(
        att_mode=1, hi91=Output(40), hi92=Output(on_mark=True), alarm_y=AlarmSetting(-5, 7.5, True), sout_div=4,
        urfr=(0.8, -0.6, 0, 0.6, 0.8, 0, 0, 0, 1),
    )  # fmt: skip
    line = HipnucLine(settings, hardware_of(Behaviour(), mag_bias_t=(14.14e-6, -2.08e-6, -8.75e-6)))
    words = shown(
        {
            **combined(line.run(SETTINGS.read(Target(None, 0), None))).words,
            "TEMP_COEF": "1.5",
            "COMCONFIG 7": "a line of another form",
        }
    )
    assert words == {
        "output.hi91": "25 Hz", "output.hi92": "on mark", "mode": "9-axis",
        "mounting": "0.8, -0.6, 0, 0.6, 0.8, 0, 0, 0, 1", "magnetic_calibration": "on", "pins.sin": "IO1",
        "pins.sout": "IO2", "pins.led": "IO5", "pins.sout_div": "IO6", "pins.alarm": "IO9", "sout_divisor": "4",
        "alarm.x": "-5° … 5°, off", "alarm.y": "-5° … 7.5°, on", "magnetometer_bias": "14.14, -2.08, -8.75 µT",
        "baud": "115200 bit/s", "TEMP_COEF": "1.5", "COMCONFIG 7": "a line of another form",
    }  # fmt: skip
    assert (
        shown(combined(HipnucLine().run(SETTINGS.read(Target(None, 0), None))).words)["magnetometer_bias"]
        == "0, 0, 0 µT: not calibrated"
    )

    for raw in (
        {},
        {"ATT_MODE": "x", "URFR": "1,2,3", "EN_MCAL": "x", "PMUX1": "IO0", "SOUT_DIV": "", "MB": "nan, 0, 0"},
        {"URFR": "1,0,0,0,1,0,0,0,inf", "BAUD": "123", "ALARM_X": "-5,5", "COMCONFIG 1": "LOG HI93 ONTIME 1"},
    ):
        assert (report_values(raw), shown(raw)) == ({}, raw)


CHANGES: list[tuple[str, Any, dict[str, Any]]] = [
    ("mode", "9-axis", {"att_mode": 1}), ("mounting", "x_up", {"urfr": (0, 0, -1, 0, 1, 0, 1, 0, 0)}),
    ("mounting", [0.8, -0.6, 0, 0.6, 0.8, 0, 0, 0, 1], {"urfr": (0.8, -0.6, 0, 0.6, 0.8, 0, 0, 0, 1)}),
    ("magnetic_calibration", False, {"mag_calibration": False}),
    ("pins", {"led": 3, "sout_div": 7}, {"pins": (1, 2, 3, 7, 9)}), ("sout_divisor", 64, {"sout_div": 64}),
    ("alarm", {"y": {"min_deg": -5, "max_deg": 5}}, {"alarm_y": AlarmSetting(-5, 5, True)}),
    ("output", {"hi91": 0, "hi92": 8}, {"hi91": Output(), "hi92": Output(125)}),
    ("output", {"hi91": "on_mark"}, {"hi91": Output(on_mark=True)}), ("baud", 921600, {"baud": 921600}),
]  # fmt: skip


IN_EVERY_VARIANT = ("mode", "baud")
CASES = [
    (behaviour, *change)
    for behaviour, change in product(VARIANTS.values(), CHANGES)
    if behaviour == Behaviour() or change[0] in IN_EVERY_VARIANT
]


@pytest.mark.parametrize(("behaviour", "name", "given", "changed"), CASES)
@pytest.mark.manual("B 2.2.2 SAVECONFIG")
def test_written_read_back_saved_and_kept_over_a_restart(
    behaviour: Behaviour, name: str, given: Any, changed: dict[str, Any]
) -> None:
    line = HipnucLine(hardware=hardware_of(behaviour))
    setting = TABLE[name]
    assert setting.write is not None
    assert SETTINGS.save is not None
    assert SETTINGS.restart is not None
    value = msgspec.convert(given, setting.type)
    assert not setting.agrees(value, combined(line.run(SETTINGS.read(Target(None, 0), None))).values[name])
    line.run(setting.write(Target(None, line.baud), value))
    assert setting.agrees(value, combined(line.run(SETTINGS.read(Target(None, 0), None))).values[name])
    line.run(SETTINGS.save(Target(None, line.baud)))
    line.run(SETTINGS.restart(Target(None, line.baud)))
    assert setting.agrees(value, combined(line.run(SETTINGS.read(Target(None, 0), None))).values[name])
    assert {field: getattr(line.module.settings, field) for field in changed} == changed


@pytest.mark.manual("B 2.2.4 PMUX")
def test_combinations_are_accepted_or_rejected_and_a_declaration_is_checked_by_its_types() -> None:
    for values, words in (
        ({"output": {"hi91": 200}}, "HI91: expected at most 100 Hz at 115200 baud, got 200 Hz"),
        ({"output": {"hi91": 100, "hi92": 100}}, "got 136000 bit/s by HI91 at 100 Hz and HI92 at 100 Hz"),
        ({"output": {"hi91": 100}, "baud": 9600}, "at most 10 Hz at 9600 baud"),
        ({"pins": {"sin": 2, "sout": 2}}, "pins: expected another pin for each function, got IO2 for sin and sout"),
        ({"alarm": {"x": {"min_deg": 5, "max_deg": 5}}}, "alarm.x: expected the minimum below the maximum"),
    ):
        with pytest.raises(BadArgument, match=words):
            SETTINGS.check(Target(None, 115200), values)
    for accepted in (
        DELIVERED, {"output": {"hi91": 1000}, "baud": 921600}, {"output": {"hi91": "on_mark", "hi92": 200}},
        {"output": {"hi91": 100, "hi92": 50}}, {},
    ):  # fmt: skip
        SETTINGS.check(Target(None, 115200), accepted)
    for given in (
        {"output": {"hi93": 1}}, {"output": {"hi91": 300}}, {"mode": "7-axis"}, {"mounting": "x+90"},
        {"pins": {"sin": 10}}, {"sout_divisor": 65}, {"alarm": {"z": {"min_deg": 0, "max_deg": 1}}},
        {"alarm": {"x": {"min_deg": -181, "max_deg": 1}}}, {"baud": 57600}, {"magnetometer_bias": [0, 0, 0]},
    ):  # fmt: skip
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(given, SETTINGS.declarable)


def x(low_deg: float, high_deg: float, enabled: bool = True) -> dict[str, AlarmRange]:
    """X is pitch."""
    return {"X": AlarmRange(1, low_deg, high_deg, enabled)}


def y(low_deg: float, high_deg: float, enabled: bool = True) -> dict[str, AlarmRange]:
    """Y is roll."""
    return {"Y": AlarmRange(0, low_deg, high_deg, enabled)}


@pytest.mark.manual("B 2.2.4 alarm range")
def test_the_alarm_is_read_from_the_modules_own_lines_and_from_other_forms() -> None:
    settings = ModuleSettings(alarm_x=AlarmSetting(-5, 5.5, False), alarm_y=AlarmSetting(-30.25, 12, True))
    report = parse_report([*settings.user_lines(), "OK"]).values
    assert DRIVER.alarm_ranges is not None
    assert DRIVER.alarm_ranges(report_values(report)) == contract.AlarmRanges(
        {**x(-5, 5.5, False), **y(-30.25, 12)}, "PMUX5", "URFR"
    )
    for name, value, expected in (
        ("PMUX5", "Y,-5,5,0,1", y(-5, 5)), ("ALARM X", " +1.5 , 2 , 0 , 0 ", x(1.5, 2, False)),
        ("pmux5_y", "-5,5,0,1", y(-5, 5)), ("IO_ALARM", "x,-5,5,0,1", x(-5, 5)), ("PMUX5", "IO9", {}),
        ("PMUX5", "-5,5,0,1", {}),  # the axis is missing
        ("ALARM_X", "-5,5,0,2", {}), ("ALARM_X", "-5,5,1", {}), ("URFR", "1,0,0,0,1,0,0,0,1", {}),
    ):  # fmt: skip
        assert alarm_ranges(report_values({name: value})).by_axis == expected


@pytest.mark.parametrize(
    ("line", "value"),
    [("COORD 4", 4), ("coord,4.0", 4), ("IMU_COORD: 04", 4), ("CONFIG IMU COORD 2", 2), ("Coord: 0", 0),
     ("COORD=", "no value"), ("COORD=-1", -1), ("COORD=0.5", "0.5"), ("COORDS=4", None), ("", None)],
)  # fmt: skip
def test_coordinates_select_axes_and_the_angles_of_the_alarm(line: str, value: int | str | None) -> None:
    """COORD 4 makes roll the angle about the x axis, which the alarm of X watches."""
    settings = ModuleSettings(alarm_x=AlarmSetting(-5, 5.5, False), alarm_y=AlarmSetting(-30.25, 12, True))
    report = parse_report([*settings.user_lines(), line])
    raw = {**report.values, **{f"USRCONFIG {n}": other for n, other in enumerate(filter(None, report.other), 1)}}
    assert report_values(raw).get("coordinates") == value
    sent = DRIVER.sent_axes(shown(raw))
    assert (sent.navigation_frame == "NWU", bool(sent.problem)) == (value == 4, value not in (0, 4, None))
    by_axis = alarm_ranges(report_values(raw)).by_axis
    assert (by_axis["X"].euler_index, by_axis["Y"].euler_index) == ((0, 1) if value == 4 else (1, 0))


SOUT = DeviceLines(sout=SoutOptions(line="A"))
DIVIDED = DeviceLines(sout_div=DividedOptions(line="B", divisor=4))
SIN = DeviceLines(sin=contract.TriggerOptions(line="C", rate_hz=200))
PPS = DeviceLines(pps=contract.PpsOptions(line="D"))
ALARM = DeviceLines(alarm=InputOptions(line="E"))
MARKED = Output(on_mark=True)


@pytest.mark.parametrize(
    ("lines", "settings", "found"),
    [
        (SOUT, ModuleSettings(), {}),
        (SOUT, ModuleSettings(pins=(1, 2, 2, 6, 9)), {"sout": "the device has sout and led on IO2: move one"}),
        (DIVIDED, ModuleSettings(sout_div=4), {}),
        (DIVIDED, ModuleSettings(), {"sout_div": "expected divisor 4 from the configuration, got 8 from the device"}),
        (SIN, ModuleSettings(baud=921600, hi91=MARKED), {}),
        (SIN, ModuleSettings(), {"sin": "no message of the device is on mark"}),
        (
            SIN,
            ModuleSettings(hi91=MARKED),
            {"sin": "expected triggers of at most 100 Hz for HI91 at 115200 baud, got 200 Hz"},
        ),
        (SIN, ModuleSettings(hi91=Output(), hi92=MARKED), {"sin": "HI92 on mark has no device time"}),
        (PPS, ModuleSettings(), {}),
        (PPS, ModuleSettings(hi91=MARKED), {"pps": "HI91 on mark: each pulse per second makes a sample"}),
        (ALARM, ModuleSettings(alarm_y=AlarmSetting(-5, 5, True)), {}),
        (ALARM, ModuleSettings(), {"alarm": "the device watches no angle"}),
    ],
)
def test_contradictions_of_the_device_are_found(
    lines: DeviceLines, settings: ModuleSettings, found: dict[str, str]
) -> None:
    differences = uart_settings.line_differences(
        combined(HipnucLine(settings).run(SETTINGS.read(Target(None, 0), None))).values, lines
    )
    assert differences.keys() == found.keys()
    for key, words in found.items():
        assert words in differences[key]


@pytest.mark.parametrize(
    ("lines", "declared", "found"),
    [
        (SIN, {"output": {"hi91": 0, "hi92": "on_mark"}}, {"sin": "HI92 on mark has no device time"}),
        (SIN, {"output": {"hi91": 100, "hi92": 0}}, {"sin": "no message of the device is on mark"}),
        (SIN, {"output": {"hi91": "on_mark", "hi92": 0}}, {}),
        (SIN, {"output": {"hi92": "on_mark"}}, {}),  # the device may have HI91 on mark
        (DIVIDED, {"sout_divisor": 8}, {"sout_div": "expected divisor 4 from the configuration"}),
        (SOUT, {"pins": {"sout": 2, "led": 2}}, {"sout": "sout and led on IO2"}),
        (ALARM, {"alarm": {"x": {"min_deg": -5, "max_deg": 5, "enabled": False}}}, {}),  # the device may watch Y
    ],
)
def test_contradictions_of_declared_settings_are_found(
    lines: DeviceLines, declared: dict[str, object], found: dict[str, str]
) -> None:
    differences = uart_settings.declared_line_differences(declared, lines)
    assert differences.keys() == found.keys()
    for key, words in found.items():
        assert words in differences[key]


def test_check_refuses_a_line_that_declared_settings_contradict_but_compares_no_unreported_settings() -> None:
    text = (
        "devices:\n  bow:\n    driver: hipnuc-uart\n    uart: {port: /dev/ttyUSB0, baud: 921600}\n"
        "    lines: {sin: {line: GPIO1, rate_hz: 10}}\n    settings: {output: {hi91: 0, hi92: on_mark}}\n"
    )
    with pytest.raises(ConfigError, match=r"f:5:\d+: devices\.bow\.lines\.sin: .*HI92 on mark has no device time"):
        config.parse(text, "f", TABLES)
    for lines in (SOUT, DIVIDED, SIN, PPS, ALARM):
        assert uart_settings.line_differences({"mode": "6-axis"}, lines) == {}


@pytest.mark.parametrize(
    ("declared", "lines", "fed", "found"),
    [
        ({}, DeviceLines(), True, []),
        ({"output": {"hi91": 100, "hi92": 0}}, DeviceLines(), True, []),
        ({"output": {"hi92": 100}}, DeviceLines(), False, []),
        ({"output": {"hi92": 100}}, DeviceLines(), True, ["HI92 has no UTC"]),
        ({"output": {"hi92": 100}}, DeviceLines(pps=contract.PpsOptions(line="GPIO1")), False, ["HI92 has no UTC"]),
        (
            {"output": {"hi91": 50, "hi92": 50}}, DeviceLines(), False,
            ["HI92 next to HI91 is time-stamped by its arrival"],
        ),
    ],
)  # fmt: skip
def test_limits_of_hi92_are_reported(
    declared: dict[str, object], lines: DeviceLines, fed: bool, found: list[str]
) -> None:
    limits = uart_settings.message_limits(declared, lines, fed)
    assert len(limits) == len(found)
    assert all(limit.startswith(words) for limit, words in zip(limits, found, strict=True))
