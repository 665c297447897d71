"""Plan of what is written to a device to make it as wanted, and in which order.

Settings are written in the order of the driver's table, those that change how the device is reached last. What comes
into force by a restart only is left out where nothing is to be saved: the restart would lose it.
"""

from collections.abc import Mapping
from typing import Any, Final

from imud.contracts.action import Risk, Target
from imud.contracts.device_settings import DeviceSettings, Effect, PlannedStep, Setting, SettingsPlan
from imud.runtime.settings.difference import Values, as_json, has

NEEDS_SAVE: Final = "comes into force by save and restart only, and nothing is to be saved"
SAVES_ITSELF: Final = "saves to flash and restarts the device, and nothing is to be saved"
CANNOT_SAVE: Final = "comes into force by save and restart only, and this driver cannot save"


def make_plan(
    table: DeviceSettings,
    target: Target,
    wanted: Values,
    actual: Values,
    unreadable: Values,
    *,
    save: bool,
    unsaved: bool,
) -> SettingsPlan:
    """Plan to make a device that has `actual` as `wanted`.

    `unreadable` are values of settings that cannot be read back, as they were written to this device, `unsaved` whether
    something was written that flash does not have. Raises BadArgument for values that do not go together.
    """
    differing = [name for name in table.table if name in wanted and not has(table, name, wanted, actual, unreadable)]
    left_out = {name: why for name in differing if (why := _why_left_out(table, table.table[name], save))}
    written = [name for name in differing if name not in left_out]
    if written:
        table.check(target, merged(actual, {name: wanted[name] for name in written}))
    names = list(table.table)
    written.sort(key=lambda name: (table.table[name].connection, table.table[name].saves, names.index(name)))
    steps = tuple(_step(name, table.table[name], wanted, actual) for name in written)
    by_itself = any(step.saves for step in steps)
    return SettingsPlan(
        steps,
        save=save and table.save is not None and (bool(steps) or unsaved) and not by_itself,
        restart=any(step.effect is Effect.AFTER_RESTART for step in steps) and not by_itself and bool(table.restart),
        left_out=left_out,
        risk=Risk.CONNECTION if any(step.connection for step in steps) else Risk.NONE,
    )


def merged(actual: Values, wanted: Values) -> dict[str, Any]:
    """Return all values as they will be: of a setting with several keys those that are wanted on top of the others."""
    values = dict(actual)
    for name, value in wanted.items():
        present = values.get(name)
        both = isinstance(value, Mapping) and isinstance(present, Mapping)
        values[name] = {**present, **value} if both else value  # type: ignore[dict-item]  # both are mappings
    return values


def _why_left_out(table: DeviceSettings, setting: Setting, save: bool) -> str:
    if setting.saves:
        return "" if save else SAVES_ITSELF
    if setting.effect is Effect.AT_ONCE:
        return ""
    if not save:
        return NEEDS_SAVE
    return "" if table.save is not None else CANNOT_SAVE


def _step(name: str, setting: Setting, wanted: Values, actual: Values) -> PlannedStep:
    before = as_json(actual.get(name))
    return PlannedStep(name, as_json(wanted[name]), before, setting.effect, setting.connection, setting.saves)
