"""Contract of device settings: names, types and units, how imud reads, writes and saves them, and the reports about
them.

Each driver has one table of settings. The table defines the keys of `settings:` in the configuration, `imud settings`,
help texts, checks and docs/settings.md. The transport of the driver runs the scripts: request scripts on UART and CAN,
transfer scripts on a polled bus. The second half of this module describes declared, actual, planned and applied
settings.
"""

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from operator import attrgetter, eq
from typing import Any, Final, cast

import msgspec

from imud.contracts.command import Risk, Target
from imud.model.options import Options, shown


class OnDifference(StrEnum):
    """Reaction of imud if the device settings differ from the declared settings."""

    REPORT = "report"  # report the difference: event, status and metric
    # Write the settings that take effect immediately. imud writes them again after each restart of the device.
    APPLY = "apply"
    # Write all settings and save them to the flash of the device. Restart the device if necessary.
    APPLY_AND_SAVE = "apply_and_save"


class Effect(StrEnum):
    """Time at which a written setting takes effect."""

    IMMEDIATELY = "immediately"
    AFTER_RESTART = "after save and restart"


class Written(StrEnum):
    """Result of a script that writes a setting: how certain the new value is."""

    VERIFIED = "written and read back"
    UNVERIFIED = "written, not verified"  # the device confirmed the write and cannot report the value
    PENDING = "written and read back, in force after save and restart"
    UNVERIFIED_PENDING = "written, not verified; in force after save and restart"


@dataclass(frozen=True, slots=True)
class DeviceReport:
    """Settings in one reply of the device."""

    words: Mapping[str, str] = field(default_factory=dict)  # text by the names that the device uses
    # Values by the names and in the types of the table, without values that the table does not know
    values: Mapping[str, Any] = field(default_factory=dict)


Reports = Mapping[str, DeviceReport]  # reports of a device by name, without reports that the device does not send


def combined(reports: Reports) -> DeviceReport:
    """Return the settings of all reports as one report."""
    words: dict[str, str] = {}
    values: dict[str, Any] = {}
    for report in reports.values():
        words |= report.words
        values |= report.values
    return DeviceReport(words, values)


def nothing_wrong(_target: Target, _values: Mapping[str, Any]) -> None:
    """Accept every combination of values. Default of devices without such rules."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One setting of a device."""

    type: Any
    """Type of a value that JSON can represent: `Annotated[…, Meta(description=…, extra={"unit": …, "section": …})]`.

    The type contains bounds and choices. `section` is the section of the vendor's manual."""
    write: Callable[[Target, Any], Any] | None = None
    """`write(target, value)` returns the script that writes the setting. None: read-only, cannot be declared.

    The script raises CommandError, TransferError or DeviceRefused if the device rejects the value."""
    effect: Effect = Effect.IMMEDIATELY
    # Whether the change affects how imud reaches the device (baud rate, address, node number). imud writes such a
    # setting last. Its script follows the device and returns to the former connection if the device does not reply: by
    # `Request.baud` on UART, `Request.settings` on CAN, `Transfer.then_at` on RS-485 and I2C.
    connection: bool = False
    # Whether the script itself saves all settings to flash and restarts the device. imud runs it only if saving is
    # requested, counts one write to flash, and runs no `save` after it.
    saves: bool = False
    readable: bool = True  # Whether the device reports the value. Otherwise the result is `sent, not verified`.
    # Name of the report that contains the value. imud reads this report again after a write. Empty: the only report.
    report: str = ""
    # Whether it is the bit rate of a bus that other devices use too. A declared value must be the present rate of the
    # bus. A user can set another rate by name: imud saves it and does not restart the device.
    bus_rate: bool = False
    note: str = ""  # next step of the user after a change, one sentence; part of the plan and of the reply
    # `agrees(declared, actual)` compares two values: equality, or a comparison with tolerances or optional parts
    agrees: Callable[[Any, Any], bool] = eq


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingsTable:
    """All settings of the devices of one driver. The steps of a plan have the order of the table."""

    table: Mapping[str, Setting]
    read: Callable[[Target, Collection[str] | None], Any]
    """`read(target, names)` returns the script that reads the reports with these names, None: all reports.

    Its result has the type `Reports`. The script changes nothing."""
    # Returns the script that writes all settings to flash; None if the device has no flash for settings
    save: Callable[[Target], Any] | None = None
    # Whether flash contains the settings after a confirmed save. False: some firmware confirms it without an effect
    save_is_certain: bool = True
    # Returns the script that restarts the device and waits for it; None if imud cannot restart the device
    restart: Callable[[Target], Any] | None = None
    check: Callable[[Target, Mapping[str, Any]], None] = nothing_wrong
    """Raises BadArgument for values that exclude each other, for example more output than the baud rate can carry.

    `values` contains the declared values and, for all other settings, the known present values. `imud check` passes
    only the declared values. `target.baud` is 0 if the baud rate is not known."""

    @property
    def declarable(self) -> type[Options]:
        """Struct type of a declaration: one field per writable setting, None if it is not declared."""
        return _declarable(self)

    def __hash__(self) -> int:
        # by identity: each driver has one table
        return id(self)


