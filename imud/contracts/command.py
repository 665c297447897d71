"""Contract of a verb: an operation that a device executes once on request, for example save, restart, level."""

from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from inspect import signature
from math import hypot, remainder, tau
from typing import Any, Final, cast, get_type_hints

import msgspec

from imud.model.errors import BadArgument
from imud.model.options import Options, expected, shown, wrong_values
from imud.model.sample import Pair, Vector3
from imud.model.units import RAD_PER_DEG


@dataclass(frozen=True, slots=True)
class Target:
    """The device that executes a verb."""

    settings: Any  # options of the device's driver
    baud: int  # present bit rate of the link, bit/s; 0 if the link has no bit rate
    fixed_baud: int = 0  # bit rate in the configuration, bit/s; 0 if the configuration does not set a bit rate
    # Possible addresses of the device on a polled bus: present, former and configured address. Empty on other links.
    places: tuple[int, ...] = ()
    other_bits_per_s: float = 0.0  # load of the same CAN bus by all other configured devices, bit/s without stuff bits


class Risk(StrEnum):
    """Effect that no other verb can undo. Interactive programs ask for confirmation before such a verb."""

    NONE = ""
    CONNECTION = "the device may not be reached afterwards"
    RESET = "all settings of the device are lost"  # imud first writes a backup of all readable settings


class Proof(StrEnum):
    """Evidence for the effect of a verb: an observation that an unchanged device cannot cause.

    imud reports "sent, not verified" if it only has other observations, for example a pause of the samples, a sample of
    a device that sent samples before, or angles that agreed before. docs/commands.md contains the evidence of each
    verb.
    """

    VALUE = "value"  # the verb has no effect: its result is the requested value
    SCRIPT = "script"  # the script has checked the effect; it may return a `VerbResult`
    NONE = "none"  # the device does not show the effect
    RESTART = "restart"  # the device counter restarts; a device without a counter does not show a restart
    SETTINGS = "settings"  # the device reports other settings than before
    SAMPLES = "samples"  # the samples at rest have the values of `Verb.expected`, and did not have them before
    STREAM = "stream"  # samples arrive, and none arrived before
    ONE_SAMPLE = "one sample"  # a sample arrives, and none arrived before


class VerbResult(msgspec.Struct, frozen=True):
    """Result of a verb with an effect."""

    verified: bool
    evidence: str  # evidence for the effect, or the reason why imud could not verify the effect
    result: Any = None  # values that the verb returns
    not_saved: str = ""  # that the flash lacks a change, and the next step; empty if the flash contains all settings
    failed: bool = False  # whether the evidence shows that the effect did not occur; False if it is not known


def _always(_arguments: Any) -> bool:
    return True


