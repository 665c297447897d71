"""Noise has the declared strength, depends on its seed, and does not change the attitude."""

from math import hypot
from statistics import correlation, fmean, pstdev

import pytest

from imud.sim.physics import NORMAL, Noise, NoiseLevels, Still

TRUTH = Still().at(0.0)


def test_white_noise_has_the_stated_spread() -> None:
    levels = NoiseLevels(accel_m_s2=0.1, gyro_rad_s=0.2, mag_t=0.3, pressure_pa=4.0)
    noise = Noise(7, levels)
    read = [noise.add(TRUTH, 0.0) for _ in range(2000)]
    for axis in range(3):
        assert pstdev(r.accel_m_s2[axis] for r in read) == pytest.approx(0.1, rel=0.06)
        assert pstdev(r.gyro_rad_s[axis] for r in read) == pytest.approx(0.2, rel=0.06)
        assert pstdev(r.mag_t[axis] for r in read) == pytest.approx(0.3, rel=0.06)
    assert pstdev(r.pressure_pa for r in read) == pytest.approx(4.0, rel=0.06)


def test_noise_is_white_around_truth_plus_bias() -> None:
    noise = Noise(5)
    read = [noise.add(TRUTH, 42.0) for _ in range(2000)]
    bias = noise.bias(42.0)[1]
    for axis in range(3):
        mean = fmean(r.gyro_rad_s[axis] for r in read)
        assert mean == pytest.approx(TRUTH.gyro_rad_s[axis] + bias[axis], abs=5e-5)
    x, y, *_ = ([r.accel_m_s2[axis] for r in read] for axis in range(3))
    for a, b in ((x[1:], x[:-1]), (x, y), (x[1:], y[:-1])):
        assert abs(correlation(a, b)) < 0.09  # 4 sigma of 2000 samples


def test_bias_wanders_slowly_within_its_bounds() -> None:
    levels = NoiseLevels()
    noise = Noise(3, levels)
    biases = [noise.bias(t) for t in range(0, 700, 7)]
    for part, bound in enumerate((levels.accel_bias_m_s2, levels.gyro_bias_rad_s, levels.mag_bias_t)):
        for axis in range(3):
            values = [bias[part][axis] for bias in biases]
            assert 0.9 * bound < max(map(abs, values)) <= bound
    near, far = noise.bias(100.0)[0][0], noise.bias(100.01)[0][0]
    assert 0 < abs(near - far) < 1e-5


def test_the_seed_decides_and_the_attitude_stays_true() -> None:
    def run(seed: int) -> list[float]:
        noise = Noise(seed)
        return [noise.add(TRUTH, n / 100).mag_t[1] for n in range(20)]

    assert run(1) == run(1)
    assert run(1) != run(2)
    read = Noise(1).add(TRUTH, 1.0)
    assert read[3:6] == TRUTH[3:6]
    assert hypot(*read.accel_m_s2) != hypot(*TRUTH.accel_m_s2)
    assert fmean(NORMAL) == pytest.approx(0.0, abs=1e-12)
    assert pstdev(NORMAL) == pytest.approx(1.0, abs=1e-3)
