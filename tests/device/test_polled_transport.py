"""A polled device from its bus to the outputs: identification, deadlines, return after an absence.
With a data-ready line: reads and time stamps at its edges, at deadlines without edges."""

import asyncio
import errno
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from itertools import pairwise
from math import asin, atan2, dist, hypot, pi, radians, sqrt
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from imud.attitude.conventions import AttitudeSource, Convention
from imud.attitude.rotation import matrix_from_quat, quat_from_euler_zyx
from imud.bridges.status import axes as device_axes
from imud.config.model import DeviceConfig
from imud.contracts.codec import Poll, Reading
from imud.contracts.lines import DeviceLines, LineFactory, OnEdges, OnLineEnd, ReadyOptions
from imud.contracts.status import DeviceState
from imud.device.latency import Need
from imud.device.polled_transport import DataReady
from imud.device.timetable import Deadlines, ReadySchedule
from imud.drivers.imu61x import spi as codec
from imud.drivers.imu61x.spi import READ_STATE
from imud.host.clock import HostClock
from imud.model.errors import CommandError, LinkMissing, TransferError, Trouble
from imud.model.event import EventKind
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_S
from imud.sampling.path import PolledPath
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.imu61x.uart import REGISTER_VARIANTS
from imud.sim.physics import Sine, Swing
from imud.sim.ports.pins import MemoryInput, MemoryOutput
from tests.support.device_rig import DeviceRig, device_config
from tests.support.event_loops import VirtualClock, in_loop
from tests.support.old_spellings import act
from tests.support.polled_bus_bench import RATE_HZ, PolledBusBench, on_i2c
from tests.support.stories import in_bench


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PolledBusBench:
    return PolledBusBench(tmp_path, monkeypatch, VirtualClock())


@pytest.mark.parametrize(
    ("burst", "resolution_m_s2", "temperature"),
    [("standard", 4e-5, 2e-3), ("extended", 2e-6, 2e-3), ("registers", 4e-8, 1e-3)],
)
@in_bench
async def test_spi_samples_have_the_values_of_their_time_stamp(
    bench: PolledBusBench, burst: str, resolution_m_s2: float, temperature: float
) -> None:
    """Resolution of a burst: 0.2 / 65536 g = 3e-5 m/s²; of a register: a thousandth; of f32: 1e-6."""
    device = bench.registers(modes=frozenset({3}), update_ns=970_000)  # not synchronous with the deadlines
    latched: list[int] = []

    def answer(selections: Any, mode: int) -> list[bytes]:
        miso = device.spi(selections, mode)
        is_reading = selections[0][0] in (0x80, 0x0E) and len(selections) != 4
        if is_reading and latched[-1:] != [
            device.latched_ns
        ]:  # a second read of the same values is stale and makes no sample
            latched.append(device.latched_ns)
        return miso

    bench.spi.device = answer
    async with bench.running(bench.on_spi(burst=burst, update_hz=1000)) as (rig,):
        await rig.until_samples(60)
        status = rig.device.status()
        assert (status.identity, status.link) == ({"product": "IMU614"}, f"{bench.node}, mode 3")
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
    assert rig.samples[-1].temperature_c == pytest.approx(device.truth_at(bench.clock.now_ns()).temperature_c, abs=0.05)
    assert rig.samples[-1].t_err_ns < 2_000_000
    assert sqrt(sum(error**2 for error in errors) / len(errors)) < 1.1
    assert max(errors) < sqrt(3) * 1.01
    assert device.window == 0
    assert not bench.spi.opened


def with_attitude(config: DeviceConfig) -> DeviceConfig:
    return replace(config, attitude=AttitudeSource.HOST, convention=Convention.NED_FRD)


