"""Every variant of a simulated IMU61x, with actions and settings, in virtual time and on a pty."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.setting import StepOutcome
from imud.contracts.status import DeviceState
from imud.drivers.imu61x.uart.commands import Imu61xUartOptions
from imud.links.memory import MemoryOptions
from imud.model.errors import BadArgument, CommandError
from imud.sim.imu61x.uart import REFUSING, VARIANTS, Imu61xBehaviour, Imu61xModule, Imu61xSettings
from tests.support.device_rig import DeviceRigs, device_config, running
from tests.support.event_loops import VirtualClock
from tests.support.old_spellings import act
from tests.support.pty_port import plugged
from tests.support.simulated_modules import every_variant, imu61x_hardware
from tests.support.stories import played
from tests.support.wired_device import Imu61xLine, play_on_line

UPTIME_US = 20_000_000
SLOW = Imu61xSettings(rate_hz=50)


class VariantBench:
    """One device in virtual time."""

    def __init__(self, behaviour: Imu61xBehaviour, settings: Imu61xSettings | None = None) -> None:
        self.clock = VirtualClock()
        hardware = imu61x_hardware(behaviour=behaviour, uptime_us=UPTIME_US)
        self.module = Imu61xModule(self.clock.now_ns(), settings, hardware)
        memory = MemoryOptions(baud=self.module.baud)
        self.line = Imu61xLine(memory, self.module, self.clock)
        self.rigs = DeviceRigs(self.clock.host)
        options = Imu61xUartOptions(result_done=behaviour.result_done)
        self.rig = self.rigs.add(DeviceConfig("bow", "imu61x-uart", options, True, "memory", memory), self.line)
        self.device = self.rig.device

    def play(self, story: Callable[[], Awaitable[None]]) -> None:
        """Run the device. The story starts after the first samples and the identity."""

        async def whole() -> None:
            await self.rig.until(
                lambda: self.rig.samples and self.device.status().settings, "identity", 60, step_s=0.01
            )
            await story()

        play_on_line(self.line, self.rigs, whole)

    async def samples(self) -> None:
        """Wait for more samples."""
        count = len(self.rig.samples) + 20
        await self.rig.until(lambda: len(self.rig.samples) >= count, "more samples", 10, step_s=0.01)
        assert self.device.state is DeviceState.RUNNING


@every_variant
@played(lambda variant: VariantBench(VARIANTS[variant]))
async def test_settings_are_applied_in_an_order_that_keeps_the_connection(bench: VariantBench, variant: str) -> None:
    device = bench.device
    assert device.status().identity["model_number"] == "614"
    await act(device, "rate", {"rate_hz": 200})
    assert device.status().settings["output_rate_hz"] == "200"
    with pytest.raises(BadArgument, match="rate_hz and baud: expected at most 200 Hz at 115200 baud"):
        await act(device, "rate", {"rate_hz": 400})
    await bench.samples()
    applied = await device.settings_apply({"baud": 460800}, save=True)
    assert ("not known whether the device executed" in applied.problem) is (variant == "no K1")
    assert device.status().settings["baud"] == "460800"
    assert bench.line.baud == bench.module.baud == 460800
    await bench.samples()
    sample = await device.act("sample_once", {})
    assert isinstance(sample, dict)
    assert sample["accel_m_s2"][2] == pytest.approx(9.8, abs=0.1)
    await device.act("restart", {})
    await bench.samples()
    await device.act("factory_reset", {})
    assert (bench.line.baud, bench.module.flash) == (115200, Imu61xSettings())
    await bench.samples()
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
    await bench.samples()


@played(lambda: VariantBench(REFUSING, SLOW))
async def test_a_device_that_refuses_all_commands_keeps_its_settings(bench: VariantBench) -> None:
    for name in ("save", "restart", "factory_reset", "stop_streaming"):
        with pytest.raises(CommandError):
            await bench.device.act(name, {})
    applied = await bench.device.settings_apply({"output_rate_hz": 10}, save=True)
    assert [step.outcome for step in applied.steps] == [StepOutcome.NOT_APPLIED]
    assert "after the write, got 50" in applied.problem
    assert (bench.module.settings, bench.module.flash) == (SLOW, SLOW)
    await bench.samples()


# --- on a real port ---------------------------------------------------------------------------------------------------


@pytest.mark.live
def test_on_a_real_port(tmp_path: Path) -> None:
    """The baud rate of the pty has an effect: another rate damages the bytes."""
    hardware = imu61x_hardware(uptime_us=UPTIME_US, boot_ms=200)
    module = Imu61xModule(time.monotonic_ns(), None, hardware)

    async def story(path: Path) -> None:
        config = device_config("bow", "imu61x-uart", "uart", {"port": str(path), "baud": 115200})
        async with running(config) as (rig,):
            await rig.until_samples(20)
            await rig.until(lambda: rig.device.status().settings, "settings")
            applied = await rig.device.settings_apply({"baud": 460800, "output_rate_hz": 400}, save=True)
            assert (applied.problem, applied.saved) == ("", True)
            assert (module.baud, module.flash.rate_hz, module.flash.baud) == (460800, 400, 460800)
            await rig.until_samples(20)
            await rig.device.act("factory_reset", {})
            assert (module.baud, module.settings) == (115200, Imu61xSettings())
            assert rig.device.status().settings["output_rate_hz"] == "100"
            await rig.until_samples(20)
            assert rig.device.ledger.closes()

    with plugged(tmp_path / "port", module) as path:
        asyncio.run(story(path))
