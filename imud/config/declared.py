"""Reading of `settings:` of a device: the values that the device's own settings should have, by its driver's table.

They are declared for a named driver only, whose table has their names and types. What the table refuses together, and
what contradicts the place where imud is configured to find the device, is refused here, before any port is opened.
"""

from collections.abc import Mapping
from typing import Any

from imud.config.keys import Keys
from imud.config.schema import DriverRow
from imud.config.yaml_tree import Path as KeyPath
from imud.contracts.action import Target
from imud.contracts.device_settings import DeviceSettings, declared_values
from imud.contracts.lines import DeviceLines
from imud.contracts.settings import Settings, shown
from imud.errors import BadArgument


class DeclaredReader:
    """Reader of the declared settings of devices. `drivers` is the table of drivers."""

    def __init__(self, keys: Keys, drivers: Mapping[str, DriverRow]) -> None:
        self._keys = keys
        self._drivers = drivers

    def read(self, path: KeyPath, device: Mapping[str, Any]) -> Settings | None:
        """Read `settings` among the keys of a device; None where there are none, or a problem is with them."""
        key = (*path, "settings")
        if device.get("settings") is None:
            return None
        driver = device.get("driver", "auto")
        if driver == "auto":
            message = f"expected settings only beside a named driver, got them with driver auto; {self._known()}"
            self._keys.problem(key, message, at_key=True)
            return None
        if not isinstance(driver, str) or driver not in self._drivers:
            return None  # reported with the driver
        table = self._table(driver)
        if table is None:
            message = f"expected settings only of a driver that knows those of its device, got them with {driver}; "
            self._keys.problem(key, message + self._known(), at_key=True)
            return None
        if device.get("identify") is False:
            message = "expected identify: true, without which imud does not read settings, got false"
            self._keys.problem(key, message, at_key=True)
            return None
        return self._keys.part(table.declarable, device["settings"], key)

    def check(self, path: KeyPath, driver: str, declared: Settings, options: Settings | None, link: Settings) -> None:
        """Refuse settings that do not go together, or with the place where the device is to be found."""
        table = self._table(driver)
        if table is None:
            return
        key, values = (*path, "settings"), declared_values(declared)
        for name, value in values.items():
            place = _fixed(name, options, link) if table.table[name].connection else None
            if place not in (None, value):
                message = f"expected {shown(place)}, where imud is configured to find the device, got {shown(value)}; "
                hint = f"`imud command {path[-1]} {name} …` changes it, or let imud search for it where it can (auto)"
                self._keys.problem((*key, name), message + hint)
        baud = getattr(link, "baud", 0)
        try:
            table.check(Target(options, baud if isinstance(baud, int) else 0), values)
        except BadArgument as error:
            self._keys.problem(key, str(error))

    def check_lines(self, path: KeyPath, driver: str, declared: Settings, lines: DeviceLines) -> None:
        """Refuse lines that do nothing with the settings that are declared."""
        if self._table(driver) is not None:
            found = self._drivers[driver].declared_line_differences(declared_values(declared), lines)
            for key, words in found.items():
                self._keys.problem((*path, "lines", key), f"with the settings declared here {words}", at_key=True)

    def _table(self, driver: str) -> DeviceSettings | None:
        try:
            return self._drivers[driver].device_settings
        except ImportError:  # reported with the driver
            return None

    def _known(self) -> str:
        names = [name for name in self._drivers if self._table(name) is not None]
        return f"drivers with settings: {', '.join(names) or 'none'}"


def _fixed(name: str, options: Settings | None, link: Settings) -> object:
    """The value with which the configuration finds the device; None where it searches, or has no such key."""
    for part in (link, options):
        value = getattr(part, name, None)
        if value is not None and value != "auto":
            return value
    return None