def declared_values(declared: Options | None) -> dict[str, Any]:
    """Return the declared values by name from an instance of `declarable`."""
    if declared is None:
        return {}
    return {name: value for name, value in msgspec.structs.asdict(declared).items() if value is not None}


@cache
def _declarable(settings: SettingsTable) -> type[Options]:
    fields = [(name, one.type | None, None) for name, one in settings.table.items() if one.write is not None]
    return cast(type[Options], msgspec.defstruct("Declared", fields, bases=(Options,)))


# --- reports about settings --------------------------------------------------------------------------------------


class SettingsState(StrEnum):
    """Result of the newest comparison of declared and actual settings."""

    UNDECLARED = "undeclared"  # the configuration declares no settings for the device
    UNKNOWN = "unknown"  # imud has not read the device settings since the link was opened
    AGREE = "agree"  # all readable settings have the declared values
    DIFFER = "differ"


class SettingDifference(msgspec.Struct, frozen=True):
    """One setting with another value than declared."""

    declared: Any
    actual: Any = None  # null if the device does not report the setting


class SettingsStatus(msgspec.Struct, frozen=True):
    """Comparison of declared and actual settings of one device."""

    state: SettingsState
    on_difference: OnDifference
    # Reason why imud could not read or write the settings, one sentence; empty if there is no problem
    problem: str = ""
    differences: dict[str, SettingDifference] = {}  # msgspec copies a mutable default
    unverified: tuple[str, ...] = ()  # declared settings that the device accepts and does not report
    read_ns: int | None = None  # CLOCK_MONOTONIC of the newest read; null before the first read
    repairs: int = 0  # number of automatic attempts of imud to write the declared settings since start
    flash_writes: int = 0  # number of writes to the flash of this device by imud in all runs, automatic or by command
    flash_writes_day: int = 0  # number of these writes in the last 24 hours
    unsaved: bool = False  # whether imud changed a setting, and no save followed
    # Present value of each changed setting, except if flash contains the value
    lost_at_power_off: dict[str, Any] = {}  # msgspec copies a mutable default
    # Names in `lost_at_power_off` whose value in flash is unknown: the device may lose the present value
    flash_unknown: tuple[str, ...] = ()


_UNIT = re.compile(r"_(hz|ms|deg_s|deg)$")
_SHORT_NAME = re.compile(r"sout|sin|ff[0-9a-f]{2}|\w*\d\w*")


def title_of(name: str) -> str:
    """Return the title of a setting for people, for example `TPDO1 interval` for `tpdo1_interval_ms`."""
    words = _UNIT.sub("", name).split("_")
    title = " ".join(word.upper() if _SHORT_NAME.fullmatch(word) else word for word in words)
    return title[:1].upper() + title[1:]


def value_text(value: Any) -> str:
    """Return the value of a setting for people, without quotes and brackets."""
    if isinstance(value, dict):
        value = [f"{name} {value_text(part)}" for name, part in value.items()]
    if isinstance(value, list):
        return ", ".join(map(value_text, value))
    return value if isinstance(value, str) else shown(value)


def group_of(name: str, setting: Setting) -> str:
    """Return the group of a setting in a form: `connection`, `output`, `pins` or `measurement`."""
    if setting.connection or name in ("heartbeat_ms", "second_bus", "i2c_address", "port_baud"):
        return "connection"
    if name.startswith(("output", "port_output", "tpdo", "ff", "burst")):
        return "output"
    return "pins" if name in ("pins", "sout_divisor", "alarm") else "measurement"


@cache
def schemas_of(table: SettingsTable) -> Mapping[str, dict[str, Any]]:
    """Return the JSON Schema of the values of each setting."""
    return {name: msgspec.json.schema(setting.type) for name, setting in table.table.items()}


class SavedState(StrEnum):
    """Comparison of the present value of a setting with the flash of the device."""

    SAME = "same"
    DIFFERS = "differs"  # the device loses the present value at power-off
    UNKNOWN = "unknown"  # imud has not observed a start of the device, and has not saved its settings


