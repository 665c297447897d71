"""Plan and execution of a change of device settings.

imud writes settings in the order of the driver's table, reads back the reports that contain them, and then saves. The
settings that change the connection (baud rate, address) are last; imud checks each of them by itself. Without a save,
imud leaves out the settings that need a restart, because the restart loses unsaved values.
"""

import re
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from shlex import quote
from typing import Annotated, Any, Final, get_args, get_origin

import msgspec

from imud.config.model import DeviceConfig
from imud.contracts.command import Risk, Target
from imud.contracts.driver import Driver
from imud.contracts.setting import (
    AppliedSettings,
    Effect,
    PlannedStep,
    SettingDifference,
    SettingInfo,
    SettingsPlan,
    SettingsTable,
    StepOutcome,
    Written,
    group_of,
    schemas_of,
    title_of,
)
from imud.device.attachments import Attachments
from imud.device.evidence import SampleSource, SampleWatch
from imud.device.flash import FlashValues
from imud.host.log import printable
from imud.model.errors import (
    BadArgument,
    CommandError,
    DeviceRefused,
    IsSetting,
    LinkError,
    TransferError,
)
from imud.model.options import expected, json_or_text, shown, unknown_name, value_problem

Values = Mapping[str, Any]  # values of settings by name, in the types of the table
as_json: Final = msgspec.to_builtins  # returns the JSON value of a setting


def has(table: SettingsTable, name: str, wanted: Values, actual: Values, unreadable: Values) -> bool:
    """Return whether the device has the wanted value. `unreadable` contains written values that it does not report."""
    setting = table.table[name]
    known = actual if name in actual else unreadable
    return name in known and setting.agrees(wanted[name], known[name])


def differences(
    table: SettingsTable, wanted: Values, actual: Values, unreadable: Values
) -> dict[str, SettingDifference]:
    """Return the readable settings that differ from `wanted`, in the order of the table.

    `unreadable` contains written values. They count for settings that the device does not report.
    """
    return {
        name: SettingDifference(as_json(wanted[name]), as_json(actual.get(name)))
        for name, setting in table.table.items()
        if name in wanted and setting.readable and not has(table, name, wanted, actual, unreadable)
    }


def words(found: Mapping[str, SettingDifference]) -> str:
    """Describe differences, for example `mode is "9-axis", declared "6-axis"`."""
    return ", ".join(
        f"{name} is {'not reported' if one.actual is None else shown(one.actual)}, declared {shown(one.declared)}"
        for name, one in found.items()
    )


def wanted_values(table: SettingsTable, given: Mapping[str, Any]) -> dict[str, Any]:
    """Convert values of JSON or YAML to the types of the table, in its order.

    A name with dots selects a part of a setting, for example `output.hi91`. Then the value is a `Parts` object, which
    `completed` converts. Raises BadArgument if a setting is unknown or read-only, or if a value is invalid.
    """
    parts: dict[str, dict[Path, Any]] = {}
    for given_name, value in given.items():
        name, *path = given_name.split(".")
        setting = table.table.get(name)
        if setting is None or setting.write is None:
            settable = [name for name, setting in table.table.items() if setting.write is not None]
            only_read = f"{name}: it is read-only" if setting is not None else ""
            raise BadArgument(only_read or unknown_name("a setting", name, settable))
        if path and (problem := value_problem(value, _part_type(name, setting.type, path))):
            raise BadArgument(f"{given_name}: {problem}")
        mine = tuple(path)
        for other in parts.setdefault(name, {}):  # a part and its whole, or another part of the part
            if other[: len(mine)] == mine or mine[: len(other)] == other:
                both = " and ".join(".".join((name, *one)) for one in (other, mine))
                raise BadArgument(f"{name}: expected one value for each part, got {both}")
        parts[name][mine] = value
    wanted: dict[str, Any] = {}
    for name in filter(parts.__contains__, table.table):
        values, value_type = parts[name], table.table[name].type
        if () not in values:
            wanted[name] = Parts(values)
            continue
        try:
            wanted[name] = msgspec.convert(values[()], value_type)
        except msgspec.ValidationError:
            got = shown(values[()])[:60]
            raise BadArgument(f"{name}: expected {expected(value_type)}, got {got}") from None
    return wanted