def _nothing_expected(_arguments: Any) -> "Sequence[Expectation]":
    return ()


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb of a device: help text, arguments and request script.

    The arguments are the keyword-only parameters of `begin`. The annotation of a parameter gives its type and its
    bounds (`msgspec.Meta`). The name of a parameter contains its unit. A parameter with a default is optional.
    """

    help: str  # effect of the verb, one sentence
    begin: Callable[..., Any]
    """`begin(target, *, name: type = default, …)` returns the request script (polled drivers: the transfer script).

    The script returns the result of the verb, a value that JSON can represent. `begin` and the script raise
    BadArgument."""
    risk: Risk = Risk.NONE
    # Whether the verb writes the flash of the device. imud counts these writes and limits them per day.
    saves: bool = False
    changes: bool = True  # Whether the verb can change a setting. imud reads all settings again after such a verb.
    # Whether the device has the settings of its flash afterwards. imud also reads the identity again.
    restarts: bool = False
    # Returns whether the device restarts, from the arguments, for a verb that restarts it with some arguments only
    restarts_with: "Callable[[Any], bool]" = _always
    # Name of the argument with a published heading, degrees; empty if there is none. The script gets the yaw of the
    # device.
    heading: str = ""
    proof: Proof = Proof.VALUE
    evidence: str = ""  # evidence of `Proof.SCRIPT`, or the reason of `Proof.NONE`, one clause
    # Returns the expected means of the samples after the verb, from its arguments; empty if no sample shows the effect
    expected: "Callable[[Any], Sequence[Expectation]]" = _nothing_expected

    @property
    def parameters(self) -> type[Options]:
        """Struct type with the parameters of `begin` as fields."""
        return _parameters(self.begin)

    def arguments(self, given: Mapping[str, Any]) -> Options:
        """Return the checked and converted arguments of a call. Raises BadArgument."""
        if wrong := wrong_values(self.parameters, given, "argument"):
            known = ", ".join(str(parameter) for parameter in parameters_of(self)) or "none"
            raise BadArgument(f"{'; '.join(map(str, wrong))}; arguments: {known}")
        return msgspec.convert(dict(given), self.parameters)

    def effect_on_flash(self, arguments: Options) -> tuple[bool, bool]:
        """Return whether the device restarts, and whether the flash may lack a change afterwards."""
        restarts = self.restarts and self.restarts_with(arguments)
        return restarts, self.changes and not (self.saves or self.restarts)

    def script(self, target: Target, arguments: Options) -> Any:
        """Return the script of the verb for `arguments`, a result of the method `arguments`."""
        return self.begin(target, **msgspec.structs.asdict(arguments))


@cache
def _parameters(begin: Callable[..., Any]) -> type[Options]:
    hints = get_type_hints(begin, include_extras=True)
    given = [p for p in signature(begin).parameters.values() if p.kind is p.KEYWORD_ONLY]
    fields = [(p.name, hints[p.name]) if p.default is p.empty else (p.name, hints[p.name], p.default) for p in given]
    return cast(type[Options], msgspec.defstruct("Parameters", fields, bases=(Options,), kw_only=True))


Verbs = Mapping[str, Verb]


class VerbParameter(msgspec.Struct, frozen=True):
    """Description of one argument of a verb."""

    name: str
    values: str  # accepted values, for example `a whole number from 1 to 127`
    default: str | None  # default value as JSON; None for a required argument
    required: bool = False  # whether a call must contain this argument

    def __str__(self) -> str:
        """Return the description, for example `rate_hz (a number; default 100)`."""
        return f"{self.name} ({self.values}{'' if self.default is None else f'; default {self.default}'})"


class VerbInfo(msgspec.Struct, frozen=True):
    """Description of one verb."""

    name: str
    help: str
    parameters: tuple[VerbParameter, ...]
    risk: Risk = Risk.NONE  # reason for a confirmation, one clause; empty if no confirmation is necessary


def parameters_of(verb: Verb) -> tuple[VerbParameter, ...]:
    """Return the descriptions of the arguments of a verb."""
    return tuple(
        VerbParameter(one.name, expected(one.type), None if one.required else shown(one.default), one.required)
        for one in msgspec.structs.fields(verb.parameters)
    )


def described(verbs: Verbs) -> list[VerbInfo]:
    """Return the descriptions of verbs in the same order."""
    return [VerbInfo(name, verb.help, parameters_of(verb), verb.risk) for name, verb in verbs.items()]


class Handling(StrEnum):
    """Motion of the device during a calibration."""

    REST = "rest"  # the device must not move
    SPIN = "spin"  # the user turns the device, which stays level, slowly about the vertical axis
    TURN = "turn"  # the user turns the device slowly, in one place, into as many directions as possible


class Kept(StrEnum):
    """Lifetime of the result of a calibration."""

    BY_SAVE = "until power-off, unless it is saved"
    BY_DEVICE = "saved by the device itself"
    NEVER = "until power-off; it cannot be saved"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Progress of a calibration, as the device reports it."""

    done: bool
    words: str  # Values of the device as readable text. A new text after the calibration means a new result.
    progress: float | None = None  # 0 … 1; None if the device does not report its progress
    has_failed: bool = False  # whether the device reports that the calibration failed
    bias_t: Vector3 | None = None  # bias of the magnetometer, T; None if the device does not report it


@dataclass(frozen=True, slots=True)
class RestMeans:
    """Means of the samples of a device at rest, in sensor axes; None for a quantity that the samples lack."""

    accel_m_s2: Vector3 | None
    gyro_rad_s: Vector3 | None
    euler_rad: Vector3 | None  # roll, pitch, yaw
    incli_rad: Pair | None = None  # inclinometer X and Y


@dataclass(frozen=True, slots=True)
class Expectation:
    """Expected mean of the samples at rest after a calibration: `value(means)` is at most `limit`."""

    name: str
    unit: str  # SI unit of `value` and `limit`
    limit: float
    value: Callable[[RestMeans], float | None]  # returns the absolute value; None if the samples lack the quantity


