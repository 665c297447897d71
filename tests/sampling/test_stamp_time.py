"""Ticks from 13-bit values (`pps_age_ms`): wraps, resets by pulses, delayed frames, and frames with device time."""

from collections.abc import Iterable
from itertools import pairwise

import pytest

from imud.model.sample import Measurement, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock
from imud.sampling.stamp_time import StampTime

BEGIN_NS = 1_000 * NS_PER_S
MODULUS = 8192


def ticks_of(stamps: list[int], times_ms: Iterable[int] = range(0, 1 << 20, 10)) -> list[int | None]:
    time, known = StampTime(MODULUS), None
    found = []
    for stamp, ms in zip(stamps, times_ms, strict=False):
        ticks = time.ticks(stamp, BEGIN_NS + ms * NS_PER_MS, known)
        known = ticks if ticks is not None else known
        found.append(ticks)
    return found


@pytest.mark.parametrize(
    ("stamps", "ticks"),
    [
        ([8170, 8180, 8190, 8, 18], [8180, 8190, 8200, 8210]),  # the wrap of a real device at 100 Hz, recorded
        # a pulse per second does not look like a loss of seven seconds
        ([950, 960, 970, 980, 990, 2, 12, 22, 32], [960, 970, 980, 990, 1002, 1012, 1022, 1032]),
        ([0] * 50, [None] * 49), ([4711] * 50, [None] * 49),  # frames that answer triggers contain no time
    ],
)  # fmt: skip
def test_ticks_of_stamps(stamps: list[int], ticks: list[int | None]) -> None:
    assert ticks_of(stamps) == [None, *ticks]


def test_pulses_that_stay_away_and_come_again_and_triggers() -> None:
    """After the last pulse, the value increases until its wrap. Then a pulse resets it again."""
    truth = list(range(500, 30_000, 10))
    stamps = [t % 1000 if t < 3000 or t >= 20_000 else (t - 2000) % MODULUS for t in truth]
    assert ticks_of(stamps)[1:] == truth[1:]
    found = ticks_of([*range(0, 500, 10), *[0] * 20])
    assert found[49] == 490
    assert found[-12:] == [None] * 12


def test_losses_within_a_turn_and_missed_turns() -> None:
    """Frames of 4 s are lost, and the frames around the gap arrive together: only the value shows the loss."""
    time, known = StampTime(MODULUS), None
    for i in range(100):
        known = time.ticks(10 * i, BEGIN_NS + 10 * i * NS_PER_MS, known)
    late_ns = BEGIN_NS + 5_000 * NS_PER_MS
    assert time.ticks(1000, late_ns, known) == 1000
    assert time.ticks(5000, late_ns, 1000) == 5000
    # 20 s are lost. The value shows 20000 - 2 · 8192 = 3616 ms of them.
    truth = [*range(0, 3000, 10), *range(23_000, 25_000, 10)]
    found = ticks_of([ms % MODULUS for ms in truth], truth)
    assert (found[1:300], found[300], found[-100:]) == (truth[1:300], 23_000 - 2 * MODULUS, truth[-100:])
    assert sum(b - a > 10 for a, b in pairwise(found[1:]) if a is not None and b is not None) == 2


def test_messages_that_carry_time_are_preferred_and_may_alternate() -> None:
    time = StampTime(MODULUS)
    for i in range(200):
        ms = 10 * i
        assert time.ticks(ms % MODULUS, BEGIN_NS + ms * NS_PER_MS, 77_000 + ms) is None
    later_ns = BEGIN_NS + 1990 * NS_PER_MS + NS_PER_S
    assert time.ticks(4000, later_ns, 78_990) is None
    assert time.ticks(4010, later_ns + 10 * NS_PER_MS, 78_990) == 78_990 + 1010
    unknown: list[int] = []
    clock, samples = stamp_clock(unknown), []
    for i in range(3000):
        hi91, hi92 = Measurement(82, 0, 500_000 + 10 * i), Measurement(54, 0, None, pps_age_ms=10 * i % MODULUS)
        samples.append(clock.sample(hi92 if 1000 <= i < 2000 else hi91, BEGIN_NS + 10 * i * NS_PER_MS + 8_000_000, 0))
        assert clock.missed == 0
    assert all(a.t_ns < b.t_ns for a, b in pairwise(samples))
    assert [samples[i].sync for i in (900, 1900, 2900)] == [Sync.REGRESSION] * 3
    assert not unknown


def stamp_clock(unknown: list[int]) -> SampleClock:
    times = {"tick_ns": NS_PER_MS, "tick_modulus": 1 << 32, "byte_ns": 86_806, "hold_ns": 0, "stamp_modulus": MODULUS}
    return SampleClock("bow", **times, on_unknown_gap=lambda: unknown.append(1))  # type: ignore[arg-type]


def test_samples_are_time_stamped_by_the_fit_of_their_values() -> None:
    """Every third arrival is 4 ms late. The fit does not follow them."""
    unknown: list[int] = []
    clock, truth_ns, errors = stamp_clock(unknown), BEGIN_NS, []
    for i in range(3000):
        truth_ns += 10 * NS_PER_MS
        late_ns = 54 * 86_806 + (4 * NS_PER_MS if i % 3 == 2 else 0)
        sample = clock.sample(Measurement(54, 0, None, pps_age_ms=10 * i % MODULUS), truth_ns + late_ns, 0)
        errors.append(abs(sample.t_ns - truth_ns))
        assert clock.missed == 0
    assert sample.sync is Sync.REGRESSION
    assert max(errors[500:]) < NS_PER_MS
    assert not unknown
    assert clock.status().resets == 0
