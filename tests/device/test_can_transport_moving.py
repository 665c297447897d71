"""Declared settings of simulated modules of every kind, on a CAN bus in memory."""

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from imud.config.model import DeviceConfig
from imud.contracts.setting import OnDifference, SettingsState
from imud.contracts.status import DeviceState
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Options
from imud.formats.can import EXTENDED_FLAG, RAW_FRAME, CanFrame
from imud.host.clock import HostClock
from imud.links.memory import MemoryCanLink, MemoryOptions
from imud.model.options import Options
from imud.sim.can_module import CanModule, CanModules
from imud.sim.hipnuc.canopen import NODE_VARIANTS, HipnucCanopenHardware, HipnucCanopenModule, NodeSettings
from imud.sim.hipnuc.j1939 import J1939_VARIANTS, HipnucJ1939Module, J1939Hardware, J1939Settings
from tests.support.device_rig import DeviceRig, DeviceRigs
from tests.support.device_rig import play as play_rigs
from tests.support.event_loops import VirtualClock

BIT_RATE = 500_000


class BusInProcess:
    """Simulated modules in virtual time; the first module is the device."""

    def __init__(
        self,
        clock: VirtualClock,
        driver: str,
        options: Options | None,
        *modules: CanModule,
        identify: bool = True,
        **declared: object,
    ) -> None:
        """imud applies and saves the settings in `declared`."""
        self.clock = clock
        self.modules = CanModules(modules)
        self.rigs = DeviceRigs(HostClock(clock.now_ns, clock.realtime_ns, clock.now_ns))
        link = MemoryOptions(baud=BIT_RATE, name="can0")
        config = DeviceConfig("bow", driver, options, identify, "memory", link)
        if declared:
            table = DRIVERS[driver].device_settings
            assert table is not None
            config = replace(
                config, declared=msgspec.convert(declared, table.declarable), on_difference=OnDifference.APPLY_AND_SAVE
            )
        self.rig: DeviceRig = self.rigs.add(config, MemoryCanLink(link))
        self._passed_on = 0

    def step(self) -> None:
        """Deliver the frames of both sides."""
        link, now_ns = self.rig.can_link, self.clock.now_ns()
        for payload in link.written[self._passed_on :]:
            can_id, size, data = RAW_FRAME.unpack(payload)
            self.modules.receive(can_id & ~EXTENDED_FLAG, bool(can_id & EXTENDED_FLAG), data[:size], now_ns)
        self._passed_on = len(link.written)
        link.feed([CanFrame(f.can_id, f.extended, f.data, f.due_ns) for f in self.modules.advance(now_ns)])

    async def until(self, condition: Callable[[], object], what: str) -> None:
        await self.rig.until(condition, what, 120.0, step=self.step)

    async def done(self, work: Coroutine[Any, Any, Any]) -> Any:
        """Return the result of `work`, while the modules run."""
        task = asyncio.create_task(work)
        await self.until(task.done, "its end")
        return task.result()

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        async def told(_made: list[DeviceRig]) -> None:
            await self.until(lambda: self.rig.state is DeviceState.RUNNING, "samples")
            await story()

        play_rigs(self.rigs, told, self.clock)


async def made_so(bus: BusInProcess, wanted: Mapping[str, object], *, verified: bool) -> None:
    """Apply and save settings, and check the result of each setting."""
    applied = await bus.done(bus.rig.device.settings_apply(wanted, save=True))
    assert applied.problem == "", applied
    assert {step.name for step in applied.steps} == set(wanted)
    assert any("not verified" in str(step.outcome) for step in applied.steps) is not verified, applied
    assert applied.saved
    count = len(bus.rig.samples)
    await bus.until(lambda: len(bus.rig.samples) > count + 20, "samples afterwards")
    assert any("9 in the configuration" in event.message for event in bus.rig.events)