def settable_values(table: SettingsTable, actual: Values) -> dict[str, Any]:
    """Return the values that can be set again as JSON values, without values that imud does not know."""
    values = {name: as_json(actual[name]) for name, one in table.table.items() if one.write and name in actual}
    return {name: value for name, value in values.items() if not value_problem(value, table.table[name].type)}


Path = tuple[str, ...]  # names of the parts that select a value in a setting, from the outside to the inside


@dataclass(frozen=True, slots=True)
class Parts:
    """Values of some parts of a setting, by path, for example `{("x", "min_deg"): -10}` for `alarm`."""

    values: Mapping[Path, Any]


def completed(table: SettingsTable, wanted: Values, actual: Values) -> dict[str, Any]:
    """Replace `Parts` by values of the table's type. The other parts of the same entry keep their actual values.

    Raises BadArgument if an entry lacks a part that the device does not report.
    """
    values = dict(wanted)
    for name, value in wanted.items():
        if isinstance(value, Parts):
            values[name] = _joined(name, value, actual.get(name), table.table[name].type)
    return values


def _joined(name: str, parts: Parts, actual: Any, value_type: Any) -> Any:
    present = as_json(actual) if isinstance(actual, Mapping) else {}
    tree: dict[str, Any] = {}
    for (first, *path), value in parts.values.items():
        if not path:
            tree[first] = value
            continue
        node = tree.setdefault(first, dict(present.get(first) or {}))
        for key in path[:-1]:
            node = node.setdefault(key, {})
        node[path[-1]] = value
    if problem := value_problem(tree, value_type):
        raise BadArgument(f"{name}: {problem}; the device does not report the missing parts: set them too")
    return msgspec.convert(tree, value_type)


def _part_type(name: str, value_type: Any, path: Sequence[str]) -> Any:
    """Return the type of a part of a setting. Raises BadArgument if the setting has no such part."""
    for key in path:
        if get_origin(value_type) is Annotated:
            value_type = get_args(value_type)[0]
        if get_origin(value_type) is dict:
            keys, item = get_args(value_type)
            types = dict.fromkeys(get_args(keys), item)
        elif isinstance(value_type, type) and issubclass(value_type, msgspec.Struct):
            types = {field.encode_name: field.type for field in msgspec.structs.fields(value_type)}
        else:
            raise BadArgument(f"{name}: expected a setting without parts, got {shown('.'.join((name, key)))}")
        if key not in types:
            raise BadArgument(unknown_name(f"a part of {name}", key, list(types)))
        name, value_type = f"{name}.{key}", types[key]
    return value_type


def described_settings(
    table: SettingsTable, declared: Values, actual: Values | None, in_flash: FlashValues | None = None
) -> tuple[SettingInfo, ...]:
    """Describe all settings of a table. `actual` is None if imud has not read them."""
    found = differences(table, declared, actual, {}) if actual is not None else {}
    schemas = schemas_of(table)
    meanings = {name: description_of(setting.type) for name, setting in table.table.items()}
    flash = in_flash or FlashValues()
    saved = {name: flash.state(name, (actual or {}).get(name)) for name in table.table}
    return tuple(
        SettingInfo(
            name,
            *meanings[name],
            setting.effect,
            setting.connection,
            setting.readable,
            setting.write is not None,
            as_json(declared.get(name)),
            as_json((actual or {}).get(name)),
            name in found,
            title_of(name),
            first_sentence(meanings[name][1]),
            group_of(name, setting),
            schemas[name],
            as_json(saved[name][1]),
            saved[name][0],
        )
        for name, setting in table.table.items()
    )


def first_sentence(text: str) -> str:
    """Return the first sentence of a description."""
    return re.split(r"[.;] ", text, maxsplit=1)[0]


def description_of(value_type: Any) -> tuple[str, str, str, str]:
    """Return accepted values, description, unit and manual section of a setting, from its type."""
    info = msgspec.inspect.type_info(value_type)
    schema: Mapping[str, Any] = {}
    extra: Mapping[str, Any] = {}
    if isinstance(info, msgspec.inspect.Metadata):
        schema, extra = info.extra_json_schema or {}, info.extra or {}
    meaning, unit, section = schema.get("description", ""), extra.get("unit", ""), extra.get("section", "")
    return expected(value_type), str(meaning), str(unit), str(section)


