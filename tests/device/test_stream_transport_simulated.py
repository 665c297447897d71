"""Simulated devices in virtual time: silence, commands, changed settings, read-back, and an output that imud starts."""

import asyncio
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import msgspec
import pytest

from imud.config.model import DeviceConfig
from imud.contracts.command import VerbResult
from imud.contracts.lines import DeviceLines, DividedOptions
from imud.contracts.setting import StepOutcome
from imud.contracts.status import DeviceState
from imud.device.stream_transport import StreamTransport
from imud.drivers.hipnuc.uart.settings import SETTINGS
from imud.drivers.imu61x.uart.commands import Imu61xUartOptions, OutputMode
from imud.links.memory import MemoryOptions
from imud.model.errors import BadArgument, CommandError
from imud.model.event import EventKind
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import VARIANTS, Behaviour, ModuleSettings, Output
from imud.sim.imu61x.uart import REFUSING, Imu61xModule, Imu61xSettings
from imud.sim.imu61x.uart import VARIANTS as IMU61X_VARIANTS
from tests.support.device_rig import DeviceRigs, device_config, running
from tests.support.event_loops import VirtualClock
from tests.support.old_spellings import act
from tests.support.pty_port import plugged
from tests.support.simulated_modules import every_variant, hardware_of, imu61x_hardware
from tests.support.stories import played
from tests.support.wired_device import Imu61xLine, LinkedDevice, play_on_line

NO_RATE = ModuleSettings(hi91=Output())
ON_MARK = ModuleSettings(hi91=Output(on_mark=True))
LINKS: list[dict[str, Any]] = [{}, {"baud": "auto"}, {"baud": "auto", "driver": "auto"}]
OUTPUT_OFF = msgspec.convert({"output_enabled": False}, SETTINGS.declarable)
UP_AND_DOWN = (EventKind.UP, EventKind.DOWN)

every_link = pytest.mark.parametrize("link", LINKS, ids=str)


def turns(device: LinkedDevice) -> list[EventKind]:
    return [event.kind for event in device.events if event.kind in UP_AND_DOWN]


@pytest.mark.parametrize(
    ("settings", "why", "link"),
    [
        (NO_RATE, "no message has a rate", LINKS[0]),
        (ON_MARK, "HI91 on mark, one frame for each pulse on SIN", LINKS[1]),
        (NO_RATE, "no message has a rate", LINKS[2]),
    ],
)
@pytest.mark.manual("B 2.2.5 LOG DISABLE")
@played(lambda settings, link: LinkedDevice(settings, **link))
async def test_a_module_with_its_output_off_is_known_and_stays_silent(
    device: LinkedDevice, settings: ModuleSettings, why: str, link: dict[str, Any]
) -> None:
    await device.wait(35)
    assert device.rig.is_in(DeviceState.SILENT)
    assert device.problem == (
        f"it replies (HI14R3, firmware 1.5.6) but sends no samples: {why}; the command wake starts its output"
    )
    assert device.device.status().identity["serial_number"] == "043995698D6E1708"
    assert (device.module.settings, turns(device)) == (settings, [])
    await device.act("mode", axes=9)
    assert device.module.settings.att_mode == 1
    assert device.device.status().settings["mode"] == "9-axis"
    await device.act("wake")
    await device.until(lambda: len(device.samples) > 20)
    assert device.rig.is_in(DeviceState.RUNNING)
    assert (device.problem, turns(device)) == ("", [EventKind.UP])


@played(lambda: LinkedDevice(NO_RATE))
async def test_commands_are_accepted_after_the_first_reply(device: LinkedDevice) -> None:
    await device.until(lambda: device.device.verbs, limit_s=0.1)
    with pytest.raises(CommandError, match="bow is searching"):
        await device.device.act("wake", {})
    await device.until(lambda: device.device.status().settings, limit_s=1.9)
    assert device.rig.is_in(DeviceState.SEARCHING)
    await device.act("output", message="HI91", rate_hz=50)
    await device.until(lambda: device.samples)


@every_link
@played(lambda link: LinkedDevice(hardware=hardware_of(Behaviour(), boot_ms=0), **link))
async def test_a_disabled_output_is_enabled(device: LinkedDevice, link: dict[str, Any]) -> None:
    device.module.receive(b"LOG DISABLE\r\n", device.clock.now_ns())
    await device.until(lambda: len(device.samples) > 20)
    assert "it replied but sent no samples: imud started its output and did not save this" in device.messages
    assert device.module.settings == device.module.flash == ModuleSettings()
    assert turns(device) == [EventKind.UP]


