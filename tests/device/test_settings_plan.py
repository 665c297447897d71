"""The plan: written settings, their order, and settings that need a save.
test_settings_writes.py tests the writes."""

from dataclasses import replace
from typing import Any

import msgspec
import pytest

from imud.contracts import setting
from imud.contracts.command import Risk, Target
from imud.device import settings_plan
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.uart.settings import AngleAlarm
from imud.model.errors import BadArgument
from tests.support.fake_drivers import FACTORY, FAKE_SETTINGS

ACTUAL = {name: value for name, value in FACTORY.items() if name != "secret"}
TARGET = Target(None, 115200)


def planned(
    wanted: dict[str, Any], *, save: bool = True, unsaved: bool = False, **written: Any
) -> setting.SettingsPlan:
    return settings_plan.make_plan(FAKE_SETTINGS, TARGET, wanted, ACTUAL, written, save=save, unsaved=unsaved)


def names(plan: setting.SettingsPlan) -> list[str]:
    return [step.name for step in plan.steps]


def test_a_backup_contains_only_values_that_can_be_set_again() -> None:
    table = DRIVERS["hipnuc-uart"].device_settings
    assert table is not None
    known = {"mode": "low_dynamics", "mounting": "024", "coordinates": 4}
    assert settings_plan.settable_values(table, known | {"magnetometer_bias": [1.0, 2.0, 3.0]}) == known
    assert settings_plan.settable_values(table, {"mode": "3", "coordinates": 2, "sout_divisor": 4}) == {
        "sout_divisor": 4
    }


def test_only_different_or_unreadable_settings_are_written() -> None:
    assert planned({"mode": "6-axis", "output": {"a": 100}}) == setting.SettingsPlan()
    assert planned({"mode": "6-axis"}).empty
    plan = planned({"mode": "9-axis", "output": {"a": 100}})
    assert plan == setting.SettingsPlan((setting.PlannedStep("mode", "9-axis", "6-axis"),), save=True)
    assert not planned({"mode": "9-axis"}, save=False).save
    assert planned({"mode": "6-axis"}, unsaved=True).save  # a previous write is not saved
    assert not planned({"mode": "6-axis"}, save=False, unsaved=True).save
    assert (names(planned({"secret": 5})), names(planned({"secret": 5}, secret=5))) == (["secret"], [])
    assert names(planned({"secret": 5}, secret=4)) == ["secret"]
    plan = settings_plan.make_plan(
        FAKE_SETTINGS, TARGET, {"secret": 5}, ACTUAL, {"secret": 5}, save=False, unsaved=False, by_name=True
    )
    assert names(plan) == ["secret"]


def test_settings_of_the_connection_are_last() -> None:
    plan = planned({"baud": 921600, "offset_deg": 1.0, "mounting": "x_up", "mode": "9-axis"})
    assert names(plan) == ["mode", "mounting", "offset_deg", "baud"]
    assert plan.risk is Risk.CONNECTION
    assert (plan.save, plan.restart) == (False, False)  # the step of the rate saves and restarts
    assert planned({"mode": "9-axis"}).risk is Risk.NONE
    baud = replace(FAKE_SETTINGS.table["baud"], saves=False)
    table = replace(FAKE_SETTINGS, table={**FAKE_SETTINGS.table, "baud": baud})
    assert next(iter(table.table)) == "baud"
    plan = settings_plan.make_plan(
        table, TARGET, {"baud": 921600, "mode": "9-axis"}, ACTUAL, {}, save=True, unsaved=False
    )
    assert (names(plan), plan.save) == (["mode", "baud"], True)


def test_settings_that_need_a_restart_need_a_save() -> None:
    wanted = {"mounting": "x_up", "mode": "9-axis", "baud": 921600}
    plan = planned(wanted, save=False)
    assert names(plan) == ["mode"]
    assert plan.left_out == {"baud": settings_plan.SAVES_ITSELF, "mounting": settings_plan.NEEDS_SAVE}
    assert not plan.restart
    saving = planned({"mounting": "x_up"})
    assert (names(saving), saving.save, saving.restart) == (["mounting"], True, True)
    table = replace(FAKE_SETTINGS, save=None)
    plan = settings_plan.make_plan(
        table, TARGET, {"mounting": "x_up", "mode": "9-axis"}, ACTUAL, {}, save=True, unsaved=False
    )
    assert (names(plan), plan.left_out, plan.save) == (["mode"], {"mounting": settings_plan.CANNOT_SAVE}, False)
    table = replace(FAKE_SETTINGS, restart=None)
    plan = settings_plan.make_plan(table, TARGET, {"mounting": "x_up"}, ACTUAL, {}, save=True, unsaved=False)
    assert (names(plan), plan.save, plan.restart) == (["mounting"], True, False)


