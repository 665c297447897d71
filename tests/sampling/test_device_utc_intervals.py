"""Intervals of whole milliseconds and their common fit."""

import pytest

from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.device_utc import IntervalFit

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


def test_the_estimate_runs_at_the_slope_of_the_intervals() -> None:
    intervals = IntervalFit()
    for x in range(0, 20 * NS_PER_S + 1, NS_PER_S // 10):
        low = int(x * (1 + 50e-6))
        intervals.add_interval(x, low, low + MS, FAR, 1.0)  # 50 ppm in addition to the given slope
    at, fits = 60 * NS_PER_S, int(60 * NS_PER_S * (1 + 50e-6)) + MS // 2
    assert abs(intervals.combined(at, fits, 1e12, 0.0)[0]) < 300_000


def test_a_better_fit_stays_within() -> None:
    intervals, x = filled(0.0)
    assert abs(intervals.combined(x, x + 50_000, 1000.0, 0.0)[0]) < 100
    fix, error = intervals.combined(x, x + 5 * MS, 1000.0, 0.0)
    assert -5.7 * MS < fix < -4 * MS
    assert error > 200_000


def test_a_fit_beside_the_intervals_is_moved_and_doubted_by_that() -> None:
    """Intervals of one second show no slope, and the feasible lines are as wide as the intervals."""
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


def test_the_width_grows_with_time() -> None:
    intervals, x = filled(50.0, 5)
    assert intervals.width_ns(x + NS_PER_S) > intervals.width_ns(x) + 10_000


def test_arrivals_bound_from_above() -> None:
    intervals = IntervalFit()
    for x in range(0, 5 * NS_PER_S, NS_PER_S):
        intervals.add_interval(x, x, x + MS, x + 100_000, 1.0)
    assert intervals.width_ns(4 * NS_PER_S) < 200_000


def test_contradictions_drop_old_intervals() -> None:
    intervals, x = filled(0.0)
    for i in range(1, 200):
        intervals.add_interval(
            x + i * NS_PER_S // 10, x + 20 * MS + i * NS_PER_S // 10, x + 21 * MS + i * NS_PER_S // 10, FAR, 1.0
        )
    assert intervals.known
    at = x + 199 * NS_PER_S // 10
    assert intervals.combined(at, at, 1e9, 0.0)[0] == pytest.approx(20.5 * MS, abs=0.6 * MS)


def test_a_fit_that_contradicts_narrow_intervals_is_covered() -> None:
    """A device without pulses drifts away and reports UTC: its milliseconds only agree with each other."""
    intervals, x = IntervalFit(), 0
    for _ in range(1000):
        x += 10_037_000
        low = x // MS * MS
        intervals.add_interval(x, low, low + MS, FAR, 1.0)
    assert intervals.width_ns(x) < MS // 4
    fix, error = intervals.combined(x, x + 3 * MS, 1000.0, 0.0)
    assert fix == pytest.approx(-3 * MS, rel=0.1)
    assert 2 * error >= abs(fix)
