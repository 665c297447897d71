"""Devices with a reset line: imud resets a device that it cannot find, or on request."""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.command import VerbResult
from imud.contracts.lines import DeviceLines, Edge, ResetOptions, SoutOptions, TriggerOptions, TriggerStamp
from imud.contracts.status import DeviceState
from imud.drivers.imu61x.uart.codec import encode_ahrs
from imud.drivers.imu61x.uart.driver import DRIVER
from imud.lines.sync import SyncSignals
from imud.links.memory import MemoryOptions
from imud.model.errors import BadArgument, CommandError
from imud.model.event import EventKind
from imud.model.sample import Measurement, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.driver_clock import make_clock
from imud.sim.ports.pins import MemoryLines, MemoryOutput
from tests.support.device_rig import DeviceRig, DeviceRigs
from tests.support.event_loops import VirtualClock, in_loop, run_virtually
from tests.support.polled_bus_bench import PolledBusBench
from tests.support.stories import in_bench, played

LINES = DeviceLines(reset=ResetOptions(line="R"))
BOOT_S = 2.9  # Start-up time of the device, a little shorter than in the manual


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PolledBusBench:
    return PolledBusBench(tmp_path, monkeypatch, VirtualClock())


def reset_line(lines: MemoryLines, now_ns: Callable[[], int], boot: Callable[[], None]) -> MemoryOutput:
    """Reset line of a device that boots after each pulse."""

    def changed(_t_ns: int, active: bool) -> None:
        if not active:
            asyncio.get_running_loop().call_later(BOOT_S, boot)

    line = lines.outputs["imu reset"] = MemoryOutput("imu reset", now_ns=now_ns, on_change=changed)
    return line


class Scene:
    """A polled device that hangs, and its reset line."""

    rig: DeviceRig

    def __init__(self, bench: PolledBusBench) -> None:
        self.line = reset_line(bench.lines, bench.clock.now_ns, self.boot)
        self.device = bench.registers()
        self.dead = False  # whether the device ignores the reset
        bench.spi.device = self.device.spi

    def hang(self) -> None:
        self.device.faults.line = 0xFF

    def boot(self) -> None:
        if self.dead:
            return
        self.device.restart()
        self.device.faults.line = None

    async def search(self, times: int) -> None:
        due = self.device.transactions + times
        await self.rig.until(lambda: self.device.transactions >= due, "the search")

    @property
    def pulses(self) -> int:
        return sum(active for _, active in self.line.history)

    @property
    def told(self) -> list[str]:
        return [event.message for event in self.rig.events if event.detail.get("line") == "reset"]


@asynccontextmanager
async def polled(bench: PolledBusBench, **more: Any) -> AsyncIterator[Scene]:
    config = replace(
        bench.on_spi(burst="extended", gyro_filter=2), lines=DeviceLines(reset=ResetOptions(line="R", **more))
    )
    scene = Scene(bench)
    async with bench.running(config) as (scene.rig,):
        yield scene


@in_bench
async def test_a_device_that_hangs_is_reset_and_set_up_again(bench: PolledBusBench) -> None:
    async with polled(bench) as it:
        await it.rig.until_samples(5)
        it.hang()
        down_ns = bench.clock.now_ns()
        await it.rig.until(lambda: EventKind.DOWN in it.rig.kinds, "down")
        await it.rig.until_samples(5, 20)
        assert it.pulses == 1
        (up_ns, _), (released_ns, _) = it.line.history
        assert 4.4e9 < up_ns - down_ns < 5.1e9
        assert released_ns - up_ns == pytest.approx(10e6, abs=10)
        assert it.told == ["not found for 4 s: restarted by its reset line"]
        assert it.rig.kinds.count(EventKind.UP) == 2
        assert (it.device.extended, it.device.filter & 0x0F) == (1, 2)
        assert bench.clock.now_ns() - up_ns < 4e9


