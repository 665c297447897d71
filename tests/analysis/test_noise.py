"""Noise of a sensor at rest: density, corner frequency, temperature drift, disturbances, resolution."""

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from imud.analysis.noise import corner_of, motion_words, sensor_noise, step_of, temperature_drift
from imud.analysis.series import FloatArray, Readings
from imud.analysis.spectrum import power_spectrum
from imud.model.units import STANDARD_GRAVITY_M_S2
from tests.analysis.synthetic import random_walk, stamps_ns, three, white

RATE_HZ = 200.0
COUNT = 60_000


def readings_of(values: FloatArray, temperature_c: FloatArray | None = None) -> Readings:
    return Readings(stamps_ns(len(values), RATE_HZ), values, None, temperature_c)


def noise_of_three(seed: int, n: float = 1e-3, count: int = COUNT) -> FloatArray:
    random = np.random.default_rng(seed)
    return np.stack([white(random, count, RATE_HZ, n) for _ in range(3)], axis=1)


def test_white_noise_of_three_axes() -> None:
    values = noise_of_three(1) + np.array([0.1, -0.2, 0.3])
    found = sensor_noise(readings_of(values), values)
    for axis, mean in zip(found.axes, (0.1, -0.2, 0.3), strict=True):
        assert axis.terms.random_walk.value == pytest.approx(1e-3, rel=0.05)
        assert axis.density == pytest.approx(np.sqrt(2) * 1e-3, rel=0.05), "one-sided: √2 N"
        assert axis.mean == pytest.approx(mean, abs=1e-3)
        assert axis.spread == pytest.approx(1e-3 * np.sqrt(RATE_HZ), rel=0.02)
        assert axis.drift is None
        assert axis.bias_instability_most == pytest.approx(axis.least_deviation / 0.6643, rel=1e-3)
    assert found.corner_hz is None
    assert (found.disturbed_s, found.still_s) == (0, 300)
    assert found.step is None


def test_missing_samples_and_filters_do_not_change_the_coefficients() -> None:
    random = np.random.default_rng(2)
    values = noise_of_three(2)
    keep = np.sort(random.choice(COUNT, round(COUNT * 0.99), replace=False))
    keep = keep[(keep < 20_000) | (keep > 20_500)]
    readings = Readings(stamps_ns(COUNT, RATE_HZ)[keep], values[keep], None, None)
    found = sensor_noise(readings, values[keep])
    assert found.grid.missing == COUNT - len(keep) - (COUNT - 1 - keep[-1]) - keep[0]
    assert len(found.grid.runs) == 2
    for axis in found.axes:
        assert axis.terms.random_walk.value == pytest.approx(1e-3, rel=0.05)
    b, a = butter(1, 20.0, fs=RATE_HZ)
    values = lfilter(b, a, noise_of_three(3), axis=0)
    found = sensor_noise(readings_of(values), values)
    assert found.corner_hz == pytest.approx(20.0, rel=0.35)
    assert found.tau_least_s == pytest.approx(5 / (found.corner_hz or 1))
    for axis in found.axes:
        assert axis.terms.random_walk.value == pytest.approx(1e-3, rel=0.07)
    for seed in [4, 5]:
        walk = three(random_walk(np.random.default_rng(seed), COUNT, RATE_HZ, 1.0))
        assert corner_of(power_spectrum([walk], RATE_HZ)) is None


