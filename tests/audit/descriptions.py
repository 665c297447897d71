"""Sections of the manuals as the drivers' own descriptions name them: actions, settings, calibrations."""

import re
from collections.abc import Iterator
from typing import Any, Final

import msgspec

from imud.contracts.driver import Driver
from imud.drivers import DRIVERS

MANUALS: Final = {"imu61x": "A", "hipnuc": "B"}
"""Letter of the manual by the first word of a driver's name."""
_SECTION: Final = re.compile(r"^(\d+(?:\.\d+)*)")


def described() -> dict[str, list[str]]:
    """Return the descriptions of the drivers by section, for example `B 2.2.4: hipnuc-uart: action mode (axes)`."""
    found: dict[str, list[str]] = {}
    for driver in DRIVERS.values():
        letter = MANUALS[driver.name.partition("-")[0]]
        for section, words in _of(driver):
            if match := _SECTION.match(section):
                found.setdefault(f"{letter} {match[1]}", []).append(f"{driver.name}: {words}")
    return found


def _of(driver: Driver) -> Iterator[tuple[str, str]]:
    for name, action in driver.verbs.items():
        for field in msgspec.structs.fields(action.parameters):
            if section := _section(field.type):
                yield section, f"action {name} ({field.name})"
    for kind, calibration in driver.calibrations.items():
        yield calibration.section, f"calibration {kind}"
    if driver.device_settings is not None:
        for name, setting in driver.device_settings.table.items():
            yield _section(setting.type), f"setting {name}"


def _section(annotated: Any) -> str:
    info = msgspec.inspect.type_info(annotated)
    extra = info.extra if isinstance(info, msgspec.inspect.Metadata) else None
    return str((extra or {}).get("section", ""))
