"""Noise coefficients: synthetic noise within 5 %, and no value for a coefficient that the series does not resolve."""

import numpy as np
import pytest

from imud.analysis.noise import BIAS_FACTOR, NoiseTerms, allan_curve, basis, noise_terms
from imud.analysis.series import FloatArray
from imud.model.errors import BadArgument
from tests.analysis.synthetic import flicker, quantisation, ramp, random_walk, white

RATE_HZ = 100.0
COUNT = 1 << 18
WITHIN = 0.05


def terms_of(series: FloatArray, rate_hz: float = RATE_HZ) -> NoiseTerms:
    return noise_terms(allan_curve([series[:, None]], rate_hz), 0)


def test_basis_factor_and_a_constant() -> None:
    assert pytest.approx(0.664, abs=5e-4) == BIAS_FACTOR
    assert basis(np.array([2.0]))[0] == pytest.approx([3 / 4, 1 / 2, 2 * np.log(2) / np.pi, 2 / 3, 2.0])
    found = terms_of(np.zeros(500))
    assert all(term.value is None for term in found)


def test_each_term_over_white_noise() -> None:
    random = np.random.default_rng(11)
    found = terms_of(white(random, COUNT, RATE_HZ, 2e-4))
    assert found.random_walk.value == pytest.approx(2e-4, rel=WITHIN)
    assert found.rate_random_walk.value is None
    assert found.rate_ramp.value is None
    found = terms_of(white(random, COUNT, RATE_HZ, 1e-4) + flicker(random, COUNT, 3e-3))
    assert found.bias_instability.value == pytest.approx(3e-3, rel=WITHIN)
    noise = white(random, COUNT, RATE_HZ, 1e-3)
    found = terms_of(noise + random_walk(random, COUNT, RATE_HZ, 1e-2))
    assert found.random_walk.value == pytest.approx(1e-3, rel=WITHIN)
    assert found.rate_random_walk.value == pytest.approx(1e-2, rel=WITHIN)
    found = terms_of(noise + quantisation(random, COUNT, RATE_HZ, 1e-3))
    assert found.random_walk.value == pytest.approx(1e-3, rel=WITHIN)
    assert found.quantisation.value == pytest.approx(1e-3, rel=WITHIN)
    found = terms_of(noise + ramp(COUNT, RATE_HZ, 1e-5))
    assert found.random_walk.value == pytest.approx(1e-3, rel=WITHIN)
    assert found.rate_ramp.value == pytest.approx(1e-5, rel=WITHIN)


def test_all_of_a_gyroscope_together() -> None:
    random, count = np.random.default_rng(21), 1 << 20
    series = (
        white(random, count, RATE_HZ, 1e-3) + flicker(random, count, 8e-3) + random_walk(random, count, RATE_HZ, 8e-3)
    )
    found = terms_of(series)
    assert found.random_walk.value == pytest.approx(1e-3, rel=WITHIN)
    assert found.bias_instability.value == pytest.approx(8e-3, rel=WITHIN)
    assert found.rate_random_walk.value == pytest.approx(8e-3, rel=WITHIN)


def test_the_fit_makes_the_curve_again() -> None:
    random = np.random.default_rng(31)
    curve = allan_curve([white(random, COUNT, RATE_HZ, 1e-3)[:, None]], RATE_HZ)
    fitted = noise_terms(curve, 0).deviation(curve.tau_s)
    near = curve.freedom[:, 0] > 100
    assert fitted[near] == pytest.approx(curve.deviation[near, 0], rel=0.15)


def test_spreads_and_bounds_are_those_of_many_series() -> None:
    random = np.random.default_rng(41)
    found = [terms_of(white(random, 4096, 1.0, 1.0), 1.0).random_walk for _ in range(60)]
    values = np.array([one.value for one in found], dtype=float)
    stated = float(np.median([one.sigma for one in found]))
    assert 0.5 < stated / values.std() < 3.0
    random = np.random.default_rng(51)
    unresolved = terms_of(white(random, 4096, RATE_HZ, 1e-3)).rate_ramp
    assert unresolved.value is None
    assert unresolved.below > 0


def test_short_filtered_points_are_left_out() -> None:
    random = np.random.default_rng(61)
    smooth = np.convolve(white(random, COUNT, RATE_HZ, 1e-3), np.ones(8) / 8, mode="same")
    curve = allan_curve([smooth[:, None]], RATE_HZ)
    assert noise_terms(curve, 0, tau_least_s=0.8).random_walk.value == pytest.approx(1e-3, rel=WITHIN)
    with pytest.raises(BadArgument, match="record a longer series"):
        noise_terms(curve, 0, tau_least_s=curve.tau_s[-3])
