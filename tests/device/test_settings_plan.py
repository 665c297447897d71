"""The plan: written settings, their order, and settings that need a save."""

from dataclasses import replace
from typing import Any

import pytest

from imud.contracts.command import Risk, Target
from imud.contracts.setting import PlannedStep, SettingsPlan
from imud.device.settings_plan import CANNOT_SAVE, NEEDS_SAVE, SAVES_ITSELF, make_plan, merged
from imud.drivers import DRIVERS
from imud.model.errors import BadArgument
from tests.support.fake_drivers import FACTORY, FAKE_SETTINGS

ACTUAL = {name: value for name, value in FACTORY.items() if name != "secret"}
TARGET = Target(None, 115200)


def planned(wanted: dict[str, Any], *, save: bool = True, unsaved: bool = False, **written: Any) -> SettingsPlan:
    return make_plan(FAKE_SETTINGS, TARGET, wanted, ACTUAL, written, save=save, unsaved=unsaved)


def names(plan: SettingsPlan) -> list[str]:
    return [step.name for step in plan.steps]


def test_only_different_or_unreadable_settings_are_written() -> None:
    assert planned({"mode": "6-axis", "output": {"a": 100}}) == SettingsPlan()
    assert planned({"mode": "6-axis"}).empty
    plan = planned({"mode": "9-axis", "output": {"a": 100}})
    assert plan == SettingsPlan((PlannedStep("mode", "9-axis", "6-axis"),), save=True)
    assert not planned({"mode": "9-axis"}, save=False).save
    assert planned({"mode": "6-axis"}, unsaved=True).save  # a previous write is not saved
    assert not planned({"mode": "6-axis"}, save=False, unsaved=True).save
    assert names(planned({"secret": 5})) == ["secret"]
    assert names(planned({"secret": 5}, secret=5)) == []
    assert names(planned({"secret": 5}, secret=4)) == ["secret"]


def test_settings_of_the_connection_are_last() -> None:
    plan = planned({"baud": 921600, "offset_deg": 1.0, "mounting": "x_up", "mode": "9-axis"})
    assert names(plan) == ["mode", "mounting", "offset_deg", "baud"]
    assert plan.risk is Risk.CONNECTION
    assert (plan.save, plan.restart) == (False, False)  # the step of the rate saves and restarts
    assert planned({"mode": "9-axis"}).risk is Risk.NONE
    baud = replace(FAKE_SETTINGS.table["baud"], saves=False)
    table = replace(FAKE_SETTINGS, table={**FAKE_SETTINGS.table, "baud": baud})
    assert next(iter(table.table)) == "baud"
    plan = make_plan(table, TARGET, {"baud": 921600, "mode": "9-axis"}, ACTUAL, {}, save=True, unsaved=False)
    assert (names(plan), plan.save) == (["mode", "baud"], True)


def test_settings_that_need_a_restart_need_a_save() -> None:
    wanted = {"mounting": "x_up", "mode": "9-axis", "baud": 921600}
    plan = planned(wanted, save=False)
    assert names(plan) == ["mode"]
    assert plan.left_out == {"baud": SAVES_ITSELF, "mounting": NEEDS_SAVE}
    assert not plan.restart
    saving = planned({"mounting": "x_up"})
    assert (names(saving), saving.save, saving.restart) == (["mounting"], True, True)
    table = replace(FAKE_SETTINGS, save=None)
    plan = make_plan(table, TARGET, {"mounting": "x_up", "mode": "9-axis"}, ACTUAL, {}, save=True, unsaved=False)
    assert (names(plan), plan.left_out, plan.save) == (["mode"], {"mounting": CANNOT_SAVE}, False)
    table = replace(FAKE_SETTINGS, restart=None)
    plan = make_plan(table, TARGET, {"mounting": "x_up"}, ACTUAL, {}, save=True, unsaved=False)
    assert (names(plan), plan.save, plan.restart) == (["mounting"], True, False)


def test_values_are_checked_together_with_the_present_ones() -> None:
    assert names(planned({"output": {"b": 1000}})) == ["output"]  # with `a` at 100 Hz the load is 1100 of 1152
    with pytest.raises(BadArgument, match="at most 96 Hz in all at 9600 baud, got 100 Hz"):
        planned({"baud": 9600})
    planned({"baud": 9600, "output": {"a": 90}})
    planned({"baud": 9600}, save=False)  # the plan leaves it out


def test_values_of_several_keys_are_merged() -> None:
    assert merged({"output": {"a": 1, "b": 2}, "mode": "6"}, {"output": {"b": 3}, "mode": "9"}) == {
        "output": {"a": 1, "b": 3}, "mode": "9",
    }  # fmt: skip


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
    plan = make_plan(table, target, {name: other}, actual, {}, save=True, unsaved=False, by_name=True)
    assert (names(plan), plan.save, plan.restart, plan.risk) == ([name], True, False, Risk.CONNECTION)
    assert f"{name}: the device uses the new rate after its restart" in plan.advice
    with pytest.raises(BadArgument, match=f"{name}: expected {present}.*, got {other}"):
        make_plan(table, target, {name: other}, actual, {}, save=True, unsaved=False)  # declared
    actual = {name: other}  # saved, before the restart
    plan = make_plan(table, target, {name: present}, actual, {}, save=True, unsaved=False, by_name=True)
    assert (names(plan), plan.save, plan.restart, plan.advice) == ([name], True, True, "")
    restarting = (
        {"mounting": "x_up"} if driver == "hipnuc-modbus" else {"node" if "canopen" in driver else "address": 9}
    )
    plan = make_plan(table, target, restarting, actual, {}, save=True, unsaved=False, by_name=True)
    assert (names(plan), plan.save, plan.restart) == (list(restarting), True, False)


def test_a_present_contradiction_does_not_prevent_another_change() -> None:
    table = DRIVERS["hipnuc-uart"].device_settings
    assert table is not None
    actual = {"mode": "6-axis", "pins": {"sin": 1, "sout": 2, "led": 1}}

    def plan(**wanted: Any) -> SettingsPlan:
        return make_plan(table, TARGET, wanted, actual, {}, save=False, unsaved=False, by_name=True)

    assert names(plan(mode="9-axis")) == ["mode"]
    assert names(plan(pins={"led": 5})) == ["pins"]
    for pins, problem in ({"sout": 1}, "sout, got IO1; sin"), ({"alarm": 2}, "alarm, got IO2; sout"):
        with pytest.raises(BadArgument, match=f"pins: expected an unused pin for {problem} uses it"):
            plan(pins=pins)


def test_a_user_writes_an_unreadable_value_again() -> None:
    plan = make_plan(
        FAKE_SETTINGS, TARGET, {"secret": 5}, ACTUAL, {"secret": 5}, save=False, unsaved=False, by_name=True
    )
    assert names(plan) == ["secret"]
