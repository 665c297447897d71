"""Keys of a device with rules of their own: `frame`, `declination_deg`, `attitude`, `lines` and `rmc`."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from importlib import import_module
from typing import Any, Final

import msgspec

from imud.attitude.conventions import RFU_ENU, AttitudeSource, Heading
from imud.attitude.published import FrameOptions, MountingAngles, MountingAxes, mounting_of
from imud.config.model import DeviceConfig
from imud.config.schema import DeviceGeneral, Keys
from imud.config.yaml import Path as KeyPath
from imud.contracts.driver import Driver
from imud.contracts.lines import LINE_SCHEMAS, DeviceLines, LineOptions
from imud.model.errors import ImudError
from imud.model.options import Options, shown
from imud.utc.receivers import RmcOptions

KEY: Final = "frame"
# Keys of `frame` with keys of their own.
NESTED: Final[Mapping[str, type[Options]]] = {"axes": MountingAxes, "euler": MountingAngles}
WAYS: Final = ("axes", "euler", "quat_wxyz")  # keys for a rotation


def read_frame(keys: Keys, path: KeyPath, device: Mapping[str, Any]) -> FrameOptions | None:
    """Read the key `frame` of a device; None if the key is absent or invalid."""
    if KEY not in device:
        return None
    found = keys.mapping(path, device[KEY])
    if found is None:
        return None
    given = [way for way in WAYS if found.get(way) is not None]
    if len(given) > 1:
        message = f"expected one key for the rotation ({', '.join(WAYS)}), got {' and '.join(given)}"
        keys.problem((*path, given[1]), message, at_key=True)
    nested = {
        name: keys.part(schema, found[name], (*path, name))
        for name, schema in NESTED.items()
        if found.get(name) is not None
    }
    settings = keys.part(FrameOptions, {name: value for name, value in found.items() if name not in NESTED}, path)
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


def check_declination(
    keys: Keys, path: KeyPath, general: DeviceGeneral, options: Options | None, drivers: Mapping[str, Driver]
) -> None:
    """Report a declination if the heading is not magnetic or the configuration does not name the driver."""
    if general.declination_deg is None:
        return
    place = (*path, "declination_deg")
    if general.driver == "auto":
        keys.problem(place, "expected the name of a driver next to declination_deg, got auto", at_key=True)
        return
    heading = Heading.UNKNOWN
    if general.driver in drivers:
        with suppress(ImportError):  # another check reports this problem
            heading = drivers[general.driver].heading(options, {})
    if heading in (Heading.TRUE, Heading.RELATIVE):
        why = "is relative to power-on" if heading is Heading.RELATIVE else "is already true"
        message = f"expected declination_deg only with a magnetic heading, got {general.driver}"
        keys.problem(place, f"{message}, whose heading {why}", at_key=True)


def check_attitude(
    keys: Keys, path: KeyPath, general: DeviceGeneral, options: Options | None, drivers: Mapping[str, Driver]
) -> None:
    """Report the attitude of the host for a device with its own attitude, or without the library."""
    if general.attitude is not AttitudeSource.HOST:
        return
    place = (*path, "attitude")
    if general.driver == "auto":
        keys.problem(place, "expected the name of a driver next to attitude: host, got auto", at_key=True)
        return
    if options is None:
        return  # another check reports the problem of the driver
    if drivers[general.driver].sends_attitude(options):
        message = (
            f"expected a device without an attitude of its own ({', '.join(_without_attitude(drivers))}), got "
            f"{general.driver} with these options; remove the key"
        )
        keys.problem(place, message, at_key=True)
        return
    try:
        import_module("imud.sampling.attitude").check_extra()
    except ImudError as error:
        keys.problem(place, str(error), at_key=True)


def _without_attitude(drivers: Mapping[str, Driver]) -> Iterator[str]:
    for name in drivers:
        with suppress(ImportError):
            if not drivers[name].sends_attitude(drivers[name].settings()):
                yield name


LINK: Final = "uart"
PULSE: Final = "pps"  # Key of the line for a pulse per second. A device with this line uses PPS and RMC sentences.
TRIGGER: Final = "sin"  # key of the line with which imud drives the pulse input of the device


def read_lines(
    keys: Keys, path: KeyPath, device: Mapping[str, Any], drivers: Mapping[str, Driver]
) -> DeviceLines | None:
    """Read the key `lines` of a device; None if the key is absent."""
    if "lines" not in device:
        return None
    found = keys.mapping(path, device["lines"])
    if found is None:
        return None
    _fit(keys, path, found, device.get("driver", "auto"), drivers)
    made: dict[str, LineOptions] = {}
    for name, schema in LINE_SCHEMAS.items():
        if name in found:
            inside = keys.mapping((*path, name), found[name])
            settings = None if inside is None else keys.part(schema, inside, (*path, name))
            if settings is not None:
                made[name] = settings
    return DeviceLines(**made) if made else None  # type: ignore[arg-type]  # each was made by the schema of its key


def lines_once(keys: Keys, used: Iterable[tuple[KeyPath, LineOptions]]) -> None:
    """Report a GPIO line that is used twice, by devices or outputs. `used` contains the paths of their keys."""
    owners: list[tuple[LineOptions, str]] = []
    for path, settings in used:
        first = next((place for other, place in owners if _same_line(other, settings)), None)
        if first is not None:
            wire = f"{settings.chip} line {settings.line}" if settings.chip else f"line {settings.line}"
            keys.problem(path, f"expected an unused line, got {wire}, which {first} uses", at_key=True)
        place = ".".join(map(str, path[1:] if path[0] == "devices" else path))
        owners.append((settings, f"{place} (line {keys.tree.key_mark(path).line})"))


def read_rmc(keys: Keys, path: KeyPath, device: Mapping[str, Any], drivers: Mapping[str, Driver]) -> RmcOptions | None:
    """Read the key `rmc` of a device; None if the key is absent."""
    if "rmc" not in device:
        return None
    driver = device.get("driver", "auto")
    if LINK not in device or (driver != "auto" and PULSE not in _lines_of_driver(drivers, driver)):
        message = f"expected rmc only with the link {LINK} and a device with SIN/PPS, got driver {shown(driver)}"
        keys.problem(path, message, at_key=True)
    if driver == "auto":
        keys.problem(path, "expected the name of a driver next to rmc, got auto", at_key=True)
    lines = device.get("lines")
    if isinstance(lines, dict) and TRIGGER in lines:
        mark = keys.tree.key_mark((*path[:-1], "lines", TRIGGER))
        message = (
            "expected the pulse per second of a receiver on SIN with rmc, got lines.sin, with which imud drives SIN "
            f"(line {mark.line}); remove one of the keys"
        )
        keys.problem(path, message, at_key=True)
    return keys.part(RmcOptions, device["rmc"], path)


def _fit(keys: Keys, path: KeyPath, found: Mapping[str, Any], driver: object, drivers: Mapping[str, Driver]) -> None:
    """Report unknown lines, and lines that devices of this driver do not have."""
    keys.unknown_keys(path, found, list(LINE_SCHEMAS))
    if driver == "auto":
        message = "expected the name of a driver next to lines, got auto; drivers with lines"
        keys.problem(path, f"{message}: {', '.join(_with_lines(drivers))}", at_key=True)
    if not isinstance(driver, str) or driver not in drivers:
        return
    try:
        lines = drivers[driver].lines
    except ImportError:
        return  # the driver reports its failed import
    for name in found:
        if name in LINE_SCHEMAS and name not in lines:
            known = ", ".join(key for key in LINE_SCHEMAS if key in lines) or "none"
            message = f"expected a line of {driver} devices ({known}), got {shown(name)}"
            keys.problem((*path, name), message, at_key=True)


def _with_lines(drivers: Mapping[str, Driver]) -> Iterator[str]:
    for name in drivers:
        with suppress(ImportError):
            if drivers[name].lines:
                yield name


def lines_of_device(device: DeviceConfig) -> Iterator[tuple[KeyPath, LineOptions]]:
    """Yield the GPIO lines of a device with the paths of their keys."""
    for name in LINE_SCHEMAS if device.lines is not None else ():
        settings = getattr(device.lines, name)
        if settings is not None:
            yield ("devices", device.name, "lines", name), settings


def _same_line(one: LineOptions, other: LineOptions) -> bool:
    """Return whether both options name the same line. A line name without a chip matches a line of any chip."""
    chips = {one.chip.removeprefix("/dev/"), other.chip.removeprefix("/dev/")}
    return one.line == other.line and (len(chips) == 1 or "" in chips)


def _lines_of_driver(drivers: Mapping[str, Driver], driver: object) -> frozenset[str]:
    try:
        return drivers[driver].lines if isinstance(driver, str) and driver in drivers else frozenset({PULSE})
    except ImportError:
        return frozenset({PULSE})  # another check reports this problem and an unknown driver
