"""Devices with UTC or with a pulse per second: detection, bounds, accurate errors, no step."""

import pytest

from imud.contracts.lines import TimeBits, UtcReference
from imud.model.sample import Measurement, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock
from imud.sampling.device_utc import IntervalFit
from imud.sim.ports.arrival import BARE_UART, LOADED, USB_16MS, USB_16MS_PACKET, ArrivalModel, ArrivalProfile, Crystal
from tests.bench import line_runs
from tests.bench.clock import BAUD_OF_RATE, clock_for
from tests.support.clock_feed import BEGIN_NS, feed, message, rises, steady

UNIX = 1 << 32
DAY = 86_400_000
SLEW = 550e-6  # 500 ppm, and a margin for inexact crystals and lines


def model(profile: ArrivalProfile, rate_hz: int = 100, ppm: float = 0.0, seed: int = 1) -> ArrivalModel:
    return ArrivalModel(profile, rate_hz, seed, Crystal(ppm), BAUD_OF_RATE.get(rate_hz, 115_200))


@pytest.mark.parametrize(
    ("profile", "turn_ms", "seed"),
    [pytest.param(BARE_UART, UNIX, 1, marks=pytest.mark.thorough), (USB_16MS, UNIX, 1), (USB_16MS_PACKET, DAY, 3)],
    ids=lambda v: getattr(v, "name", v),
)
@pytest.mark.manual("B 1.2.1 UTC by PPS and RMC")
def test_a_device_that_turns_to_utc_is_recognised(profile: ArrivalProfile, turn_ms: int, seed: int) -> None:
    dated, clock = line_runs.run_utc(model(profile, seed=seed), 45, turn_ms=turn_ms)
    assert clock.status().resets == 0
    assert clock.status().reference_error_ns == line_runs.REFERENCE.error_ns
    assert line_runs.syncs(dated[1500:]) == {Sync.UTC}
    assert line_runs.share_honest(dated) >= 0.95
    assert line_runs.steepest(dated[1100:]) < 2 * SLEW  # the slew of the fit and of its correction
    assert rises(t.sample for t in dated)
    assert max(abs(t.off_ns) for t in line_runs.after(dated, 30)) < 600_000
    assert max(t.sample.t_err_ns for t in line_runs.after(dated, 30)) < NS_PER_MS


@pytest.mark.parametrize("ppm", [-50_000.0, 50.0])
def test_the_old_rate_of_the_crystal_is_forgotten_after_the_jump(ppm: float) -> None:
    """With the crystal's old rate, the time moved by 0.8 s until the new fit was in use, 16 s after the jump."""
    dated, clock = line_runs.run_utc(model(USB_16MS, 100, ppm), 32, turn_ms=UNIX)
    assert clock.status().resets == 0
    assert line_runs.share_honest(dated) >= 0.95
    assert max(abs(t.off_ns) for t in line_runs.after(dated, 9)) < 3 * NS_PER_MS
    assert max(t.sample.t_err_ns for t in line_runs.after(dated, 9)) < 5 * NS_PER_MS


def test_a_turn_before_anything_is_known_and_a_slow_drift_through_the_milliseconds() -> None:
    dated, clock = line_runs.run_utc(model(USB_16MS), 20, turn_ms=UNIX, turn_at=0.02)
    assert clock.status().resets == 0
    assert line_runs.syncs(dated[40:]) == {Sync.UTC}
    assert max(abs(t.off_ns) for t in dated[40:]) < 2 * NS_PER_MS
    assert line_runs.share_honest(dated) >= 0.95
    # Device time and UTC are each accurate within a tick, and both can stay at their limits for seconds.
    dated, _ = line_runs.run_utc(model(USB_16MS_PACKET, 200, -50.0, 2002), 15, turn_ms=UNIX, turn_at=0.06)
    assert line_runs.share_honest(dated) >= 0.95


