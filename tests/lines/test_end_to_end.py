"""Pins of a simulated module through the whole device: edges, samples, and time stamps without steps."""

from itertools import pairwise

import pytest

from imud.contracts.lines import DeviceLines, DividedOptions, InputOptions, PpsOptions, SoutOptions, TriggerOptions
from imud.lines.sync import ALARM_STATUS
from imud.model.event import EventKind
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.uart_settings import AlarmSetting, HipnucHardware, ModuleSettings, Output
from imud.sim.physics import Still
from imud.sim.ports.faults import FaultRates, Faults
from imud.sim.ports.pins import PinFaultRates, PinFaults
from imud.sim.sensor import Pin
from imud.utc.receivers import RmcOptions
from tests.support.old_spellings import act
from tests.support.stories import played
from tests.support.wired_device import BEGIN_NS, EDGE_LATE_NS, WiredDevice

SOUT = DeviceLines(sout=SoutOptions(line="A"))
HI92 = ModuleSettings(hi91=Output(), hi92=Output(10))
"""Frames without device time. Their 13-bit `pps_age_ms` makes the time stamps."""
FEW_US = 4_000
STEP_NS = 20_000
"""Maximum change of the time stamp error between two samples, ns: 500 ppm of slewing in 10 ms, and noise."""


def off_ns(wired: WiredDevice, sample: Sample) -> int:
    return sample.t_ns - wired.instant(sample)


def check_pairs(wired: WiredDevice, samples: list[Sample]) -> int:
    """Check that each sample with an edge has its own edge. Return the number of these samples."""
    pulses = wired.pulses(Pin.SOUT)
    named = [sample for sample in samples if sample.edge_seq is not None]
    for sample in named:
        assert sample.edge_seq is not None
        assert pulses[sample.edge_seq] == pytest.approx(wired.instant(sample), abs=1000)
    return len(named)


def rises(samples: list[Sample]) -> bool:
    return all(a.t_ns < b.t_ns <= b.t_rx_ns for a, b in pairwise(samples))


@pytest.mark.parametrize("settings", [None, HI92])
@pytest.mark.manual("B 1.2.2 SOUT")
@played(lambda settings: WiredDevice(SOUT, settings))
async def test_every_sample_has_its_edge(wired: WiredDevice, settings: ModuleSettings | None) -> None:
    await wired.wait(3)
    samples = await wired.wait(5)
    assert len(samples) == pytest.approx(500, abs=2)
    assert check_pairs(wired, samples) == len(samples)
    for sample in samples:
        assert sample.sync is Sync.EDGE
        assert off_ns(wired, sample) == pytest.approx(EDGE_LATE_NS, abs=FEW_US)
        assert abs(off_ns(wired, sample)) < 2 * sample.t_err_ns
    (event,) = [event for event in wired.of_kind(EventKind.SYNC) if event.detail["sync"] == "edge"]
    assert event.detail["before"] in ("arrival", "regression")
    status = wired.device.status()
    assert status.lines is not None
    assert 0 <= max(wired.pulses(Pin.SOUT)) - status.lines.edges["sout"] <= 1  # one edge may wait for the event loop
    assert (status.lines.problems, status.clock.samples_unpaired) == ({}, 0)


@played(lambda: WiredDevice(SOUT))
async def test_edges_that_stop_and_come_back(wired: WiredDevice) -> None:
    await wired.wait(5)
    wired.cut.add(Pin.SOUT)
    without = await wired.wait(10)
    before = sum(sample.edge_seq is not None for sample in without)
    assert before <= 1  # of a pulse before the start
    assert {sample.sync for sample in without[before + 2 :]} == {Sync.REGRESSION}
    assert {sample.edge_seq for sample in without[before:]} == {None}
    (event,) = [event for event in wired.of_kind(EventKind.SYNC) if event.detail["before"] == "edge"]
    assert event.message == "time stamps by regression, were by edge"
    wired.cut.clear()
    again = await wired.wait(10)
    assert {sample.sync for sample in again[50:]} == {Sync.EDGE}
    assert check_pairs(wired, again) > 900
    steady = wired.samples[400:]
    offs = [off_ns(wired, sample) for sample in steady]
    assert max(abs(b - a) for a, b in pairwise(offs)) < STEP_NS
    assert rises(wired.samples)


