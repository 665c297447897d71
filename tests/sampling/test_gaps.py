"""Losses while the process is stopped: the device continues, and the kernel drops data if its buffer is full.

The truth is the number of samples of the device less the delivered samples. The count of lost samples is accurate
within one sample per stall, or the gap is reported as a gap of unknown size.
"""

from dataclasses import dataclass, field, replace
from itertools import product
from random import Random
from typing import Final

import pytest

from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.clock import SampleClock
from imud.sampling.gaps import ArrivalPace

FRAME_BYTES: Final = 82
READ_BYTES: Final = 4095
BEGIN_NS: Final = 1_000 * NS_PER_S
N_TTY: Final = 4096
FLIP_BUFFER: Final = 65536
STALLS: Final = 8
SEEDS: Final = (1, pytest.param(2, marks=pytest.mark.thorough), pytest.param(3, marks=pytest.mark.thorough))


@dataclass(frozen=True)
class Device:
    """A simulated device: its rate, its counter, and the error of its crystal."""

    rate_hz: int
    tick_ns: int  # 0: the counter numbers the samples. -1: no counter.
    modulus: int
    ppm: float = 30.0
    first: int = 12345
    stamp_modulus: int = 0  # modulus of `pps_age_ms` in frames without a counter; 0 without this value
    pulses: bool = False  # whether a pulse per second resets `pps_age_ms`

    def stamp_ms(self, index: int) -> int | None:
        if not self.stamp_modulus:
            return None
        if self.pulses:
            return self.time_ns(index) % NS_PER_S // NS_PER_MS
        return (self.first + index * 1000 // self.rate_hz) % self.stamp_modulus

    def ticks(self, index: int) -> int | None:
        if self.tick_ns < 0:
            return None
        step = NS_PER_S / self.rate_hz / self.tick_ns if self.tick_ns else 1
        return int(self.first + index * step) % self.modulus

    def time_ns(self, index: int) -> int:
        """Return CLOCK_MONOTONIC at the measurement of a sample, ns."""
        return BEGIN_NS + int(index * NS_PER_S / self.rate_hz * (1 - self.ppm * 1e-6))


def make_clock(device: Device, unknown: list[int]) -> SampleClock:
    """Return a clock that appends a gap of unknown size to `unknown`."""
    return SampleClock(
        "imu", tick_ns=device.tick_ns if device.tick_ns >= 0 else NS_PER_MS, tick_modulus=device.modulus, byte_ns=0,
        hold_ns=0, stamp_modulus=device.stamp_modulus, on_unknown_gap=lambda: unknown.append(1),
    )  # fmt: skip


@dataclass
class Reader:
    """A process that reads the bytes of a device from the kernel's buffer, and stalls sometimes."""

    device: Device
    clock: SampleClock
    kept_bytes: int
    random: Random
    made: int = 0
    delivered: int = 0
    missed: int = 0
    late_ns: int = 0
    stated_ns: int = 0
    now_ns: int = BEGIN_NS
    waiting: list[int] = field(default_factory=list)

    def run(self, duration_ns: int) -> None:
        end = self.now_ns + duration_ns
        while (due := self.device.time_ns(self.made)) < end:
            self._wait(due + 150 * NS_PER_US)
            self._read()
        self._wait(end)

    def stall(self, duration_ns: int) -> None:
        """Do not read for this time. Then read the kernel's buffer."""
        self._wait(self.now_ns + duration_ns)
        while self.waiting:
            self._read()
            self._wait(self.now_ns + 40 * NS_PER_US)

    def starve(self, duration_ns: int, every_ns: int) -> None:
        """Get a read only sometimes, like a process next to a busy process."""
        end = self.now_ns + duration_ns
        while self.now_ns < end:
            self._wait(self.now_ns + every_ns)
            self._read()

    def finish(self) -> int:
        """Read until the clock is settled. Return the true number of lost samples."""
        self.stall(0)
        self.run(6 * NS_PER_S)
        return self.made - self.delivered

    def _wait(self, until_ns: int) -> None:
        """Let the device send, and let the kernel drop the bytes that do not fit."""
        while self.device.time_ns(self.made) < until_ns - 100 * NS_PER_US:
            if (len(self.waiting) + 1) * FRAME_BYTES <= self.kept_bytes:
                self.waiting.append(self.made)
            self.made += 1
        self.now_ns = until_ns

    def _read(self) -> None:
        at_once = READ_BYTES // FRAME_BYTES
        indices, self.waiting = self.waiting[:at_once], self.waiting[at_once:]
        t_rx_ns = self.now_ns + int(self.random.expovariate(1 / (30 * NS_PER_US)))
        for place, index in enumerate(indices):
            trailing = (len(indices) - 1 - place) * FRAME_BYTES
            ticks, stamp_ms = self.device.ticks(index), self.device.stamp_ms(index)
            m = Measurement(FRAME_BYTES, trailing, ticks, (0.0, 0.0, 9.8), pps_age_ms=stamp_ms)
            sample = self.clock.sample(m, t_rx_ns, 0)
            assert sample.t_ns <= sample.t_rx_ns
            self.delivered += 1
            self.missed += self.clock.missed
            self.late_ns += sample.t_ns - self.device.time_ns(index)
            self.stated_ns += sample.t_err_ns


def reader(device: Device, kept_bytes: int, seed: int) -> tuple[Reader, list[int]]:
    """Return a reader at 8 s, and the list of gaps of unknown size."""
    unknown: list[int] = []
    one = Reader(device, make_clock(device, unknown), kept_bytes, Random(seed))
    one.run(8 * NS_PER_S)
    return one, unknown


HI91 = Device(1000, NS_PER_MS, 1 << 32)
HI91_400 = Device(400, NS_PER_MS, 1 << 32)
IMU61X = Device(200, NS_PER_US, 1 << 32)
IMU61X_WRAPS = Device(200, NS_PER_US, 1 << 24)
NUMBERED = Device(200, 0, 1 << 16)
NUMBERED_SHORT = Device(200, 0, 256)
UNCOUNTED = Device(100, -1, 1 << 32)
UNCOUNTED_FAST = Device(400, -1, 1 << 32)
HI92, HI92_400, HI92_FAST = (Device(rate_hz, -1, 1 << 32, stamp_modulus=8192) for rate_hz in (100, 400, 1000))
COUNTED = [HI91, HI91_400, IMU61X, IMU61X_WRAPS, NUMBERED, NUMBERED_SHORT]
STAMPED = [HI92, HI92_400, HI92_FAST]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("device", "kept_bytes"),
    [*product(COUNTED + STAMPED, [N_TTY]), *product([HI91_400, NUMBERED, HI92_400], [FLIP_BUFFER])],
)
def test_losses_over_stalls_are_those_of_the_device(device: Device, kept_bytes: int, seed: int) -> None:
    """Stalls are shorter than a wrap of the counter or value."""
    one, unknown = reader(device, kept_bytes, seed)
    longest_s = 7 if device.stamp_modulus else 10
    for _ in range(STALLS):
        one.stall(int(one.random.choice([0.05, 0.2, 0.7, 1, 2, 5, longest_s]) * NS_PER_S))
        one.run(int(one.random.choice([0.01, 0.1, 0.3, 1.5]) * NS_PER_S))
    assert one.finish() == one.missed
    assert not unknown
    assert not device.stamp_modulus or one.clock.status().resets == 0