def test_values_are_merged_and_checked_together_with_the_present_ones() -> None:
    assert names(planned({"output": {"b": 1000}})) == ["output"]  # with `a` at 100 Hz the load is 1100 of 1152
    with pytest.raises(BadArgument, match="at most 96 Hz in all at 9600 baud, got 100 Hz"):
        planned({"baud": 9600})
    planned({"baud": 9600, "output": {"a": 90}})
    planned({"baud": 9600}, save=False)  # the plan leaves it out


@pytest.mark.parametrize(
    ("driver", "name", "present", "other"),
    [
        ("hipnuc-modbus", "baud", 115200, 921600),
        ("hipnuc-canopen", "bit_rate", 500_000, 250_000),
        ("hipnuc-j1939", "bit_rate", 500_000, 250_000),
    ],
)
def test_a_user_moves_a_bus_to_another_rate_in_two_steps(driver: str, name: str, present: int, other: int) -> None:
    """imud saves the rate in each device. The device keeps the rate of the bus until its restart."""
    row = DRIVERS[driver]
    table, target, actual = row.device_settings, Target(row.settings(), present), {name: present}
    assert table is not None
    plan = settings_plan.make_plan(table, target, {name: other}, actual, {}, save=True, unsaved=False, by_name=True)
    assert (names(plan), plan.save, plan.restart, plan.risk) == ([name], True, False, Risk.CONNECTION)
    assert f"{name}: the device uses the new rate after its restart" in plan.advice
    with pytest.raises(BadArgument, match=f"{name}: expected {present}.*, got {other}"):
        settings_plan.make_plan(table, target, {name: other}, actual, {}, save=True, unsaved=False)  # declared
    actual = {name: other}  # saved, before the restart
    plan = settings_plan.make_plan(table, target, {name: present}, actual, {}, save=True, unsaved=False, by_name=True)
    assert (names(plan), plan.save, plan.restart, plan.advice) == ([name], True, True, "")
    restarting = (
        {"mounting": "x_up"} if driver == "hipnuc-modbus" else {"node" if "canopen" in driver else "address": 9}
    )
    plan = settings_plan.make_plan(table, target, restarting, actual, {}, save=True, unsaved=False, by_name=True)
    assert (names(plan), plan.save, plan.restart) == (list(restarting), True, False)


def test_a_present_contradiction_does_not_prevent_another_change() -> None:
    table = DRIVERS["hipnuc-uart"].device_settings
    assert table is not None
    actual = {"mode": "6-axis", "pins": {"sin": 1, "sout": 2, "led": 1}}

    def plan(**wanted: Any) -> setting.SettingsPlan:
        return settings_plan.make_plan(table, TARGET, wanted, actual, {}, save=False, unsaved=False, by_name=True)

    assert (names(plan(mode="9-axis")), names(plan(pins={"led": 5}))) == (["mode"], ["pins"])
    for pins, problem in ({"sout": 1}, "IO1 for sin and sout"), ({"alarm": 2}, "IO2 for sout and alarm"):
        with pytest.raises(BadArgument, match=f"pins: expected another pin for each function, got {problem}"):
            plan(pins=pins)


def differing(
    wanted: dict[str, Any], actual: dict[str, Any] = ACTUAL, unreadable: dict[str, Any] | None = None
) -> list[str]:
    return list(settings_plan.differences(FAKE_SETTINGS, wanted, actual, unreadable or {}))


