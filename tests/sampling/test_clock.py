"""The complete clock: three rules for any input, disturbances by devices and hosts, polled samples.
Frames in one loop (`add_run`): the same samples, losses and state of the clock as frame by frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from random import Random
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.contracts.status import ClockStatus
from imud.host.clock import SteadyTime
from imud.model.sample import Measurement, Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.clock import SampleClock
from imud.sim.ports.arrival import LOADED, PROFILES, USB_1MS, USB_16MS, ArrivalModel, ArrivalProfile, Crystal
from tests.bench.clock import BAUD_OF_RATE, accuracy, run
from tests.support.clock_feed import BEGIN_NS, Point, feed, make_clock, message, rises, steady

# --- samples that arrive ----------------------------------------------------------------------------------------------


FRAME = Measurement(28, 0, None, (0.0, 0.0, 9.8))
NEAR_NS = 2 * NS_PER_MS
"""Maximum distance of a time stamp from the truth, ns. A frame needs 0.9 ms on the wire, and is read 1 ms after its
sample."""


def far(samples: Sequence[Sample], points: Sequence[Point]) -> int:
    """Return the largest distance of a time stamp from the truth, ns."""
    return max(abs(s.t_ns - BEGIN_NS - ms * NS_PER_MS) for s, (_, ms) in zip(samples, points, strict=True))


@given(st.lists(st.sampled_from([1, 2, 3, 10, 11, 500, 990, 999]), min_size=20, max_size=150), st.integers(0, 999))
def test_a_believable_device_never_resets(steps: list[int], first: int) -> None:
    clock = make_clock(tick_modulus=1000)
    points: list[Point] = []
    ms = 0
    for step in steps:
        points.append(((first + ms) % 1000, ms))
        ms += step
    samples = feed(clock, points)
    assert clock.status().resets == 0
    assert far(samples, points) < NEAR_NS
    assert samples[-1].t_dev_ns == (first + points[-1][1]) * NS_PER_MS


def test_it_comes_from_arrival_to_regression_and_learns_fast_and_slow_counters() -> None:
    clock = make_clock()
    samples = feed(clock, steady(5000, 0, 200))
    assert samples[0].sync is Sync.ARRIVAL
    assert samples[-1].sync is Sync.REGRESSION
    assert samples[-1].t_err_ns < samples[0].t_err_ns
    status = clock.status()
    assert status.sync is Sync.REGRESSION
    assert abs(status.skew_ppm) < 1
    assert status.t_err_ns == samples[-1].t_err_ns
    assert (status.parts[0].name, status.parts[0].value_ns) == ("link", 41_396), "143.4 us / sqrt(12)"
    assert abs(status.offset_ns - (BEGIN_NS - 5000 * NS_PER_MS)) < NEAR_NS
    clock = make_clock()
    points: list[Point] = [(int(10.5 * i), 10 * i) for i in range(6000)]
    samples = feed(clock, points)
    assert abs(clock.status().skew_ppm - 50_000) < 20
    assert abs(clock.expected_rate_hz - 100) < 0.01
    assert far(samples[1000:], points[1000:]) < NEAR_NS
    # A pty reports 9600 baud and delivers 1 kHz. The clock must not subtract 85 ms of time on the wire.
    clock = make_clock(byte_ns=1_041_666)
    points = steady(0, 0, 5000, step_ms=1)
    samples = feed(clock, points)
    assert far(samples[-500:], points[-500:]) < NEAR_NS
    assert clock.status().resets == 0


@pytest.mark.parametrize(
    ("before", "after", "resets"),
    [
        (steady(100_000, 0, 300), steady(7, 3500, 300), 1),  # the counter restarted
        (steady(0, 0, 500), steady(3_605_000, 5000, 500), 1),  # the host was suspended for an hour
        # 40 ms in the future is impossible; the clock accepts neither a new minimum nor a restart
        (steady(0, 0, 1000), steady(10_040, 10_000, 500), 0),
        (steady(0, 0, 500), steady(305_000, 305_000, 100), 0),  # silent for five minutes
    ],
    ids=["restarted", "suspended", "set forward", "silent"],
)
def test_jumps_of_the_counter(before: list[Point], after: list[Point], resets: int) -> None:
    clock = make_clock()
    samples = feed(clock, [*before, after[0]])
    assert clock.missed == (30_000 if after[0][1] == 305_000 else 0)
    samples += feed(clock, after[1:])
    assert clock.missed == 0
    assert clock.status().resets == resets
    assert rises(samples)
    assert far(samples, [*before, *after]) < NEAR_NS
    assert samples[len(before)].sync is (Sync.ARRIVAL if resets else Sync.REGRESSION)
    assert samples[-1].sync is Sync.REGRESSION


@pytest.mark.parametrize(
    ("before", "after", "settled", "resets"),
    [
        # reboot at 3 s, silent for a minute, counter at 5 s: forward, believable alone, and 58 s late
        (steady(0, 0, 300), steady(5000, 63_000, 500), 150, 1),
        # The counter continues 40 ms late: the link delays the frames, or the clock of the device stopped. No restart.
        (steady(0, 0, 2000), steady(20_000, 20_040, 3000), 2500, 0),
    ],
)
def test_a_counter_that_stays_late_has_restarted(
    before: list[Point], after: list[Point], settled: int, resets: int
) -> None:
    clock = make_clock()
    feed(clock, before)
    samples = feed(clock, after)
    assert clock.status().resets == resets
    assert rises(samples)
    assert far(samples[settled:], after[settled:]) < NEAR_NS
    # the error of 58 s is above the maximum of 32 bits
    assert (max(sample.t_err_ns for sample in samples) == 0xFFFF_FFFF) == (settled == 150)


def backlog(start_ms: int, stop_ms: int, burst: int, lost: frozenset[int] = frozenset()) -> list[Point]:
    """Return two minutes at 100 Hz through a serial device server: it delivers nothing from `start_ms` to `stop_ms`,
    then bursts of `burst` frames each 0.5 s until the backlog is empty, then each frame on time."""
    points: list[Point] = []
    now_ms, is_behind = 0, False
    for number in range(12_000):
        due_ms = 10 * number
        if start_ms <= due_ms < stop_ms:
            now_ms = stop_ms
            is_behind = True
        if is_behind and number % burst == 0:
            now_ms += 500
        is_behind = is_behind and now_ms > due_ms
        if number not in lost:
            points.append((due_ms, now_ms if is_behind else due_ms))
    return points


@pytest.mark.parametrize(
    ("start_ms", "stop_ms", "burst", "lost"),
    [
        (0, 4000, 120, frozenset[int]()),  # at the start
        (30_000, 34_000, 120, frozenset[int]()),
        (30_000, 34_000, 1000, frozenset[int]()),  # the complete backlog at once
        (30_000, 33_000, 60, frozenset({3050, 3051, 3125})),
    ],
)
def test_backlog_of_the_link_is_no_restart(start_ms: int, stop_ms: int, burst: int, lost: frozenset[int]) -> None:
    clock, missed = make_clock(), 0
    for point in backlog(start_ms, stop_ms, burst, lost):
        feed(clock, [point])
        missed += clock.missed
    assert (clock.status().resets, missed) == (0, len(lost))


@pytest.mark.parametrize(
    ("before_ms", "after", "resets", "missed"),
    [
        (86_400_000, steady(0, 3000, 500), 0, 0),
        (86_400_000, steady(30, 3030, 500), 0, 3),  # three samples lost at midnight
        (86_398_000, steady(10_000, 15_000, 500), 0, 1200),  # 12 s without samples around midnight
        (86_300_000, steady(0, 3000, 500), 1, 0),  # a restart 100 s before midnight
        (86_399_000, steady(500, 3500, 500), 1, 0),  # a restart 1 s before midnight
        (60_000, steady(0, 3000, 500), 1, 0),
    ],
)
def test_the_end_of_a_day_is_no_reset(before_ms: int, after: list[Point], resets: int, missed: int) -> None:
    feed(clock := make_clock(), steady(before_ms - 3000, 0, 300))
    samples = feed(clock, after[:1])
    assert (clock.status().resets, clock.missed) == (resets, missed)
    samples += feed(clock, after[1:])
    assert (clock.status().resets, clock.missed) == (resets, 0)
    assert rises(samples)
    assert resets or far(samples, after) < NEAR_NS
    assert resets or samples[-1].t_dev_ns == (after[-1][0] or 0) * NS_PER_MS + 86_400_000 * NS_PER_MS


@pytest.mark.parametrize("reads", [((200, 22_001),), ((150, 22_001), (150, 23_500))])
def test_a_busy_host_causes_no_reset(reads: tuple[tuple[int, int], ...]) -> None:
    """The reader of a busy host gets old frames. Several frames in one read count as one late read."""
    clock = make_clock()
    feed(clock, steady(0, 0, 2000))
    samples: list[Sample] = []
    for count, read_ms in reads:
        for i in range(count):
            late = message(20_000 + 10 * len(samples), 82 * (count - 1 - i))
            samples.append(clock.sample(late, BEGIN_NS + read_ms * NS_PER_MS, 0))
    assert clock.status().resets == 0
    assert len(reads) > 1 or far(samples, steady(20_000, 20_000, 200)) < NEAR_NS


def test_repeated_stamps_rise_and_a_stuck_counter_falls_back_to_arrival() -> None:
    clock = make_clock()
    points = [(10 * (i // 2), 10 * (i // 2) + i % 2) for i in range(400)]
    samples = feed(clock, points)
    assert rises(samples)
    assert clock.missed == 0
    assert clock.status().resets == 0
    clock = make_clock()
    clock.sample_polled(FRAME, BEGIN_NS, 1, BEGIN_NS, 0)
    assert make_clock().sample(message(None), -BEGIN_NS, 0).t_ns <= -BEGIN_NS, "a capture longer than the uptime"
    samples = [clock.sample(message(None), BEGIN_NS, 0) for _ in range(2)]
    assert [(s.t_ns, s.t_rx_ns) for s in samples] == [(BEGIN_NS + 1,) * 2, (BEGIN_NS + 2,) * 2]
    clock = make_clock()
    feed(clock, steady(0, 0, 300))
    samples = feed(clock, [(2990, 3000 + 10 * i) for i in range(600)])
    assert rises(samples)
    assert samples[-1].sync is Sync.ARRIVAL
    assert samples[-1].t_rx_ns - samples[-1].t_ns < NS_PER_S


def test_without_device_time_or_with_it_in_every_second_message_and_slewed_corrections() -> None:
    clock = make_clock()
    points: list[Point] = [(None, 10 * i) for i in range(100)]
    samples = feed(clock, points)
    assert {(s.sync, s.t_dev_ns) for s in samples} == {(Sync.ARRIVAL, None)}
    assert far(samples, points) < NEAR_NS
    assert (clock.missed, clock.expected_rate_hz) == (0, 0.0)
    clock = make_clock(byte_ns=1000)  # frames of one burst keep their distance
    samples = [clock.sample(message(None, 82 * (3 - i)), BEGIN_NS, 0) for i in range(4)]
    assert [b.t_ns - a.t_ns for a, b in pairwise(samples)] == [82_000] * 3
    assert samples[0].t_ns <= BEGIN_NS - 4 * 82_000
    clock = make_clock()
    samples = feed(clock, [(10 * (i // 2) if i % 2 else None, 10 * (i // 2) + 3 * (i % 2)) for i in range(600)])
    assert rises(samples)
    assert [s.sync for s in samples[-4:]] == [Sync.ARRIVAL, Sync.REGRESSION] * 2
    # Arrivals are suddenly 3 ms earlier. The step between samples changes by at most 0.05 %.
    clock = make_clock(hold_ns=0)
    late = [clock.sample(message(10 * i), BEGIN_NS + (10 * i + 4) * NS_PER_MS, 0) for i in range(3000)]
    steps = [b.t_ns - a.t_ns for a, b in pairwise(late[2000:])]
    assert max(abs(step - 10 * NS_PER_MS) for step in steps) <= 5_001


def test_one_clock_or_link_follows_another() -> None:
    clock = make_clock()
    samples = feed(clock, steady(0, 0, 300))
    clock.link_changed(byte_ns=1_085, hold_ns=NS_PER_MS)
    samples += feed(clock, steady(3000, 3000, 300))
    assert samples[300].sync is Sync.ARRIVAL
    assert samples[-1].sync is Sync.REGRESSION
    assert clock.status().resets == 0
    clock.restart()  # neither a reset nor a gap
    samples += feed(clock, [(7, 9000)])
    assert clock.missed == 0
    assert clock.status().resets == 0
    clock.link_changed(byte_ns=10_850, hold_ns=0)  # the device restarts: a reset
    samples += feed(clock, steady(27, 9020, 300)) + feed(clock, steady(7, 15_000, 300))
    assert clock.status().resets == 1
    assert clock.missed == 0
    assert rises(samples)
    assert samples[-300].t_dev_ns == 7 * NS_PER_MS
    clock = make_clock()
    feed(clock, steady(0, 0, 500))
    clock.sample(message(5000), BEGIN_NS + 10_000 * NS_PER_MS, 0)  # the host read this frame 5 s late
    clock.link_changed(byte_ns=10_850, hold_ns=0)
    feed(clock, [(10_010, 10_010)])
    assert (clock.missed, clock.status().resets) == (500, 0)
    first, second = make_clock(), make_clock()
    samples = feed(first, steady(0, 0, 100))
    second.continue_from(first)
    samples += feed(second, steady(5, 990, 100))
    assert rises(samples)
    assert [s.seq for s in samples] == list(range(1, 201))


def test_every_value_of_the_measurement_is_in_the_sample() -> None:
    values = {
        "accel_m_s2": (1.0, 2.0, 3.0), "gyro_rad_s": (4.0, 5.0, 6.0), "mag_t": (7.0, 8.0, 9.0),
        "quat_wxyz": (1.0, 0.0, 0.0, 0.0), "euler_rad": (0.1, 0.2, 0.3), "temperature_c": 20.5,
        "pressure_pa": 101325.0, "incli_rad": (0.01, 0.02), "status": 3, "pps_age_ms": 17,
    }  # fmt: skip
    m = Measurement(82, 0, 5, **values)  # type: ignore[arg-type] # a dict of all fields has one value type
    s = make_clock().sample(m, BEGIN_NS, 0)
    assert {name: getattr(s, name) for name in values} == values
    assert s.device == "imu"


# --- polled samples ---------------------------------------------------------------------------------------------------


def polled_clock() -> SampleClock:
    return SampleClock("imu", tick_ns=0, tick_modulus=2, byte_ns=0, hold_ns=0)


def test_the_time_of_polled_samples_is_that_of_the_poll_or_edge_and_rises() -> None:
    one = polled_clock()
    sample = one.sample_polled(FRAME, 1_000_000, 300, 1_200_000, 5_000_000_000)
    assert (sample.t_ns, sample.t_err_ns, sample.t_rx_ns, sample.utc_ns) == (1_000_000, 300, 1_200_000, 5_001_000_000)
    assert (sample.seq, sample.sync, sample.t_dev_ns) == (1, Sync.ARRIVAL, None)
    assert polled_clock().sample_polled(FRAME, 1, 2**40, 2, 0).t_err_ns == 2**32 - 1, "the largest that fits"
    other = polled_clock()  # another clock of the device continues from this clock
    other.continue_from(one)
    sample = other.sample_polled(FRAME, 500, 1, 1_000_001, 0)
    assert (sample.seq, sample.t_ns) == (2, 1_000_001)
    one = polled_clock()
    samples = [one.sample_polled(FRAME, t_ns, 1, t_ns + 5, 0) for t_ns in (100, 100, 50, 103, 200)]
    assert [sample.t_ns for sample in samples] == [100, 101, 102, 103, 200]
    assert [sample.t_err_ns for sample in samples] == [1, 2, 53, 1, 1]
    assert all(sample.t_ns <= sample.t_rx_ns for sample in samples)
    assert [sample.seq for sample in samples] == [1, 2, 3, 4, 5]
    one = polled_clock()
    stamps = ((100, 7), (200, None), (300, 8))
    samples = [one.sample_polled(FRAME, t_ns, 5, t_ns + 50, 0, edge) for t_ns, edge in stamps]
    assert [(sample.sync, sample.edge_seq, sample.t_ns) for sample in samples] == [
        (Sync.EDGE, 7, 100), (Sync.ARRIVAL, None, 200), (Sync.EDGE, 8, 300),
    ]  # fmt: skip
    assert (one.status().sync, [part.name for part in one.status().parts]) == (Sync.EDGE, ["pulses"])


@pytest.mark.parametrize(("hold_ns", "slower"), [(0, 0.0), (NS_PER_MS, 0.0), (0, 50e-6)])
def test_held_frames_are_time_stamped_by_the_fit_and_do_not_change_it(hold_ns: int, slower: float) -> None:
    """Nine of ten frames are read up to 9 ms late. If the crystal slows by 50 ppm, one of ten frames shows it."""
    clock = make_clock(hold_ns=hold_ns)
    feed(clock, steady(0, 0, 20_000, 1))
    before, offs = clock.status(), []
    for number in range(20_000, 45_000 if slower else 30_000):
        true_ns = BEGIN_NS + number * NS_PER_MS + int((number - 20_000) * slower * NS_PER_MS)
        late_ms = (10 - number % 10) if number % 10 else 0
        clock.waited_ns = 10 * NS_PER_MS if late_ms else 0
        offs.append(abs(clock.sample(message(number), true_ns + (late_ms + 1) * NS_PER_MS, 0).t_ns - true_ns))
    assert max(offs) < 1.2 * NS_PER_MS
    if slower:
        assert offs[-1] < 100_000
    else:
        assert abs(clock.status().t_err_ns - before.t_err_ns) < 20_000


CRYSTALS = {
    "exact": Crystal(0.0), "5 % fast": Crystal(50_000.0), "50 ppm slow": Crystal(-50.0),
    "drifting": Crystal(20.0, 0.1),
}  # fmt: skip


USUAL = [*product(PROFILES, ("5 % fast",)), (USB_1MS, "50 ppm slow"), (LOADED, "exact"), (USB_16MS, "drifting")]
CELLS = [
    pytest.param(*cell, marks=() if cell in USUAL else pytest.mark.thorough) for cell in product(PROFILES, CRYSTALS)
]


@pytest.mark.parametrize(("profile", "crystal"), CELLS, ids=lambda v: getattr(v, "name", v))
def test_the_error_covers_the_truth(profile: ArrivalProfile, crystal: str) -> None:
    for rate_hz, seconds in ((100, 30), (1, 100)):
        model = ArrivalModel(profile, rate_hz, 7, CRYSTALS[crystal], BAUD_OF_RATE[rate_hz])
        got = accuracy(run(model, rate_hz * seconds), settle_ns=20_000_000_000)
        assert got.share >= 0.95
        assert got.share_settling >= 0.95


def test_uneven_ticks_cause_no_error() -> None:
    """400 Hz in milliseconds: the time stamps do not contain the truncation of up to 0.5 ms."""
    model = ArrivalModel(PROFILES[1], 400, 1, Crystal(0.0), 921_600)
    assert accuracy(run(model, 8000), settle_ns=5_000_000_000).rms_ns < 60_000


@pytest.mark.parametrize("rate_hz", [200, pytest.param(1000, marks=pytest.mark.thorough)])
def test_bursts_behind_a_slow_timer(rate_hz: int) -> None:
    """Each read contains frames of 16 ms. The time stamp depends on the bytes after the frame and on the timer."""
    model = ArrivalModel(USB_16MS, rate_hz, 3, CRYSTALS["50 ppm slow"], BAUD_OF_RATE[rate_hz])
    got = accuracy(run(model, 20 * rate_hz), settle_ns=10_000_000_000)
    assert got.share >= 0.95
    assert got.rms_ns < 1_500_000
    assert got.mean_t_err_ns < 4 * got.rms_ns


BYTES: Final = 82
BYTE_NS: Final = 10_850
MODULUS: Final = 1 << 12  # Modulus of the counter, ticks. It wraps several times in a trial.
ROUNDS: Final = 600


@dataclass(frozen=True)
class Trial:
    """Properties of the device and its link."""

    name: str
    period_ms: float = 1.0
    hold_ns: int = 0
    most: int = 24  # maximum number of frames in a read
    waits: bool = False  # whether frames wait and are read together
    lost: float = 0.0
    odd: float = 0.0  # share of frames without device time, and of jumps of the counter
    slewed: float = 0.0  # rate of CLOCK_MONOTONIC relative to steady time
    early_ns: int = 0  # time by which some reads are too early, ns


TRIALS: Final = (
    Trial("even"), Trial("waits", waits=True), Trial("waits at 200 Hz", period_ms=5.0, most=6, waits=True),
    Trial("USB adapter", hold_ns=16 * NS_PER_MS), Trial("400 Hz in ms", period_ms=2.5),
    Trial("slewed host", waits=True, slewed=20e-6), Trial("losses", lost=0.0005, waits=True),
    Trial("jumps", odd=0.001, waits=True), Trial("early reads", early_ns=200 * NS_PER_US, waits=True),
)  # fmt: skip


class Device:
    """Reads of a device, each with its time and the maximum wait of its frames."""

    def __init__(self, trial: Trial, random: Random) -> None:
        self._trial = trial
        self._random = random
        self._number = self._jumped = 0
        self._t_rx_ns = BEGIN_NS

    def read(self) -> tuple[list[CodecEvent], int, int]:
        """Return the next read."""
        trial, random = self._trial, self._random
        count = random.choice((1, 1, trial.most // 2, trial.most))
        events = [event for place in range(count) for event in self._message(count - 1 - place)]
        period_ns = int(trial.period_ms * NS_PER_MS)
        late_ns = int(random.expovariate(1 / (20 * NS_PER_US))) + (count > 1) * random.randrange(period_ns)
        late_ns -= trial.early_ns * (random.random() < 0.05)
        due_ns = BEGIN_NS + self._number * int(period_ns * 1.00004) + BYTES * BYTE_NS + late_ns
        self._t_rx_ns = max(self._t_rx_ns, due_ns + int(self._number * period_ns * trial.slewed))
        return events, self._t_rx_ns, count * period_ns if trial.waits and count > 1 else 0

    def _message(self, behind: int) -> list[CodecEvent]:
        trial, random = self._trial, self._random
        self._number += 1
        self._jumped += random.randrange(5000) * (random.random() < trial.odd / 2)
        if random.random() < trial.lost:
            return [BadFrame(BadReason.CRC, b"")] if random.random() < 0.5 else []
        ticks = (int(self._number * trial.period_ms) + self._jumped) % MODULUS
        return [
            Measurement(
                BYTES, behind * BYTES, None if random.random() < trial.odd / 2 else ticks,
                accel_m_s2=(float(self._number), 0.0, 9.8), status=random.choice((None, 5)), pps_age_ms=self._number,
            )
        ]  # fmt: skip


class Dated:
    """A clock with its samples of the reads."""

    def __init__(self, trial: Trial) -> None:
        self.host = SteadyTime()
        self.unknown = 0
        self.clock = SampleClock(
            "imu", tick_ns=NS_PER_MS, tick_modulus=MODULUS, byte_ns=BYTE_NS, hold_ns=trial.hold_ns, host=self.host,
            on_unknown_gap=self._on_unknown_gap,
        )  # fmt: skip
        self.samples: list[Sample] = []
        self.missed: list[int] = []
        self.states: list[ClockStatus] = []
        self.in_runs = 0

    def _on_unknown_gap(self) -> None:
        self.unknown += 1

    def take(self, events: Sequence[CodecEvent], t_rx_ns: int, waited_ns: int, *, runs: bool) -> None:
        """Time-stamp the frames of a read, in runs or one by one."""
        self.clock.waited_ns = waited_ns
        at = 0
        while at < len(events):
            after = self.clock.add_run(self.samples, events, at, t_rx_ns, 7) if runs else at
            if after > at:
                self.in_runs += after - at
                self.missed += [self.clock.missed] * (after - at)
                at = after
                continue
            event = events[at]
            at += 1
            if isinstance(event, Measurement):
                self.samples.append(self.clock.sample(event, t_rx_ns, 7))
                self.missed.append(self.clock.missed)
        self.clock.waited_ns = 0
        self.states.append(self.clock.status())


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in (1, 2))])
@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.name)
def test_a_run_gives_the_same_samples_as_single_frames(trial: Trial, seed: int) -> None:
    random = Random(f"{trial.name} {seed}")
    device, one, many = Device(trial, random), Dated(trial), Dated(trial)
    for number in range(ROUNDS):
        events, t_rx_ns, waited_ns = device.read()
        own = random.choice((None, 1 << 31))
        for dated in (one, many):
            if trial.slewed:
                dated.host.add_pair(t_rx_ns, int(t_rx_ns * (1 - trial.slewed)))
            if not number % 50:
                dated.clock.set_own_status(own)
            dated.take(events, t_rx_ns, waited_ns, runs=dated is many)
    assert (many.samples, many.missed, many.states) == (one.samples, one.missed, one.states)
    assert many.unknown == one.unknown
    if trial.period_ms == int(trial.period_ms):  # otherwise no step equals the period
        assert many.in_runs > 0.05 * len(many.samples)


def test_no_run_without_a_fit_in_use() -> None:
    for settle in (False, True):
        trial = Trial("even")
        device, dated = Device(trial, Random(1)), Dated(trial)
        for _ in range(ROUNDS * settle):
            dated.take(*device.read(), runs=True)
        if settle:
            assert dated.in_runs
            assert dated.clock._sources().edge_seq is None  # the clock has aiding sources now
        before, (events, t_rx_ns, _) = len(dated.samples), device.read()
        assert dated.clock.add_run(dated.samples, events, 0, t_rx_ns, 0) == 0
        assert len(dated.samples) == before