@every_link
@played(lambda link: LinkedDevice(**link))
async def test_a_silenced_module_stays_silent_and_is_queried_at_its_rate(
    device: LinkedDevice, link: dict[str, Any]
) -> None:
    await device.until(lambda: len(device.samples) > 20 and device.device.status().settings)
    await device.act("output_none")
    count, sent = len(device.samples), len(device.link.sent_at)
    await device.wait(50)
    assert len(device.samples) <= count + 2
    assert device.rig.is_in(DeviceState.SILENT)
    assert "no message has a rate" in device.problem
    assert turns(device) == [EventKind.UP, EventKind.DOWN]
    asked = device.link.sent_at[sent:]
    assert {baud for baud, _ in asked} == {115200}
    assert 2 <= sum(data.startswith(b"LOG VERSION") for _, data in asked) <= 4  # one search per 15 s
    await device.act("output", message="HI91", rate_hz=100)
    await device.until(lambda: len(device.samples) > count + 20)
    assert turns(device) == [EventKind.UP, EventKind.DOWN, EventKind.UP]


@played(lambda: LinkedDevice(baud="auto"))
async def test_no_command_is_sent_during_a_search(device: LinkedDevice) -> None:
    """The module is off: only the search sends requests at all rates."""
    await device.until(lambda: len(device.samples) > 20 and device.device.status().settings)
    device.module.receive(b"UNLOGALL\r\n", device.clock.now_ns())
    await device.wait(0.1)
    device.link.module_is_on = False
    await device.until(lambda: device.rig.is_in(DeviceState.SEARCHING), limit_s=60)
    bauds, refused = set(), 0
    for _ in range(200):
        bauds.add(device.link.baud)
        try:
            await act(device.device, "output", {"message": "HI91", "rate_hz": 50})
        except CommandError:
            refused += 1
        await device.wait(0.05)
    assert refused == 200
    assert len(bauds) > 4
    assert {data for _, data in device.link.sent_at if data.startswith(b"LOG HI91")} == set()
    assert turns(device) == [EventKind.UP, EventKind.DOWN]


@played(lambda: LinkedDevice(baud="auto", identify=False))
async def test_a_search_ends_a_running_script(device: LinkedDevice, monkeypatch: pytest.MonkeyPatch) -> None:
    """A running script does not send at the rates of the search, even if the search does not wait for the script."""
    monkeypatch.setattr(StreamTransport, "busy", property(lambda _transport: False, lambda *_: None))
    await device.until(lambda: len(device.samples) > 20)
    device.link.module_is_on = False
    acting = [asyncio.ensure_future(device.device.act("restart", {})) for _ in range(3)]
    await device.until(lambda: all(one.done() for one in acting), limit_s=90)
    assert all(isinstance(one.exception(), CommandError) for one in acting)
    assert any("cannot run a command during the search" in str(one.exception()) for one in acting)
    reboots = [baud for baud, data in device.link.sent_at if data.startswith(b"REBOOT")]
    assert set(reboots) == {115200}


@pytest.mark.parametrize(
    ("variant", "link"),
    [*((variant, {}) for variant in VARIANTS), *(("as in the manual", link) for link in LINKS[1:])],
    ids=str,
)
@pytest.mark.manual("B 2.2.3 a wrong rate")
@played(lambda variant, link: LinkedDevice(hardware=hardware_of(VARIANTS[variant]), **link))
async def test_every_variant_is_followed_to_another_rate_and_back(
    device: LinkedDevice, variant: str, link: dict[str, Any]
) -> None:
    await device.until(lambda: len(device.samples) > 20 and device.device.status().settings)
    applying = asyncio.ensure_future(device.device.settings.apply({"baud": 921600}, save=True))
    await device.until(applying.done, "the new rate", 60)
    assert device.link.baud == device.module.baud == device.module.flash.baud == 921600
    assert ("in the configuration" in applying.result().advice) is (not link)
    count = len(device.samples)
    await device.until(lambda: len(device.samples) > count + 20)
    assert device.device.status().settings["baud"] == "921600 bit/s"
    answer = await device.act("factory_reset")
    assert answer == VerbResult(True, "baud is 115200, was 921600", {"baud": 115200})
    count = len(device.samples)
    await device.until(lambda: len(device.samples) > count + 20)
    assert device.device.status().settings["baud"] == "115200 bit/s"
    assert device.module.settings == ModuleSettings()
    assert device.device.ledger.frames_bad() < 10


