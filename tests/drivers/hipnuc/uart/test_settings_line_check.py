"""GPIO lines of the configuration, compared with the device settings of the simulated device."""

import pytest

from imud import config
from imud.config.schema import TABLES
from imud.contracts.command import Target
from imud.contracts.lines import DeviceLines, DividedOptions, InputOptions, PpsOptions, SoutOptions, TriggerOptions
from imud.contracts.setting import values_of
from imud.drivers.hipnuc.uart.settings import SETTINGS, declared_line_differences, line_differences, message_limits
from imud.model.errors import ConfigError
from imud.sim.hipnuc.uart_settings import AlarmSetting, ModuleSettings, Output
from tests.support.simulated_modules import HipnucLine

SOUT = DeviceLines(sout=SoutOptions(line="A"))
DIVIDED = DeviceLines(sout_div=DividedOptions(line="B", divisor=4))
SIN = DeviceLines(sin=TriggerOptions(line="C", rate_hz=200))
PPS = DeviceLines(pps=PpsOptions(line="D"))
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
    differences = line_differences(values_of(HipnucLine(settings).run(SETTINGS.read(Target(None, 0), None))), lines)
    assert differences.keys() == found.keys()
    for key, words in found.items():
        assert words in differences[key]


@pytest.mark.parametrize("lines", [SOUT, DIVIDED, SIN, PPS, ALARM])
def test_unreported_settings_are_not_compared(lines: DeviceLines) -> None:
    assert line_differences({"mode": "6-axis"}, lines) == {}


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
    differences = declared_line_differences(declared, lines)
    assert differences.keys() == found.keys()
    for key, words in found.items():
        assert words in differences[key]


def test_check_refuses_a_line_that_declared_settings_contradict() -> None:
    text = (
        "devices:\n  bow:\n    driver: hipnuc-uart\n    uart: {port: /dev/ttyUSB0, baud: 921600}\n"
        "    lines: {sin: {line: GPIO1, rate_hz: 10}}\n    settings: {output: {hi91: 0, hi92: on_mark}}\n"
    )
    with pytest.raises(ConfigError, match=r"f:5:\d+: devices\.bow\.lines\.sin: .*HI92 on mark has no device time"):
        config.parse(text, "f", TABLES)


@pytest.mark.parametrize(
    ("declared", "lines", "fed", "found"),
    [
        ({}, DeviceLines(), True, []),
        ({"output": {"hi91": 100, "hi92": 0}}, DeviceLines(), True, []),
        ({"output": {"hi92": 100}}, DeviceLines(), False, []),
        ({"output": {"hi92": 100}}, DeviceLines(), True, ["HI92 has no UTC"]),
        ({"output": {"hi92": 100}}, DeviceLines(pps=PpsOptions(line="GPIO1")), False, ["HI92 has no UTC"]),
        (
            {"output": {"hi91": 50, "hi92": 50}}, DeviceLines(), False,
            ["HI92 next to HI91 is time-stamped by its arrival"],
        ),
    ],
)  # fmt: skip
def test_limits_of_hi92_are_reported(
    declared: dict[str, object], lines: DeviceLines, fed: bool, found: list[str]
) -> None:
    limits = message_limits(declared, lines, fed)
    assert len(limits) == len(found)
    assert all(limit.startswith(words) for limit, words in zip(limits, found, strict=True))
