"""Allan deviation compared with allantools and with values by hand, and the coverage of the intervals."""

import allantools
import numpy as np
import pytest

from imud.analysis.noise import NoiseType, allan_curve, averaging_factors, degrees_of_freedom, interval, noise_types
from imud.model.errors import BadArgument
from tests.analysis.synthetic import flicker, quantisation, random_walk, three, white

ALPHAS = {
    NoiseType.QUANTISATION: 2, NoiseType.FLICKER_PHASE: 1, NoiseType.WHITE: 0, NoiseType.FLICKER: -1,
    NoiseType.RATE_RANDOM_WALK: -2,
}  # fmt: skip


def test_a_deviation_and_an_interval_by_hand() -> None:
    rate = np.array([[1.0], [2.0], [4.0], [3.0]])  # differences of neighbours 1, 2, -1: 6 / (2 · 3) = 1
    curve = allan_curve([rate], 1.0, np.array([1]))
    assert curve.deviation[0, 0] == pytest.approx(1.0)
    means = [1.5, 3.0, 3.5]  # averages of two samples, overlapping: the first and the last average differ by 2
    curve = allan_curve([rate], 1.0, np.array([2]))
    assert curve.deviation[0, 0] == pytest.approx((means[2] - means[0]) / np.sqrt(2))
    # χ² of 10 degrees of freedom at 5 and 95 %: 3.940 and 18.307 (any table)
    low, high = interval(np.array([1.0]), np.array([10.0]), confidence=0.9)
    assert low[0] == pytest.approx(np.sqrt(10 / 18.307), rel=1e-4)
    assert high[0] == pytest.approx(np.sqrt(10 / 3.940), rel=1e-4)


def test_it_is_that_of_allantools() -> None:
    random = np.random.default_rng(1)
    rate_hz = 50.0
    one = white(random, 20_000, rate_hz, 0.1) + random_walk(random, 20_000, rate_hz, 0.02) + 9.81
    curve = allan_curve([three(one)], rate_hz)
    tau_s, deviation, _, _ = allantools.oadev(one, rate=rate_hz, data_type="freq", taus=curve.tau_s)
    assert tau_s == pytest.approx(curve.tau_s)
    assert curve.deviation[:, 0] == pytest.approx(deviation, rel=1e-9)


def test_runs_are_taken_together_without_a_difference_across_the_gap() -> None:
    random = np.random.default_rng(3)
    first, second = white(random, 500, 1.0, 1.0)[:, None], white(random, 300, 1.0, 1.0)[:, None] + 1000.0
    factors = np.array([1, 10])
    both = allan_curve([first, second], 1.0, factors).deviation[:, 0] ** 2
    alone = [allan_curve([run], 1.0, factors).deviation[:, 0] ** 2 for run in (first, second)]
    counts = [np.array([len(run) + 1 - 2 * m for m in factors]) for run in (first, second)]
    assert both == pytest.approx((alone[0] * counts[0] + alone[1] * counts[1]) / (counts[0] + counts[1]))


def test_runs_that_are_too_short_have_no_degrees_of_freedom() -> None:
    run = white(np.random.default_rng(4), 500, 1.0, 1.0)[:, None]
    curve = allan_curve([run, run[:20], run[:19]], 1.0, np.array([10]))
    noise = NoiseType(int(curve.types[0, 0]))
    assert curve.freedom[0, 0] == sum(degrees_of_freedom(noise, 10, n) for n in (501, 21))


@pytest.mark.parametrize("noise", list(NoiseType))
@pytest.mark.parametrize(("m", "n"), [(1, 1001), (4, 1001), (100, 1001), (7, 50)])
def test_degrees_of_freedom_are_those_of_allantools(noise: NoiseType, m: int, n: int) -> None:
    if noise is NoiseType.FLICKER and m == 1:
        theirs = 2 * (n - 2) ** 2 / (2.3 * n - 4.9)  # SP 1065, table 5; allantools 2024.6 returns 0.87
    else:
        theirs = allantools.edf_simple(n, m, ALPHAS[noise])
    assert degrees_of_freedom(noise, m, n) == pytest.approx(max(theirs, 1.0), rel=1e-9)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    random = np.random.default_rng(4)
    factors, truth = np.array([1, 8, 40]), 1.0 / np.sqrt([1, 8, 40])
    held = np.zeros(3)
    rounds = 300
    for _ in range(rounds):
        curve = allan_curve([white(random, 400, 1.0, 1.0)[:, None]], 1.0, factors)
        held += (curve.low[:, 0] <= truth) & (truth <= curve.high[:, 0])
    assert held / rounds == pytest.approx([0.683] * 3, abs=0.08)


def test_types_of_noise_factors_and_short_runs() -> None:
    for made, expected in [
        (quantisation(np.random.default_rng(5), 4000, 1.0, 1.0), NoiseType.QUANTISATION),
        (white(np.random.default_rng(5), 4000, 1.0, 1.0), NoiseType.WHITE),
        (flicker(np.random.default_rng(5), 4000, 1.0), NoiseType.FLICKER),
        (random_walk(np.random.default_rng(5), 4000, 1.0, 1.0), NoiseType.RATE_RANDOM_WALK),
    ]:
        types = noise_types(made[:, None], np.array([1, 4, 1000]))
        assert types[0, 0] == expected
        assert types[2, 0] == types[1, 0], "too few averages: as at the τ before"
    factors = averaging_factors(3000)
    assert (factors[0], factors[-1]) == (1, 1000)
    assert len(factors) > 24
    with pytest.raises(BadArgument, match="at least 3 samples"):
        averaging_factors(2)
    curve = allan_curve([np.full((200, 3), 9.81)], 100.0)
    assert curve.deviation == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(BadArgument, match="at least 200 samples"):
        allan_curve([np.zeros((50, 1))], 1.0, np.array([100]))
