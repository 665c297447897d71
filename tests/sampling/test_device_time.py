"""Device time: unwrapped, finer than a tick, even over corrections of the counter; lost samples; numbers."""

from collections.abc import Callable
from itertools import pairwise, product
from random import Random

import pytest

from imud.contracts.lines import UtcReference
from imud.model.sample import Measurement, Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.arrival_fit import ArrivalFit
from imud.sampling.clock import SampleClock
from imud.sampling.device_time import DeviceTime, PeriodLearner
from imud.sim.ports.arrival import BARE_UART, USB_16MS, ArrivalModel, ArrivalProfile, Crystal
from tests.bench.clock import BAUD_OF_RATE
from tests.bench.line_model import LineFaults, measured_ns, simulate_reads
from tests.bench.line_runs import (
    REFERENCE,
    UTC_OFFSET_NS,
    DatedSample,
    after,
    begun_ns,
    measurement,
    share_honest,
    sout_clock,
    steepest,
)  # fmt: skip
from tests.support.clock_feed import BEGIN_NS, feed, make_clock, rises, steady

# --- unwrapping -------------------------------------------------------------------------------------------------------


def test_it_wraps_has_no_sign_and_counts_losses() -> None:
    time = DeviceTime(NS_PER_MS, 1000)
    time.begin(990)
    for i in range(1, 1001):
        time.advance((990 + 10 * i) % 1000)
    assert (time.raw_ns, time.even_ns, time.error_ns) == ((990 + 10_000) * NS_PER_MS, time.raw_ns, 0)
    # The caller compares it with the host time. Device time has no sign.
    time = DeviceTime(NS_PER_MS, 1 << 32)
    time.begin(5000)
    assert time.elapsed_ns(4990) == ((1 << 32) - 10) * NS_PER_MS
    time = DeviceTime(NS_PER_MS, 1 << 32)
    time.begin(0)
    for i in range(1, 11):
        time.advance(10 * i)
    time.advance(130)
    assert time.missed == 2
    time.begin(0)
    assert time.missed == 0


@pytest.mark.parametrize(("first", "gaps"), [(5100, 0), (0, 1)])
def test_the_caller_reports_the_gap_of_a_step_between_two_counters(first: int, gaps: int) -> None:
    noted: list[int] = []
    time = DeviceTime(NS_PER_MS, 1 << 32, lambda: noted.append(1))
    time.begin(0)
    for ticks in (100, 5100):
        time.advance(ticks)
    time.begin(first)
    for ticks in range(first + 100, first + 600, 100):
        time.advance(ticks)
    assert len(noted) == gaps


def test_uneven_and_repeated_ticks_become_even() -> None:
    """400 Hz in milliseconds: the counter steps 2, 3, 2, 3, the samples 2.5."""
    time = DeviceTime(NS_PER_MS, 1 << 32)
    time.begin(0)
    even = []
    for i in range(1, 2000):
        time.advance(i * 5 // 2)
        even.append(time.even_ns)
        assert 0 <= time.even_ns - time.raw_ns <= NS_PER_MS
    steps = [b - a for a, b in pairwise(even[1000:])]
    assert max(abs(step - 2_500_000) for step in steps) < 2_000
    assert 0 < time.error_ns < 50_000
    # 1 kHz in milliseconds, 100 ppm fast: after 5 s, a counter value occurs twice.
    time = DeviceTime(NS_PER_MS, 1 << 32)
    time.begin(0)
    even = []
    for i in range(1, 14_000):
        time.advance(int(i * 0.9999 + 0.5))
        even.append(time.even_ns)
    assert all(abs(b - a - NS_PER_MS) < 1000 for a, b in pairwise(even[100:]))


# --- the period and missing samples -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("steps", "missed", "period"),
    [
        ([10, 30, 10, 50, 10], [0] * 5, 0),  # no lost samples before the period is known
        ([10] * 10 + [20, 10, 10], [1, 0, 0], 10), ([10] * 10 + [30, 10, 10], [2, 0, 0], 10),
        ([1] * 10 + [2, 1, 1], [1, 0, 0], 1), ([1] * 10 + [5, 1, 1], [4, 0, 0], 1),
        ([1000] * 10 + [3000, 1000], [2, 0], 1000),
        ([1] * 10 + [2, 1, 3, 1] * 500, [1, 0, 2, 0] * 500, 1),  # losses between normal steps do not change the period
        ([10, 0] * 50, [0] * 100, 10),  # ignores repeated counter values
        ([10] * 20 + [1] * 20 + [10], [0] * 20 + [9], 1),  # a faster rate causes no loss
        ([10] * 20 + [20] * 12 + [40], [0, 1], 20),  # uses a slower rate after twelve steps
        ([1, 2, 1, 1] + [1] * 100, [0] * 100, 1),  # losses at the start leave no fraction
    ],
)  # fmt: skip
def test_missing_samples_of_steps(steps: list[int], missed: list[int], period: int) -> None:
    """`missed` contains the results of the last steps."""
    learner = PeriodLearner()
    assert [learner.add_step(step) for step in steps][-len(missed) :] == missed
    assert (learner.period_ticks, learner.changes) == (period, 0)