@pytest.mark.parametrize(("count", "off_ms", "late_ns"), [(500, 0, 38_600), (500, 4, 43_211), (5, 4, 43_211)])
def test_a_device_can_restart_its_sampling_when_it_turns_to_utc(count: int, off_ms: int, late_ns: int) -> None:
    clock, at_ns = utc_clock(), BEGIN_NS + (10 * count + off_ms) * MS
    feed(clock, steady(0, 0, count))
    sample = clock.sample(message((at_ns + line_runs.UTC_OFFSET_NS) // MS % UNIX), at_ns + 2 * MS, 0)
    assert (sample.t_ns - at_ns, sample.sync, clock.status().resets) == (late_ns, Sync.UTC, 0)


@pytest.mark.parametrize("error_ns", [line_runs.REFERENCE.error_ns, 10 * NS_PER_S])
def test_gps_time_is_refused(error_ns: int) -> None:
    """The clock rejects a time that is 18 s off, even if the error of the host's time is 10 s."""
    unsure = UtcReference(line_runs.UTC_OFFSET_NS, error_ns)
    dated, clock = line_runs.run_utc(model(BARE_UART), 25, turn_ms=UNIX, ahead_ns=18 * NS_PER_S, reference=unsure)
    assert Sync.UTC not in line_runs.syncs(dated)
    assert clock.status().resets == 1


def test_a_device_that_was_on_utc_before_is_recognised() -> None:
    dated, _ = line_runs.run_utc(model(BARE_UART), 20, turn_ms=UNIX)
    clock = clock_for(model(BARE_UART))
    clock.set_utc_reference(line_runs.REFERENCE)
    samples = []
    for t in dated[600:]:
        ticks = (t.truth_ns + line_runs.UTC_OFFSET_NS) // NS_PER_MS % UNIX
        samples.append(clock.sample(Measurement(82, 0, ticks), t.sample.t_rx_ns, 0))
    assert [s.sync for s in samples[300:]] == [Sync.UTC] * (len(samples) - 300)


def on_utc(clock: SampleClock, count: int, status: int | None, off_ms: float, first: int = 0) -> list[Sync]:
    """100 Hz on UTC, with an increasing distance."""
    found = []
    for i in range(first, first + count):
        at = BEGIN_NS + 10 * i * NS_PER_MS
        ticks = (at + line_runs.UTC_OFFSET_NS + int(off_ms * (i - first) * NS_PER_MS)) // NS_PER_MS % UNIX
        found.append(clock.sample(Measurement(82, 0, ticks, status=status), at + 2 * NS_PER_MS, 0).sync)
    return found


def utc_clock(not_utc: int = 0) -> SampleClock:
    bits = TimeBits(not_utc=not_utc)
    clock = SampleClock("imu", tick_ns=NS_PER_MS, tick_modulus=UNIX, byte_ns=10_850, hold_ns=0, bits=bits)
    clock.set_utc_reference(line_runs.REFERENCE)
    return clock


def test_utc_ends_with_the_status_bit_a_drift_or_a_missing_reference() -> None:
    clock = utc_clock(0x800)
    assert Sync.UTC not in on_utc(clock, 500, 0x800, 0.0)
    assert on_utc(clock, 500, 0, 0.0, 500).index(Sync.UTC) == 7 * 13  # eight checks, one per 125 ms
    assert on_utc(clock, 10, 0x800, 0.0, 1000)[0] is Sync.REGRESSION
    clock = utc_clock()
    assert on_utc(clock, 1000, None, 0.0)[-1] is Sync.UTC
    assert on_utc(clock, 3000, None, 0.01, 1000)[-1] is Sync.REGRESSION  # 30 ms
    clock = utc_clock()
    on_utc(clock, 1000, None, 0.0)
    before = clock.status()
    clock.set_utc_reference(None)
    assert on_utc(clock, 1, None, 0.0, 1000) == [Sync.REGRESSION]
    assert abs(clock.status().offset_ns - before.offset_ns) < 10_000 + NS_PER_MS
    assert clock.status().reference_error_ns == 0


@pytest.mark.parametrize(("rate_hz", "ppm", "seconds"), [(1, 0.0, 100), (1, 50.0, 100), (100, 50_000.0, 25)])
@pytest.mark.manual("B 1.2.1 pulse per second")
def test_a_pulse_per_second_is_better_than_a_slow_adapter(rate_hz: int, ppm: float, seconds: int) -> None:
    dated = line_runs.run_pps(model(USB_16MS_PACKET, rate_hz, ppm), seconds)
    assert line_runs.share_honest(dated) >= 0.95
    assert rises(t.sample for t in dated)
    settled = line_runs.after(dated, 0.6 * seconds)
    assert sum(abs(t.off_ns) for t in settled) < 600_000 * len(settled)  # without it 1.5 ms at 100 Hz, 6 ms at 1 Hz
    assert Sync.EDGE in line_runs.syncs(settled)


def test_a_young_fit_and_a_lost_pulse_cause_no_step() -> None:
    """A slope error of 0.1 % is one millisecond at an age of one second. The intervals must contain it."""
    dated = line_runs.run_pps(model(LOADED, 1000, 50.0, 1007), 4)
    assert line_runs.share_honest(dated) >= 0.95
    assert all(abs(t.off_ns) < 3 * t.sample.t_err_ns for t in dated)
    dated = line_runs.run_pps(model(USB_16MS_PACKET, 50, 50.0), 90, silent_s=range(40, 60))
    assert {dated[1950].sample.sync, dated[-1].sample.sync} == {Sync.EDGE}
    assert dated[2500].sample.sync is Sync.REGRESSION
    assert line_runs.steepest(dated[1000:]) < 2 * SLEW
    assert line_runs.share_honest(dated) >= 0.95


@pytest.mark.parametrize(("rate_hz", "ppm"), [(100, 50_000.0), (1000, -50.0)])
@pytest.mark.manual("B 1.2.1 delay of the answer")
def test_triggers_find_their_answers(rate_hz: int, ppm: float) -> None:
    dated, clock, missed = line_runs.run_triggers(model(BARE_UART, rate_hz, ppm), 5, 0.95)
    paired = [t for t in dated if t.sample.edge_seq is not None]
    assert len(paired) > 0.9 * len(dated)
    assert all(t.sample.edge_seq == t.number for t in paired)
    assert line_runs.share_honest(dated) >= 0.95
    assert abs(clock.status().triggers_missed - missed) <= 20
    assert clock.status().edges == rate_hz * 5


MS = NS_PER_MS
FAR = 1 << 60


def filled(ppm: float, seconds: int = 40) -> tuple[IntervalFit, int]:
    """Add time stamps, truncated to ms, of a clock that is `ppm` fast. The device time is the instant itself."""
    intervals, x = IntervalFit(), 0
    for i in range(seconds * 10):
        x = i * NS_PER_S // 10 + 400_000
        low = int((x * (1 + ppm * 1e-6)) // MS * MS / (1 + ppm * 1e-6))
        intervals.add_interval(x, low, low + MS, FAR, 1.0)
    return intervals, x


@pytest.mark.parametrize(("ppm", "most_ns"), [(0.0, 350_000), (50.0, 100_000)], ids=["lockstep", "drift narrows"])
def test_a_drift_through_the_milliseconds_narrows(ppm: float, most_ns: int) -> None:
    intervals, x = filled(ppm)
    fix, error = intervals.combined(x, x, 1e9, 0.0)
    assert abs(fix) < min(2 * error, 150_000)
    assert error < most_ns
    if not ppm:
        assert intervals.width_ns(x) == pytest.approx(MS, rel=0.2)
        assert error == pytest.approx(289_000, rel=0.2)


def test_the_estimate_runs_at_the_slope_of_the_intervals_and_a_better_fit_within_them() -> None:
    intervals = IntervalFit()
    for x in range(0, 20 * NS_PER_S + 1, NS_PER_S // 10):
        low = int(x * (1 + 50e-6))
        intervals.add_interval(x, low, low + MS, FAR, 1.0)  # 50 ppm in addition to the given slope
    at, fits = 60 * NS_PER_S, int(60 * NS_PER_S * (1 + 50e-6)) + MS // 2
    assert abs(intervals.combined(at, fits, 1e12, 0.0)[0]) < 300_000
    intervals, x = filled(0.0)
    assert abs(intervals.combined(x, x + 50_000, 1000.0, 0.0)[0]) < 100
    fix, error = intervals.combined(x, x + 5 * MS, 1000.0, 0.0)
    assert -5.7 * MS < fix < -4 * MS
    assert error > 200_000


def test_the_width_grows_with_time_and_contradictions_drop_old_intervals() -> None:
    intervals, x = filled(50.0, 5)
    assert intervals.width_ns(x + NS_PER_S) > intervals.width_ns(x) + 10_000
    intervals = IntervalFit()
    for x in range(0, 5 * NS_PER_S, NS_PER_S):
        intervals.add_interval(x, x, x + MS, x + 100_000, 1.0)
    assert intervals.width_ns(4 * NS_PER_S) < 200_000
    # Intervals of one second show no slope, and the feasible lines are as wide as the intervals.
    intervals = IntervalFit()
    for x in (0, NS_PER_S // 2, NS_PER_S):
        intervals.add_interval(x, x, x + MS, FAR, 1.0)
    assert intervals.width_ns(NS_PER_S) > 100 * MS
    fix, error = intervals.combined(NS_PER_S, NS_PER_S, 1000.0, 0.0)
    assert abs(fix) < 10
    assert error == 1000.0
    middle = intervals.combined(NS_PER_S, NS_PER_S, 1e12, 0.0)[0]
    beside = NS_PER_S + int(middle + intervals.width_ns(NS_PER_S) / 2) + MS
    fix, error = intervals.combined(NS_PER_S, beside, 1000.0, 0.0)
    assert fix == pytest.approx(-MS, rel=0.01)
    assert error == pytest.approx(MS, rel=0.01)
    # up to 1.75 standard errors next to the intervals, both can be right; otherwise it is unknown which one is wrong
    beside = NS_PER_S + int(MS / 2 + intervals.width_ns(NS_PER_S) / 2 + 1.75 * NS_PER_S)
    errors = [intervals.combined(NS_PER_S, beside + more, 1e9, 0.0)[1] for more in (0, 1)]
    assert errors == pytest.approx([577_638_944, 1_531_179_641], abs=1)
    intervals, x = filled(0.0)
    for i in range(1, 200):
        at = x + i * NS_PER_S // 10
        intervals.add_interval(at, at + 20 * MS, at + 21 * MS, FAR, 1.0)
    assert intervals.known
    assert intervals.combined(at, at, 1e9, 0.0)[0] == pytest.approx(20.5 * MS, abs=0.6 * MS)
    # A device without pulses drifts away and reports UTC: its milliseconds only agree with each other.
    intervals, x = IntervalFit(), 0
    for _ in range(1000):
        x += 10_037_000
        low = x // MS * MS
        intervals.add_interval(x, low, low + MS, FAR, 1.0)
    assert intervals.width_ns(x) < MS // 4
    fix, error = intervals.combined(x, x + 3 * MS, 1000.0, 0.0)
    assert fix == pytest.approx(-3 * MS, rel=0.1)
    assert 2 * error >= abs(fix)