class SettingInfo(msgspec.Struct, frozen=True):
    """Description and known values of one setting."""

    name: str
    values: str  # accepted values, for example `a whole number from 1 to 127`
    description: str
    unit: str
    section: str  # section of the vendor's manual
    effect: Effect
    connection: bool  # whether the change affects how imud reaches the device
    readable: bool
    declarable: bool  # whether the setting is writable
    declared: Any = None
    actual: Any = None  # null if the device did not report the setting
    differs: bool = False
    title: str = ""
    help: str = ""  # first sentence of `description`
    group: str = ""  # `connection`, `output`, `pins` or `measurement`
    schema: dict[str, Any] = {}  # JSON Schema of the value
    saved: Any = None  # value in flash; null if it is not known
    saved_state: SavedState = SavedState.UNKNOWN


class SettingsReport(msgspec.Struct, frozen=True):
    """All settings of a device."""

    device: str
    driver: str
    identity: dict[str, str]
    status: SettingsStatus
    settings: tuple[SettingInfo, ...]


class PlannedStep(msgspec.Struct, frozen=True):
    """One setting that imud will write."""

    name: str
    value: Any
    before: Any = None  # null if the present value is not known
    effect: Effect = Effect.IMMEDIATELY
    connection: bool = False
    saves: bool = False  # whether this step writes the flash and restarts the device


class SettingsPlan(msgspec.Struct, frozen=True):
    """Steps that change the settings of a device, in this order: steps, save, restart, comparison."""

    steps: tuple[PlannedStep, ...] = ()
    save: bool = False
    restart: bool = False
    # Reason for each setting that differs and that imud will not write, by name
    left_out: dict[str, str] = {}  # msgspec copies a mutable default
    risk: Risk = Risk.NONE
    advice: str = ""  # next step of the user after the plan; empty if no step is necessary

    @property
    def empty(self) -> bool:
        """Whether no step is necessary."""
        return not self.steps and not self.save


class StepOutcome(StrEnum):
    """Result of one step."""

    VERIFIED = "verified"  # the device reports the wanted value after the write
    WRITTEN = "written, in force after a restart"
    NOT_VERIFIED = "sent, not verified"  # the device does not report this setting
    NOT_APPLIED = "not applied"  # the device rejected the value or reports another value
    NOT_DONE = "not done"  # a previous step failed


class AppliedStep(msgspec.Struct, frozen=True):
    """One step and its result."""

    name: str
    value: Any
    before: Any
    outcome: StepOutcome
    message: str = ""  # reason if the setting is not applied or not verified; empty otherwise


SAVE_SENT: Final = "save to flash: sent, not verified: imud cannot read the flash"


class AppliedSettings(msgspec.Struct, frozen=True):
    """Applied steps, and remaining differences."""

    steps: tuple[AppliedStep, ...] = ()
    saved: bool = False
    restarted: bool = False  # whether a restart is verified
    problem: str = ""  # reason of a failure, one sentence; empty if imud did all planned steps
    left_out: dict[str, str] = {}  # msgspec copies a mutable default
    # Remaining differences from the wanted values
    differences: dict[str, SettingDifference] = {}  # msgspec copies a mutable default
    # Next step of the user, for example a change of the configuration, so that imud finds the device at its next start;
    # empty if no step is necessary
    advice: str = ""
    not_saved: str = ""  # that the flash lacks a change, and the next step; empty if the flash contains all settings
    restart_doubt: str = ""  # reason why the restart is not verified; empty otherwise

    @property
    def ends(self) -> list[str]:
        """Results of the save and the restart. A value that the device reports after a restart verifies a save, because
        imud cannot read the flash."""
        outcomes = set(map(attrgetter("outcome"), self.steps))
        is_verified = StepOutcome.VERIFIED in outcomes and StepOutcome.NOT_APPLIED not in outcomes
        save = "saved to flash"
        if not (self.restarted and is_verified):
            save = SAVE_SENT
        doubt = [f"restart: sent, not verified: {self.restart_doubt}"] if self.restart_doubt else []
        return [save] * self.saved + ["restarted"] * self.restarted + doubt

    @property
    def failure(self) -> str:
        """Reason why the device lacks a wanted value; empty if it has all wanted values."""
        left_out = [f"{name} {why}" for name, why in self.left_out.items()]
        others = [f"{name}: expected {one.declared}, got {one.actual}" for name, one in self.differences.items()]
        return "; ".join([self.problem] if self.problem else [*left_out, *others])