@pytest.mark.parametrize(
    ("steps", "gaps"),
    [
        ([400, 300, 100, 100, 100, 100], 2),  # of about the same length: neither is longer than the other
        ([300, 300, 100, 100, 100, 100], 2),
        ([400, 100, 300, 100, 100, 100, 100], 2),
        ([100, 160, 40, 100, 101, 100, 100], 0),  # the short step makes up for the long step
        ([100, 101, 99, 100], 0),
        ([2, 3, 2, 3, 2, 3], 0),
        ([1, 1, 2, 1], 0),  # 750 Hz in milliseconds, or a loss: accurate within one sample
    ],
)
def test_gaps_from_before_a_period_is_known_are_noted_when_it_is(steps: list[int], gaps: int) -> None:
    noted: list[int] = []
    learner = PeriodLearner(lambda: noted.append(1))
    for step in steps:
        assert learner.add_step(step) == 0
    assert learner.period_ticks
    assert len(noted) == gaps
    learner.add_even_steps(1000)
    assert len(noted) == gaps


@pytest.mark.parametrize(("period", "scatter"), [(10, 4), (20, 6), (50, 20), (50, 40), (100, 30)])
def test_a_device_time_that_scatters_does_not_show_losses(period: int, scatter: int) -> None:
    random, noted, learner, newest = Random(1), list[int](), PeriodLearner(lambda: noted.append(1)), 0
    lost = 0
    for number in range(1, 3000):
        ticks = max(number * period + random.randint(-scatter, scatter), newest)
        lost += learner.add_step(ticks - newest)
        newest = ticks
    assert (lost, len(noted), learner.is_scattered) == (0, 0, True)
    for _ in range(40):
        lost += learner.add_step(period)
    assert (learner.add_step(2 * period), lost, learner.is_scattered) == (1, 0, False)


def test_steps_that_never_agree_make_no_period_and_uneven_and_equal_ticks_cause_no_loss() -> None:
    noted: list[int] = []
    learner = PeriodLearner(lambda: noted.append(1))
    learner.add_step(1 << 31)
    learner.restart(was_added=True)
    for _ in range(10):
        learner.add_step(100)
    assert learner.period_ticks == 100
    assert not noted
    learner = PeriodLearner()
    random = Random(7)
    for _ in range(1000):
        learner.add_step(random.randrange(1, 1 << 30))
    assert not learner.period_ticks
    assert len(learner._unjudged) <= 64
    # 400 Hz in milliseconds.
    learner = PeriodLearner()
    assert [learner.add_step(2 + i % 2) for i in range(1000)] == [0] * 1000
    assert learner.period_ticks == pytest.approx(2.5, abs=0.01)
    assert learner.add_step(8) == 2
    learner = PeriodLearner()  # regular steps of two ticks are a rate, and not losses, after eight steps
    assert sum(learner.add_step(1 + (i % 20 == 19)) for i in range(1000)) == 8
    assert learner.period_ticks == pytest.approx(1.05)
    # 1 kHz in milliseconds, 100 ppm fast: a counter value occurs twice after 10 s.
    learner = PeriodLearner()
    for i in range(10_100):
        learner.add_step(int(i * 0.9999) - int((i - 1) * 0.9999))
    assert learner.period_ticks == pytest.approx(0.9999, abs=3e-5)
    learner = PeriodLearner()
    for i in range(4001):
        learner.add_step(11 if i % 2000 == 1999 else 10)
    assert learner.period_ticks == pytest.approx(10.0005, abs=1e-5)
    assert 0 < learner.changes < 5


