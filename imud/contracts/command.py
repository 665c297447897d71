"""Contract of an action: a command that a device executes by name, for example calibrate, save, restart, baud rate."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from inspect import signature
from math import hypot
from typing import Any, Final, cast, get_type_hints

import msgspec

from imud.model.errors import BadArgument
from imud.model.options import Options, expected, shown, wrong_values
from imud.model.sample import Pair, Vector3
from imud.model.units import RAD_PER_DEG


@dataclass(frozen=True, slots=True)
class Target:
    """The device that an action is carried out on."""

    settings: Any
    """Options of the device's driver."""
    baud: int
    """Present bit rate of the line, bit/s; 0 on a link without one."""
    fixed_baud: int = 0
    """Bit rate that the configuration fixes, bit/s; 0 where it fixes none."""
    places: tuple[int, ...] = ()
    """Addresses at which the device can be on a bus that is polled: the present one, the former one, the configured
    one; empty on other links."""
    other_bits_per_s: float = 0.0
    """What other devices of the configuration send on the same CAN bus, bit/s without stuff bits."""


class Risk(StrEnum):
    """What an action can do that cannot be taken back by another one. Programs for people ask before such an action."""

    NONE = ""
    CONNECTION = "the device may not be reached afterwards"
    RESET = "all settings of the device are lost"
    """Its settings are written to a backup before, as far as they can be read."""


@dataclass(frozen=True, slots=True)
class Action:
    """An action of a device: help, arguments and request script.

    The arguments are the keyword-only parameters of `begin`. Their annotations give type and bounds (`msgspec.Meta`),
    their names the unit; a parameter with a default is optional.
    """

    help: str
    """The effect, one sentence."""
    begin: Callable[..., Any]
    """`begin(target, *, name: type = default, …)` makes the request script, or a polled driver's transfer script.

    The script returns the result of the action, a value that JSON can carry. Both raise BadArgument.
    """
    risk: Risk = Risk.NONE
    saves: bool = False
    """Whether it writes the device's flash, which is counted, and limited per day."""

    @property
    def parameters(self) -> type[Options]:
        """The parameters of `begin` as a struct type."""
        return _parameters(self.begin)

    def arguments(self, given: Mapping[str, Any]) -> Options:
        """Check and convert the arguments of a call. Raises BadArgument naming what was expected and what came."""
        if wrong := wrong_values(self.parameters, given, "argument"):
            known = ", ".join(str(parameter) for parameter in parameters_of(self)) or "none"
            raise BadArgument(f"{'; '.join(map(str, wrong))}; arguments: {known}")
        return msgspec.convert(dict(given), self.parameters)

    def script(self, target: Target, arguments: Options) -> Any:
        """Make the script of the action, from the result of `arguments`."""
        return self.begin(target, **msgspec.structs.asdict(arguments))


@cache
def _parameters(begin: Callable[..., Any]) -> type[Options]:
    hints = get_type_hints(begin, include_extras=True)
    given = [p for p in signature(begin).parameters.values() if p.kind is p.KEYWORD_ONLY]
    fields = [(p.name, hints[p.name]) if p.default is p.empty else (p.name, hints[p.name], p.default) for p in given]
    made = msgspec.defstruct(
        "Parameters", fields, bases=(Options,), frozen=True, kw_only=True, forbid_unknown_fields=True
    )
    return cast(type[Options], made)


Actions = Mapping[str, Action]


class ActionParameter(msgspec.Struct, frozen=True):
    """Description of one argument of an action."""

    name: str
    values: str
    """The accepted values, for example `a whole number from 1 to 127`."""
    default: str | None
    """The default as JSON; None for a required argument."""
    required: bool = False
    """Whether a call without it is refused."""

    def __str__(self) -> str:
        """Format the description, for example `rate_hz (a number; default 100)`."""
        return f"{self.name} ({self.values}{'' if self.default is None else f'; default {self.default}'})"


class ActionInfo(msgspec.Struct, frozen=True):
    """Description of one action."""

    name: str
    help: str
    parameters: tuple[ActionParameter, ...]
    risk: Risk = Risk.NONE
    """Why people are asked before, one clause; empty where they are not."""


def parameters_of(action: Action) -> tuple[ActionParameter, ...]:
    """Describe the arguments of an action."""
    return tuple(
        ActionParameter(one.name, expected(one.type), None if one.required else shown(one.default), one.required)
        for one in msgspec.structs.fields(action.parameters)
    )


def described(actions: Actions) -> list[ActionInfo]:
    """Describe actions, in their order."""
    return [ActionInfo(name, action.help, parameters_of(action), action.risk) for name, action in actions.items()]