@pytest.mark.parametrize("bus", ["spi standard", "spi registers", "i2c"])
@in_bench
async def test_the_host_computes_the_attitude_of_raw_samples(bench: PolledBusBench, bus: str) -> None:
    """The force gives roll and pitch. The published axes are level with z down, and FRD: pitch has the other sign."""
    rest = Swing(roll=(Sine(0.3, 0.0, pi / 2), Sine(1e-4, 1.7)), pitch=(Sine(-0.2, 0.0, pi / 2),))  # never stale
    device = bench.registers(motion=rest)
    x, y, z = device.truth_at(bench.clock.now_ns()).accel_m_s2
    expected = (atan2(y, z), asin(x / hypot(x, y, z)), 0)
    if bus == "i2c":
        bench.i2c.devices[0x18], config = device, on_i2c(address=0x18)
    else:
        bench.spi.device, config = device.spi, bench.on_spi(burst=bus.split()[1])
    async with bench.running(with_attitude(config)) as (rig,):
        await rig.until_samples(1600)
        status = rig.device.status()
        assert status.frame is not None
        assert (status.frame.attitude, status.frame.heading, status.frame.problem) == ("host", "relative", "")
        assert status.status_bit_names["30"] == "attitude filter of the host has not settled"
        assert device_axes(status.frame).endswith("imud computes the attitude on the host")
    first, last = rig.samples[0], rig.samples[-1]
    assert (first.status, last.status) == (1 << 30, None)
    assert last.euler_rad is not None
    assert last.euler_rad == pytest.approx(expected, abs=2e-3)
    assert last.quat_wxyz == pytest.approx(quat_from_euler_zyx(last.euler_rad), abs=1e-9)
    assert [dict(event.detail) for event in rig.events if event.kind is EventKind.ALARM] == [
        {"attitude filter of the host has not settled": True}, {"attitude filter of the host has not settled": False},
    ]  # fmt: skip


@in_bench
async def test_the_attitude_of_the_host_follows_the_motion(bench: PolledBusBench) -> None:
    device = bench.registers(update_ns=100_000)
    bench.spi.device = device.spi
    async with bench.running(replace(bench.on_spi(), attitude=AttitudeSource.HOST)) as (rig,):
        await rig.until_samples(1500)
        status = rig.device.status()
    assert status.navigation_frame == "level, Z up; X where the yaw was 0 at the start of the filter on the host"
    assert status.frame is not None
    assert status.frame.heading == "relative"
    errors = []
    for sample in rig.samples[500:]:
        up = matrix_from_quat(sample.quat_wxyz or (0, 0, 0, 0))[2]
        true_up = matrix_from_quat(device.truth_at(sample.t_ns).quat_wxyz)[2]
        errors.append(dist(up, true_up))
    assert max(errors) < radians(1.5)


@pytest.mark.parametrize("options", [{}, {"update_hz": 100}], ids=["unknown", "slower than the reads"])
@in_bench
async def test_without_a_known_update_rate_the_error_is_the_time_since_the_last_read(
    bench: PolledBusBench, options: dict[str, Any]
) -> None:
    bench.spi.device = bench.registers().spi
    async with bench.running(bench.on_spi(**options)) as (rig,):
        await rig.until_samples(20)
    bursts = [mosi for mosi, _, _ in bench.spi.messages if mosi[0][:1] == b"\x80"]
    assert len(bursts) >= 20
    assert {tuple(map(len, mosi)) for mosi in bursts} == {(32,)}  # each transfer is one ioctl with one selection
    for before, sample in zip(rig.samples[5:], rig.samples[6:], strict=False):
        asked_ns = sample.t_rx_ns - sample.t_ns
        assert sample.t_err_ns == int(1 / sqrt(3) * (sample.t_ns - before.t_ns + asked_ns)) + 1
        assert sample.t_ns > before.t_ns


SPI_FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"line": 0xFF}, "received only 0xFF"), ({"line": 0x00}, "received only 0x00"),
    ({"error": errno.EIO}, "transfer failed"), ({"error": errno.ETIMEDOUT}, "held low"),
    ({"flips": 10**6}, "damaged frames"),
]  # fmt: skip


@pytest.mark.parametrize(("fault", "why"), SPI_FAULTS, ids=[why for _, why in SPI_FAULTS])
@in_bench
async def test_readings_after_an_absence_need_an_identification(
    bench: PolledBusBench, fault: dict[str, Any], why: str
) -> None:
    device = bench.registers()
    bench.spi.device = device.spi
    async with bench.running(bench.on_spi()) as (rig,):
        await rig.until_samples(3)
        for name, value in {**fault, "product_id": b"\x00\x00ICM206"}.items():
            setattr(device.faults, name, value)
        await rig.until(lambda: EventKind.DOWN in rig.kinds, "reported")
        assert why in next(event for event in rig.events if event.kind is EventKind.DOWN).message
        # another device with valid bursts replaces the first device
        device.faults = type(device.faults)(product_id=b"\x00\x00ICM206")
        count, asked = len(rig.samples), device.transactions
        await rig.until(lambda: device.transactions > asked + 1, "asked again")
        assert len(rig.samples) == count
        assert rig.state is DeviceState.SEARCHING
        device.faults = type(device.faults)()
        await rig.until_samples(3)
        assert rig.kinds.count(EventKind.UP) == rig.kinds.count(EventKind.DOWN) + 1
        assert [sample.seq for sample in rig.samples] == list(range(1, len(rig.samples) + 1))


