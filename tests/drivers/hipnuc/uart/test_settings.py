"""Settings of a HiPNUC device: read by name and as text, written, read back, saved, on every simulated variant."""

from itertools import product
from typing import Any

import msgspec
import pytest

from imud.contracts.command import Target
from imud.contracts.setting import Effect, values_of, words_of
from imud.drivers.hipnuc.uart.settings import SETTINGS, report_values, shown
from imud.model.errors import BadArgument
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
    values: dict[str, Any] = msgspec.to_builtins(values_of(line.run(SETTINGS.read(Target(None, line.baud), None))))
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
    assert [name for name, setting in TABLE.items() if setting.effect is Effect.AFTER_RESTART] == ["mounting"]
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


def test_the_same_in_words_with_units() -> None:
    settings = ModuleSettings(
        att_mode=1, hi91=Output(40), hi92=Output(on_mark=True), alarm_y=AlarmSetting(-5, 7.5, True), sout_div=4,
        urfr=(0.8, -0.6, 0, 0.6, 0.8, 0, 0, 0, 1),
    )  # fmt: skip
    line = HipnucLine(settings, hardware_of(Behaviour(), mag_bias_t=(14.14e-6, -2.08e-6, -8.75e-6)))
    words = shown(
        {
            **words_of(line.run(SETTINGS.read(Target(None, 0), None))),
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
        shown(words_of(HipnucLine().run(SETTINGS.read(Target(None, 0), None))))["magnetometer_bias"]
        == "0, 0, 0 µT: not calibrated"
    )


@pytest.mark.parametrize(
    "raw",
    [
        {},
        {"ATT_MODE": "7", "URFR": "1,2,3", "EN_MCAL": "x", "PMUX1": "IO0", "SOUT_DIV": "", "MB": "nan, 0, 0"},
        {"URFR": "1,0,0,0,1,0,0,0,inf", "BAUD": "123", "ALARM_X": "-5,5", "COMCONFIG 1": "LOG HI93 ONTIME 1"},
    ],
)
def test_lines_of_an_unknown_form_are_shown_unchanged(raw: dict[str, str]) -> None:
    assert report_values(raw) == {}
    assert shown(raw) == raw


CHANGES: list[tuple[str, Any, dict[str, Any]]] = [
    ("mode", "9-axis", {"att_mode": 1}),
    ("mounting", "x_up", {"urfr": (0, 0, -1, 0, 1, 0, 1, 0, 0)}),
    ("mounting", [0.8, -0.6, 0, 0.6, 0.8, 0, 0, 0, 1], {"urfr": (0.8, -0.6, 0, 0.6, 0.8, 0, 0, 0, 1)}),
    ("magnetic_calibration", False, {"mag_calibration": False}),
    ("pins", {"led": 3, "sout_div": 7}, {"pins": (1, 2, 3, 7, 9)}),
    ("sout_divisor", 64, {"sout_div": 64}),
    ("alarm", {"y": {"min_deg": -5, "max_deg": 5}}, {"alarm_y": AlarmSetting(-5, 5, True)}),
    ("output", {"hi91": 0, "hi92": 8}, {"hi91": Output(), "hi92": Output(125)}),
    ("output", {"hi91": "on_mark"}, {"hi91": Output(on_mark=True)}),
    ("baud", 921600, {"baud": 921600}),
]


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
    assert not setting.agrees(value, values_of(line.run(SETTINGS.read(Target(None, 0), None)))[name])
    line.run(setting.write(Target(None, line.baud), value))
    assert setting.agrees(value, values_of(line.run(SETTINGS.read(Target(None, 0), None)))[name])
    line.run(SETTINGS.save(Target(None, line.baud)))
    line.run(SETTINGS.restart(Target(None, line.baud)))
    assert setting.agrees(value, values_of(line.run(SETTINGS.read(Target(None, 0), None)))[name])
    assert {field: getattr(line.module.settings, field) for field in changed} == changed


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"output": {"hi91": 200}}, "HI91: expected at most 100 Hz at 115200 baud, got 200 Hz"),
        ({"output": {"hi91": 100, "hi92": 100}}, "got 136000 bit/s by HI91 at 100 Hz and HI92 at 100 Hz"),
        ({"output": {"hi91": 100}, "baud": 9600}, "at most 10 Hz at 9600 baud"),
        ({"pins": {"sin": 2, "sout": 2}}, "pins: expected an unused pin for sout, got IO2; sin uses it"),
        ({"alarm": {"x": {"min_deg": 5, "max_deg": 5}}}, "alarm.x: expected the minimum below the maximum"),
    ],
)
@pytest.mark.manual("B 2.2.4 PMUX")
def test_impossible_combinations_are_rejected(values: dict[str, Any], words: str) -> None:
    with pytest.raises(BadArgument, match=words):
        SETTINGS.check(Target(None, 115200), values)


def test_possible_combinations_are_accepted() -> None:
    for values in (
        DELIVERED,
        {"output": {"hi91": 1000}, "baud": 921600},
        {"output": {"hi91": "on_mark", "hi92": 200}},
        {"output": {"hi91": 100, "hi92": 50}},
        {},
    ):
        SETTINGS.check(Target(None, 115200), values)


@pytest.mark.parametrize(
    "given",
    [
        {"output": {"hi93": 1}}, {"output": {"hi91": 300}}, {"mode": "7-axis"}, {"mounting": "x+90"},
        {"pins": {"sin": 10}}, {"sout_divisor": 65}, {"alarm": {"z": {"min_deg": 0, "max_deg": 1}}},
        {"alarm": {"x": {"min_deg": -181, "max_deg": 1}}}, {"baud": 57600}, {"magnetometer_bias": [0, 0, 0]},
    ],
)  # fmt: skip
def test_a_declaration_is_checked_by_its_types(given: dict[str, Any]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(given, SETTINGS.declarable)
