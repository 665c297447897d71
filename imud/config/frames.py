"""Reading of `frame` and `declination_deg` of a device: how the sensor lies in its body, and where true north is.

The rotation is given in one way or in none, and is made here once, so that one which is no rotation is refused with its
place in the file.
"""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

import msgspec

from imud.config.keys import Keys
from imud.config.schema import DeviceGeneral, DriverRow
from imud.config.yaml_tree import Path as KeyPath
from imud.contracts.settings import Settings
from imud.frames.conventions import RFU_ENU, Heading
from imud.frames.settings import FrameSettings, MountingAngles, MountingAxes, mounting_of

KEY: Final = "frame"
NESTED: Final[Mapping[str, type[Settings]]] = {"axes": MountingAxes, "euler": MountingAngles}
"""Keys of `frame` with keys of their own."""
WAYS: Final = ("axes", "euler", "quat_wxyz")
"""The ways in which a rotation can be given."""


def read_frame(keys: Keys, path: KeyPath, device: Mapping[str, Any]) -> FrameSettings | None:
    """Read the key `frame` of a device; None where it has none or has problems."""
    if KEY not in device:
        return None
    found = keys.mapping(path, device[KEY])
    if found is None:
        return None
    given = [way for way in WAYS if found.get(way) is not None]
    if len(given) > 1:
        message = f"expected one way to give the rotation ({', '.join(WAYS)}), got {' and '.join(given)}"
        keys.problem((*path, given[1]), message, at_key=True)
    nested = _nested(keys, path, found)
    if nested is None:
        return None
    settings = keys.part(FrameSettings, {name: value for name, value in found.items() if name not in NESTED}, path)
    if settings is None:
        return None
    frame = msgspec.structs.replace(settings, **nested)
    if len(given) == 1:
        try:
            mounting_of(frame, RFU_ENU)
        except ValueError as error:
            keys.problem((*path, given[0]), str(error))
            return None
    return frame


def _nested(keys: Keys, path: KeyPath, found: Mapping[str, Any]) -> dict[str, Settings] | None:
    """Read the keys that have keys of their own; None where one has a problem."""
    made: dict[str, Settings] = {}
    for name, schema in NESTED.items():
        if found.get(name) is not None:
            part = keys.part(schema, found[name], (*path, name))
            if part is None:
                return None
            made[name] = part
    return made


def check_declination(
    keys: Keys, path: KeyPath, general: DeviceGeneral, options: Settings | None, drivers: Mapping[str, DriverRow]
) -> None:
    """Refuse a declination where the heading is known not to be magnetic, or the driver is not named."""
    if general.declination_deg is None:
        return
    place = (*path, "declination_deg")
    if general.driver == "auto":
        keys.problem(place, "expected declination_deg only beside a named driver, got it with driver auto", at_key=True)
        return
    heading = Heading.UNKNOWN
    if general.driver in drivers:
        with suppress(ImportError):  # reported elsewhere
            heading = drivers[general.driver].heading(options, {})
    if heading in (Heading.TRUE, Heading.RELATIVE):
        why = "counts from power-on" if heading is Heading.RELATIVE else "is true already"
        message = f"expected declination_deg only beside a magnetic heading, got it with {general.driver}"
        keys.problem(place, f"{message}, whose heading {why}", at_key=True)
