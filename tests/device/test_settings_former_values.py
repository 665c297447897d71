"""Values of a device before its restart, and values of another device on the same port."""

import asyncio
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any

from imud.config.model import DeviceConfig
from imud.contracts.setting import OnDifference
from imud.contracts.status import DeviceState
from imud.links.memory import MemoryOptions
from tests.device.test_settings import AtOnce, ModuleBench, fake_table
from tests.support.device_rig import DeviceRig, DeviceRigs, play
from tests.support.event_loops import VirtualClock
from tests.support.fake_drivers import FACTORY, FakeModule
from tests.support.stories import played

__all__ = ["fake_table"]


class QuietBench(ModuleBench):
    """Device that imud must not query without a request: `identify: false`."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.module = FakeModule(self.clock.now_ns)
        self.rigs = DeviceRigs(self.clock.host, state_dir=None)
        options = MemoryOptions(name="/dev/fake", baud=115200)
        config = DeviceConfig(
            "bow", "fake-module", None, False, "memory", options,
            declared=None, on_difference=OnDifference("report"),
        )  # fmt: skip
        self.rig = self.rigs.add(config, self.module)
        self.device = self.rig.device

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        async def run(_rigs: list[DeviceRig]) -> None:
            asyncio.get_running_loop().set_default_executor(AtOnce())
            await story()

        play(self.rigs, run, self.clock)


async def mode_of(bench: ModuleBench) -> object:
    report = await bench.device.settings.report(fresh=False)
    return next(setting.actual for setting in report.settings if setting.name == "mode")


@played(QuietBench)
async def test_restart_ends_unsaved_values_without_queries(bench: QuietBench) -> None:
    """Cell 1: imud must not ask which values the device has after its restart. They are unknown."""
    await bench.pass_s(5)
    await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=False))
    await bench.pass_s(30)
    assert (await mode_of(bench), bench.status.unsaved) == ("9-axis", True)
    bench.module.restart()  # loses the unsaved value
    await bench.pass_s(60)
    assert bench.module.set["mode"] == "6-axis"
    assert (await mode_of(bench), bench.status.unsaved) == (None, False)
    report = await bench.device.settings.report(fresh=True)
    assert next(setting.actual for setting in report.settings if setting.name == "mode") == "6-axis"


@played(partial(ModuleBench, "report", {}))
async def test_flash_follows_a_late_own_restart(bench: ModuleBench) -> None:
    """Cell 2: a restart that imud requested, 5 s after the script, gives the device the values of its flash."""
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    await bench.pass_s(5)
    settings = bench.device.settings
    await bench.doing(settings.apply({"mode": "9-axis"}, save=False))
    requested = settings.resets_requested
    await bench.pass_s(5)
    bench.module.restart()
    await bench.pass_s(5)
    assert settings.resets_requested == requested + 1
    assert (await mode_of(bench), bench.status.unsaved) == ("6-axis", False)
    report = await settings.report(fresh=True)
    mode = next(setting for setting in report.settings if setting.name == "mode")
    assert mode.saved == "6-axis"


@played(partial(ModuleBench, "report", {}))
async def test_change_stays_unsaved_after_a_restart_during_the_write(bench: ModuleBench) -> None:
    """Cell 3: imud counts the restart as requested, and warns about the change until a read shows the values."""
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    await bench.pass_s(5)
    settings = bench.device.settings
    settings.lock.can_restart = True
    settings.resets -= 1  # the device counter restarted since the last tick
    requested = settings.resets_requested
    settings._mark_unsaved({"mode": "6-axis"})
    assert (settings.resets, settings.resets_requested) == (settings.counter_resets, requested + 1)
    assert settings.is_unsaved


@played(partial(ModuleBench, "report", {}))
async def test_another_serial_number_ends_all_values(bench: ModuleBench) -> None:
    """Cell 4: no value of the former device stays, also if the new device does not report its settings."""
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING)
    await bench.pass_s(5)
    await bench.doing(bench.device.settings.apply({"mode": "9-axis"}, save=False))
    bench.module.disappear()
    await bench.rig.until(lambda: bench.device.state is DeviceState.MISSING)
    bench.module.serial, bench.module.flash = "B2", dict(FACTORY)
    bench.module.silent = {"GET"}
    bench.module.restart()
    bench.module.appear()
    await bench.until(lambda: bench.device.settings.identity.serial_number == "B2")
    settings = bench.device.settings
    assert (settings.values, dict(settings.shown), settings.is_current) == ({}, {}, False)
    assert not bench.status.unsaved
    assert await mode_of(bench) is None
