"""GPIO lines of the IMU61x on gpio-sim: the reset seen by an independent reader, and each data-ready edge."""

import asyncio
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from math import dist
from pathlib import Path
from time import monotonic_ns
from typing import Any

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.lines import DeviceLines, LineFactory, OutputOptions, ReadyOptions, ResetOptions
from imud.lines.gpio import GpioInput, GpioOutput
from imud.model.event import EventKind
from imud.model.sample import Sample, Sync
from imud.sim.imu61x.registers import Imu61xRegisters
from tests.lab.bus import Bus
from tests.lab.gpio_chip import GpioChip
from tests.lab.imu61x_bus import LIMIT_S, on_i2c, on_spi, registers
from tests.lab.tool import running as tool_running
from tests.lab.wire import I2cTransfer
from tests.support.daemon_process import LIMIT_S as TASK_LIMIT_S
from tests.support.daemon_process import wait_until
from tests.support.device_rig import DeviceRig, device_config, running

INTERRUPTS = Path("/proc/interrupts")
HOLD_MS, WAIT_S = 50.0, 1.0
STEP_NS = 50_000_000
EDGES = 20
RESOLUTION_M_S2 = 1e-3
FALLBACK_HZ = 10.0


class WiredReset(GpioOutput):
    def __init__(self, chip: GpioChip, boot: Callable[[], None], settings: OutputOptions, purpose: str) -> None:
        super().__init__(settings, purpose)
        self._chip, self._boot = chip, boot

    def set(self, active: bool) -> None:
        super().set(active)
        level = self._chip.level("RESET")
        self._chip.drive("PPS", level)
        if level:
            self._boot()


async def test_a_device_that_hangs_is_reset_by_its_line(i2c: Bus[I2cTransfer], gpio_chip: GpioChip) -> None:
    device = registers()
    i2c.attach(0x18, on_i2c(device))
    config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 0, "rate_hz": 20}, gyro_filter=3)
    settings = ResetOptions(line="RESET", hold_ms=HOLD_MS, wait_s=WAIT_S)
    gpio_chip.drive("PPS", True)

    def boot() -> None:
        device.restart()
        device.faults = type(device.faults)()

    maker = LineFactory(GpioInput, partial(WiredReset, gpio_chip, boot))

    command = (
        "gpiomon", "--line-buffered", "--format=%e %s %n", gpio_chip.path.name, str(gpio_chip.names.index("PPS")),
    )  # fmt: skip
    with tool_running(*command) as monitor:
        assert monitor.stdout is not None
        wait_until(lambda: "gpiomon" in INTERRUPTS.read_text(encoding="ascii"), "gpiomon has its interrupt")
        seen = ((kind == "1", int(s) * 10**9 + int(n)) for kind, s, n in map(str.split, monitor.stdout))
        async with running(replace(config, lines=DeviceLines(reset=settings)), lines=maker) as (rig,):
            await rig.until_samples(3, LIMIT_S)
            assert gpio_chip.level("RESET"), "held inactive, which is high"
            device.faults.line = 0xFF
            await rig.until(lambda: rig.kinds.count(EventKind.UP) == 2, "back", LIMIT_S)
            await rig.until_samples(3, LIMIT_S)
            assert device.filter == 0xB3, "set up again"
            told = [event.t_ns for event in rig.events if "restarted by its reset line" in event.message]
            (down, fall_ns), (up, rise_ns) = [await asyncio.to_thread(seen.__next__) for _ in range(2)]
            assert (down, up) == (False, True)
            assert HOLD_MS * 1e6 < rise_ns - fall_ns < HOLD_MS * 1e6 + 1e9
            assert 0 < fall_ns - told[0] < 1e9
            back_ns = next(event.t_ns for event in reversed(rig.events) if event.kind is EventKind.UP)
            assert back_ns - rise_ns > WAIT_S * 1e9
            assert len(told) == 1


class Stepped:
    def __init__(self, chip: GpioChip, **more: Any) -> None:
        self._chip = chip
        self.t_ns = STEP_NS
        self._lock = threading.Lock()
        self.device = Imu61xRegisters(self._now_ns, update_ns=1, **more)
        self.stamps_ns: list[tuple[int, int]] = []

    def renew(self) -> None:
        self._chip.drive("SOUT", False)
        with self._lock:
            self.t_ns += STEP_NS
            before_ns = monotonic_ns()
            self._chip.drive("SOUT", True)
        self.stamps_ns.append((before_ns, monotonic_ns()))

    def has(self, sample: Sample) -> None:
        assert sample.edge_seq is not None
        assert sample.sync is Sync.EDGE
        before_ns, after_ns = self.stamps_ns[sample.edge_seq - 1]
        assert before_ns <= sample.t_ns <= after_ns
        assert sample.accel_m_s2 is not None
        truth = self.device.truth_at(self.device.epoch_ns + sample.edge_seq * STEP_NS)
        assert dist(sample.accel_m_s2, truth.accel_m_s2) < RESOLUTION_M_S2

    def has_within_error(self, sample: Sample) -> None:
        assert sample.edge_seq is not None
        assert sample.accel_m_s2 is not None
        truths = [self.device.truth_at(self.device.epoch_ns + n * STEP_NS) for n in range(1, len(self.stamps_ns) + 1)]
        numbers = [
            n for n, truth in enumerate(truths, 1) if dist(sample.accel_m_s2, truth.accel_m_s2) < RESOLUTION_M_S2
        ]
        assert len(numbers) == 1
        assert numbers[0] >= sample.edge_seq
        assert self.stamps_ns[numbers[0] - 1][0] - sample.t_ns <= 2 * sample.t_err_ns

    def _now_ns(self) -> int:
        with self._lock:
            return self.t_ns