_ARGUMENT: Final = re.compile(r"\{(\w+)(?:\|(\w+))?\}")  # argument of a removed command, with its default
SHOWN_MAX: Final = 400  # maximum length of the arguments in an error message, characters
TEXT_MAX: Final = 1000  # maximum length of the command in an error message, with escapes, characters
SAVE: Final = "--save"


def setting_instead(device: str, name: str, driver: Driver | None, given: Mapping[str, Any]) -> IsSetting | None:
    """Return the error for a command that a setting replaces, with the new command; None for another name.

    `given` contains the arguments of the call. Without them, the new command contains their names.
    """
    table = driver.device_settings if driver is not None else None
    if driver is None or table is None:
        return None
    template = driver.renamed.get(name)
    if template is None:
        setting = table.table.get(name)
        if setting is None or setting.write is None:
            return None
        needs_save = setting.saves or setting.effect is Effect.AFTER_RESTART
        template = f"{name}={{{name}}}" + f" {SAVE}" * needs_save
    assignments = [word for word in template.split() if word != SAVE]
    save = SAVE in template.split()
    values = dict(one for word in assignments if (one := _assignment(word, given)) is not None)
    texts = [f"{key}={value if isinstance(value, str) else shown(value)}" for key, value in values.items()]
    if not texts or len(" ".join(texts)) > SHOWN_MAX:
        values, texts = {}, [_ARGUMENT.sub(lambda found: found[1].upper(), word) for word in assignments]
    command = [f"imud settings {device}", *(["--set", *map(quote, texts)] if texts else []), *[SAVE] * save]
    words = "is a setting" if assignments else "is not a command any more"
    return IsSetting(f"{name} {words}: {printable(' '.join(command), TEXT_MAX)}", values, save=save)


def _assignment(word: str, given: Mapping[str, Any]) -> tuple[str, Any] | None:
    """Return name and value of a setting from `NAME=VALUE` with arguments; None if an argument is missing."""
    arguments = {name: default or None for name, default in _ARGUMENT.findall(word)} | dict(given)
    if any(arguments[name] is None for name, _ in _ARGUMENT.findall(word)):
        return None
    key, _, value = word.partition("=")
    key = _ARGUMENT.sub(lambda found: str(arguments[found[1]]).lower(), key)
    if (whole := _ARGUMENT.fullmatch(value)) and whole[1] in given:
        return key, given[whole[1]]
    return key, json_or_text(_ARGUMENT.sub(lambda found: str(arguments[found[1]]), value))


NEEDS_SAVE: Final = "needs a save and a restart, and no save was requested"
SAVES_ITSELF: Final = "saves to flash and restarts the device, and no save was requested"
CANNOT_SAVE: Final = "needs a save and a restart, and this driver cannot save"


def make_plan(
    table: SettingsTable,
    target: Target,
    wanted: Values,
    actual: Values,
    unreadable: Values,
    *,
    save: bool,
    unsaved: bool,
    by_name: bool = False,
) -> SettingsPlan:
    """Return the plan that changes the settings of a device from `actual` to `wanted`.

    `unreadable` contains written values of settings that the device does not report. `unsaved` means that flash does
    not contain the last write. `by_name` means that a user has named the settings, not the configuration. Raises
    BadArgument if the values contradict each other.
    """
    if by_name:  # write again: a command or another program may have changed a value that imud cannot read
        unreadable = {}
    left_out: dict[str, str] = {}
    written: dict[str, Any] = {}
    rate = ""
    for name, setting in table.table.items():
        if name in wanted and not has(table, name, wanted, actual, unreadable):
            needs_save = setting.saves or setting.effect is Effect.AFTER_RESTART
            if needs_save and not save:
                left_out[name] = SAVES_ITSELF if setting.saves else NEEDS_SAVE
            elif needs_save and not setting.saves and table.save is None:
                left_out[name] = CANNOT_SAVE
            else:
                written[name] = wanted[name]
        if setting.bus_rate and (name in actual or name in written):
            rate = name
    new_rate: Any = written.get(rate, actual.get(rate))
    is_moved = by_name and rate in written  # the user moves the whole bus to another rate
    if written:
        _require_agreement(table, replace(target, baud=new_rate) if is_moved else target, actual, written)
    # at another rate than the bus, a device is lost after its restart and disturbs the bus
    is_other_rate = bool(rate) and new_rate != target.baud and (is_moved or target.baud != 0)
    steps, notes = [], []
    for name in written:
        setting, before = table.table[name], as_json(actual.get(name))
        value = as_json(wanted[name])
        steps.append(PlannedStep(name, value, before, setting.effect, setting.connection, setting.saves))
        if setting.note and (name != rate or is_other_rate):
            notes.append(f"{name}: {setting.note}")
    steps.sort(key=attrgetter("connection", "saves"))
    by_itself = any(map(attrgetter("saves"), steps))
    needs_restart = Effect.AFTER_RESTART in map(attrgetter("effect"), steps)
    return SettingsPlan(
        tuple(steps),
        save=save and table.save is not None and (bool(steps) or unsaved) and not by_itself,
        restart=needs_restart and not (by_itself or is_other_rate) and table.restart is not None,
        left_out=left_out,
        risk=Risk.CONNECTION if any(map(attrgetter("connection"), steps)) else Risk.NONE,
        advice="; ".join(notes),
    )