@in_bench
async def test_search_rounds_before_the_newest_sample_cause_no_reset_of_the_open_line(bench: PolledBusBench) -> None:
    async with polled(bench) as it:
        for _ in range(3):
            await it.rig.until_samples(5, 20)
            it.hang()
            await it.rig.until(lambda: it.rig.state is DeviceState.SEARCHING, "left")
            await it.search(4)
            it.boot()
        assert (it.pulses, it.line.is_open) == (0, True)
        status = it.rig.device.status()
        assert status.lines is not None
        assert status.lines.problems == {}
    assert not it.line.is_open
    it.rig.device.tick(bench.clock.now_ns())
    assert not it.line.is_open
    assert it.line.history == []


@in_bench
async def test_no_request_during_a_reset_and_for_3_s(bench: PolledBusBench) -> None:
    async with polled(bench, hold_ms=500) as it:
        await it.rig.until_samples(5)
        begin_ns = bench.clock.now_ns()
        task = asyncio.create_task(it.rig.device.act("reset", {}))
        await it.rig.until(lambda: it.line.active, "active")
        await it.rig.until(lambda: it.rig.state is DeviceState.SEARCHING, "left")
        asked = it.device.transactions
        samples = len(it.rig.samples)
        await it.rig.until(lambda: not it.line.active, "released")
        await it.rig.until(lambda: bench.clock.now_ns() > begin_ns + 3.4e9, "almost over")
        assert it.device.transactions - asked <= 1  # the transfer in progress
        await it.rig.until(task.done, "over")
        result = await task
        assert isinstance(result, VerbResult)
        assert (result.verified, result.evidence) == (False, "the device has no counter that shows a restart")
        await it.rig.until_samples(5)
        assert len(it.rig.samples) > samples
        assert it.pulses == 1
        assert [e.message for e in it.rig.events if e.kind is EventKind.DOWN] == ["reset by its line"]


@in_bench
async def test_reset_needs_a_line_but_no_device(bench: PolledBusBench) -> None:
    async with bench.running(bench.on_spi()) as (rig,):
        assert "reset" not in rig.device.verbs
        with pytest.raises(BadArgument, match="unknown command 'reset'"):
            await rig.device.act("reset", {})
    async with polled(bench) as it:
        assert "trigger" not in it.rig.device.verbs  # it has lines, but no SIN line
        it.hang()
        await it.rig.until(lambda: "received only 0xFF" in it.rig.device.status().problem, "searching")
        with pytest.raises(BadArgument, match="hard"):
            await it.rig.device.act("reset", {"hard": True})
        await it.rig.until(lambda: it.line.is_open, "open")
        found = await it.rig.device.act("reset", {})
        assert found == VerbResult(False, "the device sends no samples that show a restart")
        assert it.pulses == 1
        await it.rig.until_samples(5)
        assert it.told == []


def frame(timer_us: int) -> bytes:
    zero = (0.0, 0.0, 0.0)
    return encode_ahrs(timer_us=timer_us, accel_m_s2=(0, 0, 9.8), gyro_rad_s=zero, euler_rad=zero, temperature_c=25)