FIGURES = [
    (HI91_400, (20526, 15853, 0, 0, 6881662, 42150625)),
    (IMU61X, (9026, 3453, 0, 2, 39514998, 43423370)),
    (IMU61X_WRAPS, (9026, 3453, 0, 2, 39514998, 43423370)),
    (NUMBERED_SHORT, (9026, 3453, 0, 0, 100238019, 6608218)),
    (UNCOUNTED, (4928, 118, 1, 0, -54582426, 83666802)),
    (UNCOUNTED_FAST, (20526, 15848, 0, 0, -141908012, 118447326)),
    (HI92, (4928, 180, 0, 1, 5267146, 23445785)),
    (HI92_400, (20526, 15897, 0, 0, -199349940, 154431348)),
    (replace(HI92_400, pulses=True), (20526, 15849, 0, 2, -318281337, 207161284)),
]


@pytest.mark.parametrize(("device", "figures"), FIGURES)
def test_the_figures_of_a_run_change_only_on_purpose(device: Device, figures: tuple[int, ...]) -> None:
    """Delivered and missed samples, gaps of unknown size, resets, mean error and mean stated error, ns."""
    one, unknown = reader(device, N_TTY, 9)
    for _ in range(4):
        one.starve(int(one.random.uniform(1, 12) * NS_PER_S), int(one.random.uniform(0.05, 0.7) * NS_PER_S))
        one.run(2 * NS_PER_S)
        one.stall(int(one.random.choice([0.05, 0.7, 5, 12]) * NS_PER_S))
        one.made += 3  # lost in the device
        one.run(int(one.random.choice([0.01, 0.3, 5]) * NS_PER_S))
        device = one.device = replace(one.device, first=one.device.first + 40 * (device.tick_ns or 1) // NS_PER_MS)
    one.finish()
    means = (one.late_ns // one.delivered, one.stated_ns // one.delivered)
    got = (one.delivered, one.missed, len(unknown), one.clock.status().resets, *means)
    assert got == pytest.approx(figures, rel=1e-6, abs=2)


@pytest.mark.parametrize("device", [HI92, replace(HI92_400, pulses=True)])
def test_losses_over_longer_stalls_are_right_within_one_where_messages_are_on_time_again(device: Device) -> None:
    one, _ = reader(device, N_TTY, 1)
    for _ in range(5):
        one.stall(int(one.random.choice([1, 5, 10, 20]) * NS_PER_S))
        one.run(3 * NS_PER_S)
    assert abs(one.finish() - one.missed) <= 5


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("device", "kept_bytes"), [*product(COUNTED, [N_TTY]), (NUMBERED, FLIP_BUFFER)])
def test_losses_under_starvation_are_those_of_the_device(device: Device, kept_bytes: int, seed: int) -> None:
    """All frames are late for up to 20 s, and the fit follows them. Then the host catches up."""
    one, unknown = reader(device, kept_bytes, seed)
    for _ in range(4):
        one.starve(int(one.random.uniform(1, 20) * NS_PER_S), int(one.random.uniform(0.05, 0.7) * NS_PER_S))
        if one.random.random() < 0.5:
            one.stall(0)
        one.run(int(one.random.choice([0.1, 0.3, 1.5, 3]) * NS_PER_S))
        if device.tick_ns:
            assert one.clock.expected_rate_hz == pytest.approx(device.rate_hz, rel=1e-3)
    assert one.finish() == one.missed
    assert not unknown


@pytest.mark.parametrize(
    ("device", "stall_s"), [(UNCOUNTED, 0.2), (UNCOUNTED, 2.0), (UNCOUNTED, 10.0), (UNCOUNTED_FAST, 2.0)]
)
def test_the_pace_shows_losses_without_a_counter(device: Device, stall_s: float) -> None:
    one, unknown = reader(device, N_TTY, 2)
    one.run(20 * NS_PER_S)
    for _ in range(3):
        one.stall(int(stall_s * NS_PER_S))
        one.run(5 * NS_PER_S)
    assert abs(one.finish() - one.missed) <= 3
    assert not unknown


@pytest.mark.parametrize("device", [UNCOUNTED, UNCOUNTED_FAST])
def test_a_gap_that_the_pace_cannot_show_is_unknown(device: Device) -> None:
    one, unknown = reader(device, N_TTY, 1)
    for _ in range(STALLS):
        one.stall(int(one.random.choice([0.7, 1, 2, 5, 10]) * NS_PER_S))
        one.run(int(one.random.choice([0.01, 0.1, 0.3, 1.5]) * NS_PER_S))
    assert unknown or abs(one.finish() - one.missed) <= STALLS


def test_a_gap_that_is_long_for_a_young_pace_is_counted_and_unknown() -> None:
    unknown: list[int] = []
    clock, random, missed = make_clock(UNCOUNTED, unknown), Random(1), 0
    for index in (*range(400), *range(60_000, 60_400)):
        wait_ns = int(random.random() * NS_PER_MS)
        clock.sample(Measurement(FRAME_BYTES, 0, None), BEGIN_NS + index * 10 * NS_PER_MS + wait_ns, 0)
        missed += clock.missed
    assert len(unknown) == 1
    assert missed == pytest.approx(59_600, abs=20)


@pytest.mark.parametrize("samples", [1, 2, 4, 5, 8])
@pytest.mark.parametrize("away_ms", [100, 250, 1500])
def test_a_restart_before_the_rate_is_known_is_one_gap(samples: int, away_ms: int) -> None:
    unknown: list[int] = []
    clock = make_clock(replace(HI91, rate_hz=10), unknown)
    times_ms = [*range(0, samples * 100, 100), *((samples - 1) * 100 + away_ms + more for more in range(0, 5000, 100))]
    for number, at_ms in enumerate(times_ms):
        device_ms = 13_600 + at_ms if number < samples else 100 * (number - samples + 1)
        sample = clock.sample(Measurement(FRAME_BYTES, 0, device_ms), BEGIN_NS + at_ms * NS_PER_MS, 0)
        assert clock.missed == 0
        assert sample.t_ns <= sample.t_rx_ns
    # with a rate, a device that was away 100 ms lost none
    assert len(unknown) == (1 if samples <= 4 or away_ms > 150 else 0)


def paced(pace: ArrivalPace, begin_ns: int, messages: int, late_ns: int = 0) -> tuple[int, int]:
    """Add frames at 100 Hz. Return the number of lost samples and the number of uncertain windows."""
    found = [pace.add_arrival(begin_ns + index * 10 * NS_PER_MS + late_ns) for index in range(messages)]
    return sum(missed for missed, _ in found), sum(not certain for _, certain in found)


def known_pace(turn: int = 1) -> ArrivalPace:
    """Return the pace of 100 Hz after one minute."""
    pace = ArrivalPace(turn)
    pace.begin(BEGIN_NS)
    assert paced(pace, BEGIN_NS + 10 * NS_PER_MS, 6000) == (0, 0)
    return pace


@pytest.mark.parametrize(
    ("turn", "steps", "resumed"),
    [(100, 58, 158), (100, 59, 0), (100, 42, 142), (100, 41, 0), (66, 18, 150), (64, 22, 0)],
)
def test_a_frame_number_continues_within_8_frames_of_its_due_value(turn: int, steps: int, resumed: int) -> None:
    assert known_pace(turn).resume(steps, BEGIN_NS + 61_500 * NS_PER_MS) == resumed


@pytest.mark.parametrize("waited_ms", [0, 18, 300])
def test_a_delayed_first_frame_keeps_the_pace(waited_ms: int) -> None:
    pace = known_pace()
    period_ns = pace.period_ns
    begin_ns = BEGIN_NS + 100 * NS_PER_S
    pace.begin(begin_ns + waited_ms * NS_PER_MS)
    assert paced(pace, begin_ns + 10 * NS_PER_MS, 300) == (0, 0)
    assert pace.period_ns == pytest.approx(period_ns, rel=1e-6)
    assert paced(pace, begin_ns + 33_010 * NS_PER_MS, 300) == (3000, 0), "an outage of 30 s is counted exactly"


@pytest.mark.parametrize("seed", range(3))
def test_the_pace_is_known_within_80_messages_whatever_they_wait_up_to_a_twentieth_of_their_period(seed: int) -> None:
    random, pace, period_ns = Random(seed), ArrivalPace(1 << 16), 100 * NS_PER_MS
    pace.begin(BEGIN_NS + int(random.uniform(0, 0.05) * period_ns))
    for index in range(1, 80):
        missed, _ = pace.add_arrival(BEGIN_NS + index * period_ns + int(random.uniform(0, 0.05) * period_ns))
        assert missed == 0
    assert pace.is_known
    assert pace.period_ns == pytest.approx(period_ns, rel=5e-3)


def test_early_frames_show_a_wrong_phase_and_not_another_rate() -> None:
    pace = known_pace()
    period_ns = pace.period_ns
    begin_ns = BEGIN_NS + 60_010 * NS_PER_MS
    assert paced(pace, begin_ns, 300, late_ns=-18 * NS_PER_MS) == (0, 1), "more than half a period is not sure"
    assert pace.period_ns == pytest.approx(period_ns, rel=1e-6)
    assert paced(pace, begin_ns + 33_000 * NS_PER_MS, 300, late_ns=-18 * NS_PER_MS) == (3000, 0)


@pytest.mark.parametrize("late_ms", [4, 40])
def test_a_delayed_window_keeps_the_pace(late_ms: int) -> None:
    pace, step_ns = ArrivalPace(256), 100 * NS_PER_MS
    pace.begin(BEGIN_NS)
    for index in range(1, 400):
        waits_ns = late_ms * NS_PER_MS if 200 <= index < 240 else 0
        assert pace.add_arrival(BEGIN_NS + index * step_ns + waits_ns) == (0, True)
        assert pace.is_known == (index >= 48)
    assert pace.period_ns == pytest.approx(step_ns, rel=1e-4)


@pytest.mark.parametrize("late_ms", [4, 45])
@pytest.mark.parametrize("missing_from", [(240,), (170, 201), (180, 215)])
def test_a_constant_lateness_is_not_another_rate(late_ms: int, missing_from: tuple[int, ...]) -> None:
    """The sender restarted, or its timer slept too long. Seven or more late frames are lost samples."""
    pace, period_ns = ArrivalPace(), 100 * NS_PER_MS
    pace.begin(BEGIN_NS)
    found = []
    for number in range(1, 400):
        late_ns = late_ms * NS_PER_MS * (number >= 150)
        number += sum(7 * (number >= first) for first in missing_from)  # noqa: PLW2901
        found.append(pace.add_arrival(BEGIN_NS + number * period_ns + late_ns))
    assert all(certain for _, certain in found)
    assert sum(missing for missing, _ in found) == 7 * len(missing_from)
    assert pace.period_ns == pytest.approx(period_ns, rel=1e-5)


@pytest.mark.parametrize("period_ms", [5, 9.9, 10.1])
def test_messages_that_are_off_in_every_window_are_of_another_rate(period_ms: float) -> None:
    pace = known_pace()
    for index in range(2000):
        pace.add_arrival(BEGIN_NS + 60 * NS_PER_S + int((index + 1) * period_ms * NS_PER_MS))
    assert pace.period_ns == pytest.approx(period_ms * NS_PER_MS, rel=2e-3)


@pytest.mark.parametrize(
    ("device", "restarts"), [*product(COUNTED[1:], [False]), *product([*COUNTED[:-1], UNCOUNTED], [True])]
)
def test_losses_after_a_missing_link(device: Device, restarts: bool) -> None:
    """A counter that continued counts the lost samples. A counter that restarted leaves a gap of unknown size."""
    one, unknown = reader(device, N_TTY, 3)
    one.run(0 if restarts else 10 * NS_PER_S)
    one.device = replace(device, first=device.first + 777_777_777 * restarts)
    one.kept_bytes = 0
    one.stall((3 if restarts else 10) * NS_PER_S)
    one.kept_bytes = N_TTY
    one.clock.restart()
    one.run(3 * NS_PER_S)
    assert len(unknown) == restarts
    assert one.missed == (0 if restarts else one.finish())


def test_a_counter_that_jumps_between_two_samples_leaves_no_gap() -> None:
    one, unknown = reader(HI91, N_TTY, 3)
    one.device = replace(HI91, first=HI91.first + 777_777_777)
    one.run(3 * NS_PER_S)
    assert one.clock.status().resets == 1
    assert not unknown
    assert one.missed == 0