@pytest.fixture(params=["i2c", "spi8"])
def stepped(request: pytest.FixtureRequest, gpio_chip: GpioChip) -> tuple[Stepped, DeviceConfig]:
    far = request.getfixturevalue(request.param)
    it = Stepped(gpio_chip)
    if request.param == "i2c":
        far.attach(0x18, on_i2c(it.device))
        config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 0, "rate_hz": FALLBACK_HZ})
    else:
        far.attach(0, on_spi(it.device))
        link = {"port": "/dev/spidev0.0", "rate_hz": FALLBACK_HZ, "speed_hz": 500_000}
        config = device_config("imu", "imu61x-spi", "spi", link, burst="standard")
    return it, replace(config, lines=DeviceLines(data_ready=ReadyOptions(line="SOUT")))


async def first(rig: DeviceRig) -> None:
    await rig.until(lambda: rig.samples, "the first", LIMIT_S)
    assert rig.samples[0].sync is Sync.ARRIVAL


async def test_every_edge_is_one_sample(stepped: tuple[Stepped, DeviceConfig]) -> None:
    it, config = stepped
    async with running(config) as (rig,):
        await first(rig)
        for number in range(1, EDGES + 1):
            it.renew()
            await rig.until(lambda number=number: len(rig.samples) > number, "its sample", LIMIT_S)  # type: ignore[misc]  # binds it
        assert [sample.edge_seq for sample in rig.samples[1:]] == list(range(1, EDGES + 1))
        for sample in rig.samples[1:]:
            it.has(sample)
        assert rig.device.ledger.lost_queue == 0
        polling = rig.device.status().polling
        assert polling is not None
        mean_us, worst_us = polling.late_mean_ns / 1e3, polling.late_worst_ns / 1e3
        print(f"edge to read: {mean_us:.0f} us on average, {worst_us:.0f} us at worst")


async def test_edges_that_come_faster_than_reads_are_missed_and_counted(stepped: tuple[Stepped, DeviceConfig]) -> None:
    """Ten updates without a pause: a read is active during some updates, and other updates have no read."""
    it, config = stepped
    async with running(config) as (rig,):
        await first(rig)
        it.renew()
        await rig.until(lambda: len(rig.samples) == 2, "the first edge", LIMIT_S)
        seen = rig.device.status().lines
        assert seen is not None
        for _ in range(5):
            for _ in range(10):
                it.renew()
            count = len(rig.samples)
            await rig.until(lambda count=count: len(rig.samples) > count, "its sample", LIMIT_S)  # type: ignore[misc]  # binds it
        numbers = [sample.edge_seq or 0 for sample in rig.samples[1:]]
        for sample in rig.samples[1:]:
            it.has_within_error(sample)
        missed = sum(b - a - 1 for a, b in pairwise(numbers))
        assert missed > 0
        rig.device.tick(monotonic_ns())
        polling = rig.device.status().polling
        assert polling is not None
        # a read before the edge makes the value stale at its edge
        lost, stale = rig.device.ledger.lost_queue, polling.stale
        assert 0 < lost <= missed <= lost + stale
        assert numbers[-1] <= len(it.stamps_ns) <= numbers[-1] + stale


async def test_edges_stop_and_come_back(stepped: tuple[Stepped, DeviceConfig]) -> None:
    it, config = stepped
    async with running(config) as (rig,):
        await first(rig)
        await rig.until(lambda: any("no edges" in event.message for event in rig.events), "told", LIMIT_S)
        it.t_ns += STEP_NS
        await rig.until(lambda: len(rig.samples) == 2, "by a deadline", LIMIT_S)
        assert rig.samples[1].sync is Sync.ARRIVAL
        it.t_ns -= STEP_NS
        end_ns = monotonic_ns() + round(TASK_LIMIT_S * 1e9)
        while not any("edges have returned" in event.message for event in rig.events):
            assert monotonic_ns() < end_ns
            it.renew()
            await asyncio.sleep(0.05)
            rig.device.tick(monotonic_ns())
        await rig.until(lambda: rig.samples[-1].edge_seq == len(it.stamps_ns), "the newest", LIMIT_S)
        it.has(rig.samples[-1])
