"""Removed commands: their settings, found by the table `renamed` of the driver as for a user."""

from collections.abc import Mapping
from typing import Any

from imud.contracts.command import Target
from imud.contracts.driver import Driver
from imud.device.device import Device
from imud.device.settings_plan import completed, make_plan, setting_instead, wanted_values
from imud.model.errors import CommandError, IsSetting


def script_of(driver: Driver, target: Target, name: str, arguments: Mapping[str, Any], **actual: Any) -> Any:
    """Return the script of a verb; for a removed command, the script that writes the settings in its place.

    `actual` contains present values of the device.
    """
    if verb := driver.verbs.get(name):
        return verb.script(target, verb.arguments(arguments))
    instead, table = setting_instead("bow", name, driver, arguments), driver.device_settings
    assert instead is not None
    assert table is not None
    if not instead.data["settings"]:
        raise instead
    wanted = completed(table, wanted_values(table, instead.data["settings"]), actual)
    plan = make_plan(table, target, wanted, actual, {}, save=True, unsaved=False, by_name=True)
    scripts = [write(target, wanted[step.name]) for step in plan.steps if (write := table.table[step.name].write)]

    def all_of_them() -> Any:
        result = None
        for script in scripts:
            result = yield from script
        return result

    return all_of_them()


async def act(device: Device, name: str, arguments: Mapping[str, Any]) -> object:
    """Run a verb; for a removed command, set the settings in its place. Return the result of the verb."""
    try:
        return await device.act(name, arguments)
    except IsSetting as instead:
        done = await device.settings.apply(instead.data["settings"], save=instead.data["save"])
        assert done.left_out == {}
        if done.problem:
            raise CommandError(done.problem) from None
        return None