@in_bench
async def test_pending_readings_of_a_missing_device_are_not_decoded(bench: PolledBusBench) -> None:
    """The thread of a busy bus makes further readings before the loop detects the missing device."""
    device = bench.registers()
    armed, gone_ns, good_after = False, 0, 0

    def answer(selections: Any, mode: int) -> list[bytes]:
        nonlocal gone_ns, good_after
        bench.clock.advance(2_000_000)
        miso = device.spi(selections, mode)
        if not armed or selections[0][:1] != b"\x80":
            return miso
        if gone_ns:
            good_after += 1
            return miso
        gone_ns = bench.clock.now_ns()
        return [b"\xff" * 32]

    bench.spi.device = answer
    async with bench.running(bench.on_spi(rate_hz=1000)) as (rig,):
        await rig.until_samples(20)
        before, armed = rig.ledger.bytes_skipped, True
        await rig.until(lambda: EventKind.DOWN in rig.kinds, "down")
        assert max(sample.t_rx_ns for sample in rig.samples) < gone_ns
        assert good_after > 1
        armed = False
        await rig.until(lambda: rig.ledger.bytes_skipped == before + 28 + 32 * good_after, "all counted", 1)
        await rig.until_samples(3)


@in_bench
async def test_one_damaged_reading_loses_one_sample(bench: PolledBusBench) -> None:
    device = bench.registers()
    bench.spi.device = device.spi
    async with bench.running(bench.on_spi()) as (rig,):
        await rig.until_samples(5)
        for number in (1, 2):
            device.faults.flips = 1
            await rig.until(lambda wanted=number: rig.device.ledger.frames_bad_crc == wanted, "seen")  # type: ignore[misc]  # bound per round
            await rig.until_samples(5)
        assert rig.device.ledger.lost_crc == 2
        assert EventKind.DOWN not in rig.kinds
        await rig.until(lambda: EventKind.BAD_FRAME in rig.kinds, "told")
        device.faults.flips = 3  # three damaged frames: imud identifies the device again
        await rig.until(lambda: EventKind.DOWN in rig.kinds, "gone")
        await rig.until_samples(5)
        assert (rig.ledger.lost_crc, rig.ledger.lost(), rig.ledger.lost_unknown) == (5, 5, 0)
    steps = [round((b.t_ns - a.t_ns) * RATE_HZ / 1e9) for a, b in pairwise(rig.samples)]
    assert max(steps) <= 4


@in_bench
async def test_the_time_of_a_search_is_a_gap_of_unknown_size(bench: PolledBusBench) -> None:
    """One gap, even if the device was found and lost several times before its next sample."""
    device = bench.registers()
    is_absent = False

    def answer(selections: Any, mode: int) -> list[bytes]:
        miso = device.spi(selections, mode)
        return [b"\xff" * 32] if is_absent and selections[0][:1] == b"\x80" else miso

    bench.spi.device = answer
    async with bench.running(bench.on_spi()) as (rig,):
        await rig.until_samples(5)
        assert rig.ledger.lost_unknown == 0
        for gaps in (1, 2):
            is_absent, found = True, device.transactions
            await rig.until(lambda begin=found: device.transactions > begin + 30, "found and gone, repeatedly")  # type: ignore[misc]  # bound per round
            is_absent = False
            await rig.until_samples(5)
            assert (rig.ledger.lost_unknown, rig.ledger.lost()) == (gaps, 0)


@in_bench
async def test_a_device_is_set_up_before_it_runs_and_after_a_restart(bench: PolledBusBench) -> None:
    """imud reads the filter setting every ten seconds."""
    device = bench.registers()
    bench.i2c.devices[0x1A] = device
    device.faults.ignores_writes = True
    config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 1, "rate_hz": RATE_HZ}, gyro_filter=2)
    async with bench.running(config) as (rig,):
        await rig.until(lambda: "after the write, got 0xbb" in rig.device.status().problem, "told")
        assert (rig.state, rig.samples) == (DeviceState.SEARCHING, [])
        device.faults.ignores_writes = False
        await rig.until_samples(3)
        assert device.filter == 0xB2
        device.restart()
        await rig.until(lambda: device.filter == 0xB2, "set up again", 11)
        await rig.until_samples(3)
        assert rig.polling.vanished == 1
        assert rig.device.ledger.frames_in_replies > 2


