"""Table: calibrations of all HiPNUC modules: instructions, and the zero of an inclinometer. Manual, chapters 5, 6, 8.

Those of a wire protocol are in its folder.
"""

from typing import Final

from imud.contracts.action import Actions, Target
from imud.contracts.control.calibration import INCLINATION_ZERO, Calibration, Calibrations, Handling, Kept

TURNING: Final = (
    "Go outdoors, or keep at least 30 cm away from iron, motors, computers and telephones: a field that does not turn "
    "with the module cannot be calibrated, and indoors the heading of nine axes may stay worse than that of six.",
    "Leave the module in whatever it is mounted on, and turn both as one rigid body.",
    "Turn it slowly, in one place, for one to two minutes: about each axis at least once around, and upside down too.",
)
"""Sections 8.1.1, 8.1.2 and 8.3."""
LEVELLING: Final = ("Put the module down in the attitude that is to be level, and do not touch it.",)
NINE_AXES_NEEDED: Final = "expected 9-axis mode, which uses the magnetometer; set it first"


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
