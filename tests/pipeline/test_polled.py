"""A polled device from its bus to the publishers: identified before it is believed, in time, back when it vanished."""

import asyncio
import errno
import os
from collections.abc import Callable, Coroutine
from math import dist, sqrt
from pathlib import Path
from random import Random
from time import monotonic_ns
from typing import Any

import pytest

from imud.config import Config
from imud.daemon import Daemon
from imud.devices.imu61x import i2c as device_i2c
from imud.devices.imu61x.spi import DRIVER
from imud.event import EventKind
from imud.kit.link import LinkType
from imud.kit.polling import Poll, Reading
from imud.kit.status import DeviceState
from imud.links.i2c import I2cLink, I2cSettings
from imud.links.spi import SpiLink, SpiSettings
from imud.sim.imu61x_registers import Imu61xRegisters
from imud.sim.in_process_bus import InProcessI2c, InProcessSpi
from tests.polled import device_config, running

pytestmark = pytest.mark.skipif(
    os.environ.get("IMUD_REALTIME") != "1",
    reason="asks the machine to keep deadlines of a millisecond; IMUD_REALTIME=1 runs it on one that does",
)

RATE_HZ = 250.0


def run(body: Coroutine[Any, Any, None]) -> None:
    asyncio.run(body)


def registers(**more: Any) -> Imu61xRegisters:
    return Imu61xRegisters(monotonic_ns, **more)


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search and silence take less long than in life."""
    monkeypatch.setattr("imud.pipeline.polled.RETRY_S", 0.02)
    monkeypatch.setattr("imud.pipeline.device.RETRY_S", 0.02)
    monkeypatch.setattr("imud.pipeline.polled.SILENCE_NS", 100_000_000)


@pytest.fixture
def node(tmp_path: Path) -> Path:
    """What stands for a bus's node in /dev."""
    node = tmp_path / "spidev0.0"
    node.touch()
    return node


@pytest.fixture
def spi(monkeypatch: pytest.MonkeyPatch) -> InProcessSpi:
    """The SPI bus that the configuration's links open; a device is put on it by `spi.device = …`."""
    bus = InProcessSpi()

    def make(settings: SpiSettings) -> SpiLink:
        return SpiLink(settings, ioctl=bus.ioctl, open_node=bus.open, close_node=bus.close)

    monkeypatch.setattr("imud.links.spi.LINK", LinkType("spi", SpiSettings, make_polled=make))
    return bus


@pytest.fixture
def i2c(monkeypatch: pytest.MonkeyPatch) -> InProcessI2c:
    """The I2C bus that the configuration's links open."""
    bus = InProcessI2c({})

    class Link(I2cLink):
        async def wait_present(self) -> None:
            return

    def make(settings: I2cSettings) -> I2cLink:
        return Link(settings, open_bus=bus.open, ioctl=bus.ioctl)

    monkeypatch.setattr("imud.links.i2c.LINK", LinkType("i2c", I2cSettings, make_polled=make))
    return bus


def on_spi(node: Path, rate_hz: float = RATE_HZ, **options: Any) -> Any:
    return device_config("imu", "imu61x-spi", "spi", {"port": str(node), "rate_hz": rate_hz}, **options)


def on_i2c(name: str = "imu", driver: str = "imu61x-i2c", **more: Any) -> Any:
    return device_config(name, driver, "i2c", {"bus": 1, "rate_hz": RATE_HZ, **more})