class Handling(StrEnum):
    """How the device is held during a calibration."""

    REST = "rest"
    """It must not move."""
    TURN = "turn"
    """It must be turned into as many directions as possible, slowly and in one place."""


class Kept(StrEnum):
    """What becomes of the result."""

    BY_SAVE = "until power-off, unless it is saved"
    BY_DEVICE = "saved by the device itself"
    NEVER = "until power-off; it cannot be saved"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the device says of its calibration."""

    done: bool
    words: str
    """The device's own values, for people; another text than before the calibration means a new result."""
    progress: float | None = None
    """0 … 1 where the device tells it."""


@dataclass(frozen=True, slots=True)
class RestMeans:
    """Means of the samples of a device at rest, in its own frame; None for what its samples lack."""

    accel_m_s2: Vector3 | None
    gyro_rad_s: Vector3 | None
    euler_rad: Vector3 | None
    """Roll, pitch, yaw."""
    incli_rad: Pair | None = None
    """Inclinometer X and Y."""


@dataclass(frozen=True, slots=True)
class Expectation:
    """What the samples at rest must be after a calibration: `value(means)` is at most `limit`."""

    name: str
    unit: str
    """SI."""
    limit: float
    value: Callable[[RestMeans], float | None]
    """Its absolute value; None where the samples do not tell."""


GYRO_ZERO: Final = Expectation(
    "mean angular rate", "rad/s", 0.1 * RAD_PER_DEG, lambda m: None if m.gyro_rad_s is None else hypot(*m.gyro_rad_s)
)
"""0.1 °/s: far above the bias that a calibrated sensor of these families has, far below that of one that is not."""
ROLL_ZERO: Final = Expectation(
    "roll", "rad", 0.5 * RAD_PER_DEG, lambda m: None if m.euler_rad is None else abs(m.euler_rad[0])
)
PITCH_ZERO: Final = Expectation(
    "pitch", "rad", 0.5 * RAD_PER_DEG, lambda m: None if m.euler_rad is None else abs(m.euler_rad[1])
)
YAW_ZERO: Final = Expectation(
    "yaw", "rad", 1.0 * RAD_PER_DEG, lambda m: None if m.euler_rad is None else abs(m.euler_rad[2])
)
INCLINATION_ZERO: Final = Expectation(
    "inclination", "rad", 0.5 * RAD_PER_DEG, lambda m: None if m.incli_rad is None else max(map(abs, m.incli_rad))
)
ACCEL_LEVEL: Final = Expectation(
    "horizontal acceleration", "m/s²", 0.1, lambda m: None if m.accel_m_s2 is None else hypot(*m.accel_m_s2[:2])
)
"""0.1 m/s² is a tilt of 0.6°."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """One calibration of a device."""

    help: str
    """The effect, one sentence."""
    section: str
    """Of the vendor's manual."""
    handling: Handling
    instructions: tuple[str, ...]
    """What a person does before and during it, a sentence each, in their order."""
    begin: Callable[[Target], Any]
    """Makes the script that starts it and, where the device tells, waits for its end."""
    verdict: Callable[[Target], Any] | None = None
    """Makes the script that asks the device how far it is and returns a Verdict; None where `begin` waits."""
    unready: Callable[[Target], Any] | None = None
    """Makes the script that returns what must be done first, one sentence, or an empty string; None for nothing."""
    expected: tuple[Expectation, ...] = ()
    """What the samples at rest must be afterwards."""
    kept: Kept
    save: Callable[[Target], Any] | None = None
    """Makes the script that saves the result; only with Kept.BY_SAVE."""


Calibrations = Mapping[str, Calibration]


class CalibrationInfo(msgspec.Struct, frozen=True):
    """Description of one calibration."""

    kind: str
    help: str
    section: str
    handling: Handling
    instructions: tuple[str, ...]
    kept: Kept


class Check(msgspec.Struct, frozen=True):
    """One comparison of samples after a calibration."""

    name: str
    value: float | None
    """None where the samples do not tell; such a check is not passed."""
    limit: float
    unit: str
    passed: bool


class CalibrationResult(msgspec.Struct, frozen=True):
    """The end of a calibration."""

    kind: str
    verified: bool
    """Whether the device says that it is done and every check is passed."""
    problem: str
    """What is wrong and what to do, one sentence; empty when verified."""
    device: str
    """The device's own values, for people."""
    checks: tuple[Check, ...]
    saved: bool
    kept: Kept


def infos(calibrations: Calibrations) -> list[CalibrationInfo]:
    """Describe calibrations, in their order."""
    return [
        CalibrationInfo(kind, one.help, one.section, one.handling, one.instructions, one.kept)
        for kind, one in calibrations.items()
    ]
