"""A simulated IMU61x on a line in virtual time: made to stream when it is silent, and never left silent."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from imud.config import DeviceConfig
from imud.contracts.status import DeviceState
from imud.devices.imu61x.uart.commands import OutputMode
from imud.event import EventKind
from imud.links.memory import MemorySettings
from imud.sim.imu61x.settings import Imu61xSettings
from imud.sim.imu61x.uart import Imu61xModule
from tests.support.device_rig import DeviceRigs
from tests.support.event_loops import VirtualClock, run_virtually
from tests.support.simulated_modules import imu61x_hardware
from tests.support.wired_device import Imu61xLine

QUIET = Imu61xSettings(mode=OutputMode.COMMAND)


class WakeBench:
    """One device on the line."""

    def __init__(self, clock: VirtualClock, settings: Imu61xSettings, hardware: dict[str, Any], **link: Any) -> None:
        self.clock = clock
        driver, identify = link.pop("driver", "imu61x-uart"), link.pop("identify", True)
        memory = MemorySettings(**{"baud": 115200, **link})
        self.module = Imu61xModule(clock.now_ns(), settings, imu61x_hardware(**hardware))
        self.line = Imu61xLine(memory, self.module, clock)
        self.rigs = DeviceRigs(clock.host)
        self.rig = self.rigs.add(DeviceConfig("bow", driver, None, identify, "memory", memory), self.line)
        self.device = self.rig.device
        self.samples, self.events = self.rig.samples, self.rig.events

    @property
    def woken(self) -> list[str]:
        """What was told of waking it."""
        return [event.message for event in self.events if "commanded to stream" in event.message]

    async def until(self, condition: Callable[[], object], limit_s: float = 30.0) -> None:
        """Let time pass until it holds."""
        await self.rig.until(condition, str(self.line.written), limit_s, step_s=0.01)


Play = Callable[..., WakeBench]


@pytest.fixture
def play() -> Play:
    """Runs a story with a runner at work, which is cancelled at its end."""

    def run(
        story: Callable[[WakeBench], Awaitable[None]],
        settings: Imu61xSettings = QUIET,
        hardware: dict[str, Any] | None = None,
        **link: Any,
    ) -> WakeBench:
        clock = VirtualClock()
        benches: list[WakeBench] = []

        async def both() -> None:
            bench = WakeBench(clock, settings, hardware or {}, **link)
            benches.append(bench)
            carrying = asyncio.create_task(bench.line.carry())
            try:
                async with bench.rigs.at_work():
                    await story(bench)
            finally:
                carrying.cancel()
                await asyncio.gather(carrying, return_exceptions=True)

        run_virtually(clock, both())
        return benches[0]

    return run


@pytest.mark.parametrize("link", [{}, {"baud": "auto"}, {"baud": "auto", "driver": "auto"}], ids=str)
@pytest.mark.manual("A 1 mode at power-on")
def test_device_saved_in_command_mode_is_made_to_stream(play: Play, link: dict[str, Any]) -> None:
    async def story(bench: WakeBench) -> None:
        await bench.until(lambda: bench.woken and len(bench.samples) > 20)
        assert bench.device.state is DeviceState.RUNNING
        assert bench.woken == ["it answered and sent no samples: commanded to stream, which is not saved"]
        assert bench.device.status().identity["serial_number"] == "003200473133510D33383736"

    bench = play(story, hardware={"boot_ms": 0}, **link)
    assert bench.module.flash.mode is OutputMode.COMMAND
    assert [e.kind for e in bench.events if "commanded to stream" in e.message] == [EventKind.CONFIGURATION]


def test_nothing_is_sent_where_it_may_not_be_asked(play: Play) -> None:
    async def story(bench: WakeBench) -> None:
        with pytest.raises(AssertionError):
            await bench.until(lambda: bench.samples, 8)

    bench = play(story, identify=False)
    assert bench.line.written == []
    assert bench.woken == []


def test_device_that_streams_is_not_told_to(play: Play) -> None:
    async def story(bench: WakeBench) -> None:
        await bench.until(lambda: len(bench.samples) > 500)

    bench = play(story, Imu61xSettings())
    assert bench.woken == []


def test_device_that_comes_later_is_woken_and_told_of_once(play: Play) -> None:
    """It boots for 20 s, and does not say that it obeys."""

    async def story(bench: WakeBench) -> None:
        await bench.until(lambda: bench.woken and len(bench.samples) > 500, 60)
        assert bench.woken == ["it answered and sent no samples: commanded to stream, which is not saved"]
        assert [e.detail["acknowledged"] for e in bench.events if "acknowledged" in e.detail] == [False]

    play(story, hardware={"boot_ms": 20_000, "acknowledges": False})


def test_where_nothing_answers_nothing_is_told(play: Play) -> None:
    async def story(bench: WakeBench) -> None:
        with pytest.raises(AssertionError):
            await bench.until(lambda: bench.samples, 20)

    bench = play(story, hardware={"boot_ms": 10**6})
    assert bench.woken == []
    assert len(bench.line.written) > 10


def test_device_that_acknowledges_and_stays_silent_is_told_of_once(play: Play) -> None:
    async def story(bench: WakeBench) -> None:
        with pytest.raises(AssertionError):
            await bench.until(lambda: bench.samples, 10)
        assert len(bench.woken) == 1

    play(story, hardware={"boot_ms": 0, "changes_mode": False})


def test_device_that_was_told_to_be_silent_is_left_so(play: Play) -> None:
    async def story(bench: WakeBench) -> None:
        await bench.until(lambda: len(bench.samples) > 20 and bench.device.status().settings)
        await bench.device.act("stop_streaming", {})
        count = len(bench.samples)
        with pytest.raises(AssertionError):
            await bench.until(lambda: len(bench.samples) > count + 5, 10)
        assert bench.device.state is DeviceState.SILENT

    bench = play(story, Imu61xSettings())
    assert bench.woken == []


@pytest.mark.parametrize("cut_at", range(1, 25, 3))
def test_identification_cut_off_anywhere_leaves_it_streaming(play: Play, cut_at: int) -> None:
    """The daemon stops in the middle of the questions; the device answers in command mode only."""

    async def story(bench: WakeBench) -> None:
        await bench.until(lambda: len(bench.line.written) >= cut_at)

    bench = play(story, Imu61xSettings(), {"answers_while_streaming": False})
    assert bench.module.settings.mode is OutputMode.STREAM


def test_a_link_that_is_gone_needs_nothing(play: Play) -> None:
    async def story(bench: WakeBench) -> None:
        await bench.until(lambda: bench.module.settings.mode is OutputMode.COMMAND)
        bench.line.disappear()
        await bench.until(lambda: bench.device.state is DeviceState.MISSING)
        count = len(bench.line.written)
        bench.line.appear()
        await bench.until(lambda: len(bench.line.written) > count)
        await bench.until(lambda: len(bench.samples) > 20)  # asked again, which begins with what it is in
        assert bench.device.state is DeviceState.RUNNING

    play(story, Imu61xSettings(), {"answers_while_streaming": False})
