"""Levels of diagnoses for a running daemon and for a recording."""

from itertools import pairwise
from typing import Any

import msgspec

from imud.bridges.channel import Diagnosis, DiagnosisLevel, LiveDiagnosis, LossCounts, RecordedDiagnosis, StampedEvent
from imud.contracts.status import ClockStatus, DeviceState, DeviceStatus
from imud.model.event import Event, EventKind
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_S
from tests.support.socket_rig import device_status, sample

UTC_NS = 1_790_000_000_000_000_000
OK, WARN, ERROR, STALE = DiagnosisLevel


def status(**changes: Any) -> DeviceStatus:
    return msgspec.structs.replace(device_status("bow", 0), **changes)


def one(found: DeviceStatus) -> Diagnosis:
    (diagnosis,) = LiveDiagnosis().of([found], UTC_NS).devices
    return diagnosis


def test_levels_and_messages_of_a_running_daemon() -> None:
    assert one(status(state=DeviceState.SILENT, condition=None))[1:3] == (STALE, "silent")
    clock = ClockStatus(sync=Sync.REGRESSION, t_err_ns=12_000, skew_ppm=-40.5, residual_ns=900)
    found = one(status(clock=clock, identity={"product": "HI13", "serial_number": "17"}))
    assert found[:4] == ("bow", OK, "ok", "17")
    expected = {
        "t_err_ns": "12000", "skew_ppm": "-40.5", "residual_ns": "900", "sync": "regression", "rate_hz": "1000",
        "lost_crc": "0", "link": "/dev/ttyUSB0 at 115200 baud",
    }  # fmt: skip
    assert found.values.items() >= expected.items()
    assert one(status()).hardware == "HI13"
    assert "status" not in one(status()).values
    assert one(status(status_words=["overrange", "hot"])).values["status"] == "overrange, hot"


def test_without_a_daemon_all_are_stale_and_keep_their_values() -> None:
    diagnosis = LiveDiagnosis()
    assert diagnosis.stale("no daemon", UTC_NS).devices == ()
    (before,) = diagnosis.of([status()], UTC_NS).devices
    (after,) = diagnosis.stale("no daemon", UTC_NS + 1).devices
    assert after == before._replace(level=STALE, message="no daemon")


def run_of(device: str, second: int, count: int = 10) -> list[Sample]:
    return [sample(device, 10 * second + number, NS_PER_S // 10) for number in range(1, count + 1)]


def losses(device: str, at: Sample, gap: int) -> LossCounts:
    return LossCounts(at.t_ns, at.utc_ns, device, at.seq, gap, 0, 0, 0, 0)


def test_a_recording_is_diagnosed_once_a_second() -> None:
    diagnosis, found = RecordedDiagnosis(), []
    for second in range(5):
        for number in range(10):
            for device in ("bow", "mast"):
                (one_sample,) = run_of(device, second)[number : number + 1]
                found += diagnosis.samples(device, [one_sample])
    made = found
    first, begin = made[:2]
    assert [len(one.devices) for one in made] == [1, *(len(made) - 1) * [2]], "each device as soon as it is there"
    steps_ns = [after.utc_ns - before.utc_ns for before, after in pairwise(made[1:])]
    assert len(steps_ns) == 5
    assert all(0.9 * NS_PER_S <= step_ns <= NS_PER_S for step_ns in steps_ns), "within a period of the samples"
    assert first.utc_ns == begin.utc_ns
    newest = {one.device: one for one in made[-1].devices}
    assert newest.keys() == {"bow", "mast"}
    assert newest["bow"][1:3] == (OK, "running")
    assert newest["bow"].values.items() >= {"t_err_ns": "12000", "sync": "regression", "rate_hz": "10"}.items()
    assert newest["bow"].values["samples"] == str((made[-1].utc_ns - first.utc_ns) * 10 // NS_PER_S + 1)


def test_losses_and_absent_devices_of_a_recording() -> None:
    diagnosis, levels = RecordedDiagnosis(), []
    for second in range(20):
        samples = run_of("bow", second)
        if second in (0, 4):
            diagnosis.losses(losses("bow", samples[0], second))
        seconds = diagnosis.samples("bow", samples)
        levels += [one.devices[0].level for one in seconds]
    assert levels == 4 * [OK] + 10 * [WARN] + 6 * [OK]
    assert seconds[-1].devices[0].values["lost_gap_device"] == "4"
    diagnosis = RecordedDiagnosis()
    diagnosis.samples("bow", run_of("bow", 0))
    for detail, level in (({"state": "missing"}, ERROR), ({"state": "silent"}, STALE), ({}, ERROR)):
        down = Event(5, "bow", EventKind.DOWN, "is gone", detail)  # type: ignore[arg-type] # dict is invariant
        found = diagnosis.event(StampedEvent(down, UTC_NS))
        assert found is not None
        assert (found.utc_ns, found.devices[0].level) == (UTC_NS, level)
        assert found.devices[0].message == f"{detail.get('state', 'down')}: is gone"
    found = diagnosis.event(StampedEvent(Event(6, "bow", EventKind.UP, "is back"), UTC_NS + 1))
    assert found is not None
    assert found.devices[0].level is OK
    found = diagnosis.event(StampedEvent(Event(6, "mast", EventKind.UP, "is there"), UTC_NS + 1))
    assert found is not None
    assert found.devices[1][1:3] == (OK, "no sample yet")
    assert diagnosis.event(StampedEvent(Event(7, "bow", EventKind.MARK, "a pulse"), UTC_NS)) is None
    diagnosis, levels = RecordedDiagnosis(), []
    for second in range(12):
        if second < 2:
            diagnosis.samples("mast", run_of("mast", second))
        for seen in diagnosis.samples("bow", run_of("bow", second)):
            levels.append({one.device: one.level for one in seen.devices}["mast"])
    assert levels == 5 * [OK] + (len(levels) - 5) * [STALE]