# Limit 0.1 °/s: far above the bias of a calibrated sensor, far below the bias of an uncalibrated sensor.
GYRO_ZERO: Final = Expectation(
    "mean angular rate", "rad/s", 0.1 * RAD_PER_DEG, lambda m: None if m.gyro_rad_s is None else hypot(*m.gyro_rad_s)
)
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


def yaw_at(angle_deg: float) -> Expectation:
    """Return the expectation of a heading."""

    def difference(means: RestMeans) -> float | None:
        return None if means.euler_rad is None else abs(remainder(means.euler_rad[2] - angle_deg * RAD_PER_DEG, tau))

    return Expectation("yaw", "rad", 1.0 * RAD_PER_DEG, difference)


# 0.1 m/s² is a tilt of 0.6°.
ACCEL_LEVEL: Final = Expectation(
    "horizontal acceleration", "m/s²", 0.1, lambda m: None if m.accel_m_s2 is None else hypot(*m.accel_m_s2[:2])
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """One calibration of a device."""

    help: str  # effect of the calibration, one sentence
    section: str  # section of the vendor's manual
    handling: Handling
    instructions: tuple[str, ...]  # steps of the user before and during the calibration, one sentence per step
    # Returns the script that starts the calibration. If the device shows the end, the script waits for the end. A
    # Verdict with `done` False as its result is the reason of a result that is not verified.
    begin: Callable[[Target], Any]
    # Returns the script that requests the progress and returns a Verdict; None if `begin` waits for the end
    verdict: Callable[[Target], Any] | None = None
    # Whether the device reports the state of a calibration that a command started. After the command, the state must
    # first be neither done nor failed: the device also keeps the state of an earlier calibration.
    reports_start: bool = False
    # Returns the script that returns a missing precondition, one sentence or empty; None if there is no precondition
    unready: Callable[[Target], Any] | None = None
    expected: tuple[Expectation, ...] = ()  # expected means of the samples at rest after the calibration
    kept: Kept
    save: Callable[[Target], Any] | None = None  # returns the script that saves the result; only with Kept.BY_SAVE


Calibrations = Mapping[str, Calibration]


class CalibrationStatus(msgspec.Struct, frozen=True):
    """Running calibration of a device."""

    kind: str
    phase: str  # phase of the newest progress event; empty before the first event
    begun_ns: int  # CLOCK_MONOTONIC of the start, ns
    limit_ns: int | None  # maximum time for the turns, ns; null for a device at rest
    by: str  # who requested it, for example `uid 1000`; empty if unknown
    message: str = ""  # newest progress, one sentence
    progress: dict[str, str | int | float | bool | None] = {}  # `detail` of the newest progress event


class CalibrationInfo(msgspec.Struct, frozen=True):
    """Description of one calibration."""

    kind: str
    help: str
    section: str
    handling: Handling
    instructions: tuple[str, ...]
    kept: Kept
    last: "LastCalibration | None" = None  # result of the last calibration of this kind; null if there is none


class Check(msgspec.Struct, frozen=True):
    """One comparison of samples after a calibration."""

    name: str
    value: float | None  # Mean of the samples; None if the samples lack the quantity. Then `passed` is False.
    limit: float
    unit: str
    passed: bool


class CalibrationResult(msgspec.Struct, frozen=True):
    kind: str
    verified: bool  # whether the device reports success and all checks passed
    problem: str  # fault and next step, one sentence; empty if `verified`
    device: str  # values of the device as readable text
    checks: tuple[Check, ...]
    saved: bool
    kept: Kept


class LastCalibration(msgspec.Struct, frozen=True):
    """Result of a calibration, kept in the state directory."""

    utc_ns: int  # time of the end, UTC
    verified: bool
    saved: bool
    problem: str = ""
    checks: tuple[Check, ...] = ()


REQUESTED_BY: ContextVar[str] = ContextVar("REQUESTED_BY", default="")
"""Who requested the running work, for example `uid 1000`. Outputs set it in the task of a request."""


def infos(calibrations: Calibrations, last: Mapping[str, LastCalibration] | None = None) -> list[CalibrationInfo]:
    """Return the descriptions of calibrations in the same order."""
    return [
        CalibrationInfo(kind, one.help, one.section, one.handling, one.instructions, one.kept, (last or {}).get(kind))
        for kind, one in calibrations.items()
    ]