def test_random_losses_neither_blur_an_uneven_rate_nor_make_a_slower_one() -> None:
    """The mean without the lost steps is wrong by a thousandth. The device time would move through its tick."""
    random = Random(3)
    learner = PeriodLearner()
    ticks, i, found = 0, 0, []
    for _ in range(20_000):
        i += 1
        while random.random() < 0.1:
            i += 1
        ticks, before = i * 5 // 2, ticks
        learner.add_step(ticks - before)
        found.append(learner.period_ticks)
    assert all(abs(period - 2.5) < 5e-4 for period in found[5000:])
    random = Random(1)
    learner = PeriodLearner()
    for _ in range(20_000):
        step = 1
        while random.random() < 0.1:
            step += 1
        learner.add_step(step)
        assert learner.period_ticks < 2
    assert learner.period_ticks == 1


@pytest.mark.parametrize("rate_hz", [300, 480, 600, 700, 750, 800, 850])
@pytest.mark.parametrize("loss", [0.0, 0.02])
def test_only_proven_losses_are_counted(rate_hz: int, loss: float) -> None:
    """A step of two ticks is one period at 700 Hz in milliseconds, or it contains a lost sample."""
    random, time = Random(1), DeviceTime(NS_PER_MS, 1 << 32)
    kept = [i for i in range(9000) if random.random() >= loss]
    time.begin(0)
    counted = []
    for i in kept[1:]:
        time.advance(int(i * 1000 / rate_hz + 0.3))
        counted.append(time.missed)
    assert counted[500:] == [b - a - 1 for a, b in pairwise(kept)][500:]
    assert sum(counted) <= kept[-1] - len(kept) + 1


def learned(loss: float, *rates_hz: float) -> tuple[float, int, int, int, int]:
    """Feed steps in ms of a device that changes its rate.

    Return (period in ms, changes of the step, lost samples, gaps of unknown size, new rates).
    """
    noted, missed, new = list[int](), 0, 0
    random, learner, time_ms, ticks = Random(5), PeriodLearner(lambda: noted.append(1)), 7.3, 7
    for rate_hz in rates_hz:
        for _ in range(3000):
            time_ms += 1000 / rate_hz * (1 + (random.random() < loss) * random.randrange(1, 9))
            ticks, before = int(time_ms), ticks
            missed += learner.add_step(ticks - before)
            if random.random() < 0.01:  # the device sends a sample again
                learner.add_step(0)
            new += learner.is_new
            learner.is_new = False
    return learner.period_ticks, learner.changes, missed, len(noted), new


@pytest.mark.parametrize(
    ("loss", "rates_hz", "figures"),
    [
        (0.02, (400.0, 363.0), (2.7551632245169886, 1432, 493, 0, 0)),
        (0.02, (1000.0, 500.0, 1000.0), (0.9871116986120291, 78, 776, 0, 1)),
        (0.0, (100.05, 100.0, 99.9), (9.999336518046709, 30, 0, 0, 0)),
        (0.02, (640.0,), (1.5622716705413484, 2554, 247, 0, 0)),
        (0.4, (123.4,), (8.10462130937099, 366, 5604, 0, 0)),
    ],
)
def test_the_figures_of_a_period_change_only_on_purpose(
    loss: float, rates_hz: tuple[float, ...], figures: tuple[float, int, int, int, int]
) -> None:
    assert learned(loss, *rates_hz) == pytest.approx(figures, rel=1e-9)