@played(lambda: LinkedDevice(hardware=hardware_of(Behaviour(refuses=("CONFIG ATT RST",)))))
async def test_settings_are_read_again_after_each_action(device: LinkedDevice) -> None:
    await device.until(lambda: len(device.samples) > 20 and device.device.status().settings)
    await device.act("pin", function="led", pin=7)
    await device.act("mounting", turned="y_up")
    await device.act("output", message="HI91", rate_hz=25)
    settings = device.device.status().settings
    assert (settings["pins.led"], settings["mounting"]) == ("IO7", "y_up")
    assert settings["output.hi91"] == "25 Hz"
    await device.wait(1)
    assert device.device.ledger.lost_gap_device == 0  # the rate was 100 Hz
    assert "a command changed settings of the device: pins.led is IO7, was IO5" in device.messages
    device.module.receive(b"CONFIG ATT MODE 1\r\n", device.clock.now_ns())  # by another program
    await device.wait(0.1)
    with pytest.raises(CommandError, match="the device rejected the request"):
        await device.act("level", level="automatic")
    assert device.device.status().settings["mode"] == "9-axis"


@played(lambda: LinkedDevice(hardware=hardware_of(Behaviour(), firmware=169)))
async def test_status_bits_and_settings_are_shown_by_name(device: LinkedDevice) -> None:
    """Firmware from 1.6.9 sends MAIN_STATUS; the simulated module converges within 5 s."""
    await device.until(lambda: len(device.samples) > 20 and device.device.status().settings)
    status = device.device.status()
    assert status.status_words == (
        "gyroscope bias not converged", "attitude not converged", "at rest", "time not UTC", "frame with SOUT pulse"
    )  # fmt: skip
    assert (status.status_bit_names["4"], status.settings["output.hi91"]) == ("magnetic disturbance", "100 Hz")
    assert status.settings["magnetometer_bias"] == "0, 0, 0 µT: not calibrated"
    await device.wait(10)
    assert device.device.status().status_words == ("at rest", "time not UTC", "frame with SOUT pulse")
    alarms = [event.message for event in device.events if event.kind is EventKind.ALARM]
    assert alarms[0] == "status: gyroscope bias not converged, attitude not converged"
    assert alarms[-1] == "status: cleared: gyroscope bias not converged"


@played(lambda: LinkedDevice(lines=DeviceLines(sout_div=DividedOptions(line="A", divisor=4))))
async def test_differences_between_lines_and_settings_are_reported(device: LinkedDevice) -> None:
    words = "expected divisor 4 from the configuration, got 8 from the device"
    await device.until(lambda: len(device.samples) > 20 and device.device.status().settings)
    assert device.messages.count(f"line sout_div: {words}") == 1
    await device.act("mode", axes=9)
    assert device.messages.count(f"line sout_div: {words}") == 1
    await device.act("sout_divider", divisor=4)
    await device.act("sout_divider", divisor=8)
    assert device.messages.count(f"line sout_div: {words}") == 2


@played(lambda: LinkedDevice(hardware=hardware_of(Behaviour(), boot_ms=0), declared=OUTPUT_OFF))
async def test_an_output_declared_off_is_not_enabled(device: LinkedDevice) -> None:
    device.module.receive(b"LOG DISABLE\r\n", device.clock.now_ns())
    await device.wait(20)
    assert device.samples == []
    assert "its output is disabled (LOG DISABLE); HI91 has the rate 100 Hz" in device.problem


