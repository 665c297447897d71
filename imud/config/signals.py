"""Reading of `lines` and `rmc` of a device: its GPIO lines, none used twice, and its source of RMC sentences."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

from imud.config.keys import Keys
from imud.config.model import DeviceConfig
from imud.config.schema import DriverRow
from imud.config.yaml_tree import Path as KeyPath
from imud.contracts.lines import LINE_SCHEMAS, DeviceLines, LineSettings
from imud.contracts.settings import shown
from imud.utc.source import RmcSettings

LINK: Final = "uart"
PULSE: Final = "pps"
"""A device with this line synchronises to a pulse per second and RMC sentences."""
TRIGGER: Final = "sin"
"""Key of the line by which imud drives the input of the pulse."""


def read_lines(
    keys: Keys, path: KeyPath, device: Mapping[str, Any], drivers: Mapping[str, DriverRow]
) -> DeviceLines | None:
    """Read the GPIO lines below the key `lines` of a device; None where it has none."""
    if "lines" not in device:
        return None
    found = keys.mapping(path, device["lines"])
    if found is None:
        return None
    _fit(keys, path, found, device.get("driver", "auto"), drivers)
    made: dict[str, LineSettings] = {}
    for name, schema in LINE_SCHEMAS.items():
        if name in found:
            inside = keys.mapping((*path, name), found[name])
            settings = None if inside is None else keys.part(schema, inside, (*path, name))
            if settings is not None:
                made[name] = settings
    return DeviceLines(**made) if made else None  # type: ignore[arg-type]  # each was made by the schema of its key


def lines_once(keys: Keys, devices: Sequence[DeviceConfig]) -> None:
    """Refuse a GPIO line that is used twice, by one device or by two."""
    owners: list[tuple[LineSettings, str]] = []
    for device in devices:
        for name, settings in _lines_of_device(device):
            path: KeyPath = ("devices", device.name, "lines", name)
            first = next((place for other, place in owners if _same_line(other, settings)), None)
            if first is not None:
                wire = f"{settings.chip} line {settings.line}" if settings.chip else f"line {settings.line}"
                keys.problem(path, f"expected a line of its own, got {wire}, which {first} has", at_key=True)
            owners.append((settings, f"{device.name}.lines.{name} (line {keys.tree.key_mark(path).line})"))


def read_rmc(
    keys: Keys, path: KeyPath, device: Mapping[str, Any], drivers: Mapping[str, DriverRow]
) -> RmcSettings | None:
    """Read the settings below the key `rmc` of a device; None where it has none."""
    if "rmc" not in device:
        return None
    driver = device.get("driver", "auto")
    if LINK not in device or (driver != "auto" and PULSE not in _lines_of_driver(drivers, driver)):
        message = (
            f"expected rmc only beside the link {LINK} of a device with SIN/PPS, got it with driver {shown(driver)}"
        )
        keys.problem(path, message, at_key=True)
    if driver == "auto":
        keys.problem(path, "expected rmc only beside a named driver, got it with driver auto", at_key=True)
    lines = device.get("lines")
    if isinstance(lines, dict) and TRIGGER in lines:
        mark = keys.tree.key_mark((*path[:-1], "lines", TRIGGER))
        message = (
            "expected a receiver's pulse per second on SIN beside rmc, got imud as what drives it by lines.sin "
            f"(line {mark.line}): leave one of them out"
        )
        keys.problem(path, message, at_key=True)
    return keys.part(RmcSettings, device["rmc"], path)


def _fit(keys: Keys, path: KeyPath, found: Mapping[str, Any], driver: object, drivers: Mapping[str, DriverRow]) -> None:
    """Refuse lines that no device has, and lines that devices of this driver do not have."""
    keys.unknown_keys(path, found, list(LINE_SCHEMAS))
    if driver == "auto":
        message = "expected lines only beside a named driver, got them with driver auto; drivers that have lines"
        keys.problem(path, f"{message}: {', '.join(_with_lines(drivers))}", at_key=True)
    if not isinstance(driver, str) or driver not in drivers:
        return
    try:
        lines = drivers[driver].lines
    except ImportError:
        return  # reported elsewhere: the driver cannot be imported
    for name in found:
        if name in LINE_SCHEMAS and name not in lines:
            known = ", ".join(key for key in LINE_SCHEMAS if key in lines) or "none"
            message = f"expected a line that devices of {driver} have, got {shown(name)}; they have: {known}"
            keys.problem((*path, name), message, at_key=True)


def _with_lines(drivers: Mapping[str, DriverRow]) -> Iterator[str]:
    for name in drivers:
        with suppress(ImportError):
            if drivers[name].lines:
                yield name


def _lines_of_device(device: DeviceConfig) -> Iterator[tuple[str, LineSettings]]:
    for name in LINE_SCHEMAS if device.lines is not None else ():
        settings = getattr(device.lines, name)
        if settings is not None:
            yield name, settings


def _same_line(one: LineSettings, other: LineSettings) -> bool:
    """Whether both are the same line, as far as names show: a line name without a chip is taken as on any chip."""
    chips = {one.chip.removeprefix("/dev/"), other.chip.removeprefix("/dev/")}
    return one.line == other.line and (len(chips) == 1 or "" in chips)


def _lines_of_driver(drivers: Mapping[str, DriverRow], driver: object) -> frozenset[str]:
    try:
        return drivers[driver].lines if isinstance(driver, str) and driver in drivers else frozenset({PULSE})
    except ImportError:
        return frozenset({PULSE})  # reported elsewhere, as is an unknown driver
