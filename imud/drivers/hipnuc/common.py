"""Scales, status bits and calibrations that several HiPNUC protocols share.

Manual "IMU配置手冊" V1.5.9: HI91 and HI92 in section 3.3, registers in section 4.2, TPDOs in section 5.2, PGNs in
section 6.1. A scale of one protocol only is in the module of its layout.

    quantity       HI91 (float)   HI92        Modbus, J1939   CANopen
    acceleration   G              other       G / 2048 *      0.001 G
    angular rate   °/s            other       0.061035 °/s    0.1 °/s
    field          µT             0.030517 µT in HI92, Modbus and J1939
    angles         °              0.001°      0.001°          0.01°
    quaternion     1              0.0001 in all (Modbus of older firmware: 2⁻¹⁵)

(*) The manual prints 0.00048828 G; 16 / 32768 G would be 2.6e-6 larger.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import Enum
from math import isnan
from random import Random
from typing import Any, Final

from imud.attitude.conventions import Heading
from imud.attitude.rotation import quat_normalized
from imud.contracts.command import (
    ACCEL_LEVEL,
    INCLINATION_ZERO,
    PITCH_ZERO,
    ROLL_ZERO,
    Calibration,
    Calibrations,
    Expectation,
    Handling,
    Kept,
    Proof,
    Target,
    Verb,
    Verbs,
)
from imud.contracts.driver import DataSheet, StatusBit
from imud.model.errors import BadArgument
from imud.model.sample import Quaternion, Vector3
from imud.model.units import RAD_PER_DEG, T_PER_UT

M_S2_PER_G: Final = 9.8  # G of the firmware, m/s²: it divides by 9.8, not by standard gravity
ACCEL_M_S2_PER_LSB: Final = 0.00048828 * M_S2_PER_G
GYRO_RAD_S_PER_LSB: Final = 0.061035 * RAD_PER_DEG
MAG_T_PER_LSB: Final = 0.030517 * T_PER_UT  # value in the manual; 1000 / 32768 µT would be 1.9e-5 larger
EULER_RAD_PER_LSB: Final = 0.001 * RAD_PER_DEG
QUAT_PER_LSB: Final = 0.0001
TEMPERATURE_C_PER_LSB: Final = 0.01
PRESSURE_PA_PER_LSB: Final = 0.01


def counts_of(value: float, bits: int) -> int:
    """Return the count of a signed field, clipped to its range. Raises ValueError for NaN."""
    if isnan(value):
        raise ValueError("NaN has no count")
    most = 1 << bits - 1
    return round(max(-most, min(most - 1, value)))


def refuse_all(*checks: Callable[[], None]) -> None:
    """Run all checks. Raises BadArgument with the problems of all of them."""
    problems = []
    for check in checks:
        try:
            check()
        except BadArgument as error:
            problems.append(str(error))
    if problems:
        raise BadArgument("; ".join(problems))


def random_quaternion(random: Random) -> Quaternion:
    """Return a random unit quaternion, for the examples of the property tests."""
    return quat_normalized((random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1)))


PRESSURE_MIN_PA: Final = 1_000.0
PRESSURE_MAX_PA: Final = 120_000.0
PLACEHOLDERS: Final = (0.0, 999.0)  # pressures that firmware without a barometer sends


def pressure_of(value_pa: float) -> float | None:
    """Return a pressure, Pa; None for a value outside the range of air pressure, NaN and infinity."""
    return value_pa if PRESSURE_MIN_PA <= value_pa <= PRESSURE_MAX_PA else None


def byte_temperature_c(temperature_c: int) -> float | None:
    """Return the temperature in a byte, °C; None for the ends of the range, which are filler bytes."""
    return temperature_c + 0.0 if -128 < temperature_c < 127 else None


# Counts of filler bytes in three 16-bit fields, if all three are equal: the ends of the range and 7F 7F. No sensor
# measures its maximum on three axes. Zeros and FF FF are only in a field without a magnetometer not a measurement.
FILLERS: Final = (0x7FFF, 0x7F7F, -0x8000)
FIELD_FILLERS: Final = (*FILLERS, 0, -1)


def vector_of(x: int, y: int, z: int, factor: float) -> Vector3 | None:
    """Return three 16-bit counts times `factor`; None for filler bytes."""
    return None if x == y == z and x in FILLERS else (x * factor, y * factor, z * factor)


def field_of(x: int, y: int, z: int) -> Vector3 | None:
    """Return the magnetic field of three counts of MAG_T_PER_LSB, T; None for filler bytes."""
    return None if x == y == z and x in FIELD_FILLERS else vector_of(x, y, z, MAG_T_PER_LSB)


def temperature_beside(temperature_c: float | None, pressure_pa: float) -> float | None:
    """Return the temperature next to a pressure field of HI91, °C; None if the firmware wrote neither field.

    The inertial sensor measures the temperature, so it also exists without a barometer. If the pressure has a value
    that no firmware writes, both fields are old content of the device's buffer.
    """
    is_written = pressure_pa in PLACEHOLDERS or pressure_of(pressure_pa) is not None
    return temperature_c if is_written and (temperature_c or pressure_pa) else None


DOCUMENT: Final = "HiPNUC IMU configuration manual V1.5.9 (CH0x0, CH10x, HI14): no noise figures for any model"
FLOATS: Final = DataSheet(document=DOCUMENT)  # data sheet of the UART protocol
# Data sheet of Modbus and J1939
REGISTERS: Final = DataSheet(document=DOCUMENT, gyro_step_rad_s=GYRO_RAD_S_PER_LSB, accel_step_m_s2=ACCEL_M_S2_PER_LSB)


def save_verb(begin: Callable[[Target], Any]) -> Verb:
    """Return the verb `save` with the script of a protocol."""
    return Verb(
        "write all settings to flash",
        begin,
        saves=True,
        changes=False,
        proof=Proof.NONE,
        evidence="the device confirmed it, and imud cannot read the flash",
    )


def levelled(given: Any) -> Sequence[Expectation]:
    """Return the expected angles after the verb `level`."""
    return () if given.level == "cancel" else (ROLL_ZERO, PITCH_ZERO)


def zeroed(given: Any) -> Sequence[Expectation]:
    """Return the expected angles after the verb `zero`."""
    return () if given.zero == "cancel" else (INCLINATION_ZERO,)


def heading_by_mode(_options: object, settings: Mapping[str, Any]) -> Heading:
    """Return the reference of yaw from the values of the device settings."""
    return {"6-axis": Heading.RELATIVE, "9-axis": Heading.MAGNETIC}.get(settings.get("mode", ""), Heading.UNKNOWN)


MAIN_STATUS: Final[Mapping[int, StatusBit]] = {
    3: StatusBit("gyroscope bias not converged", notable=True),
    4: StatusBit("magnetic disturbance", notable=True),
    5: StatusBit("accelerometer over range", notable=True),
    6: StatusBit("gyroscope over range", notable=True),
    7: StatusBit("attitude not converged", notable=True),
    9: StatusBit("at rest"),
    10: StatusBit("heading by magnetometer"),
    11: StatusBit("time not UTC"),
    12: StatusBit("frame with SOUT pulse"),
}


class AttitudeMode(Enum):
    """Attitude modes: without or with the magnetometer, and three of newer firmware on a UART."""

    SIX_AXIS = 0  # heading is relative, 0 at power-on
    NINE_AXIS = 1  # heading is magnetic; it needs one calibration and an undisturbed field
    HUMANOID = 4
    SLOW_VEHICLE = 5  # slow vehicle on the ground
    LOW_DYNAMICS = 7


class LevelReset(Enum):
    """Operations on the level; the device must be at rest."""

    RELATIVE = 2  # pitch and roll are zero in the present attitude, at any tilt
    AUTOMATIC = 3  # like RELATIVE and also for the accelerometer, but only within 5° of level or of upside down
    CANCEL = 5  # back to the factory level


Script = Callable[[Target], Any]  # returns a script for the target

# sections 8.1.1, 8.1.2 and 8.3
TURNING: Final = (
    "Go outdoors, or keep at least 30 cm away from iron, motors, computers and telephones. A field that does not turn "
    "with the device prevents the calibration. Indoors, the 9-axis heading may stay worse than the 6-axis heading.",
    "Keep the device in its mount, and turn both as one rigid body.",
    "Turn it slowly, in one place, for one to two minutes: at least one full turn about each axis, also upside down.",
)
LEVELLING: Final = ("Put the device down in the attitude that must be level, and do not touch it.",)
NINE_AXES_NEEDED: Final = (
    "expected 9-axis mode, which uses the magnetometer; set it first: `imud settings NAME --set mode=9-axis`"
)


def magnetometer(begin: Script, verdict: Script, unready: Script) -> Calibration:
    """Return the calibration of the magnetometer, which the device makes in 9-axis mode."""
    return Calibration(
        help="measure the magnetic field of the mount; the calibration continues in the background",
        section="8.1.1",
        handling=Handling.TURN,
        instructions=TURNING,
        begin=begin,
        verdict=verdict,
        unready=unready,
        kept=Kept.BY_DEVICE,
    )


def levels(section: str, limit_deg: int, begin: Callable[[LevelReset], Script], save: Script) -> Calibrations:
    """Return the calibrations of the level: at any tilt, and with the accelerometer within `limit_deg` of level."""
    relative = Calibration(
        help="make the present pitch and roll zero, at any tilt",
        section=section,
        handling=Handling.REST,
        instructions=LEVELLING,
        begin=begin(LevelReset.RELATIVE),
        expected=(ROLL_ZERO, PITCH_ZERO),
        kept=Kept.BY_SAVE,
        save=save,
    )
    near = f"within {limit_deg}° of level"
    # upside down, roll becomes 180°: only pitch and acceleration must be zero
    automatic = replace(
        relative,
        help=f"make pitch, roll and the horizontal acceleration zero, {near} or of upside down",
        instructions=(f"Put the device on a level surface, {near}, and do not touch it.",),
        begin=begin(LevelReset.AUTOMATIC),
        expected=(PITCH_ZERO, ACCEL_LEVEL),
    )
    return {"level": relative, "accelerometer_level": automatic}


def inclinometer_zero(section: str, verbs: Verbs) -> Calibrations:
    """Return the calibrations of an inclinometer on a bus, from its verbs `zero` and `save`."""

    def zero_here(target: Target) -> object:
        return verbs["zero"].begin(target, zero="here")

    zero = Calibration(
        help="make the present position the zero of the inclinometer",
        section=section,
        handling=Handling.REST,
        instructions=LEVELLING,
        begin=zero_here,
        expected=(INCLINATION_ZERO,),
        kept=Kept.BY_SAVE,
        save=verbs["save"].begin,
    )
    return {"zero": zero}
