"""Contract of a guided calibration: what a person does, what is sent to the device, and how its result is judged.

A script here is what the driver's transport runs, as for actions. The guide (`imud.runtime.calibration`) watches the
samples meanwhile: it refuses motion where the device must rest, shows how far turning has come, and afterwards compares
the samples with what they must be.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import hypot
from typing import Any, Final

import msgspec

from imud.contracts.action import Target
from imud.sample import Pair, Vector3
from imud.units import RAD_PER_DEG


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
