"""Noise of a sensor at rest: density, corner frequency, temperature drift, disturbances, resolution.
Allan deviation compared with allantools and with values by hand, and the coverage of the intervals.
Noise coefficients: synthetic noise within 5 %, and no value for a coefficient that the series does not resolve."""

from dataclasses import replace

import allantools
import numpy as np
import pytest
from scipy.signal import butter, lfilter

from imud.analysis import noise as analysis_noise
from imud.analysis.series import FloatArray, Readings
from imud.analysis.spectrum import Spectrum, power_spectrum
from imud.model.errors import BadArgument
from imud.model.units import STANDARD_GRAVITY_M_S2
from tests.analysis.synthetic import flicker, quantisation, ramp, random_walk, stamps_ns, three, white

RATE_HZ = 200.0
COUNT = 60_000


def readings_of(values: FloatArray, temperature_c: FloatArray | None = None) -> Readings:
    return Readings(stamps_ns(len(values), RATE_HZ), values, None, temperature_c)


def noise_of_three(seed: int, n: float = 1e-3, count: int = COUNT) -> FloatArray:
    random = np.random.default_rng(seed)
    return np.stack([white(random, count, RATE_HZ, n) for _ in range(3)], axis=1)


def test_white_noise_of_three_axes() -> None:
    values = noise_of_three(1) + np.array([0.1, -0.2, 0.3])
    found = analysis_noise.sensor_noise(readings_of(values), values)
    for axis, mean in zip(found.axes, (0.1, -0.2, 0.3), strict=True):
        assert axis.terms.random_walk.value == pytest.approx(1e-3, rel=0.05)
        assert axis.density == pytest.approx(np.sqrt(2) * 1e-3, rel=0.05), "one-sided: √2 N"
        assert axis.mean == pytest.approx(mean, abs=1e-3)
        assert axis.spread == pytest.approx(1e-3 * np.sqrt(RATE_HZ), rel=0.02)
        assert axis.drift is None
        assert axis.bias_instability_most == pytest.approx(axis.least_deviation / 0.6643, rel=1e-3)
        assert axis.least_at_end
        assert 25 < axis.least_tau_s <= 30, "a tenth of the duration"
    assert found.corner_hz is None
    assert found.flat_hz == pytest.approx((5.0, 60.0))
    assert (found.disturbed_s, found.still_s) == (0, 300)
    assert found.step is None


def test_missing_samples_and_filters_do_not_change_the_coefficients() -> None:
    random = np.random.default_rng(2)
    values = noise_of_three(2)
    keep = np.sort(random.choice(COUNT, round(COUNT * 0.99), replace=False))
    keep = keep[(keep < 20_000) | (keep > 20_500)]
    readings = Readings(stamps_ns(COUNT, RATE_HZ)[keep], values[keep], None, None)
    found = analysis_noise.sensor_noise(readings, values[keep])
    assert found.grid.missing == COUNT - len(keep) - (COUNT - 1 - keep[-1]) - keep[0]
    assert len(found.grid.runs) == 2
    for axis in found.axes:
        assert axis.terms.random_walk.value == pytest.approx(1e-3, rel=0.05)
    b, a = butter(1, 20.0, fs=RATE_HZ)
    values = lfilter(b, a, noise_of_three(3), axis=0)
    found = analysis_noise.sensor_noise(readings_of(values), values)
    assert found.corner_hz == pytest.approx(20.0, rel=0.35)
    assert found.tau_least_s == pytest.approx(5 / (found.corner_hz or 1))
    for axis in found.axes:
        assert axis.terms.random_walk.value == pytest.approx(1e-3, rel=0.07)
    for seed in [4, 5]:
        walk = three(random_walk(np.random.default_rng(seed), COUNT, RATE_HZ, 1.0))
        assert analysis_noise.corner_of(power_spectrum([walk], RATE_HZ)) is None


