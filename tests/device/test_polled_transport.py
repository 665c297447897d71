"""A polled device from its bus to the outputs: identification, deadlines, return after an absence."""

import asyncio
import errno
from itertools import pairwise
from math import dist, sqrt
from pathlib import Path
from typing import Any

import pytest

from imud.contracts.codec import Poll, Reading
from imud.contracts.status import DeviceState
from imud.device.latency import Need
from imud.drivers.imu61x import spi as codec
from imud.drivers.imu61x.spi import READ_STATE
from imud.model.errors import CommandError, TransferError, Trouble
from imud.model.event import EventKind
from imud.sampling.path import PolledPath
from imud.sim.imu61x.uart import REGISTER_VARIANTS
from tests.support.device_rig import device_config
from tests.support.event_loops import VirtualClock
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
        down = next(event for event in rig.events if event.kind is EventKind.DOWN)
        assert why in down.message
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
        assert EventKind.BAD_FRAME in rig.kinds
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
async def test_restarted_device_is_set_up_again(bench: PolledBusBench) -> None:
    """imud reads the filter setting every ten seconds."""
    device = bench.registers()
    bench.i2c.devices[0x1A] = device
    config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 1, "rate_hz": RATE_HZ}, gyro_filter=2)
    async with bench.running(config) as (rig,):
        await rig.until_samples(3)
        assert device.filter == 0xB2
        device.restart()
        await rig.until(lambda: device.filter == 0xB2, "set up again", 11)
        await rig.until_samples(3)
        assert rig.polling.vanished == 1
        assert rig.device.ledger.frames_in_replies > 2


@in_bench
async def test_a_device_with_a_rejected_setting_does_not_run(bench: PolledBusBench) -> None:
    device = bench.registers()
    bench.i2c.devices[0x18] = device
    device.faults.ignores_writes = True
    config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 1}, gyro_filter=2)
    async with bench.running(config) as (rig,):
        await rig.until(lambda: "after the write, got 0xbb" in rig.device.status().problem, "told")
        assert rig.state is DeviceState.SEARCHING
        assert not rig.samples


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
async def test_a_failed_read_of_settings_loses_no_sample(bench: PolledBusBench) -> None:
    bench.spi.device = bench.registers().spi
    async with bench.running(bench.on_spi()) as (rig,):
        await rig.until_samples(3)
        path = rig.device._transport.path
        assert isinstance(path, PolledPath)
        assert path.on_readings([Reading(1, b"", TransferError(Trouble.DISTURBED, "noise"), 1, 2)]) == ""
        assert (path.failed, rig.ledger.lost()) == (1, 0)


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
async def test_readings_are_held_if_the_hold_contains_two(bench: PolledBusBench) -> None:
    bench.spi.device = bench.registers().spi
    async with bench.running(bench.on_spi()) as (rig,):
        for latency_ns, hold_ns in ((8_000_000, 8_000_000), (7_999_999, 0)):  # the period is 4 ms
            rig.device.set_need(Need(latency_ns, "client"))
            before, batches = len(rig.samples), rig.batches
            await rig.until_samples(20)
            assert rig.device.status().hold_ns == hold_ns
            assert (rig.batches - batches < len(rig.samples) - before) is (hold_ns > 0)


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
        report = await rig.device.settings_report(fresh=True)
        actual = {one.name: one.actual for one in report.settings}
        assert actual == {"accel_filter": "47 Hz", "gyro_filter": "47 Hz", "burst": "extended"}
        applied = await rig.device.settings_apply({"accel_filter": "average 16"}, save=False)
        assert [(step.name, str(step.outcome)) for step in applied.steps] == [("accel_filter", "verified")]
        assert device.filter == 0xDB
        assert rig.device.status().settings["gyro_filter"] == "47 Hz"
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
        polling = rig.polling
        assert (polling.vanished, rig.device.ledger.frames_bad_crc) == (0, 0)
        device.restart()
        await rig.until_samples(5)
        assert rig.polling.vanished == (burst == "extended")
        assert device.extended == (burst == "extended")