@pytest.mark.parametrize(
    ("burst", "resolution_m_s2", "temperature"),
    [("standard", 4e-5, 2e-3), ("extended", 2e-6, 2e-3), ("registers", 4e-8, 1e-3)],
)
def test_spi_samples_are_the_truth_of_the_latched_instant(
    spi: InProcessSpi, node: Path, burst: str, resolution_m_s2: float, temperature: float
) -> None:
    """The resolution of a burst count is 0.2 / 65536 g = 3e-5 m/s², of a register's a thousandth, of f32 1e-6."""
    device = registers(modes=frozenset({3}), update_ns=970_000)  # not in step with the deadlines
    latched: list[int] = []

    def answer(selections: Any, mode: int) -> list[bytes]:
        miso = device.spi(selections, mode)
        is_reading = selections[0][0] in (0x80, 0x0E) and len(selections) != 4
        if is_reading and latched[-1:] != [device.latched_ns]:  # read twice, it is stale and makes no sample
            latched.append(device.latched_ns)
        return miso

    spi.device = answer

    async def body() -> None:
        async with running(on_spi(node, burst=burst, update_hz=1000)) as (rig,):
            await rig.until_samples(60)
            status = rig.runner.status()
            assert status.identity == {"product": "IMU614"}
            assert status.link == f"{node}, mode 3"
            assert status.settings["burst"] == ("extended" if burst == "extended" else "standard")
            assert status.expected_rate_hz == RATE_HZ
        errors = []
        for sample, instant_ns in zip(rig.samples, latched, strict=False):
            truth = device.truth_at(instant_ns)
            assert sample.accel_m_s2 is not None
            assert sample.gyro_rad_s is not None
            assert dist(sample.accel_m_s2, truth.accel_m_s2) < resolution_m_s2
            assert dist(sample.gyro_rad_s, truth.gyro_rad_s) < 1e-6
            assert instant_ns <= sample.t_rx_ns
            errors.append((sample.t_ns - instant_ns) / sample.t_err_ns)
            if burst == "extended":
                assert sample.quat_wxyz == pytest.approx(truth.quat_wxyz, abs=1e-6)
        assert rig.samples[-1].temperature_c == pytest.approx(device.truth_at(monotonic_ns()).temperature_c, abs=0.05)
        assert rig.samples[-1].t_err_ns < 2_000_000
        assert sqrt(sum(error**2 for error in errors) / len(errors)) < 1.1
        assert max(errors) < sqrt(3) * 1.01

    run(body())
    assert device.window == 0
    assert not spi.opened


def test_without_a_known_update_rate_the_error_is_the_time_since_the_last_read(spi: InProcessSpi, node: Path) -> None:
    spi.device = registers().spi

    async def body() -> None:
        async with running(on_spi(node)) as (rig,):
            await rig.until_samples(20)
        for before, sample in zip(rig.samples[5:], rig.samples[6:], strict=False):
            asked_ns = sample.t_rx_ns - sample.t_ns
            assert sample.t_err_ns == pytest.approx((sample.t_ns - before.t_ns + asked_ns) / sqrt(3), rel=0.2, abs=2e5)
            assert sample.t_ns > before.t_ns

    run(body())


def test_one_burst_is_one_ioctl_in_one_selection(spi: InProcessSpi, node: Path) -> None:
    spi.device = registers().spi

    async def body() -> None:
        async with running(on_spi(node)) as (rig,):
            await rig.until_samples(10)

    run(body())
    bursts = [mosi for mosi, _, _ in spi.messages if mosi[0][:1] == b"\x80"]
    assert len(bursts) >= 10
    assert {tuple(map(len, mosi)) for mosi in bursts} == {(32,)}


SPI_FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"line": 0xFF}, "only 0xFF"),
    ({"line": 0x00}, "only 0x00"),
    ({"error": errno.EIO}, "transfer failed"),
    ({"error": errno.ETIMEDOUT}, "held low"),
    ({"flips": 10**6}, "damaged frames"),
]


@pytest.mark.parametrize(("fault", "why"), SPI_FAULTS, ids=[why for _, why in SPI_FAULTS])
def test_vanished_device_is_not_believed_before_it_is_identified(
    spi: InProcessSpi, node: Path, fault: dict[str, Any], why: str
) -> None:
    device = registers()
    spi.device = device.spi

    async def body() -> None:
        async with running(on_spi(node)) as (rig,):
            await rig.until_samples(3)
            for name, value in {**fault, "product_id": b"\x00\x00ICM206"}.items():
                setattr(device.faults, name, value)
            await rig.until(lambda: EventKind.DOWN in rig.kinds, "reported")
            down = next(event for event in rig.events if event.kind is EventKind.DOWN)
            assert why in down.message
            # another device takes its place, whose bursts look right
            device.faults = type(device.faults)(product_id=b"\x00\x00ICM206")
            count, asked = len(rig.samples), device.transactions
            await rig.until(lambda: device.transactions > asked + 1, "asked again")
            assert len(rig.samples) == count
            assert rig.state is DeviceState.SEARCHING
            device.faults = type(device.faults)()
            await rig.until_samples(3)
            assert rig.kinds.count(EventKind.UP) == rig.kinds.count(EventKind.DOWN) + 1
            assert [sample.seq for sample in rig.samples] == list(range(1, len(rig.samples) + 1))

    run(body())


def test_readings_on_their_way_when_it_vanished_are_not_believed(spi: InProcessSpi, node: Path) -> None:
    """The thread may have read more before it hears that the device is gone."""
    device = registers()
    spi.device = device.spi

    async def body() -> None:
        async with running(on_spi(node)) as (rig,):
            await rig.until_samples(3)
            now_ns = monotonic_ns()
            good = DRIVER.example_reading(Random(1))
            gone = [Reading(0, b"\xff" * 32, None, now_ns, now_ns), Reading(0, good, None, now_ns, now_ns)]
            before, count = rig.runner.ledger.bytes_skipped, len(rig.samples)
            rig.runner._take(gone, None)
            rig.runner._take(gone[1:], None)
            assert len(rig.samples) == count
            assert rig.runner.ledger.bytes_skipped == before + 28 + 32 + 32
            await rig.until_samples(3)

    run(body())


