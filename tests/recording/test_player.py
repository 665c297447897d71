"""Recording and replay: recorded tests of devices, whose replay must equal the live run (`check_replay`).

`IMUD_RECORD_RIGS=1 pytest tests/device tests/lines` records all of these tests.
"""

import asyncio
import errno
from collections.abc import Callable
from pathlib import Path
from random import Random

import msgspec
import pytest

from imud import __version__
from imud.attitude.conventions import Convention
from imud.attitude.published import published_frame
from imud.contracts.publisher import Batch
from imud.drivers import DRIVERS
from imud.formats import records
from imud.formats.records import CallRecord, CheckRecord, Kind, PathRecord, Record, SessionRecord, records_of
from imud.host.clock import HostClock
from imud.links.memory import MemoryLink
from imud.model.errors import ImudError
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.recording.player import Player, RecordedClock, _reading
from tests.device import test_can_transport as can
from tests.device import test_polled_transport as polled
from tests.device import test_stream_transport_stream_hold as waiting
from tests.device import test_watches as watches
from tests.lines import test_end_to_end as signals
from tests.support.device_rig import DeviceRig, DeviceRigs, device_config, play
from tests.support.event_loops import LoopWorker, VirtualClock
from tests.support.fake_drivers import FAKE_DRIVER
from tests.support.polled_bus_bench import PolledBusBench
from tests.support.rings import make_sample

SAMPLES = 60


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.setattr(DeviceRigs, "recording", True)
    return monkeypatch


@pytest.fixture
def bench(tmp_path: Path, recorded: pytest.MonkeyPatch) -> PolledBusBench:
    return PolledBusBench(tmp_path, recorded, VirtualClock())


@pytest.mark.usefixtures("recorded")
@pytest.mark.parametrize(
    "run",
    [
        lambda: signals.test_every_sample_has_its_edge(settings=None), signals.test_frames_answer_the_triggers_on_sin,
        signals.test_an_alarm_is_an_event_and_shown_in_the_samples, waiting.test_a_link_without_pause_has_no_hold,
        can.test_lost_samples_are_counted_by_cause, can.test_frames_from_before_a_loss_are_not_mixed_with_those_after,
        can.test_bus_down_and_up, can.test_a_suspend_of_the_host_is_a_gap_of_unknown_size,
        lambda: watches.test_both_coordinates_of_a_device_give_the_same_published_samples(Convention.NED_FRD, {}),
    ],
    ids=[
        "edges", "triggers", "alarm", "held samples", "losses on CAN", "loss within a sample", "bus down", "suspended",
        "axes by a setting",
    ],
)  # fmt: skip
def test_a_run_on_a_line_or_can_bus_is_replayed(run: Callable[[], None]) -> None:
    run()


@pytest.mark.parametrize(
    "run",
    [
        polled.test_each_edge_is_a_sample_with_its_time, polled.test_one_damaged_reading_loses_one_sample,
        lambda bench: polled.test_readings_after_an_absence_need_an_identification(
            bench=bench, fault={"error": errno.EIO}, why="transfer failed"
        ),
    ],
    ids=["edges", "damage", "failed transfers"],
)  # fmt: skip
def test_a_run_of_a_polled_device_is_replayed(bench: PolledBusBench, run: Callable[..., None]) -> None:
    run(bench=bench)


def run_with_attitude(bench: PolledBusBench, middle: int) -> DeviceRig:
    """imud computes the attitude of a rotating sensor. The recording starts again at sample `middle`."""
    bench.spi.device = bench.registers().spi

    found: list[DeviceRig] = []

    async def story() -> None:
        async with bench.running(polled.with_attitude(bench.on_spi())) as (rig,):
            await rig.until_samples(middle)
            rig.recorded.clear()
            rig.samples.clear()
            bench.rigs.record(rig)
            await rig.until_samples(700)
        found.append(rig)

    bench.run(story())
    return found[0]


@pytest.mark.parametrize("middle", [1, 20, 300])
def test_a_replay_computes_the_same_attitude_bit_for_bit(bench: PolledBusBench, middle: int) -> None:
    rig = run_with_attitude(bench, middle)  # `check_replay` compares all samples
    assert len(rig.samples) >= 700
    assert all(sample.quat_wxyz is not None for sample in rig.samples)
    assert rig.samples[0].seq > 1
    records_found = [record for one in rig.recorded for record in records_of(one)]
    state = next(records.decode_object(one, PathRecord).state for one in records_found if one.kind == Kind.PATH)
    broken = state.replace(b"gyrQuat", b"gyrQuad")
    assert broken != state
    player = Player(lambda _batch: None)
    player.play(
        one._replace(body=one.body.replace(state, broken)) if one.kind == Kind.PATH else one for one in records_found
    )
    (played,) = player.devices.values()
    assert [why.partition(":")[0] for why in played.fresh_starts] == ["cannot restore the state"]