@pytest.mark.parametrize(("rise_hz", "drop_hz", "corner_hz"), [(0, 5, 5.0), (0, 4, None), (3, 33, 33.0), (3, 24, None)])
def test_a_corner_needs_four_flat_bands_below_and_uses_eight(
    rise_hz: int, drop_hz: int, corner_hz: float | None
) -> None:
    """The lowest bands contain 1, 2, 3 and 4 Hz. The eight bands below 33 Hz begin at 4 Hz, below 24 Hz at 3 Hz."""
    frequency_hz = np.arange(1025.0)
    density = np.where(frequency_hz < drop_hz, 1.0, 0.1)
    density[: rise_hz + 1] = 100.0
    for power, expected_hz in ((density, corner_hz), (0 * density, None)):
        spectrum = Spectrum(2048.0, frequency_hz, power[:, None], "hann", 2048, 1.5, 1, 0)
        assert analysis_noise.corner_of(spectrum) == expected_hz


def test_drift_with_temperature() -> None:
    temperature = np.linspace(20.0, 40.0, COUNT)
    values = noise_of_three(6, 1e-4) + np.outer(temperature - 30, [1e-3, 0.0, -2e-3])
    found = analysis_noise.sensor_noise(readings_of(values, np.round(temperature)), values)
    slopes = [axis.drift for axis in found.axes]
    assert slopes[0] is not None
    assert slopes[1] is not None
    assert slopes[2] is not None
    assert slopes[0].slope == pytest.approx(1e-3, rel=0.02)
    assert slopes[0].r2 > 0.99
    assert abs(slopes[1].slope) < 4 * slopes[1].sigma
    assert slopes[1].r2 < 0.1
    assert slopes[2].slope == pytest.approx(-2e-3, rel=0.02)
    noise = noise_of_three(7)[:, 0]
    for span_c, samples in ((1.9, COUNT), (20.0, 1599)):  # at least 2 K and 8 s
        assert analysis_noise.temperature_drift(np.linspace(20, 20 + span_c, samples), noise[:samples], RATE_HZ) is None
    for span_c, samples in ((2.1, COUNT), (20.0, 1600)):
        assert (
            analysis_noise.temperature_drift(np.linspace(20, 20 + span_c, samples), noise[:samples], RATE_HZ)
            is not None
        )
    halves = analysis_noise.temperature_drift(np.linspace(20, 40, 4000), np.tile([0.0, 1.0], 2000), 1.0)
    assert halves is not None
    assert halves.sigma == pytest.approx(0.0, abs=1e-12), "at most 2000 means: each of two samples"
    temperature = np.full(COUNT, np.nan)
    temperature[:: int(RATE_HZ)] = np.linspace(20.0, 40.0, COUNT // int(RATE_HZ))
    values = noise_of_three(8, 1e-4) + np.outer(np.linspace(-10, 10, COUNT), [1e-3] * 3)
    drift = analysis_noise.sensor_noise(readings_of(values, temperature), values).axes[0].drift
    assert drift is not None
    assert drift.slope == pytest.approx(1e-3, rel=0.02)


def test_the_figures_of_a_filtered_walking_and_drifting_sensor() -> None:
    """The test fails after each change of the analysis: update the figures if the change is on purpose."""
    temperature = np.linspace(20.0, 40.0, COUNT)
    values = lfilter(*butter(1, 20.0, fs=RATE_HZ), noise_of_three(11), axis=0)
    values += 3e-4 * three(random_walk(np.random.default_rng(12), COUNT, RATE_HZ, 1.0))
    values += np.outer(temperature - 30, [1e-3, 0.0, -2e-3])
    found = analysis_noise.sensor_noise(readings_of(values, np.round(temperature)), values)
    curve, axis = found.curve, found.axes[0]
    assert axis.drift is not None
    assert (found.corner_hz, found.tau_least_s) == pytest.approx((20.458984375, 0.24439140811), rel=1e-4)
    assert found.flat_hz == pytest.approx((1.02294921875, 12.275390625), rel=1e-4)
    assert (len(curve.tau_s), found.disturbed_s, found.still_s) == (49, 0, 300)
    assert (curve.low[5, 0], curve.high[5, 0]) == pytest.approx((0.00455677485, 0.00461482738), rel=1e-4)
    figures = (axis.least_deviation, axis.least_tau_s, axis.density)
    assert figures == pytest.approx((0.00066820761, 3.925, 0.00133997352), rel=1e-4)
    assert not axis.least_at_end
    figures = (axis.drift.slope, axis.drift.sigma, axis.drift.r2)
    assert figures == pytest.approx((0.00122897744, 1.98019364e-5, 0.9281906555), rel=1e-4)
    terms = axis.terms
    assert (terms.random_walk.value, terms.random_walk.sigma) == pytest.approx((9.8109261e-4, 1.5264768e-5), rel=1e-3)
    walk = terms.rate_random_walk
    assert (walk.value, walk.sigma) == pytest.approx((4.7583391e-4, 3.4083908e-5), rel=1e-3)
    below = [one.below for one in (terms.quantisation, terms.bias_instability, terms.rate_ramp)]
    assert below == pytest.approx([1.980569e-4, 1.0131024e-3, 1.2697425e-4], rel=1e-3)


def test_disturbances_and_counts() -> None:
    values = noise_of_three(9)
    values[2000:2010] += 1.0
    values[30_000:30_400] += np.sin(np.arange(400))[:, None]
    values[40_000:40_200] *= 5
    values[50_000:50_200] *= 3
    assert analysis_noise.sensor_noise(readings_of(values), values).disturbed_s == 4
    values = np.round(noise_of_three(10) / 1.065e-3) * 1.065e-3
    assert analysis_noise.step_of(values) == pytest.approx(1.065e-3)
    assert analysis_noise.step_of(noise_of_three(10)) is None
    assert analysis_noise.step_of(np.zeros((100, 3))) is None


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
        (shaken(0.0, 1.0, 0.012), shaken(0.0, 1.0) * 8 + AT_REST * 1.02, ""),  # much noise
        (shaken(0.0, 1.0, 0.02), None, "angular rate: expected a difference of the mean from 0 rad/s of at most 0.0"),
        (shaken(0.1, 10.0), None, "angular rate: expected a standard deviation of at most 0.025 rad/s"),
        (shaken(0.02, 33.0), None, "angular rate: expected no vibration, got 0.014 rad/s at"),
        (None, shaken(0.1, 1.0) + AT_REST, "acceleration: expected no vibration, got 0.071 m/s² at"),
        (shaken(0.015, 0.05), None, "angular rate: expected a change of the mean of at most 0.01 rad/s"),
        (None, shaken(0.0, 1.0, 5.0) + AT_REST, "acceleration: expected a difference of the mean from 9.807 m/s² of"),
        (None, shaken(1.0, 10.0) + AT_REST, "acceleration: expected a standard deviation of at most 0.15 m/s²"),
        (None, shaken(0.5, 0.05) + AT_REST, "acceleration: expected a change of the mean of at most 0.1 m/s²"),
    ],
)  # fmt: skip
def test_rest_has_limits_that_do_not_depend_on_the_motion(
    gyro: FloatArray | None, accel: FloatArray | None, words: str
) -> None:
    found = analysis_noise.motion_words(Readings(stamps_ns(COUNT, RATE_HZ), gyro, accel, None))
    assert found.startswith(words) if words else not found


