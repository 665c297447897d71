"""Comparison of the settings that a device should have with those that it has, and descriptions of both for people.

Values are compared in the types of the driver's table, and described as JSON values.
"""

from collections.abc import Mapping
from typing import Any

import msgspec

from imud.contracts.device_settings import DeviceSettings, SettingDifference, SettingInfo
from imud.contracts.settings import expected, shown, unknown_name
from imud.errors import BadArgument

Values = Mapping[str, Any]
"""Values of settings by name, in the types of the driver's table."""


def has(table: DeviceSettings, name: str, wanted: Values, actual: Values, unreadable: Values) -> bool:
    """Whether a device has a wanted value: as it reports, or as was written to it where it does not."""
    setting = table.table[name]
    known = actual if name in actual else unreadable
    return name in known and setting.agrees(wanted[name], known[name])


def differences(
    table: DeviceSettings, wanted: Values, actual: Values, unreadable: Values
) -> dict[str, SettingDifference]:
    """List the settings that can be read and are not as wanted, in the order of the table.

    `unreadable` are values as they were written, which count where the device does not say what it has.
    """
    return {
        name: SettingDifference(as_json(wanted[name]), as_json(actual.get(name)))
        for name, setting in table.table.items()
        if name in wanted and setting.readable and not has(table, name, wanted, actual, unreadable)
    }


def unverified(table: DeviceSettings, wanted: Values, actual: Values) -> tuple[str, ...]:
    """List the wanted settings that the device does not tell, in the order of the table."""
    return tuple(name for name in table.table if name in wanted and name not in actual)


def words(found: Mapping[str, SettingDifference]) -> str:
    """Describe differences, for example `mode is "9-axis", declared "6-axis"`."""
    return ", ".join(
        f"{name} is {'not reported' if one.actual is None else shown(one.actual)}, declared {shown(one.declared)}"
        for name, one in found.items()
    )


def as_json(value: Any) -> Any:
    """Return a value of a setting as JSON has it."""
    return msgspec.to_builtins(value)


def wanted_values(table: DeviceSettings, given: Mapping[str, Any]) -> dict[str, Any]:
    """Convert values of JSON or YAML to the types of the table, in its order.

    Raises BadArgument for a setting that is not known or cannot be set, and for a value that is not accepted.
    """
    settable = [name for name, setting in table.table.items() if setting.write is not None]
    for name in given:
        if name not in settable:
            only_read = f"{name}: it can only be read" if name in table.table else ""
            raise BadArgument(only_read or unknown_name("a setting", name, settable))
    return {name: _converted(name, given[name], table.table[name].type) for name in settable if name in given}


def described_settings(table: DeviceSettings, declared: Values, actual: Values | None) -> tuple[SettingInfo, ...]:
    """Describe all settings of a table; `actual` is None where they were not read."""
    found = differences(table, declared, actual, {}) if actual is not None else {}
    return tuple(
        SettingInfo(
            name,
            *description_of(setting.type),
            setting.effect,
            setting.connection,
            setting.readable,
            setting.write is not None,
            as_json(declared.get(name)),
            as_json((actual or {}).get(name)),
            name in found,
        )
        for name, setting in table.table.items()
    )


def description_of(value_type: Any) -> tuple[str, str, str, str]:
    """Return accepted values, description, unit and section of the manual, from the type of a setting."""
    info = msgspec.inspect.type_info(value_type)
    schema: Mapping[str, Any] = {}
    extra: Mapping[str, Any] = {}
    if isinstance(info, msgspec.inspect.Metadata):
        schema, extra = info.extra_json_schema or {}, info.extra or {}
    meaning, unit, section = schema.get("description", ""), extra.get("unit", ""), extra.get("section", "")
    return expected(value_type), str(meaning), str(unit), str(section)


def _converted(name: str, value: Any, value_type: Any) -> Any:
    try:
        return msgspec.convert(value, value_type)
    except msgspec.ValidationError:
        raise BadArgument(f"{name}: expected {expected(value_type)}, got {shown(value)[:60]}") from None
