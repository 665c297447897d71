"""Table: scales of raw values of HiPNUC modules to SI that two or more protocols share; and counts of SI values.

Manual "IMU配置手冊" V1.5.9: HI91 and HI92 in section 3.3, registers in section 4.2, TPDOs in section 5.2, PGNs in
section 6.1. A scale that one protocol has alone stands with its layout.

    quantity       HI91 (float)   HI92        Modbus, J1939   CANopen
    acceleration   G              own         G / 2048 *      0.001 G
    angular rate   °/s            own         0.061035 °/s    0.1 °/s
    field          µT             0.030517 µT on all three of them
    angles         °              0.001°      0.001°          0.01°
    quaternion     1              0.0001 on all (Modbus of older firmware: 2⁻¹⁵)

(*) printed as 0.00048828 G; 16 / 32768 G would be 2.6e-6 more.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from enum import Enum
from math import isnan
from typing import Any, Final

from imud.attitude.conventions import Heading
from imud.contracts.command import (
    ACCEL_LEVEL,
    INCLINATION_ZERO,
    PITCH_ZERO,
    ROLL_ZERO,
    Actions,
    Calibration,
    Calibrations,
    Handling,
    Kept,
    Target,
)
from imud.contracts.driver import DataSheet, StatusBit
from imud.model.units import RAD_PER_DEG, T_PER_UT

M_S2_PER_G: Final = 9.8
"""The firmware divides m/s² by 9.8, so this G is not standard gravity."""
ACCEL_M_S2_PER_LSB: Final = 0.00048828 * M_S2_PER_G
GYRO_RAD_S_PER_LSB: Final = 0.061035 * RAD_PER_DEG
MAG_T_PER_LSB: Final = 0.030517 * T_PER_UT
"""As the manual prints it; 1000 / 32768 µT would be 1.9e-5 more."""
EULER_RAD_PER_LSB: Final = 0.001 * RAD_PER_DEG
QUAT_PER_LSB: Final = 0.0001
TEMPERATURE_C_PER_LSB: Final = 0.01
PRESSURE_PA_PER_LSB: Final = 0.01


def counts_of(value: float, bits: int) -> int:
    """Round to a count of a signed field, clipped to its range. Raises ValueError for NaN."""
    if isnan(value):
        raise ValueError("NaN has no count")
    most = 1 << bits - 1
    return round(max(-most, min(most - 1, value)))


PRESSURE_MIN_PA: Final = 1_000.0
PRESSURE_MAX_PA: Final = 120_000.0
PLACEHOLDERS: Final = (0.0, 999.0)
"""Values that firmware without a barometer writes on purpose."""


def pressure_of(value_pa: float) -> float | None:
    """Return a pressure in Pa, or None where the field holds none; NaN and infinity are none."""
    return value_pa if PRESSURE_MIN_PA <= value_pa <= PRESSURE_MAX_PA else None


def temperature_beside(temperature_c: float, pressure_pa: float) -> float | None:
    """Return the temperature in °C that HI91 carries next to a pressure field, or None where both were never written.

    It is the inertial sensor's, so it stands without a barometer too; but where the pressure is no value that any
    firmware writes, the bytes around it are what stood in the buffer.
    """
    is_written = pressure_pa in PLACEHOLDERS or pressure_of(pressure_pa) is not None
    return temperature_c if is_written else None


DOCUMENT: Final = "HiPNUC IMU configuration manual V1.5.9 (CH0x0, CH10x, HI14): no figure of noise for any model"
FLOATS: Final = DataSheet(document=DOCUMENT)
"""Of the UART."""
REGISTERS: Final = DataSheet(document=DOCUMENT, gyro_step_rad_s=GYRO_RAD_S_PER_LSB, accel_step_m_s2=ACCEL_M_S2_PER_LSB)
"""Of Modbus and J1939."""

SETTINGS: Final = ("ATT_MODE", "heading_mode", "mode")
"""Names under which modules report it: ASCII commands, Modbus."""
HEADINGS: Final = {
    "0": Heading.RELATIVE,
    "six axes": Heading.RELATIVE,
    "6-axis": Heading.RELATIVE,
    "1": Heading.MAGNETIC,
    "nine axes": Heading.MAGNETIC,
    "9-axis": Heading.MAGNETIC,
}


def heading_by_mode(_settings: object, read_back: Mapping[str, str]) -> Heading:
    """Return the reference of yaw by the settings that were read back."""
    for name in SETTINGS:
        value = read_back.get(name, "").strip().lower()
        if value in HEADINGS:
            return HEADINGS[value]
    return Heading.UNKNOWN


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
    """Attitude modes: without or with the magnetometer."""

    SIX_AXIS = 0
    """Heading is relative, 0 at power-on."""
    NINE_AXIS = 1
    """Heading is magnetic; needs one calibration and an undisturbed field."""


class LevelReset(Enum):
    """Operations on the level; the module must be at rest."""

    RELATIVE = 2
    """Pitch and roll are zero in the present attitude, at any tilt."""
    AUTOMATIC = 3
    """Like RELATIVE and for the accelerometer too, but only within 5° of level or of upside down."""
    CANCEL = 5
    """Back to the factory's level."""


Script = Callable[[Target], Any]
"""Makes a script from the target."""

TURNING: Final = (
    "Go outdoors, or keep at least 30 cm away from iron, motors, computers and telephones: a field that does not turn "
    "with the module cannot be calibrated, and indoors the heading of nine axes may stay worse than that of six.",
    "Leave the module in whatever it is mounted on, and turn both as one rigid body.",
    "Turn it slowly, in one place, for one to two minutes: about each axis at least once around, and upside down too.",
)
"""Sections 8.1.1, 8.1.2 and 8.3."""
LEVELLING: Final = ("Put the module down in the attitude that is to be level, and do not touch it.",)
NINE_AXES_NEEDED: Final = "expected 9-axis mode, which uses the magnetometer; set it first"


def magnetometer(begin: Script, verdict: Script, unready: Script) -> Calibration:
    """Make the calibration of the magnetometer that the module does by itself in 9-axis mode."""
    return Calibration(
        help="measure the field of what the module is mounted on; goes on in the background afterwards",
        section="8.1.1",
        handling=Handling.TURN,
        instructions=TURNING,
        begin=begin,
        verdict=verdict,
        unready=unready,
        kept=Kept.BY_DEVICE,
    )


def levels(section: str, limit_deg: int, begin: Callable[[LevelReset], Script], save: Script) -> Calibrations:
    """Make the calibrations of the level: at any tilt, and with the accelerometer within `limit_deg` of level.

    Upside down the second one makes roll 180°: only pitch and acceleration are expected to be zero.
    """
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
    automatic = replace(
        relative,
        help=f"make pitch, roll and the horizontal acceleration zero, {near} or of upside down",
        instructions=(f"Put the module on a level surface, {near}, and do not touch it.",),
        begin=begin(LevelReset.AUTOMATIC),
        expected=(PITCH_ZERO, ACCEL_LEVEL),
    )
    return {"level": relative, "accelerometer_level": automatic}


def inclinometer_zero(section: str, actions: Actions) -> Calibrations:
    """Make the calibrations of an inclinometer on a bus, from its actions `zero` and `save`."""

    def zero_here(target: Target) -> object:
        return actions["zero"].begin(target, zero="here")

    zero = Calibration(
        help="make the present position the inclinometer's zero",
        section=section,
        handling=Handling.REST,
        instructions=LEVELLING,
        begin=zero_here,
        expected=(INCLINATION_ZERO,),
        kept=Kept.BY_SAVE,
        save=actions["save"].begin,
    )
    return {"zero": zero}
