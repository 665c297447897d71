"""Verbs: check and description of arguments, and the actions in the rows of all drivers."""

from math import pi, radians
from typing import Annotated

import msgspec
import pytest
from msgspec import Meta

from imud.contracts import command
from imud.contracts.command import RestMeans, Risk, Target, Verb, described, infos, parameters_of, yaw_at
from imud.drivers import DRIVERS
from imud.model.errors import BadArgument

SAVING = {("hipnuc-uart", "baud"), ("imu61x-uart", "baud"), ("imu61x-uart", "factory_reset")}
RISKS = {
    "factory_reset": Risk.RESET, "address": Risk.CONNECTION, "baud": Risk.CONNECTION, "bitrate": Risk.CONNECTION,
    "node": Risk.CONNECTION,
}  # fmt: skip
"""Risk of the actions with these names, of every driver."""


@pytest.mark.parametrize("driver", DRIVERS)
def test_every_action_is_described_and_says_what_it_saves_and_risks(driver: str) -> None:
    for name, action in DRIVERS[driver].verbs.items():
        (info,) = described({name: action})
        assert info.help, name
        assert not info.help.endswith("."), name
        assert name == name.lower()
        assert all(parameter.values != "keys and values" for parameter in info.parameters), name
        with pytest.raises(BadArgument):
            action.arguments({"no_such_argument": 1})
        assert action.saves == (name == "save" or (driver, name) in SAVING), name
        assert info.risk is RISKS.get(name, info.risk), name
        assert info.risk is not Risk.RESET or name == "factory_reset", name
    assert [info.kind for info in infos(DRIVERS[driver].calibrations)] == [*DRIVERS[driver].calibrations]


def _turn(target: Target, *, relative: bool = False, angle_deg: Annotated[float, Meta(ge=-180, le=180)]) -> str:
    return f"{target.baud} {angle_deg} {relative}"


ACTION = Verb("turn it", _turn)


def test_arguments_are_completed_by_defaults_and_bad_arguments_name_the_good_ones() -> None:
    arguments = ACTION.arguments({"angle_deg": 5})
    assert msgspec.structs.asdict(arguments) == {"angle_deg": 5.0, "relative": False}
    assert ACTION.script(Target(None, 9600), arguments) == "9600 5.0 False"
    for given in ({}, {"angle_deg": "x"}, {"angle_deg": 1, "turns": 2}, {"angle_deg": 181}):
        good = r"relative \(true or false; default false\), angle_deg \(a number from -180 to 180\)"
        with pytest.raises(BadArgument, match=good):
            ACTION.arguments(given)
        assert ", ".join(map(str, parameters_of(ACTION))) == good.replace("\\", "")


def test_description_for_people() -> None:
    (info,) = described({"yaw": ACTION})
    assert msgspec.json.decode(msgspec.json.encode(info)) == {
        "name": "yaw", "help": "turn it", "risk": "",
        "parameters": [
            {"name": "relative", "values": "true or false", "default": "false", "required": False},
            {"name": "angle_deg", "values": "a number from -180 to 180", "default": None, "required": True},
        ],
    }  # fmt: skip


def test_effect_on_the_flash() -> None:
    for options, effect in (
        ({}, (False, True)), ({"restarts": True}, (True, False)), ({"saves": True}, (False, False)),
        ({"restarts": True, "restarts_with": lambda _: False}, (False, False)), ({"changes": False}, (False, False)),
    ):  # fmt: skip
        verb = Verb("turn it", _turn, **options)
        arguments = verb.arguments({"angle_deg": 5})
        assert verb.effect_on_flash(arguments) == effect
        assert verb.expected(arguments) == ()


def test_expected_means_at_rest() -> None:
    means = RestMeans((0.06, -0.08, 9.8), (0.002, 0.003, 0.006), (-0.1, -0.2, -3.0), (0.3, -0.4))
    for expectation, value, limit in (
        (command.GYRO_ZERO, 0.007, radians(0.1)), (command.ROLL_ZERO, 0.1, radians(0.5)),
        (command.PITCH_ZERO, 0.2, radians(0.5)), (command.YAW_ZERO, 3.0, radians(1.0)),
        (command.INCLINATION_ZERO, 0.4, radians(0.5)), (command.ACCEL_LEVEL, 0.1, 0.1),
        (yaw_at(180.0), pi - 3.0, radians(1.0)), (yaw_at(-90.0), 3.0 - pi / 2, radians(1.0)),
    ):  # fmt: skip
        assert (expectation.value(means), expectation.limit) == pytest.approx((value, limit)), expectation.name
        assert expectation.value(RestMeans(None, None, None)) is None