@pytest.mark.parametrize("behaviour", VARIANTS.values(), ids=VARIANTS)
@played(lambda behaviour: LinkedDevice(hardware=hardware_of(behaviour), baud="auto"))
async def test_declared_settings_reach_every_variant(device: LinkedDevice, behaviour: Behaviour) -> None:
    """An output that needs the new baud rate, together with this rate."""
    wanted = {"mode": "9-axis", "mounting": "y_up", "sout_divisor": 3, "output": {"hi91": 500}, "baud": 921600}
    await device.until(lambda: len(device.samples) > 20 and device.device.status().settings)
    applying = asyncio.ensure_future(device.device.settings.apply(wanted, save=True))
    await device.until(applying.done, "the end of the plan", 90)
    applied = applying.result()
    assert applied.problem == ""
    outcomes = {step.name: step.outcome for step in applied.steps}
    assert outcomes.pop("mounting") in (StepOutcome.VERIFIED, StepOutcome.WRITTEN)  # active after the restart for baud
    assert set(outcomes.values()) == {StepOutcome.VERIFIED}
    assert applied.steps[-1].name == "baud"
    flash = ModuleSettings(
        baud=921600, att_mode=1, urfr=(1, 0, 0, 0, 0, -1, 0, 1, 0), sout_div=3, hi91=Output(2)
    )  # fmt: skip
    assert device.module.flash == device.module.settings == flash
    assert device.link.baud == device.module.baud == 921600
    count = len(device.samples)
    await device.until(lambda: len(device.samples) > count + 100)


@pytest.mark.live
def test_on_a_real_port(tmp_path: Path) -> None:
    """The baud rate of the pty has an effect: another rate damages the bytes."""
    hardware = hardware_of(Behaviour(), boot_ms=200)
    module = HipnucModule(time.monotonic_ns(), NO_RATE, hardware)

    async def story(path: Path) -> None:
        config = device_config("bow", "hipnuc-uart", "uart", {"port": str(path), "baud": 115200})
        async with running(config) as (rig,):
            await rig.until(lambda: rig.is_in(DeviceState.SILENT), "silence")
            assert "no message has a rate" in rig.problem
            await rig.device.act("wake", {})
            await rig.until_samples(20)
            await act(rig.device, "baud", {"baud": 460800})
            assert (module.baud, module.flash.baud) == (460800, 460800)
            await rig.until_samples(20)
            answer = await rig.device.act("factory_reset", {})
            assert answer == VerbResult(True, "baud is 115200, was 460800", {"baud": 115200})
            assert (module.baud, module.settings) == (115200, ModuleSettings())
            await rig.until_samples(20)
            assert rig.device.status().settings["baud"] == "115200 bit/s"
            assert rig.device.ledger.closes()

    with plugged(tmp_path / "port", module) as path:
        asyncio.run(story(path))


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


@every_variant
@played(lambda variant: Imu61xDevice(STREAMING, behaviour=IMU61X_VARIANTS[variant], uptime_us=20_000_000))
async def test_settings_are_applied_in_an_order_that_keeps_the_connection(bench: Imu61xDevice, variant: str) -> None:
    device = bench.device
    await bench.until(lambda: bench.samples and device.status().settings, 60)
    assert device.status().identity["model_number"] == "614"
    await act(device, "rate", {"rate_hz": 200})
    assert device.status().settings["output_rate_hz"] == "200"
    with pytest.raises(BadArgument, match="rate_hz and baud: expected at most 200 Hz at 115200 baud"):
        await act(device, "rate", {"rate_hz": 400})
    await bench.until_samples()
    applied = await device.settings.apply({"baud": 460800}, save=True)
    assert ("not known whether the device executed" in applied.problem) is (variant == "no K1")
    assert device.status().settings["baud"] == "460800"
    assert bench.line.baud == bench.module.baud == 460800
    await bench.until_samples()
    sample = await device.act("sample_once", {})
    assert isinstance(sample, VerbResult)
    assert sample.result["accel_m_s2"][2] == pytest.approx(9.8, abs=0.1)
    await device.act("restart", {})
    await bench.until_samples()
    await device.act("factory_reset", {})
    assert (bench.line.baud, bench.module.flash) == (115200, Imu61xSettings())
    await bench.until_samples()
    with pytest.raises(BadArgument, match="output_rate_hz and baud: expected at most 200 Hz at 115200 baud"):
        await device.settings.apply({"output_rate_hz": 400}, save=False)
    assert bench.module.settings == Imu61xSettings()
    wanted: dict[str, Any] = {"baud": 460800, "output_rate_hz": 400, "gyro_filter": "10 Hz", "i2c_address": "0x1a"}
    applied = await device.settings.apply(wanted, save=variant != "no K1")
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
    applied = await bench.device.settings.apply({"output_rate_hz": 10}, save=True)
    assert [step.outcome for step in applied.steps] == [StepOutcome.NOT_APPLIED]
    assert "after the write, got 50" in applied.problem
    assert (bench.module.settings, bench.module.flash) == (SLOW, SLOW)
    await bench.until_samples()