@in_bench
async def test_auto_finds_driver_and_address_of_unclaimed_devices(bench: PolledBusBench) -> None:
    bench.i2c.devices.update({0x19: bench.registers(product="IMU612"), 0x1B: bench.registers(product="IMU618")})
    async with bench.running(on_i2c("a", "auto"), on_i2c("b"), on_i2c("c")) as rigs:

        def settled() -> bool:
            for rig in rigs:
                rig.device.tick(bench.clock.now_ns())
            return all(rig.state is DeviceState.RUNNING or rig.device.status().problem for rig in rigs)

        await rigs[0].until(settled, "settled")
        there = [rig for rig in rigs if rig.state is DeviceState.RUNNING]
        assert {rig.device.status().link for rig in there} == {
            "/dev/i2c-1, address 0x19", "/dev/i2c-1, address 0x1b"
        }  # fmt: skip
        (left,) = (rig for rig in rigs if rig not in there)
        await left.until(lambda: "another device of this configuration" in left.device.status().problem, "told")
        assert {rig.device.status().identity["product"] for rig in there} == {"IMU612", "IMU618"}


@in_bench
async def test_a_stuck_bus_is_tried_once_in_a_round(bench: PolledBusBench) -> None:
    devices = [bench.registers() for _ in range(4)]
    bench.i2c.devices.update(dict(zip(range(0x18, 0x1C), devices, strict=True)))
    for device in devices:
        device.faults.error = errno.ETIMEDOUT
    async with bench.running(on_i2c()) as (rig,):
        await asyncio.sleep(2.2)  # one round per 0.5 s
        assert rig.is_in(DeviceState.SEARCHING)
        assert sum(device.transactions for device in devices) == 5


@in_bench
async def test_readings_are_held_in_twos_and_a_failed_read_of_settings_loses_none(bench: PolledBusBench) -> None:
    bench.spi.device = bench.registers().spi
    async with bench.running(bench.on_spi()) as (rig,):
        for latency_ns, hold_ns in ((8_000_000, 8_000_000), (7_999_999, 0)):  # the period is 4 ms
            rig.device.set_need(Need(latency_ns, "client"))
            before, batches = len(rig.samples), rig.batches
            await rig.until_samples(20)
            assert rig.device.status().hold_ns == hold_ns
            assert (rig.batches - batches < len(rig.samples) - before) is (hold_ns > 0)
        path = rig.device._transport.path
        assert isinstance(path, PolledPath)
        assert path.on_readings([Reading(1, b"", TransferError(Trouble.DISTURBED, "noise"), 1, 2)]) == ""
        assert (path.failed, rig.ledger.lost()) == (1, 0)  # a failed read of settings loses no sample


@in_bench
async def test_a_missing_device_does_not_delay_other_devices(bench: PolledBusBench) -> None:
    there, gone = bench.registers(), bench.registers()
    bench.i2c.devices.update({0x18: there, 0x19: gone})
    gone.faults.error = errno.ENXIO
    async with bench.running(on_i2c("there", address=0x18), on_i2c("gone", address=0x19)) as (good, bad):
        await good.until_samples(100)
        assert (good.polling.missed, good.polling.late) == (0, 0)
        assert bad.state is DeviceState.SEARCHING
        assert "no acknowledgement at address 0x19" in bad.device.status().problem
        gone.faults.error = 0
        await bad.until_samples(3)


@in_bench
async def test_repeated_values_are_stale_and_make_the_device_silent(bench: PolledBusBench) -> None:
    device = bench.registers()
    bench.i2c.devices[0x18] = device
    async with bench.running(on_i2c()) as (rig,):
        await rig.until_samples(3)
        device.faults.frozen = True
        await rig.until(lambda: rig.state is DeviceState.SILENT, "silent")
        polling, ledger = rig.polling, rig.device.ledger
        assert polling.stale == ledger.frames_ignored > 10
        assert ledger.lost() == 0
        device.faults.frozen = False
        await rig.until_samples(3)