def test_single_damage_costs_its_sample_and_nothing_else(spi: InProcessSpi, node: Path) -> None:
    device = registers()
    spi.device = device.spi

    async def body() -> None:
        async with running(on_spi(node)) as (rig,):
            await rig.until_samples(5)
            for number in (1, 2):
                device.faults.flips = 1
                await rig.until(lambda wanted=number: rig.runner.ledger.frames_bad_crc == wanted, "seen")  # type: ignore[misc]  # bound per round
                await rig.until_samples(5)
            assert rig.runner.ledger.lost_crc == 2
            assert EventKind.DOWN not in rig.kinds
            assert EventKind.BAD_FRAME in rig.kinds

    run(body())


def test_restarted_device_is_set_up_again(i2c: InProcessI2c, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its filter is read now and then; here more often than every ten seconds."""
    polls = (Poll(device_i2c.READ_BURST), Poll(device_i2c.READ_ID, 10**7), Poll(device_i2c.READ_FILTER, 10**7))
    monkeypatch.setattr(device_i2c.Imu61xI2cCodec, "polls", polls)
    device = registers()
    i2c.devices[0x1A] = device
    config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 1, "rate_hz": RATE_HZ}, gyro_filter=2)

    async def body() -> None:
        async with running(config) as (rig,):
            await rig.until_samples(3)
            assert device.filter == 0xB2
            device.restart()
            await rig.until(lambda: device.filter == 0xB2, "set up again")
            await rig.until_samples(3)
            assert rig.runner.status().polling.vanished == 1  # type: ignore[union-attr]  # a polled device has it
            assert rig.runner.ledger.frames_in_replies > 2

    run(body())


def test_setting_that_does_not_take_keeps_it_from_running(i2c: InProcessI2c, monkeypatch: pytest.MonkeyPatch) -> None:
    device = registers()
    i2c.devices[0x18] = device

    def deaf(part: bytes | int) -> bool:
        return written(part if isinstance(part, int) else part[:1])

    written = device._written
    monkeypatch.setattr(device, "_written", deaf)
    config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 1}, gyro_filter=2)

    async def body() -> None:
        async with running(config) as (rig,):
            await rig.until(lambda: "read back 0xbb" in rig.runner.status().problem, "told")
            assert rig.state is DeviceState.SEARCHING
            assert not rig.samples

    run(body())


def test_auto_finds_driver_and_address_and_does_not_take_one_twice(i2c: InProcessI2c) -> None:
    i2c.devices.update({0x19: registers(product="IMU612"), 0x1B: registers(product="IMU618")})

    async def body() -> None:
        async with running(on_i2c("a", "auto"), on_i2c("b"), on_i2c("c")) as rigs:

            def settled() -> bool:
                for rig in rigs:
                    rig.runner.tick(monotonic_ns())
                return all(rig.state is DeviceState.RUNNING or rig.runner.status().problem for rig in rigs)

            await rigs[0].until(settled, "settled")
            there = [rig for rig in rigs if rig.state is DeviceState.RUNNING]
            assert {rig.runner.status().link for rig in there} == {
                "/dev/i2c-1, address 0x19", "/dev/i2c-1, address 0x1b"
            }  # fmt: skip
            (left,) = (rig for rig in rigs if rig not in there)
            await left.until(lambda: "another device of this configuration" in left.runner.status().problem, "told")
            assert {rig.runner.status().identity["product"] for rig in there} == {"IMU612", "IMU618"}

    run(body())


def test_vanished_device_does_not_hold_up_the_others(i2c: InProcessI2c) -> None:
    there, gone = registers(), registers()
    i2c.devices.update({0x18: there, 0x19: gone})
    gone.faults.error = errno.ENXIO

    async def body() -> None:
        async with running(on_i2c("there", address=0x18), on_i2c("gone", address=0x19)) as (good, bad):
            await good.until_samples(100)
            polling = good.runner.status().polling
            assert polling is not None
            assert polling.missed <= 2
            assert bad.state is DeviceState.SEARCHING
            assert "no acknowledgement at address 0x19" in bad.runner.status().problem
            gone.faults.error = 0
            await bad.until_samples(3)

    run(body())


def test_repeated_values_are_stale_and_then_silence(i2c: InProcessI2c) -> None:
    device = registers()
    i2c.devices[0x18] = device

    async def body() -> None:
        async with running(on_i2c()) as (rig,):
            await rig.until_samples(3)
            device.faults.frozen = True
            await rig.until(lambda: rig.state is DeviceState.SILENT, "silent")
            polling, ledger = rig.runner.status().polling, rig.runner.ledger
            assert polling is not None
            assert polling.stale == ledger.frames_ignored > 10
            assert ledger.lost() == ledger.lost_queue
            device.faults.frozen = False
            await rig.until_samples(3)

    run(body())


def test_device_slower_than_its_polls_gives_each_value_once(spi: InProcessSpi, node: Path) -> None:
    device = registers(update_ns=10_000_000)
    spi.device = device.spi

    async def body() -> None:
        async with running(on_spi(node, rate_hz=500)) as (rig,):
            await rig.until_samples(20)
        values = [sample.accel_m_s2 for sample in rig.samples]
        assert len(set(values)) == len(values)
        polling = rig.runner.status().polling
        assert polling is not None
        assert polling.stale > 2 * len(values)
        steps = [b.t_ns - a.t_ns for a, b in zip(rig.samples[5:], rig.samples[6:], strict=False)]
        assert sum(steps) / len(steps) == pytest.approx(1e7, rel=0.1)

    run(body())


def test_missing_bus_is_waited_for_and_lost_again(spi: InProcessSpi, node: Path) -> None:
    spi.device = registers().spi
    plug, unplug = node.touch, node.unlink
    unplug()

    async def body() -> None:
        async with running(on_spi(node)) as (rig,):
            await asyncio.sleep(0)
            assert rig.state is DeviceState.MISSING
            plug()
            await rig.until_samples(3)
            unplug()
            device = registers()
            device.faults.error = errno.ENODEV
            spi.device = device.spi
            await rig.until(lambda: rig.state is DeviceState.MISSING, "missing")
            assert EventKind.DOWN in rig.kinds
            device.faults.error = 0
            plug()
            await rig.until_samples(3)
            assert rig.runner.status().connects == 2

    run(body())


def test_bus_that_may_not_be_opened_fails_with_the_reason(spi: InProcessSpi, node: Path) -> None:
    spi.open_error = errno.EBUSY

    async def body() -> None:
        async with running(on_spi(node)) as (rig,):
            await rig.until(lambda: rig.state is DeviceState.FAILED, "failed")
            assert "in use" in rig.runner.status().problem
            spi.open_error = 0
            spi.device = registers().spi
            await rig.until_samples(1)

    run(body())


def test_slow_transfers_miss_deadlines_which_are_lost_samples(spi: InProcessSpi, node: Path) -> None:
    device = registers()

    def slow(selections: Any, mode: int) -> list[bytes]:
        end_ns = monotonic_ns() + 5_000_000
        while monotonic_ns() < end_ns:
            pass
        return device.spi(selections, mode)

    spi.device = slow

    async def body() -> None:
        async with running(on_spi(node, rate_hz=1000)) as (rig,):
            await rig.until_samples(10)
            await rig.until(lambda: EventKind.LOSS in rig.kinds, "told")
            polling = rig.runner.status().polling
            assert polling is not None
            assert polling.missed >= 3 * len(rig.samples)
            assert rig.runner.ledger.lost_queue >= 30

    run(body())


def wait_until_running(daemon: Daemon, then: Callable[[], None]) -> Coroutine[Any, Any, None]:
    async def watch() -> None:
        while sum(device.ledger["samples"] for device in daemon.status()) < 5:
            await asyncio.sleep(0.005)
        then()

    return watch()


def test_daemon_serves_a_polled_device(spi: InProcessSpi, node: Path) -> None:
    spi.device = registers().spi

    async def body() -> None:
        daemon = Daemon(Config("info", "", {}, (on_spi(node),)))
        watching = asyncio.create_task(wait_until_running(daemon, daemon.stop))
        await asyncio.wait_for(daemon.run(), 10)
        await watching
        assert daemon.status()[0].driver == "imu61x-spi"

    run(body())
    assert not spi.opened


def test_mistake_in_the_bus_thread_ends_the_daemon(
    spi: InProcessSpi, node: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def mistake(_selections: Any, _mode: int) -> list[bytes]:
        raise ZeroDivisionError("a mistake")

    spi.device = mistake

    async def body() -> None:
        await asyncio.wait_for(Daemon(Config("info", "", {}, (on_spi(node),))).run(), 10)

    with pytest.raises(ZeroDivisionError, match="a mistake"):
        run(body())
