"""Time grid of a series: rate, lost samples, runs, interpolated samples."""

import numpy as np
import pytest

from imud.analysis.series import Readings, even_runs, grid_of, with_values
from imud.model.errors import BadArgument
from tests.analysis.synthetic import stamps_ns


def test_rate_missing_samples_and_runs() -> None:
    grid = grid_of(stamps_ns(1000, 408.0))
    assert grid.rate_hz == pytest.approx(408.0, rel=1e-6)
    assert (grid.missing, grid.runs) == (0, ((0, 1000),))
    assert grid.duration_s == pytest.approx(1000 / 408)
    assert "no sample is lost" in grid.words()
    grid = grid_of(np.delete(stamps_ns(100, 100.0), [10, 50, 51, 70, 71, 72, 73]))
    assert (grid.missing, grid.filled, grid.runs) == (7, 7, ((0, 93),))
    assert (grid.place[9], grid.place[10]) == (9, 11)
    assert "7 samples are lost (7.00 %)" in grid.words()
    grid = grid_of(np.delete(stamps_ns(1000, 100.0), range(300, 305)))
    assert grid.runs == ((0, 300), (300, 995))
    assert (grid.missing, grid.filled) == (5, 0)
    assert "2 runs" in grid.words()
    first, second = stamps_ns(1000, 100.0), stamps_ns(1000, 100.0, 1_000_000_000 + 13_333_000_000)
    grid = grid_of(np.concatenate((first, second)))
    assert grid.rate_hz == pytest.approx(100.0, rel=1e-7)
    assert len(grid.runs) == 2
    for rate_hz in [300.0, 400.0, 667.0]:
        t_ns = np.delete(stamps_ns(20_000, rate_hz), [5000]) // 1_000_000 * 1_000_000
        grid = grid_of(t_ns)
        assert grid.rate_hz == pytest.approx(rate_hz, rel=1e-5)
        assert grid.missing == 1


def test_scattered_stamps_are_said_to_hide_gaps() -> None:
    random = np.random.default_rng(1)
    noise_ns = random.normal(0, 1, 5000)
    grid = grid_of(stamps_ns(5000, 200.0) + (0.9e6 * noise_ns).astype(np.int64))
    assert grid.located
    assert grid.scatter_s == pytest.approx(0.9e-3, rel=0.05)
    t_ns = np.maximum.accumulate(stamps_ns(5000, 200.0) + (2e6 * noise_ns).astype(np.int64)) + np.arange(5000)
    for pause_ns, runs, missing in ((0, 1, 0), (900_000_000, 1, 0), (1_100_000_000, 2, 220)):
        grid = grid_of(t_ns + pause_ns * (np.arange(5000) >= 2000))
        assert (grid.located, len(grid.runs)) == (False, runs)
        assert grid.missing == pytest.approx(missing, abs=1)
        assert grid.rate_hz == pytest.approx(200.0, rel=1e-4 if runs > 1 or not pause_ns else 0.1)
    assert "cannot find and interpolate single lost samples" in grid.words()


def test_straight_lines_fill_for_noise_and_splines_for_vibration() -> None:
    t_ns, keep = stamps_ns(400, 100.0), np.delete(np.arange(400), [200])
    values = np.sin(2 * np.pi * 5.0 * np.arange(400) / 100.0)[:, None]
    grid = grid_of(t_ns[keep])
    (line,) = even_runs(grid, values[keep])
    (smooth,) = even_runs(grid, values[keep], smooth=True)
    assert len(line) == len(smooth) == 400
    assert line[200, 0] == pytest.approx((values[199, 0] + values[201, 0]) / 2)
    assert smooth[200, 0] == pytest.approx(values[200, 0], abs=2e-3)
    assert abs(smooth[200, 0] - values[200, 0]) < abs(line[200, 0] - values[200, 0]) or values[200, 0] == 0
    assert np.array_equal(line[keep], values[keep])


def test_refused_series_and_samples_without_a_value() -> None:
    for t_ns, words in [
        (stamps_ns(10, 100.0), "at least 64 samples"),
        (np.append(stamps_ns(100, 100.0), 5), "a step back at sample 100"),
    ]:
        with pytest.raises(BadArgument, match=words):
            grid_of(t_ns)
    values = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [4.0, 5.0, 6.0]])
    t_ns, found = with_values(np.array([1, 2, 3]), values)
    assert t_ns.tolist() == [1, 3]
    assert found.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert Readings(stamps_ns(101, 100.0), None, None, None).duration_s == pytest.approx(1.0)
    assert Readings(np.array([], dtype=np.int64), None, None, None).duration_s == 0.0