def _require_agreement(table: SettingsTable, target: Target, actual: Values, written: Values) -> None:
    """Raise BadArgument if the values after the change contradict each other.

    In a setting with several keys, `written` replaces only its own keys. imud accepts a contradiction that the device
    already has, because the user changes another setting.
    """
    values = dict(actual)
    for name, value in written.items():
        present = values.get(name)
        both = isinstance(value, Mapping) and isinstance(present, Mapping)
        values[name] = {**present, **value} if both else value  # type: ignore[dict-item]  # both are mappings
    try:
        table.check(target, values)
    except BadArgument as error:
        try:
            table.check(target, actual)
        except BadArgument as before:
            if str(before) == str(error):
                return
        raise


DEVICE_ERRORS: Final = (CommandError, DeviceRefused, LinkError, TransferError)
"""Errors of a device that does not reply, rejects a value, or is missing."""

PLACES: Final = ("baud", "address", "node")  # settings that the link or the options repeat to find the device
PENDING: Final = (Written.PENDING, Written.UNVERIFIED_PENDING)
NOT_REPORTED: Final = "the device does not report this setting"


class SettingsPort(SampleSource):
    """Transport of a device, as its settings use it. `imud.device.transport` imports this module."""

    attachments: Attachments
    samples: SampleWatch
    target: Target  # target of the newest script; set by `run_script`

    @property
    @abstractmethod
    def where(self) -> str:
        """Name of the link with its rate or address."""

    @property
    @abstractmethod
    def can_be_asked(self) -> bool:
        """Whether imud can run a script on the device now."""

    @abstractmethod
    def require_replies(self) -> None:
        """Raise CommandError if the device cannot reply to a command now."""

    @property
    def may_ask(self) -> bool:
        """Whether the configuration allows requests that no user made."""
        return True

    @abstractmethod
    async def run_script(self, make: Callable[..., Any], *arguments: Any) -> Any:
        """Run the script that `make(target, *arguments)` returns, and return its result.

        Raises LinkError and the errors of the script and of `make`: CommandError, TransferError, DeviceRefused.
        """

    def use_axes(self, settings: Mapping[str, str]) -> None:  # most devices have fixed axes
        """Publish samples in the axes that the readable settings select."""

    async def read_identity(self) -> None:  # a polled device is identified before imud reads its samples
        """Query the identity again after a restart. Raises as `run_script`."""


def advice(config: DeviceConfig, plan: SettingsPlan, done: AppliedSettings) -> str:
    """Return the next step of the user, for example a change of the configuration; empty if none."""
    found: list[str] = []
    for step in done.steps:
        if step.outcome not in (StepOutcome.VERIFIED, StepOutcome.WRITTEN):
            continue
        for key, part in ((config.link, config.link_settings), ("options", config.options)):
            place = getattr(part, step.name, None)
            if place not in (None, "auto", step.value) and type(place) is type(step.value) and step.name in PLACES:
                found.append(f"change `{key}.{step.name}: {place}` in the configuration to {step.value}")
    changes = "; ".join(found) + (": imud uses this value at its next start" if found else "")
    return "; ".join(filter(None, (changes, "" if done.problem else plan.advice)))