@in_bench
async def test_device_slower_than_its_polls_gives_each_value_once(bench: PolledBusBench) -> None:
    device = bench.registers(update_ns=10_000_000)
    bench.spi.device = device.spi
    async with bench.running(bench.on_spi(rate_hz=500)) as (rig,):
        await rig.until_samples(20)
    values = [sample.accel_m_s2 for sample in rig.samples]
    assert len(set(values)) == len(values)
    assert rig.polling.stale > 2 * len(values)
    steps = [b.t_ns - a.t_ns for a, b in zip(rig.samples[5:], rig.samples[6:], strict=False)]
    assert sum(steps) / len(steps) == pytest.approx(1e7, rel=0.1)


@in_bench
async def test_imud_waits_for_a_missing_bus_and_retries_a_denied_bus(bench: PolledBusBench) -> None:
    bench.spi.device = bench.registers().spi
    plug, unplug = bench.node.touch, bench.node.unlink
    unplug()
    async with bench.running(bench.on_spi()) as (rig,):
        await asyncio.sleep(0)
        assert rig.state is DeviceState.MISSING
        assert str(bench.node) in rig.problem
        plug()
        await rig.until_samples(3)
        unplug()
        device = bench.registers()
        device.faults.error = errno.ENODEV
        bench.spi.device = device.spi
        await rig.until(lambda: rig.state is DeviceState.MISSING, "missing")
        assert EventKind.DOWN in rig.kinds
        device.faults.error = 0
        plug()
        await rig.until_samples(3)
        assert rig.device.status().connects == 2
        bench.spi.open_error, device.faults.error = errno.EBUSY, errno.ENODEV
        await rig.until(lambda: rig.state is DeviceState.FAILED, "failed")
        assert "in use" in rig.device.status().problem
        bench.spi.open_error = device.faults.error = 0
        await rig.until_samples(1)
        assert rig.device.status().connects == 3


@in_bench
async def test_slow_transfers_miss_deadlines_which_are_lost_samples(
    bench: PolledBusBench, caplog: pytest.LogCaptureFixture
) -> None:
    device = bench.registers()

    def slow(selections: Any, mode: int) -> list[bytes]:
        bench.clock.advance(5_000_000)
        return device.spi(selections, mode)

    bench.spi.device = slow
    async with bench.running(bench.on_spi(rate_hz=1000)) as (rig,):
        await rig.until_samples(10)
        await rig.until(lambda: EventKind.LOSS in rig.kinds, "told")
        polling = rig.polling
        # a transfer takes 5.16 ms, the first read has three; each ms is one deadline, kept or missed
        assert polling.polls + polling.missed == pytest.approx(5.16 * (polling.polls + 2), abs=1.5)
        assert polling.late > 0.5 * polling.polls
        assert polling.late_sum_ns // polling.polls == polling.late_mean_ns > 0
        assert "no value of it is new" not in caplog.text  # too few reads for this message
        assert rig.device.ledger.lost_queue == polling.missed >= 30


@in_bench
async def test_settings_are_applied_and_read_again_after_an_action(bench: PolledBusBench) -> None:
    device = bench.registers()
    bench.spi.device = device.spi
    async with bench.running(bench.on_spi(burst="extended")) as (rig,):
        await rig.until_samples(5)
        report = await rig.device.settings.report(fresh=True)
        actual = {one.name: one.actual for one in report.settings}
        assert actual == {"accel_filter": "47 Hz", "gyro_filter": "47 Hz", "burst": "extended"}
        applied = await rig.device.settings.apply({"accel_filter": "average 16"}, save=False)
        assert [(step.name, str(step.outcome)) for step in applied.steps] == [("accel_filter", "verified")]
        assert (device.filter, rig.device.status().settings["gyro_filter"]) == (0xDB, "47 Hz")
        await act(rig.device, "filter", {"gyro_filter": "10 Hz"})
        assert rig.device.status().settings["gyro_filter"] == "10 Hz"
        device.faults.ignores_writes = True
        with pytest.raises(CommandError, match="FILTER_CTRL: expected 0xd0 after the write, got 0xd4"):
            await act(rig.device, "filter", {"gyro_filter": 0})
        assert rig.device.status().settings["gyro_filter"] == "10 Hz"
        await rig.until_samples(5)


