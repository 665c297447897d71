"""Comparison of declared and actual settings, and the description of each setting."""

from typing import Any

import msgspec
import pytest

from imud.contracts.setting import SettingDifference
from imud.device.settings_plan import completed, described_settings, differences, unverified, wanted_values, words
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.uart.settings import AngleAlarm
from imud.model.errors import BadArgument
from tests.support.fake_drivers import FACTORY, FAKE_SETTINGS

ACTUAL = {name: value for name, value in FACTORY.items() if name != "secret"}


def differing(
    wanted: dict[str, Any], actual: dict[str, Any] = ACTUAL, unreadable: dict[str, Any] | None = None
) -> list[str]:
    return list(differences(FAKE_SETTINGS, wanted, actual, unreadable or {}))


def test_the_table_compares_values_and_unreadable_values_differ_unless_written() -> None:
    assert differing({"mode": "6-axis", "output": {"a": 100}, "offset_deg": 0.009}) == []
    assert differing({"offset_deg": 0.02, "output": {"a": 100, "b": 1}, "mode": "9-axis"}) == [
        "mode", "output", "offset_deg",
    ]  # fmt: skip
    found = differences(FAKE_SETTINGS, {"mode": "6-axis"}, {}, {})
    assert found == {"mode": SettingDifference("6-axis", None)}
    assert words(found) == 'mode is not reported, declared "6-axis"'
    assert differing({"mode": "6-axis"}, {}, {"mode": "6-axis"}) == []
    assert differing({"mode": "6-axis"}, {"mode": "9-axis"}, {"mode": "6-axis"}) == [
        "mode"
    ]  # the reported value counts
    assert differing({"secret": 5}) == []
    assert unverified(FAKE_SETTINGS, {"secret": 5, "mode": "6-axis"}, ACTUAL) == ("secret",)
    assert unverified(FAKE_SETTINGS, {"secret": 5, "mode": "6-axis"}, {}) == ("mode", "secret")


def test_words_contain_both_values() -> None:
    assert words({"mode": SettingDifference("6-axis", "9-axis"), "n": SettingDifference(1, 2)}) == (
        'mode is "9-axis", declared "6-axis", n is 2, declared 1'
    )
    made = wanted_values(FAKE_SETTINGS, {"offset_deg": 5, "mode": "9-axis"})
    assert list(made.items()) == [("mode", "9-axis"), ("offset_deg", 5.0)]
    assert type(made["offset_deg"]) is float


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mod": 1}, 'expected a setting that imud knows, got "mod"; did you mean mode?'),
        ({"hours": 1}, "hours: it is read-only"),
        ({"mode": 7}, 'mode: expected one of "6-axis", "9-axis", got 7'),
        ({"offset_deg": 181}, "offset_deg: expected a number from -180 to 180, got 181"),
        ({"secret": None}, "secret: expected a whole number from 0 to 9, got null"),
    ],
)
def test_errors_contain_the_expected_values(given: dict[str, Any], message: str) -> None:
    with pytest.raises(BadArgument) as caught:
        wanted_values(FAKE_SETTINGS, given)
    assert message in str(caught.value)


def test_every_setting_is_described() -> None:
    found = {one.name: one for one in described_settings(FAKE_SETTINGS, {"mode": "9-axis", "secret": 3}, ACTUAL)}
    assert list(found) == list(FAKE_SETTINGS.table)
    mode, secret, hours, offset = found["mode"], found["secret"], found["hours"], found["offset_deg"]
    assert (mode.values, mode.declared, mode.actual, mode.differs) == (
        'one of "6-axis", "9-axis"', "9-axis", "6-axis", True,
    )  # fmt: skip
    assert (secret.declared, secret.actual, secret.readable, secret.differs) == (3, None, False, False)
    assert (hours.actual, hours.declarable) == (7, False)
    assert (offset.unit, offset.section, offset.description) == ("°", "2.3", "added to the heading")
    assert all(one.actual is None for one in described_settings(FAKE_SETTINGS, {}, None))


HIPNUC = DRIVERS["hipnuc-uart"].device_settings
ALARM = {"x": {"min_deg": -20, "max_deg": 20, "enabled": True}}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"output.hi91": 200, "output.hi92": 0}, {"output": {"hi91": 200, "hi92": 0}}),
        ({"alarm.x.min_deg": -10}, {"alarm": {"x": {"min_deg": -10, "max_deg": 20, "enabled": True}}}),
        ({"alarm.y.min_deg": -1, "alarm.y.max_deg": 1}, {"alarm": {"y": {**ALARM["x"], "min_deg": -1, "max_deg": 1}}}),
        ({"alarm.x": ALARM["x"], "alarm.y": ALARM["x"]}, {"alarm": {"x": ALARM["x"], "y": ALARM["x"]}}),
    ],
)  # fmt: skip
def test_a_dot_selects_a_part_of_a_setting(given: dict[str, Any], expected: dict[str, Any]) -> None:
    assert HIPNUC is not None
    actual = {"output": {"hi91": 100, "hi92": 50}, "alarm": msgspec.convert(ALARM, dict[str, AngleAlarm])}
    made = completed(HIPNUC, wanted_values(HIPNUC, given), actual)
    assert msgspec.to_builtins(made) == expected
    assert made == wanted_values(HIPNUC, expected)  # the types of the table


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"output.hi93": 1}, 'expected a part of output that imud knows, got "hi93"; did you mean hi92?'),
        ({"output.hi91.rate": 1}, 'output.hi91: expected a setting without parts, got "output.hi91.rate"'),
        ({"output.hi91": 3}, "output.hi91: expected one of 0, 1, 2, 4"),
        ({"mode.axes": 9}, 'mode: expected a setting without parts, got "mode.axes"'),
        ({"mod.axes": 9}, 'expected a setting that imud knows, got "mod"'),
        ({"alarm.x.low": 9}, 'expected a part of alarm.x that imud knows, got "low"'),
        ({"alarm.x.min_deg": 181}, "alarm.x.min_deg: expected a number from -180 to 180, got 181"),
        ({"alarm.y.min_deg": 1}, "the device does not report the missing parts"),
        ({"output": {"hi91": 1}, "output.hi92": 1}, "expected one value for each part, got output and output.hi92"),
        ({"alarm.x.min_deg": 1, "alarm.x": ALARM["x"]}, "got alarm.x.min_deg and alarm.x"),
        ({"output.": 1}, 'expected a part of output that imud knows, got ""'),
    ],
)  # fmt: skip
def test_an_error_names_the_wrong_part(given: dict[str, Any], message: str) -> None:
    assert HIPNUC is not None
    with pytest.raises(BadArgument) as caught:
        completed(HIPNUC, wanted_values(HIPNUC, given), {"alarm": msgspec.convert(ALARM, dict[str, AngleAlarm])})
    assert message in str(caught.value)
