"""`settings:` of a device: types from the driver's table, errors with their place, and the comparison on reload."""

# ruff: noqa: E501 - a row of the table has the whole message

from typing import Any

import pytest

from imud import config
from imud.config.model import Config, differences
from imud.config.schema import Tables
from imud.contracts.setting import OnDifference, declared_values
from imud.model.errors import ConfigError
from tests.config.test_reading import PortSettings, fake_row
from tests.support.fake_drivers import FAKE_DRIVER, FAKE_MODULE_DRIVER

TABLES = Tables({"fake-module": FAKE_MODULE_DRIVER, "fake-uart": FAKE_DRIVER}, {"wire": fake_row(PortSettings)}, {})
HEAD = "devices:\n  bow:\n    driver: {driver}\n    wire: {{port: x, baud: {baud}}}\n"


def parse(*lines: str, driver: str = "fake-module", baud: str = "115200") -> Config:
    text = HEAD.format(driver=driver, baud=baud) + "".join(f"    {line}\n" for line in lines)
    return config.parse(text, "f", TABLES)


def test_declared_values_have_the_types_of_the_table() -> None:
    (device,) = parse(
        "settings: {mode: 9-axis, output: {a: 10}, offset_deg: 5}", "on_difference: apply_and_save"
    ).devices
    assert declared_values(device.declared) == {"mode": "9-axis", "output": {"a": 10}, "offset_deg": 5.0}
    assert device.on_difference is OnDifference.APPLY_AND_SAVE


@pytest.mark.parametrize("lines", [[], ["settings:"], ["settings: {}"], ["settings: {mode: null}"]])
def test_nothing_is_declared(lines: list[str]) -> None:
    (device,) = parse(*lines).devices
    assert declared_values(device.declared) == {}
    assert device.on_difference is OnDifference.REPORT


@pytest.mark.parametrize(
    ("given", "error"),
    [
        ({"lines": ["settings: {mod: 9-axis}"]}, '5:16: devices.bow.settings.mod: expected a key that imud knows, got "mod"; did you mean mode? known: baud, mode, mounting, offset_deg, output, secret'),
        ({"lines": ["settings: {hours: 3}"]}, '5:16: devices.bow.settings.hours: expected a key that imud knows, got "hours"; known: baud, mode, mounting, offset_deg, output, secret'),
        ({"lines": ["settings: {offset_deg: 181}"]}, "5:28: devices.bow.settings.offset_deg: expected a number from -180 to 180, or null, got 181"),
        ({"lines": ["settings: 5"]}, "5:15: devices.bow.settings: expected keys and values, got 5"),
        ({"lines": ["settings: {mode: 9-axis}"], "driver": "auto"}, "5:5: devices.bow.settings: expected the name of a driver next to settings, got auto; drivers with settings: fake-module"),
        ({"lines": ["settings: {mode: 9-axis}"], "driver": "fake-uart"}, "5:5: devices.bow.settings: expected a driver with a table of settings, got fake-uart; drivers with settings: fake-module"),
        ({"lines": ["settings: {mode: 9-axis}", "identify: false"]}, "5:5: devices.bow.settings: expected identify: true, because imud reads the settings only then, got false"),
        ({"lines": ["settings: {output: {a: 1000, b: 500}}"]}, "5:15: devices.bow.settings: output: expected at most 1152 Hz in all at 115200 baud, got 1500 Hz"),
        ({"lines": ["settings: {baud: 921600}"]}, "5:22: devices.bow.settings.baud: expected 115200, the value that imud uses to open the device, got 921600; change it with `imud settings bow --set baud=… --save`, or use auto if the link supports it"),
        ({"lines": ["on_difference: repair"]}, '5:20: devices.bow.on_difference: expected one of "report", "apply", "apply_and_save", got "repair"'),
    ],
)  # fmt: skip
def test_errors_with_their_place(given: dict[str, Any], error: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(*given.pop("lines"), **given)
    assert str(caught.value).splitlines() == ["f:" + error]


def test_what_may_be_declared_where_imud_searches() -> None:
    for values, baud in (("baud: 921600", "auto"), ("baud: 115200", "115200"), ("output: {a: 1000, b: 500}", "auto")):
        assert parse(f"settings: {{{values}}}", baud=baud).devices[0].declared is not None


def test_a_change_of_settings_is_a_change_of_the_device() -> None:
    old = parse("settings: {mode: 9-axis}")
    assert differences(old, parse("settings: {mode: 6-axis}")).devices_changed == ("bow",)
    assert differences(old, parse("settings: {mode: 9-axis}", "on_difference: apply")).devices_changed == ("bow",)
    assert str(differences(old, parse("settings: {mode: 9-axis}"))) == "nothing differs"
