"""Thinning: the sample nearest to each due time, without drift, and the mean between samples."""

import random
from itertools import pairwise
from math import ceil

import msgspec
import pytest

from imud.model.sample import Sample, Sync
from imud.publishers.thinning import MeanRate, Pace, RateThinner

START_NS = 80_000_000_000_001


def taken(pace: Pace, times_ns: list[int]) -> list[int]:
    return [t_ns for before_ns, t_ns in pairwise([times_ns[0], *times_ns]) if pace.is_due(t_ns, t_ns - before_ns)]


@pytest.mark.parametrize("rate_hz", [1.0, 3.0, 7.3, 99.9, 100.0, 300.0])
def test_the_sample_nearest_to_each_due_time_is_selected(rate_hz: float) -> None:
    rng = random.Random(5)
    times_ns = [START_NS]
    while times_ns[-1] < START_NS + 10_000_000_000:
        times_ns.append(times_ns[-1] + rng.randrange(1_900_000, 2_100_000))
    instants = [START_NS + ceil(k * 1e9 / rate_hz) for k in range(int(10 * rate_hz))]
    chosen = taken(Pace(rate_hz), times_ns)[: len(instants)]
    assert len(chosen) == len(instants)
    away_ns = [abs(t_ns - due_ns) for t_ns, due_ns in zip(chosen, instants, strict=True)]
    assert away_ns[1] <= 2_100_000, "the step between samples is not known yet"
    assert max(away_ns[2:]) <= 1_150_000, "half a step, and what steps differ by"


@pytest.mark.parametrize("device_hz", [99.99, 100.0, 100.01])
def test_all_samples_of_a_device_with_the_same_rate_are_selected(device_hz: float) -> None:
    rng = random.Random(7)
    times_ns = [START_NS + int(k * 1e9 / device_hz) + rng.randrange(-300_000, 300_000) for k in range(30_000)]
    times_ns[100:103] = times_ns[1_000:1_001] = []  # a lost sample does not affect other samples
    # at most the two samples at the gap, and the samples above 100 Hz
    assert len(taken(Pace(100.0), times_ns)) >= len(times_ns) - 5


def test_the_selection_does_not_drift_and_has_no_burst() -> None:
    pace, instants = Pace(3.0), 259_200
    times_ns = [START_NS + ceil(k * 1e9 / 3.0) for k in range(instants)]
    assert sum(pace.is_due(t_ns, 333_333_333) for t_ns in times_ns) == instants
    # half a sample period before due time number 259,200
    assert pace.due_ns == START_NS + 86_400 * 1_000_000_000 - 166_666_667 + 1
    for step_ns, rates_hz in ((1_000_000, (1000.0, 1001.0, 1e6)), (1, (1e9, 5e9, 1e300))):
        times_ns = [START_NS + k * step_ns for k in range(100)]
        for rate_hz in rates_hz:
            assert taken(Pace(rate_hz), times_ns) == times_ns
    times_ns = [START_NS, *(START_NS + 5_000_000_000 + k * 10_000_000 for k in range(10))]
    assert taken(Pace(10.0), times_ns) == times_ns[:2]


def test_a_thinner_chooses_for_each_rate_across_batches() -> None:
    thinner, ms = RateThinner(), 1_000_000
    assert not thinner.choose([0])
    for rate_hz in (100.0, 250.0, 100.0):
        thinner.add(rate_hz)
    assert thinner.choose([*(k * ms for k in range(1, 11))]) == {100.0: (0,), 250.0: (0, 4, 8)}
    assert not thinner.choose([11 * ms - 600_000])  # 0.6 ms before the due time of the lower rate
    assert thinner.choose([11 * ms, 12 * ms]) == {100.0: (0,)}
    thinner.discard(100.0)
    thinner.discard(250.0)
    assert not thinner.choose([21 * ms - 300_001])  # the step before the selected sample was 0.6 ms
    assert thinner.choose([21 * ms - 300_000]) == {100.0: (0,)}
    thinner.discard(100.0)
    assert not thinner.choose([31 * ms])


def test_the_mean_ignores_samples_without_angular_rate() -> None:
    mean = MeanRate()
    assert mean.take() is None
    bare = Sample("bow", 1, 0, 0, Sync.ARRIVAL, 0, 0)
    mean.add([bare, *(msgspec.structs.replace(bare, gyro_rad_s=(value, 2 * value, 0.0)) for value in (1.0, 3.0))])
    assert mean.take() == (2.0, 4.0, 0.0)
    assert mean.take() is None