@pytest.mark.parametrize(
    ("angle", "slope", "pitch", "words"),
    [
        (2, 0.0, 0.0, ""), (2, 0.0175, 0.0, "yaw: expected a change of at most 0.5° in each second, got up to 1°"),
        (2, 1.0, 1.5, ""), (2, 1.0, np.nan, "yaw: "), (0, 0.001, 0.0, "roll: "), (2, 0.001, 0.0, ""),
    ],
)  # fmt: skip
def test_angles_show_a_turn_without_other_evidence(angle: int, slope: float, pitch: float, words: str) -> None:
    euler = np.tile([0.0, pitch, 0.0], (COUNT, 1))
    euler[:, angle] += np.angle(np.exp(1j * slope * SECONDS))
    readings = Readings(stamps_ns(COUNT, RATE_HZ), None, shaken(0.0, 1.0) + AT_REST, None, euler)
    found = analysis_noise.motion_words(readings)
    assert found.startswith(words) if words else not found


def test_slow_turns_without_angles() -> None:
    """A turn that starts shows a step. A steady turn around the vertical axis is not verified."""
    gyro, accel = noise_of_three(7) / 10, shaken(0.0, 1.0) + AT_REST
    gyro[:, 2] += 0.0035 * (SECONDS[-1] / 2 < SECONDS)
    assert "a step of the mean of at most 0.1 °/s, got 0.2 °/s after" in analysis_noise.motion_words(readings_of(gyro))
    readings = Readings(stamps_ns(COUNT, RATE_HZ), gyro[COUNT // 2 :], accel[COUNT // 2 :], None)
    readings = replace(readings, t_ns=readings.t_ns[COUNT // 2 :])
    assert not analysis_noise.motion_words(readings)
    assert "a steady turn at the mean vertical angular rate of 0.2 °/s" in analysis_noise.unverified_words(readings)
    assert "a turn at the mean angular rate of 0.2 °/s" in analysis_noise.unverified_words(
        replace(readings, accel_m_s2=None)
    )
    assert "not verified" in analysis_noise.unverified_words(replace(readings, gyro_rad_s=None))
    turned = replace(readings, euler_rad=np.zeros_like(readings.gyro_rad_s))
    assert not analysis_noise.unverified_words(turned)


def test_a_series_below_one_second_shows_no_motion_and_256_samples_show_a_vibration() -> None:
    values = noise_of_three(11, count=150)
    found = analysis_noise.sensor_noise(readings_of(values, np.full(150, np.nan)), values)
    assert (found.disturbed_s, found.still_s, found.axes[0].drift) == (0, 0, None)
    for count, words in ((7, ""), (8, ""), (255, ""), (256, "angular rate: expected no vibration, got 0.014")):
        gyro = shaken(0.02, 33.0)[:count]
        motion = analysis_noise.motion_words(Readings(stamps_ns(count, RATE_HZ), gyro, None, None, 0 * gyro))
        assert motion.partition(" rad/s at ")[0] == words


def test_one_weakly_disturbed_second_in_a_hundred_seconds_is_no_motion() -> None:
    gyro = noise_of_three(8, count=20_000)
    gyro[:200] += 0.03
    assert not analysis_noise.motion_words(readings_of(gyro))
    gyro[:40] += 0.35  # a strong bump increases the standard deviation of all samples by more than 10 %
    assert "in 1 of 100 seconds" in analysis_noise.motion_words(readings_of(gyro))
    gyro[:40] -= 0.35
    gyro[200:400] += 0.03
    assert "in 2 of 100 seconds" in analysis_noise.motion_words(readings_of(gyro))


ALPHAS = {"QUANTISATION": 2, "FLICKER_PHASE": 1, "WHITE": 0, "FLICKER": -1, "RATE_RANDOM_WALK": -2}


def test_a_deviation_and_an_interval_by_hand() -> None:
    rate = np.array([[1.0], [2.0], [4.0], [3.0]])  # differences of neighbours 1, 2, -1: 6 / (2 · 3) = 1
    curve = analysis_noise.allan_curve([rate], 1.0, np.array([1]))
    assert curve.deviation[0, 0] == pytest.approx(1.0)
    means = [1.5, 3.0, 3.5]  # averages of two samples, overlapping: the first and the last average differ by 2
    curve = analysis_noise.allan_curve([rate], 1.0, np.array([2]))
    assert curve.deviation[0, 0] == pytest.approx((means[2] - means[0]) / np.sqrt(2))
    # χ² of 10 degrees of freedom at 5 and 95 %: 3.940 and 18.307 (any table)
    low, high = analysis_noise.interval(np.array([1.0]), np.array([10.0]), confidence=0.9)
    assert low[0] == pytest.approx(np.sqrt(10 / 18.307), rel=1e-4)
    assert high[0] == pytest.approx(np.sqrt(10 / 3.940), rel=1e-4)


def test_it_is_that_of_allantools() -> None:
    random, rate_hz = np.random.default_rng(1), 50.0
    one = white(random, 20_000, rate_hz, 0.1) + random_walk(random, 20_000, rate_hz, 0.02) + 9.81
    curve = analysis_noise.allan_curve([three(one)], rate_hz)
    tau_s, deviation, _, _ = allantools.oadev(one, rate=rate_hz, data_type="freq", taus=curve.tau_s)
    assert tau_s == pytest.approx(curve.tau_s)
    assert curve.deviation[:, 0] == pytest.approx(deviation, rel=1e-9)


def test_runs_are_taken_together_without_a_difference_across_the_gap() -> None:
    random = np.random.default_rng(3)
    first, second = white(random, 500, 1.0, 1.0)[:, None], white(random, 300, 1.0, 1.0)[:, None] + 1000.0
    factors = np.array([1, 10])
    both = analysis_noise.allan_curve([first, second], 1.0, factors).deviation[:, 0] ** 2
    alone = [analysis_noise.allan_curve([run], 1.0, factors).deviation[:, 0] ** 2 for run in (first, second)]
    counts = [np.array([len(run) + 1 - 2 * m for m in factors]) for run in (first, second)]
    assert both == pytest.approx((alone[0] * counts[0] + alone[1] * counts[1]) / (counts[0] + counts[1]))
    run = white(np.random.default_rng(4), 500, 1.0, 1.0)[:, None]
    curve = analysis_noise.allan_curve([run, run[:20], run[:19]], 1.0, np.array([10]))
    noise = analysis_noise.NoiseType(int(curve.types[0, 0]))
    assert curve.freedom[0, 0] == sum(analysis_noise.degrees_of_freedom(noise, 10, n) for n in (501, 21))


@pytest.mark.parametrize("noise", list(analysis_noise.NoiseType))
@pytest.mark.parametrize(("m", "n"), [(1, 1001), (4, 1001), (100, 1001), (7, 50)])
def test_degrees_of_freedom_are_those_of_allantools(noise: analysis_noise.NoiseType, m: int, n: int) -> None:
    if noise is analysis_noise.NoiseType.FLICKER and m == 1:
        theirs = 2 * (n - 2) ** 2 / (2.3 * n - 4.9)  # SP 1065, table 5; allantools 2024.6 returns 0.87
    else:
        theirs = allantools.edf_simple(n, m, ALPHAS[noise.name])
    assert analysis_noise.degrees_of_freedom(noise, m, n) == pytest.approx(max(theirs, 1.0), rel=1e-9)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    random = np.random.default_rng(4)
    factors, truth = np.array([1, 8, 40]), 1.0 / np.sqrt([1, 8, 40])
    held = np.zeros(3)
    rounds = 300
    for _ in range(rounds):
        curve = analysis_noise.allan_curve([white(random, 400, 1.0, 1.0)[:, None]], 1.0, factors)
        held += (curve.low[:, 0] <= truth) & (truth <= curve.high[:, 0])
    assert held / rounds == pytest.approx([0.683] * 3, abs=0.08)


def test_types_of_noise_factors_and_short_runs() -> None:
    for made, expected in [
        (quantisation(np.random.default_rng(5), 4000, 1.0, 1.0), analysis_noise.NoiseType.QUANTISATION),
        (white(np.random.default_rng(5), 4000, 1.0, 1.0), analysis_noise.NoiseType.WHITE),
        (flicker(np.random.default_rng(5), 4000, 1.0), analysis_noise.NoiseType.FLICKER),
        (random_walk(np.random.default_rng(5), 4000, 1.0, 1.0), analysis_noise.NoiseType.RATE_RANDOM_WALK),
    ]:
        types = analysis_noise.noise_types(made[:, None], np.array([1, 4, 1000]))
        assert types[0, 0] == expected
        assert types[2, 0] == types[1, 0], "too few averages: as at the τ before"
    assert [analysis_noise.noise_types(made[:n, None], np.array([1]))[0, 0] for n in (59, 60)] == [
        analysis_noise.NoiseType.WHITE,
        expected,
    ]
    factors = analysis_noise.averaging_factors(3000)
    assert (factors[0], factors[-1]) == (1, 1000)
    assert len(factors) > 24
    with pytest.raises(BadArgument, match="at least 3 samples"):
        analysis_noise.averaging_factors(2)
    curve = analysis_noise.allan_curve([np.full((200, 3), 9.81)], 100.0)
    assert curve.deviation == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(BadArgument, match="at least 200 samples"):
        analysis_noise.allan_curve([np.zeros((50, 1))], 1.0, np.array([100]))


TERM_HZ = 100.0
TERMS_COUNT = 1 << 18
WITHIN = 0.05


def terms_of(series: FloatArray, rate_hz: float = TERM_HZ) -> analysis_noise.NoiseTerms:
    return analysis_noise.noise_terms(analysis_noise.allan_curve([series[:, None]], rate_hz), 0)


def test_basis_factor_and_the_fit_makes_the_curve_again() -> None:
    assert pytest.approx(0.664, abs=5e-4) == analysis_noise.BIAS_FACTOR
    assert analysis_noise.basis(np.array([2.0]))[0] == pytest.approx([3 / 4, 1 / 2, 2 * np.log(2) / np.pi, 2 / 3, 2.0])
    assert all(term.value is None for term in terms_of(np.zeros(500)))
    random = np.random.default_rng(31)
    curve = analysis_noise.allan_curve([white(random, TERMS_COUNT, TERM_HZ, 1e-3)[:, None]], TERM_HZ)
    fitted = analysis_noise.noise_terms(curve, 0).deviation(curve.tau_s)
    near = curve.freedom[:, 0] > 100
    assert fitted[near] == pytest.approx(curve.deviation[near, 0], rel=0.15)
    random = np.random.default_rng(61)
    smooth = np.convolve(white(random, TERMS_COUNT, TERM_HZ, 1e-3), np.ones(8) / 8, mode="same")
    curve = analysis_noise.allan_curve([smooth[:, None]], TERM_HZ)
    assert analysis_noise.noise_terms(curve, 0, tau_least_s=0.8).random_walk.value == pytest.approx(1e-3, rel=WITHIN)
    assert analysis_noise.noise_terms(curve, 0, tau_least_s=curve.tau_s[-6])
    with pytest.raises(BadArgument, match=r"at least 6 points .*, got 5; record a longer series"):
        analysis_noise.noise_terms(curve, 0, tau_least_s=curve.tau_s[-5])


def test_each_term_over_white_noise_and_all_together() -> None:
    random = np.random.default_rng(11)
    found = terms_of(white(random, TERMS_COUNT, TERM_HZ, 2e-4))
    assert found.random_walk.value == pytest.approx(2e-4, rel=WITHIN)
    assert found.rate_random_walk.value is None
    assert found.rate_ramp.value is None
    found = terms_of(white(random, TERMS_COUNT, TERM_HZ, 1e-4) + flicker(random, TERMS_COUNT, 3e-3))
    assert found.bias_instability.value == pytest.approx(3e-3, rel=WITHIN)
    noise = white(random, TERMS_COUNT, TERM_HZ, 1e-3)
    found = terms_of(noise + random_walk(random, TERMS_COUNT, TERM_HZ, 1e-2))
    assert found.random_walk.value == pytest.approx(1e-3, rel=WITHIN)
    assert found.rate_random_walk.value == pytest.approx(1e-2, rel=WITHIN)
    found = terms_of(noise + quantisation(random, TERMS_COUNT, TERM_HZ, 1e-3))
    assert found.random_walk.value == pytest.approx(1e-3, rel=WITHIN)
    assert found.quantisation.value == pytest.approx(1e-3, rel=WITHIN)
    found = terms_of(noise + ramp(TERMS_COUNT, TERM_HZ, 1e-5))
    assert found.random_walk.value == pytest.approx(1e-3, rel=WITHIN)
    assert found.rate_ramp.value == pytest.approx(1e-5, rel=WITHIN)
    random, count = np.random.default_rng(21), 1 << 20
    series = (
        white(random, count, TERM_HZ, 1e-3) + flicker(random, count, 8e-3) + random_walk(random, count, TERM_HZ, 8e-3)
    )
    found = terms_of(series)
    assert found.random_walk.value == pytest.approx(1e-3, rel=WITHIN)
    assert found.bias_instability.value == pytest.approx(8e-3, rel=WITHIN)
    assert found.rate_random_walk.value == pytest.approx(8e-3, rel=WITHIN)


def test_spreads_and_bounds_are_those_of_many_series() -> None:
    random = np.random.default_rng(41)
    found = [terms_of(white(random, 4096, 1.0, 1.0), 1.0).random_walk for _ in range(60)]
    values = np.array([one.value for one in found], dtype=float)
    stated = float(np.median([one.sigma for one in found]))
    assert 0.5 < stated / values.std() < 3.0
    random = np.random.default_rng(51)
    unresolved = terms_of(white(random, 4096, TERM_HZ, 1e-3)).rate_ramp
    assert unresolved.value is None
    assert unresolved.below > 0
