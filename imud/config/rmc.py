"""Reads where the RMC sentences come from that a device is fed over its own serial port."""

from collections.abc import Mapping
from typing import Any, Final

from imud.config.keys import Keys
from imud.config.tables import DriverRow
from imud.config.yaml_tree import Path as KeyPath
from imud.contracts.expected import shown
from imud.utc.source import RmcSettings

LINK: Final = "uart"
PULSE: Final = "pps"
"""What has this line takes its time from a pulse per second and from sentences."""
TRIGGER: Final = "sin"
"""The line by which imud drives the input that the pulse would come on."""


def read_rmc(
    keys: Keys, path: KeyPath, device: Mapping[str, Any], drivers: Mapping[str, DriverRow]
) -> RmcSettings | None:
    """The settings below the key `rmc` of a device; None where it has none."""
    if "rmc" not in device:
        return None
    driver = device.get("driver", "auto")
    if LINK not in device or (driver != "auto" and PULSE not in _lines(drivers, driver)):
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


def _lines(drivers: Mapping[str, DriverRow], driver: object) -> frozenset[str]:
    try:
        return drivers[driver].lines if isinstance(driver, str) and driver in drivers else frozenset({PULSE})
    except ImportError:
        return frozenset({PULSE})  # it is a problem of its own, as is a driver that is none