@pytest.mark.parametrize("variant", REGISTER_VARIANTS)
@pytest.mark.parametrize("burst", ["standard", "extended"])
@in_bench
async def test_the_kind_of_burst_is_detected_in_every_variant(
    bench: PolledBusBench, variant: str, burst: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """During reads of identity and settings, ten per second, and after a restart that loses the settings."""
    polls = {kind: (first, Poll(READ_STATE, 10**8)) for kind, (first, *_) in codec.POLLS.items()}
    monkeypatch.setattr(codec, "POLLS", polls)
    device = bench.registers(behaviour=REGISTER_VARIANTS[variant])
    device.extended = 1
    bench.spi.device = device.spi
    async with bench.running(bench.on_spi(burst=burst)) as (rig,):
        await rig.until_samples(int(RATE_HZ))
        assert (rig.polling.vanished, rig.device.ledger.frames_bad_crc) == (0, 0)
        device.restart()
        await rig.until_samples(5)
        assert (rig.polling.vanished, device.extended) == (burst == "extended", burst == "extended")


MS = 1_000_000
EVERY_NS = 2 * MS  # period of the device, ns: 500 Hz; `rate_hz` is 100
DEADLINES_HZ = 100.0


class Signal:
    """The line of the device: an edge at each update of its registers."""

    def __init__(self, bench: PolledBusBench, device: Imu61xRegisters) -> None:
        self.stamps: list[int] = []  # number of edges since the line was opened
        self.quiet = False
        self._stage, self._device = bench, device

    @property
    def line(self) -> MemoryInput:
        return self._stage.lines.inputs["imu data_ready"]

    @property
    def newest_ns(self) -> int:
        """Time of the last update of the registers."""
        epoch_ns = self._device.epoch_ns
        return epoch_ns + (self._stage.clock.now_ns() - epoch_ns) // EVERY_NS * EVERY_NS

    def at_once(self, t_ns: int, *, heard: bool = True) -> None:
        """Add an edge to the buffer of the kernel. With `heard` the loop processes the edge."""
        self.line.edge(t_ns, True)
        if heard:
            asyncio.get_running_loop().call_soon(self.line.drain)
        if self.line.is_open:
            self.stamps.append(t_ns)

    async def run(self) -> None:
        clock = self._stage.clock
        while True:
            t_ns = self.newest_ns + EVERY_NS
            await asyncio.sleep((t_ns - clock.now_ns()) / NS_PER_S)
            if not self.quiet and clock.now_ns() >= t_ns and t_ns not in self.stamps[-20:]:
                self.at_once(t_ns)


class Scene:
    def __init__(self, rig: DeviceRig, signal: Signal, device: Imu61xRegisters, bench: PolledBusBench) -> None:
        self.rig, self.signal, self.device, self.bench = rig, signal, device, bench

    def told(self, words: str) -> Callable[[], bool]:
        return lambda: any(e.kind is EventKind.LINK and words in e.message for e in self.rig.events)

    @property
    def missed(self) -> int:
        return self.rig.polling.missed

    def dated(self, sample: Sample) -> int:
        """Check time stamp and values of a sample. Return the index of its edge."""
        assert sample.edge_seq is not None
        assert sample.sync is Sync.EDGE
        stamp_ns = self.signal.stamps[sample.edge_seq - 1]
        assert sample.t_ns == stamp_ns
        assert sample.accel_m_s2 is not None
        assert dist(sample.accel_m_s2, self.device.truth_at(stamp_ns).accel_m_s2) < 4e-5
        return sample.edge_seq


def with_line(bench: PolledBusBench, **more: Any) -> DeviceConfig:
    return replace(
        bench.on_spi(DEADLINES_HZ, burst="standard"), lines=DeviceLines(data_ready=ReadyOptions(line="Y", **more))
    )


@asynccontextmanager
async def scene(bench: PolledBusBench, **more: Any) -> AsyncIterator[Scene]:
    device = bench.registers(update_ns=EVERY_NS)
    bench.spi.device = device.spi
    signal = Signal(bench, device)
    async with bench.running(with_line(bench, **more)) as (rig,):
        task = asyncio.create_task(signal.run())
        try:
            yield Scene(rig, signal, device, bench)
        finally:
            task.cancel()


@in_bench
async def test_each_edge_is_a_sample_with_its_time(bench: PolledBusBench) -> None:
    async with scene(bench) as it:
        await it.rig.until_samples(200)
        status = it.rig.device.status()
        assert status.expected_rate_hz == 500
        assert status.clock.sync is Sync.EDGE
        assert status.lines is not None
        assert status.lines.edges["data_ready"] >= 199
        assert status.lines.edges_lost == {"data_ready": 0}
        numbers = [it.dated(sample) for sample in it.rig.samples[1:]]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert all(sample.t_err_ns < 62_000 for sample in it.rig.samples[1:])  # 100 us / √3 and 3 us
        assert it.missed == it.rig.device.ledger.lost_queue == 0
        assert EventKind.LINK not in it.rig.kinds
    it.rig.device.tick(bench.clock.now_ns())
    assert not it.signal.line.is_open, "it is let go of at the end"


@in_bench
async def test_an_inverted_line_has_the_same_edges(bench: PolledBusBench) -> None:
    asked: list[Any] = []
    make = bench.lines.input

    def keep(settings: Any, purpose: str, rising_only: bool = False) -> MemoryInput:
        asked.append((settings.edge, settings.active_low, rising_only))
        return make(settings, purpose, rising_only)

    bench.lines.maker = replace(bench.lines.maker, make_input=keep)
    for edge, active_low in (("falling", False), ("falling", True), ("rising", True)):
        async with bench.running(with_line(bench, edge=edge, active_low=active_low)):
            pass
    assert asked == [("rising", True, True), ("rising", False, True), ("rising", True, True)]


@in_bench
async def test_a_stalled_loop_misses_edges(bench: PolledBusBench) -> None:
    """After a blocked loop the kernel has ten more edges: one read, for the newest edge."""
    async with scene(bench) as it:
        await it.rig.until_samples(20)
        newest = len(it.signal.stamps)
        for _ in range(10):
            bench.clock.advance(EVERY_NS)
            it.signal.at_once(it.signal.stamps[-1] + EVERY_NS)
        await it.rig.until_samples(20)
        numbers = [it.dated(sample) for sample in it.rig.samples[1:]]
        assert [b for a, b in pairwise(numbers) if b != a + 1] == [newest + 10]
        lost = numbers[-1] - numbers[0] + 1 - len(numbers)
        assert lost in (9, 10)
        assert it.missed == it.rig.device.ledger.lost_queue == lost
        await it.rig.until(lambda: EventKind.LOSS in it.rig.kinds, "told")


class Unheard(MemoryInput):
    """A line with edges that do not wake the loop."""

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        super().start(on_edges, on_end, watch=False)


@in_bench
async def test_an_edge_in_the_kernel_time_stamps_its_read(bench: PolledBusBench) -> None:
    """The edge is in the kernel before the read for the previous edge starts: no second read."""

    def make(_settings: Any, purpose: str, rising_only: bool = False) -> MemoryInput:
        return bench.lines.inputs.setdefault(purpose, Unheard(purpose, rising_only))

    bench.lines.maker = replace(bench.lines.maker, make_input=make)
    async with scene(bench) as it:
        await it.rig.until_samples(20)
        it.signal.quiet = True
        await asyncio.sleep(0.01)
        before = it.rig.polling
        stamp_ns = it.signal.newest_ns

        def at_the_beginning_of_the_read() -> None:
            bench.clock.advance(EVERY_NS)
            it.signal.at_once(stamp_ns + EVERY_NS, heard=False)

        it.signal.at_once(stamp_ns)
        bench.before_next_time = at_the_beginning_of_the_read
        await asyncio.sleep(0.01)
        assert bench.before_next_time is None
        after = it.rig.polling
        assert it.dated(it.rig.samples[-1]) == len(it.signal.stamps)
        assert (after.polls - before.polls, after.missed - before.missed) == (1, 1)
        assert after.stale == before.stale


@in_bench
async def test_edges_stop_and_return(bench: PolledBusBench) -> None:
    async with scene(bench) as it:
        await it.rig.until_samples(20)
        it.signal.quiet = True
        await it.rig.until(it.told("no edges: imud reads at 100 Hz"), "told")
        count = len(it.rig.samples)
        await it.rig.until_samples(50)
        assert it.rig.device.status().expected_rate_hz == DEADLINES_HZ
        by_deadlines = it.rig.samples[count + 1 :]
        assert {sample.sync for sample in by_deadlines} == {Sync.ARRIVAL}
        assert {sample.edge_seq for sample in by_deadlines} == {None}
        steps = [b.t_ns - a.t_ns for a, b in pairwise(by_deadlines)]
        assert sum(steps) / len(steps) == pytest.approx(10 * MS, rel=0.01)
        it.signal.quiet = False
        await it.rig.until(it.told("edges have returned"), "told")
        count = len(it.rig.samples)
        await it.rig.until_samples(50)
        numbers = [it.dated(sample) for sample in it.rig.samples[count:]]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert it.rig.state is DeviceState.RUNNING
        assert EventKind.DOWN not in it.rig.kinds
        assert it.missed <= 1
        stamps = [sample.t_ns for sample in it.rig.samples]
        assert stamps == sorted(set(stamps))


@in_bench
async def test_a_missing_line_causes_reads_at_deadlines(bench: PolledBusBench) -> None:
    bench.lines.input(ReadyOptions(line="Y"), "imu data_ready", True).open_error = LinkMissing("no such line")
    async with scene(bench) as it:
        await it.rig.until(it.told("line data_ready: no such line"), "told")
        await it.rig.until(it.told("no edges"), "told")
        await it.rig.until_samples(20)
        status = it.rig.device.status()
        assert status.lines is not None
        assert status.lines.problems == {"data_ready": "no such line"}
        it.signal.line.open_error = None
        await it.rig.until(it.told("edges have returned"), "told")
        await it.rig.until_samples(20)
        it.dated(it.rig.samples[-1])


@in_bench
async def test_edges_before_the_identification_are_not_missed(bench: PolledBusBench) -> None:
    async with scene(bench) as it:
        await it.rig.until_samples(20)
        it.device.faults.line = 0xFF
        await it.rig.until(lambda: EventKind.DOWN in it.rig.kinds, "down")
        await asyncio.sleep(0.5)
        it.device.faults.line = None
        await it.rig.until_samples(20)
        numbers = [it.dated(sample) for sample in it.rig.samples[1:]]
        assert max(b - a for a, b in pairwise(numbers)) > 200
        assert it.missed == 0


class DescriptorLine(MemoryInput):
    def fileno(self) -> int:
        return 77 if self.is_open else -1


class WatchingMember:
    def __init__(self) -> None:
        self.watched: dict[int, Callable[[], None]] = {}
        self.noted = self.commands = 0

    def watch(self, fd: int, callback: Callable[[], None]) -> bool:
        if fd < 0:
            return False
        assert not self.watched
        self.watched[fd] = callback
        return True

    def unwatch(self, fd: int) -> None:
        del self.watched[fd]

    def start(self, _polls: object, schedule: ReadySchedule) -> None:
        self.schedule = schedule

    def note(self, command: Callable[[], None]) -> None:
        self.noted += 1
        command()

    def command(self, command: Callable[[], None]) -> None:
        self.commands += 1
        command()


@in_loop
async def test_the_thread_watches_an_open_line_during_reads() -> None:
    line, clock, member, told = DescriptorLine(), VirtualClock(), WatchingMember(), list[str]()
    device_events: Any = SimpleNamespace(raise_event=lambda _t, _kind, message, **_detail: told.append(message))
    maker = LineFactory(lambda *_: line, lambda *_: MemoryOutput())
    ready = DataReady("imu", ReadyOptions(line="Y"), maker, DEADLINES_HZ, device_events, HostClock(clock.now_ns))
    some: Any = member
    line.open_error = LinkMissing("not there")
    ready.read(some, (), Deadlines(), clock.now_ns())
    assert not member.watched
    line.open_error = None
    clock.advance(10 * NS_PER_S)
    ready.tick(clock.now_ns(), None)
    assert set(member.watched) == {77}
    clock.advance(EVERY_NS)
    member.schedule.begun(clock.now_ns())
    member.schedule.done(clock.now_ns())
    clock.advance(EVERY_NS)
    member.watched[77]()
    assert member.schedule.due_ns == clock.now_ns()
    line.edge(clock.now_ns(), True)
    clock.advance(1000)
    member.schedule.begun(clock.now_ns())
    ready.drain()
    assert (member.noted, member.commands) == (1, 0)  # a read already covers it
    assert ready.expected_rate_hz == DEADLINES_HZ  # one edge shows no interval
    line.edge(clock.now_ns() + 1, True)
    ready.drain()
    assert (member.noted, member.commands) == (1, 1)
    line.vanish(LinkMissing("pulled out"))
    assert not member.watched
    clock.advance(10 * NS_PER_S)
    ready.tick(clock.now_ns(), None)
    assert set(member.watched) == {77}
    ready.stop()
    assert not member.watched
    ready.read(some, (), Deadlines(), clock.now_ns())
    assert set(member.watched) == {77}
    ready.close()
    assert not member.watched
    assert len(told) == 4
