"""Table: what yaw counts from, by the heading mode that a HiPNUC module reports.

Six axes: the direction at power-on. Nine axes: magnetic north (HiPNUC manual V1.5.9, chapter 8). A module that did not
report its mode is not guessed at.
"""

from collections.abc import Mapping
from typing import Final

from imud.frames.conventions import Heading

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
