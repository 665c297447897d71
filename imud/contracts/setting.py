"""Contract of the settings that a device keeps itself: their names, types and units, how they are read, written, saved.

A driver has one table of them. From it come the keys of `settings:` in the configuration, `imud settings`, help, the
checks and docs/settings.md. A script here is what the driver's transport runs: a request script on a UART or CAN, a
transfer script on a polled bus. The second half is what imud says of them: declared, actual, planned and done.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from operator import eq
from typing import Any, cast

import msgspec

from imud.contracts.command import Risk, Target
from imud.model.options import Options


class OnDifference(StrEnum):
    """What imud does where the device's settings are not those that the configuration declares."""

    REPORT = "report"
    """Say so: an event, the status, a metric."""
    APPLY = "apply"
    """Set what comes into force at once; it holds until the device restarts, and is set again then."""
    APPLY_AND_SAVE = "apply_and_save"
    """Set everything, save it to the device's flash, and restart the device where that is needed."""


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
    saves: bool = False
    """Whether its script saves all settings to flash, and restarts the device, itself in order to follow it. It is
    written only where saving is wanted, counts as a write to flash, and needs no `save` after it."""
    readable: bool = True
    """Whether the device tells the value; what it does not tell is `written, not verified`."""
    agrees: Callable[[Any, Any], bool] = eq
    """`agrees(declared, actual)`: equality, or what takes its place where one has tolerances or leaves parts open."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingsTable:
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

    `values` are the declared ones on top of the present ones as far as these are known: of a configuration that is
    checked the declared ones alone. `target.baud` is 0 where it is not known."""

    @property
    def declarable(self) -> type[Options]:
        """The struct of a declaration: each setting that can be written, None for one that is not declared."""
        return _declarable(self)

    def __hash__(self) -> int:
        """Hash by identity: a table is made once per driver."""
        return id(self)


def declared_values(declared: Options | None) -> dict[str, Any]:
    """Return the values of an instance of `declarable` by name, without those that are not declared."""
    if declared is None:
        return {}
    return {name: value for name, value in msgspec.structs.asdict(declared).items() if value is not None}


@cache
def _declarable(settings: SettingsTable) -> type[Options]:
    fields = [(name, one.type | None, None) for name, one in settings.table.items() if one.write is not None]
    made = msgspec.defstruct(
        "Declared", fields, bases=(Options,), frozen=True, kw_only=True, forbid_unknown_fields=True
    )
    return cast(type[Options], made)


# --- what imud says of them -------------------------------------------------------------------------------------------


class SettingsState(StrEnum):
    """Result of the newest comparison of declared and actual settings."""

    UNDECLARED = "undeclared"
    """Nothing is declared for the device."""
    UNKNOWN = "unknown"
    """The device has not reported its settings since its link was opened."""
    AGREE = "agree"
    """All that can be read is as declared."""
    DIFFER = "differ"


class SettingDifference(msgspec.Struct, frozen=True):
    """One setting that is not as declared."""

    declared: Any
    actual: Any = None
    """Null where the device does not tell it."""


class SettingsStatus(msgspec.Struct, frozen=True):
    """How declared and actual settings of one device compare."""

    state: SettingsState
    on_difference: OnDifference
    problem: str = ""
    """Why the settings could not be read or set, one sentence; empty for none."""
    differences: dict[str, SettingDifference] = {}  # msgspec copies a mutable default
    unverified: tuple[str, ...] = ()
    """Declared settings that the device takes and does not tell."""
    read_ns: int | None = None
    """CLOCK_MONOTONIC when they were read last; null before."""
    repairs: int = 0
    """Times that imud has set them by itself since start, successful or not."""
    flash_writes: int = 0
    """Writes to the flash of this module by imud, also in earlier runs; by commands and by itself."""
    flash_writes_day: int = 0
    """Of these, those of the last 24 hours."""


class SettingInfo(msgspec.Struct, frozen=True):
    """One setting of a device: its description, and its values as far as they are known."""

    name: str
    values: str
    """The accepted values, for example `a whole number from 1 to 127`."""
    description: str
    unit: str
    section: str
    """Section of the vendor's manual."""
    effect: Effect
    connection: bool
    """Whether the device is reached in another way after a change."""
    readable: bool
    declarable: bool
    """Whether it can be set; others can only be read."""
    declared: Any = None
    actual: Any = None
    """Null where the device did not tell it."""
    differs: bool = False


class SettingsReport(msgspec.Struct, frozen=True):
    """All settings of a device."""

    device: str
    driver: str
    identity: dict[str, str]
    status: SettingsStatus
    settings: tuple[SettingInfo, ...]


class PlannedStep(msgspec.Struct, frozen=True):
    """One setting that is to be written."""

    name: str
    value: Any
    before: Any = None
    """Null where it is not known."""
    effect: Effect = Effect.AT_ONCE
    connection: bool = False
    saves: bool = False
    """Whether this step writes the flash itself and restarts the device."""


class SettingsPlan(msgspec.Struct, frozen=True):
    """What would be done to make a device as wanted, in this order: steps, save, restart, comparison."""

    steps: tuple[PlannedStep, ...] = ()
    save: bool = False
    restart: bool = False
    left_out: dict[str, str] = {}  # msgspec copies a mutable default
    """Options that differ and are not written, each with why not."""
    risk: Risk = Risk.NONE

    @property
    def empty(self) -> bool:
        """Whether there is nothing to do."""
        return not self.steps and not self.save


class StepOutcome(StrEnum):
    """What became of one step."""

    DONE = "done"
    """Written, and read back as wanted."""
    WRITTEN = "written, in force after a restart"
    NOT_VERIFIED = "written, not verified"
    """The device does not tell this setting."""
    FAILED = "failed"
    NOT_DONE = "not done"
    """A step before it failed."""


class AppliedStep(msgspec.Struct, frozen=True):
    """One step and what became of it."""

    name: str
    value: Any
    before: Any
    outcome: StepOutcome
    message: str = ""
    """Why it failed; empty otherwise."""


class AppliedSettings(msgspec.Struct, frozen=True):
    """What was done, and how the device is now."""

    steps: tuple[AppliedStep, ...] = ()
    saved: bool = False
    restarted: bool = False
    problem: str = ""
    """What went wrong, one sentence; empty when all that was planned is done."""
    left_out: dict[str, str] = {}  # msgspec copies a mutable default
    differences: dict[str, SettingDifference] = {}  # msgspec copies a mutable default
    """What is not as wanted now."""
    advice: str = ""
    """What to change in the configuration, so that imud finds the device at its next start; empty for nothing."""
