"""Thinning: the first sample at or after each due instant, without drift; the mean of what is between."""

import random
from math import ceil

import msgspec
import pytest

from imud.publishers.thinning import MeanRate, Pace
from imud.sample import Sample, Sync

START_NS = 80_000_000_000_001


def taken(pace: Pace, times_ns: list[int]) -> list[int]:
    return [t_ns for t_ns in times_ns if pace.is_due(t_ns)]


@pytest.mark.parametrize("rate_hz", [1.0, 3.0, 7.3, 99.9, 100.0])
def test_it_takes_the_first_sample_at_or_after_each_due_instant(rate_hz: float) -> None:
    rng = random.Random(5)
    times_ns = [START_NS]
    while times_ns[-1] < START_NS + 10_000_000_000:
        times_ns.append(times_ns[-1] + rng.randrange(1_900_000, 2_100_000))
    instants = [START_NS + ceil(k * 1e9 / rate_hz) for k in range(int(10 * rate_hz))]
    expected = [next(t_ns for t_ns in times_ns if t_ns >= due_ns) for due_ns in instants]
    assert taken(Pace(rate_hz), times_ns)[: len(expected)] == expected


def test_it_does_not_drift_in_a_day() -> None:
    pace = Pace(3.0)
    last_ns = START_NS + 86_400 * 1_000_000_000
    assert taken(pace, [START_NS, last_ns - 1]) == [START_NS, last_ns - 1]
    assert not pace.is_due(last_ns - 1)
    assert pace.is_due(last_ns)  # due instant number 259,200 exactly


def test_a_rate_above_the_device_s_takes_everything() -> None:
    for step_ns, rates_hz in ((1_000_000, (1000.0, 1001.0, 1e6)), (1, (1e9, 5e9, 1e300))):
        times_ns = [START_NS + k * step_ns for k in range(100)]
        for rate_hz in rates_hz:
            assert taken(Pace(rate_hz), times_ns) == times_ns


def test_after_a_pause_there_is_no_burst() -> None:
    times_ns = [START_NS, *(START_NS + 5_000_000_000 + k * 10_000_000 for k in range(10))]
    assert taken(Pace(10.0), times_ns) == times_ns[:2]


def test_a_mean_leaves_out_what_has_no_rate() -> None:
    mean = MeanRate()
    assert mean.take() is None
    bare = Sample("bow", 1, 0, 0, Sync.ARRIVAL, 0, 0)
    mean.add([bare, *(msgspec.structs.replace(bare, gyro_rad_s=(value, 2 * value, 0.0)) for value in (1.0, 3.0))])
    assert mean.take() == (2.0, 4.0, 0.0)
    assert mean.take() is None