def test_the_table_compares_values_and_words_contain_both() -> None:
    assert differing({"mode": "6-axis", "output": {"a": 100}, "offset_deg": 0.009}) == []
    assert differing({"offset_deg": 0.02, "output": {"a": 100, "b": 1}, "mode": "9-axis"}) == [
        "mode", "output", "offset_deg",
    ]  # fmt: skip
    found = settings_plan.differences(FAKE_SETTINGS, {"mode": "6-axis"}, {}, {})
    assert found == {"mode": setting.SettingDifference("6-axis", None)}
    assert settings_plan.words(found) == 'mode is not reported, declared "6-axis"'
    assert differing({"mode": "6-axis"}, {}, {"mode": "6-axis"}) == []
    assert differing({"mode": "6-axis"}, {"mode": "9-axis"}, {"mode": "6-axis"}) == [
        "mode"
    ]  # the reported value counts
    assert differing({"secret": 5}) == []
    assert settings_plan.words(
        {"mode": setting.SettingDifference("6-axis", "9-axis"), "n": setting.SettingDifference(1, 2)}
    ) == ('mode is "9-axis", declared "6-axis", n is 2, declared 1')
    made = settings_plan.wanted_values(FAKE_SETTINGS, {"offset_deg": 5, "mode": "9-axis"})
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
        settings_plan.wanted_values(FAKE_SETTINGS, given)
    assert message in str(caught.value)


def test_every_setting_is_described() -> None:
    found = {
        one.name: one
        for one in settings_plan.described_settings(FAKE_SETTINGS, {"mode": "9-axis", "secret": 3}, ACTUAL)
    }
    assert list(found) == list(FAKE_SETTINGS.table)
    mode, secret, hours, offset = found["mode"], found["secret"], found["hours"], found["offset_deg"]
    assert (mode.values, mode.declared, mode.actual, mode.differs) == (
        'one of "6-axis", "9-axis"', "9-axis", "6-axis", True,
    )  # fmt: skip
    assert (secret.declared, secret.actual, secret.readable, secret.differs) == (3, None, False, False)
    assert (hours.actual, hours.declarable) == (7, False)
    assert (offset.unit, offset.section, offset.description) == ("°", "2.3", "added to the heading")
    assert all(one.actual is None for one in settings_plan.described_settings(FAKE_SETTINGS, {}, None))
    assert (offset.title, offset.help, offset.group) == ("Offset", "added to the heading", "measurement")
    assert mode.schema["enum"] == ["6-axis", "9-axis"]
    assert settings_plan.first_sentence("off; other functions. More") == "off"


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
    made = settings_plan.completed(HIPNUC, settings_plan.wanted_values(HIPNUC, given), actual)
    assert msgspec.to_builtins(made) == expected
    assert made == settings_plan.wanted_values(HIPNUC, expected)  # the types of the table


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
        settings_plan.completed(
            HIPNUC, settings_plan.wanted_values(HIPNUC, given), {"alarm": msgspec.convert(ALARM, dict[str, AngleAlarm])}
        )
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("name", "given", "command", "settings"),
    [
        ("baud", {}, "--set baud=BAUD --save", {}),
        ("baud", {"baud": 460800}, "--set baud=460800 --save", {"baud": 460800}),
        ("baud", {"baud": "x" * 395}, f"--set baud={'x' * 395} --save", {"baud": "x" * 395}),
        ("baud", {"baud": "x" * 396}, "--set baud=BAUD --save", {}),
        ("sout_divisor", {}, "--set sout_divisor=SOUT_DIVISOR", {}),
        ("bit_rate", {"bit_rate": 250000}, "--set bit_rate=250000 --save", {"bit_rate": 250000}),
        ("output_none", {}, "--set output.hi91=0 output.hi92=0", {"output.hi91": 0, "output.hi92": 0}),
    ],
)
def test_a_command_that_a_setting_replaces(
    name: str, given: dict[str, Any], command: str, settings: dict[str, Any]
) -> None:
    driver = DRIVERS["hipnuc-canopen" if name == "bit_rate" else "hipnuc-uart"]
    found = settings_plan.setting_instead("bow", name, driver, given)
    assert found is not None
    assert str(found) == f"{name} is a setting: imud settings bow {command}"
    assert found.data == {"settings": settings, "save": command.endswith("--save")}
    assert settings_plan.setting_instead("bow", name, None, given) is None
    for other in ("dance", "magnetometer_bias"):
        assert settings_plan.setting_instead("bow", other, DRIVERS["hipnuc-uart"], given) is None