def test_drift_with_temperature() -> None:
    temperature = np.linspace(20.0, 40.0, COUNT)
    values = noise_of_three(6, 1e-4) + np.outer(temperature - 30, [1e-3, 0.0, -2e-3])
    found = sensor_noise(readings_of(values, np.round(temperature)), values)
    slopes = [axis.drift for axis in found.axes]
    assert slopes[0] is not None
    assert slopes[1] is not None
    assert slopes[2] is not None
    assert slopes[0].slope == pytest.approx(1e-3, rel=0.02)
    assert slopes[0].r2 > 0.99
    assert abs(slopes[1].slope) < 4 * slopes[1].sigma
    assert slopes[1].r2 < 0.1
    assert slopes[2].slope == pytest.approx(-2e-3, rel=0.02)
    temperature = np.linspace(20.0, 21.5, COUNT)
    assert temperature_drift(temperature, noise_of_three(7)[:, 0], RATE_HZ) is None
    temperature = np.full(COUNT, np.nan)
    temperature[:: int(RATE_HZ)] = np.linspace(20.0, 40.0, COUNT // int(RATE_HZ))
    values = noise_of_three(8, 1e-4) + np.outer(np.linspace(-10, 10, COUNT), [1e-3] * 3)
    drift = sensor_noise(readings_of(values, temperature), values).axes[0].drift
    assert drift is not None
    assert drift.slope == pytest.approx(1e-3, rel=0.02)


def test_the_figures_of_a_filtered_walking_and_drifting_sensor() -> None:
    """The test fails after each change of the analysis: update the figures if the change is on purpose."""
    temperature = np.linspace(20.0, 40.0, COUNT)
    values = lfilter(*butter(1, 20.0, fs=RATE_HZ), noise_of_three(11), axis=0)
    values += 3e-4 * three(random_walk(np.random.default_rng(12), COUNT, RATE_HZ, 1.0))
    values += np.outer(temperature - 30, [1e-3, 0.0, -2e-3])
    found = sensor_noise(readings_of(values, np.round(temperature)), values)
    curve, axis = found.curve, found.axes[0]
    assert axis.drift is not None
    assert (found.corner_hz, found.tau_least_s) == pytest.approx((20.458984375, 0.24439140811), rel=1e-4)
    assert found.flat_hz == pytest.approx((1.02294921875, 12.275390625), rel=1e-4)
    assert (len(curve.tau_s), found.disturbed_s, found.still_s) == (49, 0, 300)
    assert (curve.low[5, 0], curve.high[5, 0]) == pytest.approx((0.00455677485, 0.00461482738), rel=1e-4)
    assert (axis.least_deviation, axis.least_tau_s, axis.density) == pytest.approx(
        (0.00066820761, 3.925, 0.00133997352), rel=1e-4
    )
    assert (axis.drift.slope, axis.drift.sigma, axis.drift.r2) == pytest.approx(
        (0.00122897744, 1.98019364e-5, 0.9281906555), rel=1e-4
    )
    terms = axis.terms
    assert (terms.random_walk.value, terms.random_walk.sigma) == pytest.approx((9.8109261e-4, 1.5264768e-5), rel=1e-3)
    assert (terms.rate_random_walk.value, terms.rate_random_walk.sigma) == pytest.approx(
        (4.7583391e-4, 3.4083908e-5), rel=1e-3
    )
    below = [one.below for one in (terms.quantisation, terms.bias_instability, terms.rate_ramp)]
    assert below == pytest.approx([1.980569e-4, 1.0131024e-3, 1.2697425e-4], rel=1e-3)


def test_disturbances_and_counts() -> None:
    values = noise_of_three(9)
    values[2000:2010] += 1.0
    values[30_000:30_400] += np.sin(np.arange(400))[:, None]
    assert sensor_noise(readings_of(values), values).disturbed_s == 3
    values = np.round(noise_of_three(10) / 1.065e-3) * 1.065e-3
    assert step_of(values) == pytest.approx(1.065e-3)
    assert step_of(noise_of_three(10)) is None
    assert step_of(np.zeros((100, 3))) is None


SECONDS = np.arange(COUNT) / RATE_HZ
AT_REST = np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])


def shaken(amplitude: float, frequency_hz: float, offset: float = 0.0) -> FloatArray:
    """Return a motion of the x axis with noise."""
    motion = noise_of_three(7)
    motion[:, 0] += offset + amplitude * np.sin(2 * np.pi * frequency_hz * SECONDS)
    return motion


@pytest.mark.parametrize(
    ("gyro", "accel", "words"),
    [
        (shaken(0.0, 1.0), shaken(0.0, 1.0) + AT_REST, ""),
        (shaken(0.0, 1.0, 0.04), shaken(0.0, 1.0) * 20 + AT_REST * 1.02, ""),  # an uncalibrated sensor with much noise
        (shaken(0.0, 1.0, 0.06), None, "angular rate: expected a difference of the mean from 0 rad/s of at most 0.05"),
        (shaken(0.1, 10.0), None, "angular rate: expected a standard deviation of at most 0.05 rad/s"),
        (shaken(0.02, 0.05), None, "angular rate: expected a change of the mean of at most 0.01 rad/s"),
        (None, shaken(0.0, 1.0, 5.0) + AT_REST, "acceleration: expected a difference of the mean from 9.807 m/s² of"),
        (None, shaken(1.0, 10.0) + AT_REST, "acceleration: expected a standard deviation of at most 0.5 m/s²"),
        (None, shaken(0.5, 0.05) + AT_REST, "acceleration: expected a change of the mean of at most 0.2 m/s²"),
    ],
)  # fmt: skip
def test_rest_has_limits_that_do_not_depend_on_the_motion(
    gyro: FloatArray | None, accel: FloatArray | None, words: str
) -> None:
    found = motion_words(Readings(stamps_ns(COUNT, RATE_HZ), gyro, accel, None))
    assert found.startswith(words) if words else not found


def test_one_weakly_disturbed_second_in_a_hundred_seconds_is_no_motion() -> None:
    gyro = noise_of_three(8, count=20_000)
    gyro[:200] += 0.03
    assert not motion_words(readings_of(gyro))
    gyro[:40] += 1.0  # a strong bump changes the standard deviation of all samples
    assert "in 1 of 100 seconds" in motion_words(readings_of(gyro))
    gyro[:40] -= 1.0
    gyro[200:400] += 0.03
    assert "in 2 of 100 seconds" in motion_words(readings_of(gyro))
