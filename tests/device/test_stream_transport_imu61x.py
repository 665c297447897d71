"""A simulated IMU61x in virtual time: imud starts the output of a silent device, and settings of every variant."""

from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.setting import StepOutcome
from imud.contracts.status import DeviceState
from imud.drivers.imu61x.uart.commands import Imu61xUartOptions, OutputMode
from imud.links.memory import MemoryOptions
from imud.model.errors import BadArgument, CommandError
from imud.model.event import EventKind
from imud.sim.imu61x.uart import REFUSING, VARIANTS, Imu61xModule, Imu61xSettings
from tests.support.device_rig import DeviceRigs
from tests.support.event_loops import VirtualClock
from tests.support.old_spellings import act
from tests.support.simulated_modules import every_variant, imu61x_hardware
from tests.support.stories import played
from tests.support.wired_device import Imu61xLine, play_on_line

QUIET = Imu61xSettings(mode=OutputMode.COMMAND)
STREAMING = Imu61xSettings()
SLOW = Imu61xSettings(rate_hz=50)
WOKEN = "it replied but sent no samples: imud started its output and did not save this"


class Imu61xDevice:
    def __init__(
        self, settings: Imu61xSettings = QUIET, *, driver: str = "imu61x-uart", identify: bool = True,
        baud: Any = 115200, **hardware: Any,
    ) -> None:  # fmt: skip
        self.clock = VirtualClock()
        memory, made = MemoryOptions(baud=baud), imu61x_hardware(**hardware)
        self.module = Imu61xModule(self.clock.now_ns(), settings, made)
        self.line = Imu61xLine(memory, self.module, self.clock)
        self.rigs = DeviceRigs(self.clock.host)
        options = None if driver == "auto" else Imu61xUartOptions(result_done=made.behaviour.result_done)
        self.rig = self.rigs.add(DeviceConfig("bow", driver, options, identify, "memory", memory), self.line)
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

    async def until_samples(self) -> None:
        count = len(self.samples) + 20
        await self.until(lambda: len(self.samples) >= count, 10)
        assert self.device.state is DeviceState.RUNNING

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        play_on_line(self.line, self.rigs, story)


@pytest.mark.parametrize("link", [{}, {"baud": "auto"}, {"baud": "auto", "driver": "auto"}], ids=str)
@pytest.mark.manual("A 1 mode at power-on")
@played(lambda link: Imu61xDevice(boot_ms=0, **link))
async def test_the_output_of_a_device_in_command_mode_is_started(bench: Imu61xDevice, link: dict[str, Any]) -> None:
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
@played(lambda hardware: Imu61xDevice(**hardware))
async def test_events_of_a_device_that_stays_silent(
    bench: Imu61xDevice, hardware: dict[str, Any], wait_s: float, woken: list[str], writes: range
) -> None:
    await bench.wait(wait_s)
    assert (bench.samples, bench.woken) == ([], woken)
    assert len(bench.line.written) in writes


@pytest.mark.parametrize("boot_ms", [17_000, 19_000, 21_000, 23_000])
@played(lambda boot_ms: Imu61xDevice(STREAMING, boot_ms=boot_ms))
async def test_a_late_device_that_streams_is_not_reported(bench: Imu61xDevice, boot_ms: int) -> None:
    await bench.until(lambda: len(bench.samples) > 500, 60)
    assert bench.woken == []


@played(lambda: Imu61xDevice(STREAMING))
async def test_a_streaming_or_silenced_device_is_not_woken(bench: Imu61xDevice) -> None:
    await bench.until(lambda: len(bench.samples) > 500 and bench.device.status().settings)
    await bench.device.act("stop_streaming", {})
    count = len(bench.samples)
    await bench.wait(10)
    assert len(bench.samples) <= count + 5
    assert bench.device.state is DeviceState.SILENT
    assert bench.woken == []


@pytest.mark.parametrize("boot_ms", [17_000, 18_000, 19_000, 21_000, 23_000])
@played(lambda boot_ms: Imu61xDevice(boot_ms=boot_ms, acknowledges=False))
async def test_a_late_device_is_woken_and_reported_once(bench: Imu61xDevice, boot_ms: int) -> None:
    """The module does not acknowledge. It boots before or during an identification, which also starts its output."""
    await bench.until(lambda: bench.woken and len(bench.samples) > 500, 60)
    assert bench.woken == [WOKEN]
    assert True not in [e.detail.get("acknowledged") for e in bench.events]


