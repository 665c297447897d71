"""A device on a CAN bus is told something: found by `driver: auto` or named, the command goes to its own node."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from imud.config import DeviceConfig
from imud.contracts.device_settings import Written
from imud.contracts.settings import Settings
from imud.contracts.status import DeviceState
from imud.devices.hipnuc.canopen.codec import HipnucCanopenSettings
from imud.errors import CommandError
from imud.formats.can import RAW_FRAME, CanFrame
from imud.host_clock import HostClock
from imud.links.memory import MemoryCanLink, MemorySettings
from imud.runtime.detection import can as detection
from imud.sim.hipnuc.canopen import HipnucCanopenHardware, HipnucCanopenModule, NodeSettings
from imud.units import NS_PER_MS, NS_PER_S
from tests.support.device_rig import DeviceRig, DeviceRigs
from tests.support.device_rig import play as play_rigs
from tests.support.event_loops import VirtualClock

NODE = 9


class CanopenDeviceBench:
    """A runner, and a simulated module of node 9 at the other end of its bus."""

    def __init__(self, driver: str, options: Settings | None) -> None:
        settings = MemorySettings(name="can0")
        config = DeviceConfig("bow", driver, options, False, "memory", settings)
        self.clock = VirtualClock()
        self.asleep_ns = 0
        now_ns = self.clock.now_ns
        self.host = HostClock(now_ns, self.clock.realtime_ns, now_ns, lambda: now_ns() + self.asleep_ns)
        self.rigs = DeviceRigs(self.host)
        self.rig = self.rigs.add(config, MemoryCanLink(settings))
        self.link = self.rig.can_link
        hardware = HipnucCanopenHardware(factory=NodeSettings(node=NODE), boot_ms=0, skew_ppm=0)
        self.module = HipnucCanopenModule(self.clock.now_ns(), hardware)
        self.deaf = False
        """Whether what imud sends is lost."""
        self._heard = 0

    def exchange(self) -> None:
        """What crossed the bus since the last call, both ways."""
        now_ns = self.clock.now_ns()
        for payload in self.link.written[self._heard :]:
            self._heard += 1
            if self.deaf:
                continue
            can_id, size, data = RAW_FRAME.unpack(payload)
            self.module.receive(can_id, False, data[:size], now_ns)
        frames = [CanFrame(f.can_id, f.extended, f.data, now_ns) for f in self.module.advance(now_ns)]
        if frames:
            self.link.feed(frames)

    async def until(self, condition: Callable[[], object]) -> None:
        await self.rig.until(condition, step=self.exchange, step_s=0.001)

    async def act(self, name: str, **arguments: object) -> object:
        """Tell it, and keep the bus going until it answered."""
        task = asyncio.create_task(self.rig.device.act(name, arguments))
        await self.until(task.done)
        return await task


def play(bench: CanopenDeviceBench, story: Coroutine[Any, Any, None]) -> None:
    async def told(_rigs: list[DeviceRig]) -> None:
        await bench.until(lambda: bench.link.listening)
        await bench.until(lambda: bench.rig.state is DeviceState.RUNNING)
        await story

    play_rigs(bench.rigs, told, bench.clock)


@pytest.mark.parametrize(("driver", "options"), [("auto", None), ("hipnuc-canopen", HipnucCanopenSettings(node=NODE))])
def test_the_command_reaches_the_node(driver: str, options: Settings | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detection, "LISTEN_NS", 100 * NS_PER_MS)
    bench = CanopenDeviceBench(driver, options)

    async def story() -> None:
        assert await bench.act("interval", tpdo=1, interval_ms=20) is Written.VERIFIED
        assert bench.module.objects.settings.periods_ms[1] == 20
        assert await bench.act("direction", x_reversed=True, y_reversed=False) is Written.VERIFIED
        assert bench.module.objects.settings.invert_x == 1

    play(bench, story())


def test_a_node_that_does_not_answer_is_an_error() -> None:
    bench = CanopenDeviceBench("hipnuc-canopen", HipnucCanopenSettings(node=NODE))

    async def story() -> None:
        bench.deaf = True
        with pytest.raises(CommandError, match="node 9"):
            await bench.act("zero", zero="here")

    play(bench, story())


def test_what_a_device_measured_while_the_machine_was_suspended_is_a_gap_of_unknown_size() -> None:
    bench = CanopenDeviceBench("hipnuc-canopen", HipnucCanopenSettings(node=NODE))

    async def story() -> None:
        samples = bench.rig.ledger.samples
        await bench.until(lambda: bench.rig.ledger.samples > samples + 200)
        before = bench.rig.ledger.lost_unknown
        bench.asleep_ns += 2 * NS_PER_S
        await bench.until(lambda: bench.rig.ledger.samples > samples + 400)
        assert bench.host.suspends == 1
        assert bench.rig.ledger.lost_unknown == before + 1

    play(bench, story())