# --- corrections ------------------------------------------------------------------------------------------------------


UNIX = 1 << 32
SECONDS = 14
SEED = 1
SET_AT_S = 12
SETTLED_S = 10.5
SLEW = 550e-6
JITTER_STEP_NS = 60_000
"""Largest step from the jitter, ns. The time stamps of edges are late by an exponential law of 4 µs."""


def run(
    profile: ArrivalProfile, rate_hz: int, set_ms: float, *, edges: bool, reference: UtcReference | None = None,
    faults: LineFaults | None = None,
) -> tuple[list[DatedSample], Callable[[], int]]:  # fmt: skip
    """Return the samples of a device on UTC with a corrected counter, and the number of resets."""
    model = ArrivalModel(profile, rate_hz, SEED, Crystal(0.0), BAUD_OF_RATE[rate_hz])
    clock, dated = sout_clock(model), []
    clock.set_utc_reference(reference)
    first_ns = 0
    for read in simulate_reads(model.run(rate_hz * SECONDS), SEED, faults or LineFaults()):
        if edges:
            clock.add_edges("sout", read.edges)
        for a, number in zip(read.arrivals, read.numbers, strict=True):
            truth_ns = measured_ns(a)
            first_ns = first_ns or truth_ns
            age_ns = truth_ns - first_ns
            moved_ns = set_ms * NS_PER_MS * (age_ns >= SET_AT_S * NS_PER_S)
            ticks = (truth_ns + UTC_OFFSET_NS + NS_PER_MS // 3 + int(moved_ns)) // NS_PER_MS % UNIX
            sample = clock.sample(measurement(a, ticks), a.t_rx_ns, 0)
            dated.append(DatedSample(sample, truth_ns, number, begun_ns(model, a)))
    return dated, lambda: clock.status().resets


CORRECTIONS_MS = (-0.9, 0.9, -30.0, 30.0)
USUAL = {
    (-0.9, 100, False, None), (0.9, 100, False, REFERENCE), (-30.0, 100, False, REFERENCE), (30.0, 100, False, None),
    (-0.9, 100, True, REFERENCE), (0.9, 100, True, None), (-30.0, 100, True, None), (30.0, 100, True, REFERENCE),
    (-0.9, 1000, True, REFERENCE),
}  # fmt: skip
"""Combinations of correction, rate, edges and reference that `make test` runs."""
CORRECTIONS = [
    pytest.param(*case, marks=() if case in USUAL else pytest.mark.thorough)
    for case in product(CORRECTIONS_MS, (100, 1000), (False, True), (None, REFERENCE))
]


@pytest.mark.parametrize(("set_ms", "rate_hz", "edges", "reference"), CORRECTIONS)
def test_a_correction_causes_no_step(set_ms: float, rate_hz: int, edges: bool, reference: UtcReference | None) -> None:
    dated, resets = run(BARE_UART, rate_hz, set_ms, edges=edges, reference=reference)
    settled = after(dated, SETTLED_S)
    assert resets() == 0
    assert all(abs(t.off_ns) <= 2 * t.sample.t_err_ns for t in settled)
    assert rises(t.sample for t in dated)
    if edges:
        assert max(abs(b.off_ns - a.off_ns) for a, b in pairwise(settled)) < JITTER_STEP_NS
        assert all(t.sample.edge_seq == t.number for t in settled)
        assert max(t.sample.t_err_ns for t in settled) < JITTER_STEP_NS
    else:
        assert steepest(settled) < 2 * SLEW


@pytest.mark.parametrize("edges", [False, True], ids=["bare", "edges"])
@pytest.mark.parametrize("rate_hz", [100, pytest.param(1000, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("set_ms", CORRECTIONS_MS)
def test_a_correction_behind_a_slow_adapter_with_losses_is_covered(set_ms: float, rate_hz: int, edges: bool) -> None:
    faults = LineFaults(pulse_loss=0.02, frame_loss=0.02)
    dated, resets = run(USB_16MS, rate_hz, set_ms, edges=edges, reference=REFERENCE, faults=faults)
    settled = after(dated, SETTLED_S)
    assert resets() == 0
    assert share_honest(settled) > 0.99
    assert all(abs(t.off_ns) <= 3 * t.sample.t_err_ns for t in settled)
    assert rises(t.sample for t in dated)
    wrong = sum(t.sample.edge_seq not in (None, t.number) for t in settled)
    assert wrong <= 16 * rate_hz // 1000  # at most the frames that the adapter holds in one read


def stamps(*steps: int) -> tuple[DeviceTime, list[int]]:
    """Return the device time over `steps`, in ms, after 100 steps of 10 ms, relative to the last of them."""
    time = DeviceTime(NS_PER_MS, UNIX)
    time.begin(0)
    ticks, found = 0, []
    for i, step in enumerate([10] * 100 + list(steps)):
        ticks += step
        time.advance(ticks)
        if i >= 99:
            found.append(time.even_ns)
    return time, [x - found[0] for x in found[1:]]


def test_two_small_corrections_cause_no_step_and_uneven_samples_are_followed() -> None:
    """The correction uses the rest of the tick. The next normal step finds no rest."""
    time, found = stamps(9, *[10] * 70, 9, 10)
    assert max(abs(b - a - 10 * NS_PER_MS) for a, b in pairwise([0, *found])) < 0.05 * NS_PER_MS
    assert time.doubt_ns > NS_PER_MS // 3
    # A device whose counter values change all the time: its samples are at these values, within a tick.
    time, found = stamps(*[11, 11, 11, 9, 9, 9] * 10)
    assert abs(found[-1] - 600 * NS_PER_MS) <= 2 * NS_PER_MS
    assert not time.uneven


@pytest.mark.parametrize("set_ms", [-2_000, 2_000])
def test_a_counter_that_moves_far_has_restarted(set_ms: int) -> None:
    clock = make_clock()
    feed(clock, steady(100_000, 0, 1000))
    feed(clock, [(110_030, 10_000)])
    assert clock.missed == 0, "samples that were never missing are not counted missing"
    feed(clock, steady(110_010 + set_ms, 10_010, 500))
    assert clock.status().resets == 1


def test_a_correction_needs_an_arrival_that_confirms_it() -> None:
    """One more period may have passed. The counter is set backward."""
    clock = make_clock()
    (last,) = feed(clock, steady(100_000, 0, 1000))[-1:]
    first, second = feed(clock, [(109_970, 10_000), (109_980, 10_010)])
    assert last.t_dev_ns is not None
    assert first.t_dev_ns == last.t_dev_ns - 20 * NS_PER_MS
    assert first.t_err_ns > 10 * NS_PER_MS
    assert second.t_err_ns < NS_PER_MS
    assert abs(first.t_ns - last.t_ns - 10 * NS_PER_MS) < NS_PER_MS // 100
    # The device paused once for 13 ms, and its frame arrived in time.
    clock = make_clock()
    points = steady(0, 0, 1000) + steady(9_993 + 10, 10_003, 500)
    samples = feed(clock, points)
    off_ns = [s.t_ns - BEGIN_NS - int(ms + 1) * NS_PER_MS for s, (_, ms) in zip(samples, points, strict=True)]
    assert max(map(abs, off_ns[500:])) < NS_PER_MS


@pytest.mark.parametrize(("seconds", "seen"), [(4, False), (6, True)])
def test_a_young_fit_detects_no_correction(seconds: int, seen: bool) -> None:
    time, _ = stamps(7)
    before_ns = time.even_ns - 7 * NS_PER_MS
    begin = before_ns - seconds * NS_PER_S
    fit = ArrivalFit(begin, begin)
    for at_ns in range(begin, before_ns + 1, 10 * NS_PER_MS):
        fit.add_arrival(at_ns, at_ns, 0, 0.0)
    assert time.absorb_correction(fit, before_ns, before_ns + 10 * NS_PER_MS) is seen


# --- counters of samples ----------------------------------------------------------------------------------------------


PERIOD_NS = 10 * NS_PER_MS


def numbering_clock() -> SampleClock:
    return SampleClock("imu", tick_ns=0, tick_modulus=65536, byte_ns=0, hold_ns=0)


def numbered(clock: SampleClock, index: int, t_ns: int, wait_ns: int = 2 * NS_PER_MS) -> Sample:
    """Sample `index`, on the wire from `t_ns`, complete after `wait_ns`."""
    return clock.sample(Measurement(40, 0, index % 65536), t_ns + wait_ns, 0, t_ns)


@pytest.mark.parametrize(
    ("indices", "missed"),
    [
        ((65530, 65531, 65532, 65535, 65536, 65540, 65541), [0, 0, 0, 2, 0, 3, 0]),  # through the wrap
        ((1, 2, 3, 4, 1004), [0, 0, 0, 0, 999]),  # a long gap that agrees with the host time
    ],
)
def test_missing_samples_are_counted(indices: tuple[int, ...], missed: list[int]) -> None:
    made, found = numbering_clock(), []
    for index in indices:
        numbered(made, index, index * PERIOD_NS)
        found.append(made.missed)
    assert found == missed
    assert made.status().resets == 0


@pytest.mark.parametrize(("later", "resets"), [(0, 1), (500, 0)], ids=["began anew", "link restarted"])
def test_a_counter_that_jumps_causes_no_loss(later: int, resets: int) -> None:
    """The counter restarts at 0 400 ms after sample 40019, or it continues while the link is missing."""
    made = numbering_clock()
    for index in range(40000, 40020):
        numbered(made, index, index * PERIOD_NS)
    if not resets:
        made.restart()
    for index in range(3):
        numbered(made, later + index, (40060 + index) * PERIOD_NS)
        assert made.missed == 0
    assert made.status().resets == resets


def test_time_is_that_of_the_first_frame_and_says_its_error() -> None:
    """The error contains the distance of the arrivals, and gaps do not change the rate."""
    made, random, offs = numbering_clock(), Random(1), []
    for index in range(2000):
        if index % 50 in (7, 8):
            continue
        delay_ns = int((0.05 + random.expovariate(20)) * NS_PER_MS)  # the middle of the allowed range
        made_of = numbered(made, index, index * PERIOD_NS + delay_ns, random.randrange(1 * NS_PER_MS, 6 * NS_PER_MS))
        assert made_of.sync is Sync.ARRIVAL
        assert made_of.t_dev_ns is None
        if index > 100:
            offs.append(abs(made_of.t_ns - index * PERIOD_NS) / made_of.t_err_ns)
    assert sum(off < 1 for off in offs) / len(offs) > 0.68
    assert sum(off < 3 for off in offs) / len(offs) > 0.98
    assert made.status().t_err_ns < 0.5 * NS_PER_MS
    assert abs(made.expected_rate_hz - 100) < 1


@pytest.mark.parametrize(
    ("steps", "is_new"),
    [
        ([10] * 100 + [35] + [2, 3] * 6, True), ([2, 3] * 100 + [20] * 12, True), ([2] * 100 + [1] * 12, True),
        ([5] * 100 + [4] * 12, True), ([10] * 100 + [35] + [2, 3] * 5, False), ([2, 3] * 300, False),
        ([1] * 999 + [2] + [1] * 40, False),
        # if every second frame is lost, twelve consecutive frames can look like half the rate
        ([1, 2, 1, 1, 2] * 20 + [2] * 12 + [1] * 12, False),
    ],
)  # fmt: skip
def test_a_change_of_rate_is_noticed_within_twelve_samples(steps: list[int], is_new: bool) -> None:
    learner = PeriodLearner()
    for step in steps:
        learner.add_step(step)
    assert learner.is_new is is_new
    if is_new or steps[-1] == 1:
        assert learner.period_ticks == pytest.approx(sum(steps[-12:]) / 12, abs=0.1)


@pytest.mark.parametrize(
    ("steps", "lost", "without"),
    [
        ([20] * 20, 0, 11), ([28] + [20] * 20, 0, 13), ([105] + [100] * 15, 0, 109), ([25] * 20, 0, 22),  # lower rates
        ([5] * 20, 0, 0), ([20, 20, 5] + [5] * 20, 2, 2), ([20] * 15 + [40, 40, 20], 2, 13),
        # A higher rate, or a loss that the next step of the previous period shows. The last case has no period.
        ([20, 10, 30, 30, 10, 10], 5, 5), ([20] * 9 + [10], 9, 9), ([30, 7, 10], 2, 2), ([40, -50, 10], 0, 3),
        ([25] * 9 + [50] + [25] * 20, 1, 36), ([20, 30, 40, 50] * 20 + [10], 200, 200),
        # Losses at the lower rate. The first steps do not show which samples of the previous rate are missing.
        ([40] + [20] * 20, 1, 14), ([20] * 3 + [60] + [20] * 20, 2, 19), ([31] + [20] * 20, 1, 13),
    ],
)  # fmt: skip
def test_a_lower_rate_that_imud_requests_is_no_loss(steps: list[int], lost: int, without: int) -> None:
    for expected, is_expected in ((without, False), (lost, True)):
        time, found = DeviceTime(NS_PER_MS, 1 << 32), 0
        time.begin(0)
        for step in [10] * 100 + steps:
            if step < 0:  # the device restarts its counter
                time.begin(0)
                continue
            if time.ticks == 1000 and is_expected:
                time.change.expect(time.even_ns)
            time.advance(time.ticks + step)
            found += time.missed
        assert found == expected


# --- late samples -----------------------------------------------------------------------------------------------------


def missed_by(steps_us: list[int], tick_ns: int = 1000) -> tuple[list[int], DeviceTime]:
    """Feed steps of a counter in microseconds after 200 steps of 10 ms. Return the lost samples of each step."""
    time = DeviceTime(tick_ns, 1 << 32)
    time.begin(0)
    missed = []
    for step_us in [10_000] * 200 + steps_us:
        time.advance(time.ticks + step_us * 1000 // tick_ns)
        missed.append(time.missed)
    assert not any(missed[:200])
    return missed[200:], time


@pytest.mark.parametrize("count", [2, 5, 13, 100])
def test_burst_of_late_samples_causes_no_loss(count: int) -> None:
    """A task of the device is late once: its samples have time stamps that are 3 µs apart."""
    burst_us = [count * 10_000] + [3] * (count - 1)
    missed, time = missed_by([*burst_us, 10_000 - 3 * (count - 1)] + [10_000] * 50)
    assert not any(missed)
    assert time.period.period_ticks == pytest.approx(10_000, rel=1e-3)
    assert not time.has_open_gap


def test_lost_samples_count_when_a_usual_sample_follows() -> None:
    missed, time = missed_by([130_000])
    assert (missed, time.has_open_gap) == ([0], True)
    missed, time = missed_by([130_000, 10_000, 10_000])
    assert (missed, time.has_open_gap) == ([0, 12, 0], False)
    missed, _ = missed_by([130_000, 30_000, 10_000])
    assert missed == [0, 12, 2]
    missed, _ = missed_by([130_000, 3, 3, 10_000])  # two of the twelve samples were late
    assert missed == [0, 0, 0, 10]
    missed, time = missed_by([130_000])
    assert (time.take_open(), time.has_open_gap) == (12, False)


def test_burst_without_a_gap_is_no_period() -> None:
    missed, time = missed_by([3] * 50 + [10_000] * 20)
    assert not any(missed)
    assert time.period.period_ticks == pytest.approx(10_000, rel=1e-3)


def test_steps_of_a_burst_are_no_first_period() -> None:
    time = DeviceTime(1000, 1 << 32)
    time.begin(0)
    for step_us in [3] * 12 + [10_000] * 20:
        time.advance(time.ticks + step_us)
        assert time.missed == 0
    assert time.period.period_ticks == 10_000
