"""A simulated IMU61x in virtual time: imud starts the output of a silent device."""

from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.status import DeviceState
from imud.drivers.imu61x.uart.commands import OutputMode
from imud.links.memory import MemoryOptions
from imud.model.event import EventKind
from imud.sim.imu61x.uart import Imu61xModule, Imu61xSettings
from tests.support.device_rig import DeviceRigs
from tests.support.event_loops import VirtualClock
from tests.support.simulated_modules import imu61x_hardware
from tests.support.stories import played
from tests.support.wired_device import Imu61xLine, play_on_line

QUIET = Imu61xSettings(mode=OutputMode.COMMAND)
STREAMING = Imu61xSettings()
WOKEN = "it replied but sent no samples: imud started its output and did not save this"


class WakeBench:
    def __init__(
        self, settings: Imu61xSettings = QUIET, *, driver: str = "imu61x-uart", identify: bool = True,
        baud: Any = 115200, **hardware: Any,
    ) -> None:  # fmt: skip
        self.clock = VirtualClock()
        memory = MemoryOptions(baud=baud)
        self.module = Imu61xModule(self.clock.now_ns(), settings, imu61x_hardware(**hardware))
        self.line = Imu61xLine(memory, self.module, self.clock)
        self.rigs = DeviceRigs(self.clock.host)
        self.rig = self.rigs.add(DeviceConfig("bow", driver, None, identify, "memory", memory), self.line)
        self.device = self.rig.device
        self.samples, self.events = self.rig.samples, self.rig.events

    @property
    def woken(self) -> list[str]:
        return [event.message for event in self.events if "started its output" in event.message]

    async def until(self, condition: Callable[[], object], limit_s: float = 30.0) -> None:
        await self.rig.until(condition, str(self.line.written), limit_s, step_s=0.01)

    async def wait(self, seconds: float) -> None:
        end_ns = self.clock.now_ns() + int(seconds * 1e9)
        await self.until(lambda: self.clock.now_ns() >= end_ns, seconds + 1)

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        play_on_line(self.line, self.rigs, story)


@pytest.mark.parametrize("link", [{}, {"baud": "auto"}, {"baud": "auto", "driver": "auto"}], ids=str)
@pytest.mark.manual("A 1 mode at power-on")
@played(lambda link: WakeBench(boot_ms=0, **link))
async def test_the_output_of_a_device_in_command_mode_is_started(bench: WakeBench, link: dict[str, Any]) -> None:
    await bench.until(lambda: bench.woken and len(bench.samples) > 20)
    assert bench.device.state is DeviceState.RUNNING
    assert bench.woken == [WOKEN]
    assert bench.device.status().identity["serial_number"] == "003200473133510D33383736"
    assert bench.module.flash.mode is OutputMode.COMMAND
    events = [event for event in bench.events if event.message == WOKEN]
    assert [(event.kind, event.device, event.detail) for event in events] == [
        (EventKind.CONFIGURATION, "bow", {"acknowledged": True})
    ]
    assert bench.device.stop_calibration() is False


@pytest.mark.parametrize(
    ("hardware", "wait_s", "woken", "writes"),
    [
        ({"identify": False}, 8, [], range(1)),
        ({"boot_ms": 10**6}, 20, [], range(7, 10**6)),
        ({"boot_ms": 0, "changes_mode": False}, 10, [WOKEN], range(1, 10**6)),  # it acknowledges, but sends no samples
    ],
    ids=["may not be asked", "never answers", "does not stream"],
)
@played(lambda hardware: WakeBench(**hardware))
async def test_events_of_a_device_that_stays_silent(
    bench: WakeBench, hardware: dict[str, Any], wait_s: float, woken: list[str], writes: range
) -> None:
    await bench.wait(wait_s)
    assert (bench.samples, bench.woken) == ([], woken)
    assert len(bench.line.written) in writes


@pytest.mark.parametrize("boot_ms", [17_000, 19_000, 21_000, 23_000])
@played(lambda boot_ms: WakeBench(STREAMING, boot_ms=boot_ms))
async def test_a_late_device_that_streams_is_not_reported(bench: WakeBench, boot_ms: int) -> None:
    await bench.until(lambda: len(bench.samples) > 500, 60)
    assert bench.woken == []


@played(lambda: WakeBench(STREAMING))
async def test_a_streaming_or_silenced_device_is_not_woken(bench: WakeBench) -> None:
    await bench.until(lambda: len(bench.samples) > 500 and bench.device.status().settings)
    await bench.device.act("stop_streaming", {})
    count = len(bench.samples)
    await bench.wait(10)
    assert len(bench.samples) <= count + 5
    assert bench.device.state is DeviceState.SILENT
    assert bench.woken == []


@pytest.mark.parametrize("boot_ms", [17_000, 18_000, 19_000, 21_000, 23_000])
@played(lambda boot_ms: WakeBench(boot_ms=boot_ms, acknowledges=False))
async def test_a_late_device_is_woken_and_reported_once(bench: WakeBench, boot_ms: int) -> None:
    """The module does not acknowledge. It boots before or during an identification, which also starts its output."""
    await bench.until(lambda: bench.woken and len(bench.samples) > 500, 60)
    assert bench.woken == [WOKEN]
    assert True not in [e.detail.get("acknowledged") for e in bench.events]


@pytest.mark.parametrize("cut_at", range(1, 25, 3))
def test_an_interrupted_identification_leaves_the_output_on(cut_at: int) -> None:
    """The daemon stops during the queries. The device only replies in command mode."""
    bench = WakeBench(STREAMING, answers_while_streaming=False)
    bench.play(lambda: bench.until(lambda: len(bench.line.written) >= cut_at))
    assert bench.module.settings.mode is OutputMode.STREAM


@played(lambda: WakeBench(STREAMING, answers_while_streaming=False))
async def test_a_missing_link_needs_no_undo(bench: WakeBench) -> None:
    await bench.until(lambda: bench.module.settings.mode is OutputMode.COMMAND)
    bench.line.disappear()
    await bench.until(lambda: bench.rig.is_in(DeviceState.MISSING))
    count = len(bench.line.written)
    bench.line.appear()
    await bench.until(lambda: len(bench.line.written) > count)
    await bench.until(lambda: len(bench.samples) > 20)  # the next query starts with the present mode
    assert bench.rig.is_in(DeviceState.RUNNING)
