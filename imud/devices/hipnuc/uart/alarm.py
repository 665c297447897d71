"""Table: the angle of each axis of the ALARM pin, and the form of its ranges in the settings (HiPNUC manual, 2.2.4).

`CONFIG PMUX5 AXIS,MIN,MAX,THR,ENABLE` sets them; the pin is high while an angle is outside MIN … MAX degrees. No source
shows how LOG USRCONFIG prints them. Accepted are lines that name the alarm and hold the values in the command's order,
for example `ALARM_X: -5,5,0,1` or `PMUX5: Y,-5,5,0,1`; with any other form the axis stays unknown.

    axis   angle                      index into euler_rad
    X      about X, pitch (assumed)   1
    Y      about Y, roll (assumed)    0

If the assumption is wrong, the check of the ALARM line reports that the line follows the other axis.
"""

import re
from collections.abc import Mapping
from typing import Final

from imud.contracts.lines import AlarmRange, AlarmRanges

PIN_SETTING: Final = "PMUX5"
"""Selects what the pin does."""
MOUNTING_SETTING: Final = "URFR"
"""Rotates the sensor frame, and with it the axes X and Y."""
EULER_INDEX: Final = {"X": 1, "Y": 0}

_NUMBER = r"[-+]?[0-9]+(?:\.[0-9]*)?"
_NAME: Final = re.compile(rf"(?:{PIN_SETTING}|.*ALARM)(?:[_ ]?([XY]))?", re.IGNORECASE)
_VALUES: Final = re.compile(
    rf"(?:([XY])\s*,\s*)?({_NUMBER})\s*,\s*({_NUMBER})\s*,\s*{_NUMBER}\s*,\s*([01])", re.IGNORECASE
)


def alarm_ranges(settings: Mapping[str, str]) -> AlarmRanges:
    """Read the ranges from the device's settings; an axis that they do not give is missing."""
    by_axis: dict[str, AlarmRange] = {}
    for name, value in settings.items():
        named, values = _NAME.fullmatch(name.strip()), _VALUES.fullmatch(value.strip())
        if not named or not values:
            continue
        axis = (values[1] or named[1] or "").upper()
        if axis:
            by_axis[axis] = AlarmRange(EULER_INDEX[axis], float(values[2]), float(values[3]), values[4] == "1")
    return AlarmRanges(by_axis, PIN_SETTING, MOUNTING_SETTING)
