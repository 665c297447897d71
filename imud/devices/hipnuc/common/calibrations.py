"""Calibrations of all HiPNUC modules: instructions, and the zero of an inclinometer. Manual, chapters 5, 6, 8.

Those of a wire protocol are in its folder.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from imud.contracts.action import Actions, Target
from imud.contracts.control.calibration import (
    ACCEL_LEVEL,
    INCLINATION_ZERO,
    PITCH_ZERO,
    ROLL_ZERO,
    Calibration,
    Calibrations,
    Handling,
    Kept,
)
from imud.devices.hipnuc.uart.commands import LevelReset

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
