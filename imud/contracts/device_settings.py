"""Contract of the settings that a device keeps itself: their names, types and units, how they are read, written, saved.

A driver has one table of them. From it come the keys of `settings:` in the configuration, `imud settings`, help, the
checks and docs/settings.md. A script here is what the driver's transport runs: a request script on a UART or CAN, a
transfer script on a polled bus.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from operator import eq
from typing import Any, cast

import msgspec

from imud.contracts.action import Target
from imud.contracts.settings import Settings


class Effect(StrEnum):
    """Moments at which a written setting comes into force."""

    AT_ONCE = "at once"
    AFTER_RESTART = "after save and restart"


class Written(StrEnum):
    """Results of a script that writes a setting: how far it is known that the device has the value."""

    VERIFIED = "written and read back"
    UNVERIFIED = "written, not verified"
    """The device confirmed, and does not tell its value."""
    PENDING = "written and read back, in force after save and restart"
    UNVERIFIED_PENDING = "written, not verified; in force after save and restart"


def nothing_wrong(_target: Target, _values: Mapping[str, Any]) -> None:
    """Accept every combination of values: the version for devices without such rules."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One setting of a device."""

    type: Any
    """Type of a value, one that JSON can carry: `Annotated[…, Meta(description=…, extra={"unit": …, "section": …})]`.

    Bounds and choices are in it; `section` is that of the vendor's manual."""
    write: Callable[[Target, Any], Any] | None = None
    """`write(target, value)` makes the script that sets it. None for what can only be read and not be declared.

    The script raises CommandError, TransferError or DeviceRefused where the device does not take the value."""
    effect: Effect = Effect.AT_ONCE
    connection: bool = False
    """Whether the device is reached in another way afterwards (bit rate, address, node number): such a setting is
    written last. Its script follows the device, and goes back where the device is not heard afterwards: by
    `Request.baud` on a UART, `Request.settings` on a CAN bus, `Transfer.then_at` on RS-485 and I2C."""
    readable: bool = True
    """Whether the device tells the value; what it does not tell is `written, not verified`."""
    agrees: Callable[[Any, Any], bool] = eq
    """`agrees(declared, actual)`: equality, or what takes its place where one has tolerances or leaves parts open."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceSettings:
    """All settings of the devices of one driver. Steps of a plan have the order of the table."""

    table: Mapping[str, Setting]
    read: Callable[[Target], Any]
    """Makes the script that reads the present values, by name and in the types of the table.

    A setting that this device does not have or did not tell is left out. The device is left as it was."""
    save: Callable[[Target], Any] | None = None
    """Makes the script that writes all settings to flash; None where there is nothing to save."""
    restart: Callable[[Target], Any] | None = None
    """Makes the script that restarts the device and waits for it; None where that cannot be done."""
    check: Callable[[Target, Mapping[str, Any]], None] = nothing_wrong
    """Raises BadArgument for values that do not go together, for example more output than the bit rate carries.

    `values` are the declared ones on top of the present ones as far as these are known."""

    @property
    def declarable(self) -> type[Settings]:
        """The struct of a declaration: each setting that can be written, None for one that is not declared."""
        return _declarable(self)

    def __hash__(self) -> int:
        """Hash by identity: a table is made once per driver."""
        return id(self)


@cache
def _declarable(settings: DeviceSettings) -> type[Settings]:
    fields = [(name, one.type | None, None) for name, one in settings.table.items() if one.write is not None]
    made = msgspec.defstruct(
        "Declared", fields, bases=(Settings,), frozen=True, kw_only=True, forbid_unknown_fields=True
    )
    return cast(type[Settings], made)
