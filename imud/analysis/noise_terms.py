"""Coefficients of the kinds of noise of an inertial sensor, fitted to its Allan variance (IEEE Std 952-1997, annex C).

    σ²(τ) = 3 Q²/τ² + N²/τ + (2 ln 2 / π) B² + K² τ/3 + R² τ²/2

Q quantisation, N angle or velocity random walk, B bias instability (0.664 B is the floor of σ), K rate random walk,
R rate ramp. The squares enter linearly and are never negative: non-negative least squares, weighted by what χ² says
of each point's spread. The weights are those of the fitted curve, not of the points, which would favour those that
happen to be low; so it is done some times over. Terms that do not stand out of their own uncertainty are left out, the
weakest first, and the others fitted again: of points so close to each other, a term too many takes from its neighbours.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import nnls

from imud.analysis.allan import PER_DECADE, AllanCurve
from imud.analysis.series import FloatArray
from imud.errors import BadArgument

BIAS_FACTOR: Final = float(np.sqrt(2 * np.log(2) / np.pi))
"""0.664: the floor of the deviation of flicker noise, in B."""
ROUNDS: Final = 12
POINTS_LEAST: Final = 6
RESOLVED_SIGMAS: Final = 2.0
"""A square that is so many of its own standard deviations above zero is resolved."""
POINTS_PER_OCTAVE: Final = PER_DECADE * float(np.log10(2))
"""Points closer than an octave are made of nearly the same averages: so many count as one."""


class Coefficient(NamedTuple):
    """One coefficient of one axis, in the sensor's SI unit."""

    value: float | None
    """None where the series does not show it: other noise hides it, or it is too short."""
    sigma: float
    """Standard deviation of `value`, about; 0 where there is none."""
    below: float
    """It is below this, with two sigma."""


class NoiseTerms(NamedTuple):
    """All coefficients of one axis; units for a rate in rad/s."""

    quantisation: Coefficient
    """Q, rad."""
    random_walk: Coefficient
    """N, rad/s/√Hz = rad/√s; the line of slope -1/2 at τ = 1 s."""
    bias_instability: Coefficient
    """B, rad/s."""
    rate_random_walk: Coefficient
    """K, rad/s/√s."""
    rate_ramp: Coefficient
    """R, rad/s²."""

    def deviation(self, tau_s: FloatArray) -> FloatArray:
        """The curve that these coefficients make, (k,)."""
        squares = np.array([(term.value or 0.0) ** 2 for term in self])
        return np.asarray(np.sqrt(basis(tau_s) @ squares))


def basis(tau_s: FloatArray) -> FloatArray:
    """(k, 5) variance at each τ of coefficients of 1, in the order of NoiseTerms."""
    ones = np.ones_like(tau_s)
    return np.stack([3 / tau_s**2, 1 / tau_s, BIAS_FACTOR**2 * ones, tau_s / 3, tau_s**2 / 2], axis=1)


def noise_terms(curve: AllanCurve, axis: int, tau_least_s: float = 0.0) -> NoiseTerms:
    """Fit the coefficients of one axis, to the points from `tau_least_s` on. Raises BadArgument for too few points."""
    used = curve.tau_s >= tau_least_s * (1 - 1e-9)
    if used.sum() < POINTS_LEAST:
        raise BadArgument(
            f"expected at least {POINTS_LEAST} points of the Allan deviation from τ = {tau_least_s:.3g} s on, got "
            f"{used.sum()}: a longer series is needed"
        )
    variance, freedom = curve.deviation[used, axis] ** 2, curve.freedom[used, axis]
    if not variance.any():
        return NoiseTerms(*(Coefficient(None, 0.0, 0.0) for _ in NoiseTerms._fields))
    shapes = basis(curve.tau_s[used])
    scale = (variance[:, None] / shapes).min(axis=0)  # of each term, the most that it can be: near one for all
    scale = np.where(scale > 0, scale, variance.max())
    chosen = list(range(shapes.shape[1]))
    squares, spread = _fit(shapes * scale, variance, freedom, chosen)
    bounds = squares + RESOLVED_SIGMAS * spread
    while len(chosen) > 1:
        weakest = min(chosen, key=lambda term: squares[term] / spread[term])
        if squares[weakest] > RESOLVED_SIGMAS * spread[weakest]:
            break
        chosen.remove(weakest)
        squares, spread = _fit(shapes * scale, variance, freedom, chosen)
    return NoiseTerms(
        *(
            _coefficient(squares[term] * scale[term], spread[term] * scale[term], bounds[term] * scale[term])
            for term in range(len(scale))
        )
    )


def _fit(
    shapes: FloatArray, variance: FloatArray, freedom: FloatArray, chosen: list[int]
) -> tuple[FloatArray, FloatArray]:
    """Squares (5,) of the chosen terms, zero for the others, and their standard deviations."""
    fitted, squares, spread = variance, np.zeros(shapes.shape[1]), np.zeros(shapes.shape[1])
    floor = variance[variance > 0].min() * 1e-6
    weighted = shapes[:, chosen]
    for _ in range(ROUNDS):
        weight = np.sqrt(freedom / 2) / np.maximum(fitted, floor)
        weighted = shapes[:, chosen] * weight[:, None]
        squares[chosen], _ = nnls(weighted, variance * weight)
        fitted = shapes @ squares
    normal = np.linalg.pinv(weighted.T @ weighted)
    spread[chosen] = np.sqrt(np.maximum(np.diag(normal), 0.0) * POINTS_PER_OCTAVE)
    return squares, np.maximum(spread, 1e-300)


def _coefficient(square: float, spread: float, bound: float) -> Coefficient:
    below = float(np.sqrt(bound))
    if square <= RESOLVED_SIGMAS * spread:
        return Coefficient(None, 0.0, below)
    value = float(np.sqrt(square))
    return Coefficient(value, float(spread / (2 * value)), below)