@pytest.mark.parametrize("cut_at", range(1, 25, 3))
def test_an_interrupted_identification_leaves_the_output_on(cut_at: int) -> None:
    """The daemon stops during the queries. The device only replies in command mode."""
    bench = Imu61xDevice(STREAMING, answers_while_streaming=False)
    bench.play(lambda: bench.until(lambda: len(bench.line.written) >= cut_at))
    assert bench.module.settings.mode is OutputMode.STREAM


@played(lambda: Imu61xDevice(STREAMING, answers_while_streaming=False))
async def test_a_missing_link_needs_no_undo(bench: Imu61xDevice) -> None:
    await bench.until(lambda: bench.module.settings.mode is OutputMode.COMMAND)
    bench.line.disappear()
    await bench.until(lambda: bench.rig.is_in(DeviceState.MISSING))
    count = len(bench.line.written)
    bench.line.appear()
    await bench.until(lambda: len(bench.line.written) > count)
    await bench.until(lambda: len(bench.samples) > 20)  # the next query starts with the present mode
    assert bench.rig.is_in(DeviceState.RUNNING)


# --- settings ---------------------------------------------------------------------------------------------------------


@every_variant
@played(lambda variant: Imu61xDevice(STREAMING, behaviour=VARIANTS[variant], uptime_us=20_000_000))
async def test_settings_are_applied_in_an_order_that_keeps_the_connection(bench: Imu61xDevice, variant: str) -> None:
    device = bench.device
    await bench.until(lambda: bench.samples and device.status().settings, 60)
    assert device.status().identity["model_number"] == "614"
    await act(device, "rate", {"rate_hz": 200})
    assert device.status().settings["output_rate_hz"] == "200"
    with pytest.raises(BadArgument, match="rate_hz and baud: expected at most 200 Hz at 115200 baud"):
        await act(device, "rate", {"rate_hz": 400})
    await bench.until_samples()
    applied = await device.settings_apply({"baud": 460800}, save=True)
    assert ("not known whether the device executed" in applied.problem) is (variant == "no K1")
    assert device.status().settings["baud"] == "460800"
    assert bench.line.baud == bench.module.baud == 460800
    await bench.until_samples()
    sample = await device.act("sample_once", {})
    assert isinstance(sample, dict)
    assert sample["accel_m_s2"][2] == pytest.approx(9.8, abs=0.1)
    await device.act("restart", {})
    await bench.until_samples()
    await device.act("factory_reset", {})
    assert (bench.line.baud, bench.module.flash) == (115200, Imu61xSettings())
    await bench.until_samples()
    with pytest.raises(BadArgument, match="output_rate_hz and baud: expected at most 200 Hz at 115200 baud"):
        await device.settings_apply({"output_rate_hz": 400}, save=False)
    assert bench.module.settings == Imu61xSettings()
    wanted: dict[str, Any] = {"baud": 460800, "output_rate_hz": 400, "gyro_filter": "10 Hz", "i2c_address": "0x1a"}
    applied = await device.settings_apply(wanted, save=variant != "no K1")
    assert {step.name for step in applied.steps} == set(wanted)
    assert {step.outcome for step in applied.steps} == {StepOutcome.VERIFIED}
    assert (applied.problem, applied.differences) == ("", {})
    assert applied.steps[-1].name == "baud"
    settings = bench.module.settings
    assert (settings.rate_hz, settings.filter_control, settings.i2c_address) == (400, 0xB4, 0x1A)
    assert bench.line.baud == bench.module.baud == 460800
    if variant != "no K1":
        assert applied.saved
        assert bench.module.flash == settings
    await bench.until_samples()


@played(lambda: Imu61xDevice(SLOW, behaviour=REFUSING))
async def test_a_device_that_refuses_all_commands_keeps_its_settings(bench: Imu61xDevice) -> None:
    await bench.until(lambda: bench.samples and bench.device.status().settings, 60)
    for name in ("save", "restart", "factory_reset", "stop_streaming"):
        with pytest.raises(CommandError):
            await bench.device.act(name, {})
    applied = await bench.device.settings_apply({"output_rate_hz": 10}, save=True)
    assert [step.outcome for step in applied.steps] == [StepOutcome.NOT_APPLIED]
    assert "after the write, got 50" in applied.problem
    assert (bench.module.settings, bench.module.flash) == (SLOW, SLOW)
    await bench.until_samples()