def run_of(driver: str, middle: int) -> DeviceRig:
    """A stream of frames with jitter. The recording starts again at frame `middle`, without the earlier records.

    The host's time is slewed by 100 ppm. The host is suspended before the first frame and shortly before the last.
    """
    row, clock, asleep_ns = DRIVERS[driver], VirtualClock(), 0
    now_ns = clock.now_ns
    host = HostClock(now_ns, clock.realtime_ns, lambda: now_ns() + now_ns() // 10_000, lambda: now_ns() + asleep_ns)
    rigs = DeviceRigs(host, start_worker=LoopWorker)
    random = Random(driver)
    config = device_config("imu", driver, "memory", {"baud": 115200})
    link = MemoryLink(config.link_settings)  # type: ignore[arg-type]  # those of its row
    rig = rigs.add(config, link)

    async def story(_rigs: list[DeviceRig]) -> None:
        nonlocal asleep_ns
        for number in range(SAMPLES):
            asleep_ns += 2 * NS_PER_S * (number in (0, SAMPLES - 20))
            host.utc_offset_ns()
            rig.tick()
            if number == middle:
                rig.recorded.clear()
                rig.samples.clear()
                rigs.record(rig)
            frame = row.example_frame(random)  # type: ignore[attr-defined]  # a driver of streams
            cut = random.randrange(len(frame))
            link.feed(frame[:cut], clock.now_ns())
            await asyncio.sleep(0.001 * random.random())
            link.feed(frame[cut:], clock.now_ns())
            await asyncio.sleep(0.010 * random.random())
        rig.tick()

    play(rigs, story, clock)
    return rig


@pytest.mark.parametrize("driver", ["hipnuc-uart", "imu61x-uart"])
@pytest.mark.parametrize("middle", [1, 7, 30])
def test_a_recording_that_begins_in_the_middle_has_the_stamps_and_numbers_of_the_run(
    recorded: pytest.MonkeyPatch, driver: str, middle: int
) -> None:
    rig = run_of(driver, middle)
    assert rig.samples
    assert rig.samples[0].seq > 1 or middle == 1
    player = Player(lambda _batch: None)
    player.play(record for one in rig.recorded for record in records_of(one))
    (played,) = player.devices.values()
    assert (played.before or {})["samples"] == rig.samples[0].seq - 1
    assert (played.ledger.snapshot(), played.fresh_starts, played.differences) == (rig.ledger.snapshot(), [], [])


def test_a_wall_clock_that_steps_moves_the_samples_before_the_step() -> None:
    """The first clock steps by 2 s. A suspend starts a new offset. A difference of 1 ms does not count as a step."""
    clock, sample = RecordedClock(), make_sample(1)
    frame = published_frame(None, None, None, FAKE_DRIVER.axes)
    samples = [msgspec.structs.replace(sample, t_ns=t_ns, utc_ns=t_ns + 1000) for t_ns in (50, 99, 100, 101)]
    batch = Batch("a", 1, samples, frame)
    assert clock.placed(batch) is batch
    for monotonic_ns, offset_ns, suspends in ((10, 1000, 0), (20, 1000 + NS_PER_MS, 0)):
        clock.add(monotonic_ns, offset_ns, suspends)
        assert clock.placed(batch) is batch
    clock.add(100, 1000 + 2 * NS_PER_MS, 1)
    placed = clock.placed(batch)
    assert (placed.device, placed.device_id, placed.frame) == ("a", 1, frame)
    assert [one.utc_ns - one.t_ns - 1000 for one in placed.samples] == [0, 0, 2 * NS_PER_MS, 2 * NS_PER_MS]


def test_without_the_state_a_new_clock_starts_and_a_removed_option_is_ignored(
    recorded: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rig = run_of("hipnuc-uart", 30)
    samples: list[Sample] = []
    player = Player(lambda batch: samples.extend(batch.samples))
    player.play(without_state(record) for one in rig.recorded for record in records_of(one))
    (played,) = player.devices.values()
    assert played.fresh_starts == ["the recording does not contain the state of the clock"]
    assert len(samples) == len(rig.samples)
    assert played.ledger.closes()
    assert played.differences
    assert "this imud ignores recorded options: calibration_done" in caplog.text
    session, player = SessionRecord(1, "0.1", "3.11", "host", 1, 0, 1, 2), Player(lambda _batch: None)
    data = [records.encode_object(Kind.SESSION, records.NO_DEVICE, session), *rig.recorded]
    player.play(record for one in data for record in records_of(one))
    starts = player.devices[played.device_id].fresh_starts
    assert starts == [f"imud 0.1 wrote the recording, this is imud {__version__}"]


def without_state(record: Record) -> Record:
    if record.kind != Kind.PATH:
        return record
    path = records.decode_object(record, PathRecord)
    made = msgspec.structs.replace(path, state=b"", options={"calibration_done": 0})
    return record._replace(body=msgspec.msgpack.encode(made))


def recorded_run() -> list[Record]:
    rig = run_of("hipnuc-uart", SAMPLES + 1)
    return [record for one in rig.recorded for record in records_of(one)]


def test_checks_find_a_stamp_a_number_and_a_count_that_differ_or_a_missing_read(recorded: pytest.MonkeyPatch) -> None:
    """A counter that an older imud did not have is not a difference, and bytes that a search skipped are not one."""
    found = recorded_run()
    for name in ("seq", "sample_t_ns", "sample_t_err_ns", "ledger", "older", "searched"):
        player = Player(lambda _batch: None)
        player.play(_changed(record, name) for record in found)
        (played,) = player.devices.values()
        assert played.checks > 0
        assert played.different_checks == played.checks * (name not in ("older", "searched"))
    reads = [number for number, record in enumerate(found) if record.kind == Kind.DATA]
    del found[reads[len(reads) // 2]]
    player = Player(lambda _batch: None)
    player.play(found)
    (played,) = player.devices.values()
    assert played.differences


def _changed(record: Record, name: str) -> Record:
    if record.kind != Kind.CHECK:
        return record
    check = records.decode_object(record, CheckRecord)
    if name == "older":
        name, value = "ledger", {key: count for key, count in check.ledger.items() if key != "frames_lost"}
    elif name == "searched":
        name, value = "ledger", check.ledger | {key: check.ledger[key] + 7 for key in ("bytes_in", "bytes_skipped")}
    else:
        value = {**check.ledger, "frames_good": 1} if name == "ledger" else getattr(check, name) + 1
    return record._replace(body=msgspec.msgpack.encode(msgspec.structs.replace(check, **{name: value})))


@pytest.mark.parametrize("seed", range(8))
def test_damaged_records_raise_imud_error(recorded: pytest.MonkeyPatch, seed: int) -> None:
    random, found = Random(seed), recorded_run()
    for _ in range(20):
        at = random.randrange(len(found))
        kind, device, body = found[at]
        place = random.randrange(len(body)) if body else 0
        damaged = body[:place] + random.randbytes(1) + body[place + 1 :]
        try:
            Player(lambda _batch: None).play([*found[:at], Record(kind, device, damaged), *found[at + 1 :]])
        except ImudError:
            continue


@pytest.mark.parametrize("name", ["", "a" * 33, "\x1b[2J", "bow\n", "=1+1", "Bow", "bow\u202e"])
def test_a_device_name_that_no_configuration_accepts_is_an_error(recorded: pytest.MonkeyPatch, name: str) -> None:
    for kind, key in ((Kind.DEVICE, "name"), (Kind.EVENT, "device")):
        event = {"t_ns": 7, "device": "bow", "kind": "up", "message": "hello"}
        other = Record(kind, 0, msgspec.msgpack.encode(event))
        record = next((one for one in recorded_run() if one.kind == kind), other)
        forged = record._replace(body=msgspec.msgpack.encode(msgspec.msgpack.decode(record.body) | {key: name}))
        if kind == Kind.EVENT and not name:  # an event of the daemon
            continue
        with pytest.raises(ImudError, match="cannot read a record of kind"):
            Player(lambda _batch: None).play([forged])


def test_counters_of_the_ledger_that_are_not_integers_are_an_error(recorded: pytest.MonkeyPatch) -> None:
    found = recorded_run()
    made = next(number for number, record in enumerate(found) if record.kind == Kind.PATH)
    for values in ({"samples": "many"}, {"samples": None}, ["samples"], 7):
        call = msgspec.msgpack.encode(CallRecord("ledger", "set", [values]))
        with pytest.raises(ImudError, match="cannot replay a record"):
            Player(lambda _batch: None).play([*found[: made + 1], Record(Kind.CALL, found[made].device, call)])


def test_the_reference_of_utc_and_its_end_are_replayed(recorded: pytest.MonkeyPatch) -> None:
    found = recorded_run()
    made = next(number for number, record in enumerate(found) if record.kind == Kind.PATH)
    calls = [msgspec.msgpack.encode(CallRecord("clock", "set_utc_reference", [one])) for one in ([5, 7], None)]
    for count, error_ns in ((1, 7), (2, 0)):
        player = Player(lambda _batch: None)
        player.play([*found[: made + 1], *(Record(Kind.CALL, found[made].device, call) for call in calls[:count])])
        ((_, played),) = player.devices.items()
        assert played.path is not None
        assert played.path.clock.status().reference_error_ns == error_ns


def test_lost_records_and_events_are_passed_on_and_an_unknown_trouble_is_the_last_known() -> None:
    told: list[tuple[str, int]] = []
    player = Player(lambda _batch: None, on_event=lambda event, utc_ns: told.append((event.message, utc_ns)))
    recorded_event = {"t_ns": 7, "device": "bow", "kind": "up", "message": "hello"}
    player.play(
        record
        for data in (
            records.encode_clocks(records.ClocksRecord(5, 5, 5, 1, 1000, 0)),
            records.encode_lost(records.LostRecord(2, 99, 5)),
            records.encode_lost(records.LostRecord(3, 99, 6)),
            records.encode_object(Kind.EVENT, records.NO_DEVICE, recorded_event),
        )
        for record in records_of(data)
    )
    assert (player.lost, told) == (5, [("hello", 1007)])
    assert _reading(records.ReadingRecord(0, 1, 2, 99, b"new kind")).error is not None
