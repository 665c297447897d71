"""Actions: arguments checked and described; and every driver's actions by their rows."""

from typing import Annotated

import msgspec
import pytest
from msgspec import Meta

from imud.contracts.action import Action, Risk, Target, described, parameters_of
from imud.devices import DRIVERS
from imud.errors import BadArgument

ACTIONS = [(driver.name, name) for driver in DRIVERS.values() for name in driver.actions]


def _yaw(_target: Target, *, angle_deg: float, relative: bool = False) -> tuple[float, bool]:
    return angle_deg, relative


ACTION = Action("turn", _yaw)


def test_arguments_are_converted_and_completed_by_defaults() -> None:
    arguments = ACTION.arguments({"angle_deg": 5})
    assert msgspec.structs.asdict(arguments) == {"angle_deg": 5.0, "relative": False}
    assert ACTION.script(Target(None, 0), arguments) == (5.0, False)


@pytest.mark.parametrize("given", [{}, {"angle_deg": "x"}, {"angle_deg": 1, "turns": 2}])
def test_bad_arguments_name_the_good_ones(given: dict[str, object]) -> None:
    with pytest.raises(BadArgument, match=r"angle_deg \(a number\), relative \(true or false; default false\)"):
        ACTION.arguments(given)


def test_description_for_people() -> None:
    (info,) = described({"yaw": ACTION})
    assert msgspec.json.decode(msgspec.json.encode(info)) == {
        "name": "yaw",
        "help": "turn",
        "parameters": [
            {"name": "angle_deg", "values": "a number", "default": None, "required": True},
            {"name": "relative", "values": "true or false", "default": "false", "required": False},
        ],
        "risk": "",
    }


@pytest.mark.parametrize(("driver", "name"), ACTIONS)
def test_every_action_has_help_and_arguments_that_can_be_described(driver: str, name: str) -> None:
    action = DRIVERS[driver].actions[name]
    (info,) = described({name: action})
    assert info.help
    assert not info.help.endswith(".")
    assert name == name.lower()
    assert all(parameter.values != "keys and values" for parameter in info.parameters)
    with pytest.raises(BadArgument):
        action.arguments({"no_such_argument": 1})


@pytest.mark.parametrize(("driver", "name"), ACTIONS)
def test_actions_that_save_say_so(driver: str, name: str) -> None:
    action = DRIVERS[driver].actions[name]
    assert action.saves == (name == "save" or (driver, name) in SAVING)


SAVING = {("hipnuc-uart", "baud"), ("imu61x-uart", "baud"), ("imu61x-uart", "factory_reset")}
RISKS = {
    "factory_reset": Risk.RESET,
    "address": Risk.CONNECTION,
    "baud": Risk.CONNECTION,
    "bitrate": Risk.CONNECTION,
    "node": Risk.CONNECTION,
}
"""Of actions by these names, whatever the driver."""


@pytest.mark.parametrize(("driver", "name"), ACTIONS)
def test_actions_that_lose_settings_or_contact_say_so(driver: str, name: str) -> None:
    (info,) = described({name: DRIVERS[driver].actions[name]})
    assert info.risk is RISKS.get(name, info.risk)
    assert info.risk is not Risk.RESET or name == "factory_reset"


def _turn(target: Target, *, angle_deg: Annotated[float, Meta(ge=-180, le=180)], relative: bool = False) -> str:
    return f"{target.baud} {angle_deg} {relative}"


def test_arguments_are_described_by_the_parameters_of_begin() -> None:
    action = Action("turn it", _turn)
    assert [str(parameter) for parameter in parameters_of(action)] == [
        "angle_deg (a number from -180 to 180)",
        "relative (true or false; default false)",
    ]
    assert action.script(Target(None, 9600), action.arguments({"angle_deg": 12})) == "9600 12.0 False"
    with pytest.raises(BadArgument, match=r"angle_deg: expected a number from -180 to 180, got 181; arguments: a"):
        action.arguments({"angle_deg": 181})
    with pytest.raises(BadArgument, match="angle"):
        action.arguments({"angle": 1})