@pytest.mark.parametrize("rate_hz", [100, 20])
@pytest.mark.parametrize(("edges", "frames"), [(0.1, 0.0), (0.0, 0.1), (0.1, 0.1)], ids=["edges", "frames", "both"])
@played(
    lambda edges, frames, rate_hz: WiredDevice(
        SOUT, ModuleSettings(hi91=Output(1000 // rate_hz)), frame_faults=Faults(3, FaultRates(lose=frames)),
        pin_faults=PinFaults(4, PinFaultRates(lose_pulse=edges, extra=edges / 5)),
    )
)  # fmt: skip
async def test_pairing_is_right_under_loss(wired: WiredDevice, edges: float, frames: float, rate_hz: int) -> None:
    await wired.wait(400 / rate_hz)
    samples = await wired.wait(1000 / rate_hz)
    assert check_pairs(wired, wired.samples)
    seen = {round(instant, -4) for instant in wired.pulses(Pin.SOUT).values()}
    with_edge = [s for s in samples if round(wired.instant(s), -4) in seen]
    assert bool(frames) == (len(samples) < 980)
    assert bool(edges) == (len(with_edge) < len(samples))
    assert sum(sample.edge_seq is not None for sample in with_edge) >= 0.99 * len(with_edge)
    assert rises(wired.samples)


@pytest.mark.manual("B 2.2.4 PMUX4 SOUT_DIV")
@played(
    lambda: WiredDevice(
        DeviceLines(sout=SOUT.sout, sout_div=DividedOptions(line="B", divisor=8)),
        frame_faults=Faults(5, FaultRates(lose=0.05)),
    )
)
async def test_marks_name_the_samples_of_a_camera(wired: WiredDevice) -> None:
    await wired.wait(10)
    by_seq = {sample.seq: sample for sample in wired.samples}
    marks = [event.detail for event in wired.of_kind(EventKind.MARK)]
    settled = [mark for mark in marks if isinstance(mark["edge_seq"], int) and mark["edge_seq"] > 20]
    assert [mark["edge_seq"] for mark in settled] == list(range(21, 21 + len(settled)))
    assert len(settled) > 90
    pulses, lost = wired.pulses(Pin.SOUT_DIV), 0
    arrived = {round(instant, -4) for instant in wired.instants.values()}
    for mark in settled:
        assert isinstance(mark["edge_seq"], int)
        instant = pulses[mark["edge_seq"]]
        if mark["seq"] is None:
            lost += 1
            assert round(instant, -4) not in arrived
        else:
            assert isinstance(mark["seq"], int)
            assert wired.instant(by_seq[mark["seq"]]) == pytest.approx(instant, abs=1000)
    assert lost > 0


ALARM = DeviceLines(alarm=InputOptions(line="C"))
RANGE = ModuleSettings(alarm_y=AlarmSetting(-5, 5, True))


@pytest.mark.manual("B 2.2.4 PMUX5 ALARM")
@played(lambda: WiredDevice(ALARM, RANGE, identify=True))
async def test_an_alarm_is_an_event_and_shown_in_the_samples(wired: WiredDevice) -> None:
    """The motion swings by 25°."""
    samples = await wired.wait(10)
    messages = [event.message for event in wired.of_kind(EventKind.ALARM)]
    assert any(message.startswith("alarm") for message in messages)
    assert any(message.startswith("alarm ended") for message in messages)
    assert not any("line alarm" in message for message in messages)
    status = wired.device.status()
    assert status.settings["alarm.y"] == "-5° … 5°, on"
    assert status.lines is not None
    assert status.lines.alarms > 2
    assert status.lines.problems == {}
    shown = [bool((sample.status or 0) & ALARM_STATUS) for sample in samples]
    assert set(shown) == {True, False}
    for sample, alarm in zip(samples, shown, strict=True):
        assert sample.euler_rad is not None
        beyond_rad = abs(sample.euler_rad[0]) - 0.0873
        assert alarm == (beyond_rad > 0) or abs(beyond_rad) < 0.03  # the device checks its angles every 10 ms


@played(lambda: WiredDevice(ALARM, RANGE, HipnucHardware(motion=Still(roll_rad=0.3)), identify=True))
async def test_an_alarm_wire_that_is_cut_is_reported(wired: WiredDevice) -> None:
    wired.cut.add(Pin.ALARM)

    await wired.wait(5)
    (event,) = wired.of_kind(EventKind.ALARM)
    assert "is the wire connected" in event.message
    status = wired.device.status()
    assert status.lines is not None
    assert status.lines.problems == {"alarm": event.message.removeprefix("line alarm: ")}
    await act(wired.device, "alarm", {"axis": "Y", "min_deg": -60, "max_deg": 60})
    status = wired.device.status()
    assert status.lines is not None
    assert status.lines.problems == {}  # the settings are unknown again


@pytest.mark.manual("B 1.2.1 trigger")
@played(
    lambda: WiredDevice(
        DeviceLines(sin=TriggerOptions(line="D", rate_hz=50)),
        ModuleSettings(hi91=Output(on_mark=True)),
        frame_faults=Faults(6, FaultRates(lose=0.05)),
    )
)
async def test_frames_answer_the_triggers_on_sin(wired: WiredDevice) -> None:
    await wired.wait(4)
    samples = await wired.wait(10)
    rising = [t_ns for t_ns, level in wired.memory.outputs["bow sin"].history if level]
    assert [b - a for a, b in pairwise(rising)] == pytest.approx([20 * NS_PER_MS] * (len(rising) - 1), abs=1000)
    assert 450 < len(samples) < 490
    for sample in samples:
        assert sample.sync is Sync.EDGE
        assert sample.edge_seq is not None
        assert sample.t_ns == pytest.approx(rising[sample.edge_seq - 1], abs=FEW_US)
    status = wired.device.status()
    assert status.lines is not None
    assert status.lines.triggers == len(rising)
    assert status.clock.triggers_missed > 10


PPS = DeviceLines(pps=PpsOptions(line="E"))
UTC_S = 1_795_000_000
FIRST_PULSE_NS = BEGIN_NS + 2 * NS_PER_S
WITHOUT_S = 30
"""Time without pulses, s. The device corrects the error of its crystal immediately after it."""


@pytest.mark.parametrize(
    ("lines", "skew_ppm"), [(PPS, 30.0), (DeviceLines(pps=PPS.pps, sout=SOUT.sout), -30.0)], ids=["pps", "pps and sout"]
)
@pytest.mark.manual("B 1.2.1 UTC by PPS and RMC")
@played(
    lambda lines, skew_ppm: WiredDevice(lines, None, HipnucHardware(skew_ppm=skew_ppm), rmc=RmcOptions(source="gpsd"))
)
async def test_a_module_that_is_fed_utc_is_on_utc_and_stays_in_time(
    wired: WiredDevice, lines: DeviceLines, skew_ppm: float
) -> None:
    async def seconds(first: int, last: int) -> None:
        for second in range(first, last):
            pulse_ns = FIRST_PULSE_NS + second * NS_PER_S
            await wired.wait((pulse_ns - wired.clock.now_ns()) / NS_PER_S)
            wired.run_module()
            wired.pulse_per_second(pulse_ns)
            await wired.wait(0.2)
            wired.sentence(UTC_S + second)
            await wired.wait(0.5)

    await seconds(0, 30)
    on_utc = [sample for sample in wired.samples if sample.sync is Sync.UTC]
    assert on_utc
    assert wired.samples[-1].sync is Sync.UTC
    status = wired.device.status()
    assert status.utc is not None
    assert status.utc.sent > 20
    assert status.utc.pulses == 30
    assert status.clock.reference_error_ns > 0
    await seconds(30 + WITHOUT_S, 60 + WITHOUT_S)
    assert wired.samples[-1].sync is Sync.UTC
    instants = sorted(wired.frames)
    assert rises(wired.samples)
    assert len(instants) == len(wired.samples)
    offs = [s.t_ns - instant for s, instant in zip(wired.samples, instants, strict=True)]
    assert max(abs(b - a) for a, b in pairwise(offs[200:])) < STEP_NS
    assert max(map(abs, offs[500:])) < 1.5 * NS_PER_MS
    assert all(abs(off) < 2 * s.t_err_ns for off, s in zip(offs, wired.samples, strict=True))
