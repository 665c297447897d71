"""Statistics compared with manually computed values, for any division into batches."""

import math
from math import pi, radians, sqrt

import msgspec
import pytest

from imud.fleet.statistics import MEASURES, IntervalMaker, by_interval, summed_up
from imud.model.sample import Sample, Sync


def made(seq: int, **values: object) -> Sample:
    return Sample("bow", seq, seq * 1000, 10 * seq, Sync.EDGE, seq * 1000, seq * 1000 + 7, **values)  # type: ignore[arg-type]


def test_statistics_have_the_computed_values() -> None:
    first = made(3, temperature_c=1.0, gyro_rad_s=(0.0, 3.0, -1.0))
    interval = summed_up([first, made(4, temperature_c=3.0, gyro_rad_s=(0.0, 4.0, 1.0))])
    assert interval is not None
    assert (interval.first, interval.last, interval.count) == (3, 4, 2)
    assert (interval.begin_t_ns, interval.end_t_ns, interval.t_err_ns) == (3000, 4000, 40)
    assert (interval.begin_utc_ns, interval.end_utc_ns) == (3007, 4007)
    temperature, gyro = interval.values["temperature_c"], interval.values["gyro_rad_s"]
    assert (temperature.mean, temperature.min, temperature.max, temperature.rms) == ((2.0,), (1.0,), (3.0,), (sqrt(5),))
    assert (gyro.mean, gyro.min) == ((0.0, 3.5, 0.0), (0.0, 3.0, -1.0))
    assert gyro.rms == pytest.approx((0.0, sqrt(12.5), 1.0))
    assert set(interval.values) == {"temperature_c", "gyro_rad_s"}
    maker = IntervalMaker(["mean"])
    maker.add([made(1, temperature_c=1.0)])
    interval = maker.take()
    assert interval is not None
    measures = interval.values["temperature_c"]
    assert (measures.mean, measures.min, measures.max, measures.rms) == ((1.0,), None, None, None)
    assert maker.is_empty
    assert maker.take() is None


@pytest.mark.parametrize("cut", range(1, 6))
def test_the_division_into_batches_has_no_effect(cut: int) -> None:
    headings = [178, -179, -177, 179, 170, -175]
    samples = [
        made(n, euler_rad=(0.1 * n, 0.0, radians(one)), accel_m_s2=(1.0 * n, -n, n * n), status=1 << n)
        for n, one in enumerate(headings, 1)
    ]
    parts, whole = IntervalMaker(MEASURES), summed_up(samples)
    for at in range(0, len(samples), cut):
        parts.add(samples[at : at + cut])
    found = parts.take()
    assert found is not None
    assert whole is not None
    for name, measures in whole.values.items():
        for measure in MEASURES:
            assert getattr(found.values[name], measure) == pytest.approx(getattr(measures, measure), abs=1e-12)
    assert found.status == whole.status == 0b1111110


def test_the_mean_of_headings_near_south_is_near_south() -> None:
    headings = enumerate((179.0, -179.0, -178.0), 1)
    interval = summed_up([made(n, euler_rad=(0.0, 0.0, radians(one))) for n, one in headings])
    assert interval is not None
    yaw = interval.values["euler_rad"]
    assert yaw.mean is not None
    assert yaw.min is not None
    assert yaw.max is not None
    assert yaw.mean[2] == pytest.approx(radians(-(180 - 2 / 3)))
    assert (yaw.min[2], yaw.max[2]) == pytest.approx((radians(179), radians(182)))
    assert abs(yaw.mean[2]) <= pi
    half = sqrt(0.5)
    interval = summed_up([made(1, quat_wxyz=(half, half, 0.0, 0.0)), made(2, quat_wxyz=(-half, -half, 0.0, 0.0))])
    assert interval is not None
    assert interval.values["quat_wxyz"].mean == pytest.approx((half, half, 0.0, 0.0))


def test_intervals_lie_on_a_grid() -> None:
    samples = [made(n) for n in range(1, 8)]
    assert [(number, [one.seq for one in part]) for number, part in by_interval(samples, 3000)] == [
        (0, [1, 2]), (1, [3, 4, 5]), (2, [6, 7]),
    ]  # fmt: skip
    interval = summed_up([made(1, temperature_c=math.nan), made(2, temperature_c=4.0), made(3, pressure_pa=math.inf)])
    assert interval is not None
    assert interval.values["temperature_c"].mean == (4.0,)
    assert "pressure_pa" not in interval.values
    assert interval.count == 3
    assert summed_up([]) is None
    worse = msgspec.structs.replace(made(2), sync=Sync.REGRESSION)
    interval = summed_up([made(1), worse, made(3)])
    assert interval is not None
    assert interval.sync is Sync.REGRESSION