@pytest.mark.parametrize("variant", NODE_VARIANTS)
def test_declared_settings_are_applied_to_a_canopen_node(variant: str) -> None:
    clock, kind = VirtualClock(), NODE_VARIANTS[variant]
    module = HipnucCanopenModule(clock.now_ns(), HipnucCanopenHardware(boot_ms=200, variant=kind))
    other = NodeSettings(node=12)
    beside = HipnucCanopenModule(clock.now_ns(), HipnucCanopenHardware(factory=other, boot_ms=0))
    bus = BusInProcess(clock, "hipnuc-canopen", HipnucCanopenOptions(), module, beside)

    async def story() -> None:
        taken = await bus.done(bus.rig.device.settings_apply({"node": 12}, save=True))
        assert "node 12 is in use" in taken.problem
        assert module.objects.writes_to_flash == 0
        wanted = {"tpdo2_interval_ms": 100, "incli_x_reversed": True, "node": 9}
        await made_so(bus, wanted, verified=kind.reads == "answered")

    bus.play(story)
    saved = module.objects.saved
    assert (saved.periods_ms[2], saved.invert_x, saved.node, module.node) == (100, 1, 9, 9)
    assert module.objects.writes_to_flash == 1
    assert beside.objects.settings == other


@pytest.mark.parametrize("variant", J1939_VARIANTS)
def test_declared_settings_are_applied_to_a_j1939_module(variant: str) -> None:
    clock, kind = VirtualClock(), J1939_VARIANTS[variant]
    module = HipnucJ1939Module(clock.now_ns(), J1939Settings(), J1939Hardware(boot_ms=200, variant=kind))
    beside = HipnucJ1939Module(clock.now_ns(), J1939Settings(address=12), J1939Hardware(boot_ms=0))
    bus = BusInProcess(clock, "hipnuc-j1939", HipnucJ1939Options(), module, beside)

    async def story() -> None:
        taken = await bus.done(bus.rig.device.settings_apply({"address": 12}, save=True))
        assert "address 12 is in use" in taken.problem
        assert module.writes_to_flash == 0
        wanted = {"ff37_interval_ms": 50, "y_reversed": True, "address": 9}
        await made_so(bus, wanted, verified=kind.reads != "ignored")

    bus.play(story)
    assert (module.flash.intervals_ms[0xFF37], module.flash.y_reversed, module.flash.address) == (50, 1, 9)
    assert module.writes_to_flash == 1
    assert beside.settings == J1939Settings(address=12)


def test_a_found_node_with_another_number_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The configuration forbids queries of the identity."""
    monkeypatch.setattr("imud.device.can_search.LISTEN_NS", 100_000_000)
    clock = VirtualClock()
    module = HipnucCanopenModule(clock.now_ns(), HipnucCanopenHardware(factory=NodeSettings(node=9), boot_ms=0))
    bus = BusInProcess(clock, "auto", None, module, identify=False)

    async def story() -> None:
        await bus.done(bus.rig.device.settings_apply({"tpdo1_interval_ms": 20}, save=False))
        assert module.objects.settings.periods_ms[1] == 20

    bus.play(story)


def test_a_node_with_a_declared_number_is_followed() -> None:
    clock = VirtualClock()
    module = HipnucCanopenModule(clock.now_ns(), HipnucCanopenHardware(boot_ms=0))
    bus = BusInProcess(
        clock, "hipnuc-canopen", HipnucCanopenOptions(), module, tpdo1_interval_ms=20, tpdo2_interval_ms=20, node=9
    )

    async def story() -> None:
        rig = bus.rig
        saved = "; saved to flash; restarted"
        await bus.until(lambda: any(saved in event.message for event in rig.events), saved)
        count = len(rig.samples)
        await bus.until(lambda: len(rig.samples) > count + 20, "samples afterwards")
        declared = rig.device.status().declared
        assert declared is not None
        assert (module.node, declared.repairs, declared.state) == (9, 1, SettingsState.AGREE)

    bus.play(story)