class Uart:
    """Reset line of a device that sends nothing before a reset."""

    def __init__(self, lines: DeviceLines, **link: Any) -> None:
        clock = self.clock = VirtualClock()
        self.wires = MemoryLines(clock.now_ns)
        reset_line(self.wires, clock.now_ns, self._boot)
        self.rigs = DeviceRigs(clock.host, lines=self.wires.maker)
        config = DeviceConfig("imu", "imu61x-uart", None, False, "memory", MemoryOptions(**link), lines=lines)
        self.rig = self.rigs.add(config)
        self.device, self.link, self.events = self.rig.device, self.rig.link, self.rig.events
        self.streams = False

    async def until(self, condition: Callable[[], object], limit_s: float = 100) -> None:
        await self.rig.until(condition, limit_s=limit_s, step=self._send, step_s=0.01)

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        async def whole() -> None:
            async with self.rigs.at_work():
                await story()

        run_virtually(self.clock, whole())

    def _boot(self) -> None:
        self.streams = True

    def _send(self) -> None:
        if self.streams and self.link.baud == 115200:
            self.link.feed(frame(self.clock.now_ns() // 1000), self.clock.now_ns())


@pytest.mark.parametrize("baud", [115200, "auto"])
@played(lambda baud: Uart(LINES, baud=baud))
async def test_a_device_without_bytes_on_a_uart_is_reset(it: Uart, baud: Any) -> None:
    await it.until(lambda: it.device.state is DeviceState.RUNNING and it.clock.now_ns() > 1015e9)
    assert [active for _, active in it.wires.outputs["imu reset"].history] == [True, False]
    assert sum(e.message.endswith("restarted by its reset line") for e in it.events) == 1
    it.streams = False
    await it.until(lambda: it.device.state is DeviceState.SILENT)
    it.streams = True
    await it.until(lambda: it.device.state is DeviceState.RUNNING)
    assert len(it.wires.outputs["imu reset"].history) == 2


@played(lambda: Uart(LINES, baud=115200))
async def test_a_device_with_bytes_on_a_uart_is_not_reset(it: Uart) -> None:
    for _ in range(60):
        next_ns = it.clock.now_ns() + 1_000_000_000
        await it.until(partial(lambda until_ns: it.clock.now_ns() > until_ns, next_ns))
        it.link.feed(b"noise", it.clock.now_ns())
    assert it.wires.outputs["imu reset"].history == []


@in_loop
async def test_the_trigger_action_needs_a_sin_line(monkeypatch: pytest.MonkeyPatch) -> None:
    it = Uart(DeviceLines(sin=TriggerOptions(line="S")), baud=115200)
    assert list(it.device.verbs) == ["trigger"]
    once: list[str] = []
    monkeypatch.setattr(SyncSignals, "trigger_once", lambda _self: once.append("edge"))
    found = await it.device.act("trigger", {})
    assert found == VerbResult(False, "no sample arrived; check the output of the device", failed=True)
    assert once == ["edge"]
    monkeypatch.undo()
    with pytest.raises(CommandError, match="trigger"):
        await it.device.act("trigger", {})


def test_the_clock_gets_the_position_of_the_measurement_in_the_pulse() -> None:
    lines = DeviceLines(
        sout=SoutOptions(line="O", offset_us=-7, bias_us=2, width_us=90), sin=TriggerOptions(line="I", offset_us=9)
    )
    by_sout, by_sin = (make_clock("imu", lines, DRIVER, None) for _ in range(2))
    for i in range(200):
        at_ns = NS_PER_S + i * 10 * NS_PER_MS
        by_sout.add_edges("sout", [Edge(at_ns + 90_000, False, 2 * i + 2)])  # imud computes the rising edge
        by_sin.add_triggers([TriggerStamp(at_ns, 0, i + 1)])
        m, t_rx_ns = Measurement(82, 0, 10_000 * i), at_ns + NS_PER_MS
        sample, answer = by_sout.sample(m, t_rx_ns, 0), by_sin.sample(m, t_rx_ns, 0)
    assert (sample.sync, sample.t_ns - at_ns) == (Sync.EDGE, -7_000)
    assert sample.t_err_ns < 10_000  # at least 26 us with the default of bias_us
    assert (answer.sync, answer.t_ns - at_ns) == (Sync.EDGE, 9_000)


@in_bench
async def test_at_start_a_device_on_a_bus_is_reset_before_the_first_request(bench: PolledBusBench) -> None:
    async with polled(bench, at_start=True) as it:
        await it.rig.until(lambda: it.pulses == 1, "the pulse")
        assert it.device.transactions == 0
        pulsed_ns = bench.clock.now_ns()
        await it.rig.until(lambda: it.device.transactions, "the first question", 10)
        assert 3e9 <= bench.clock.now_ns() - pulsed_ns < 3.2e9
        await it.rig.until_samples(5)
        it.hang()
        await it.rig.until(lambda: EventKind.DOWN in it.rig.kinds, "down")
        it.boot()
        await it.rig.until_samples(5)
        assert (it.pulses, it.told) == (1, ["restarted by its reset line at the start"])


@played(lambda: Uart(DeviceLines(reset=ResetOptions(line="R", at_start=True)), baud=115200))
async def test_at_start_a_device_on_a_uart_is_reset(it: Uart) -> None:
    begin_ns = it.clock.now_ns()
    await it.until(lambda: len(it.rig.samples) > 10)
    assert it.clock.now_ns() - begin_ns < 5e9  # without at_start: after a search of more than 4 s
    assert [e.message for e in it.events if e.detail.get("line") == "reset"] == [
        "restarted by its reset line at the start"
    ]
