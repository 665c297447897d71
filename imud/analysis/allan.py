"""Overlapping Allan deviation of a rate, with confidence intervals.

IEEE Std 952-1997, annex C (gyroscopes) and IEEE Std 1293 (accelerometers) for what is computed; W. J. Riley, Handbook
of Frequency Stability Analysis, NIST SP 1065 (2008): 5.2.4 the overlapping deviation, 5.4.1 the equivalent degrees of
freedom (table 5), 5.5.6 the type of noise by the autocorrelation at lag 1, 5.3 the χ² interval.

The rate is that of a sensor (rad/s, m/s²), its integral θ the phase of SP 1065::

    σ²(τ) = ⟨(θ(t + 2τ) - 2 θ(t + τ) + θ(t))²⟩ / 2τ²,   τ = m / rate
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import chi2

from imud.analysis.series import FloatArray, IntArray
from imud.errors import BadArgument

CONFIDENCE: Final = 0.683
"""Share of intervals that hold the truth: one sigma."""
PER_DECADE: Final = 12
PARTS_LEAST: Final = 3
"""The longest τ is this part of the longest run: beyond it there is hardly a degree of freedom."""
CLUSTERS_LEAST: Final = 60
"""Averages that the type of noise needs: with 30 (SP 1065, 5.5.6) its power is known to 0.4, often rounded wrong."""
DIFFERENCES_MOST: Final = 2


class NoiseType(IntEnum):
    """Types of noise of a rate by the power α of its spectrum, S(f) ∝ f^α."""

    RATE_RANDOM_WALK = -2
    """Slope +1/2 of the deviation."""
    FLICKER = -1
    """Bias instability, slope 0."""
    WHITE = 0
    """Angle or velocity random walk, slope -1/2."""
    FLICKER_PHASE = 1
    QUANTISATION = 2
    """Slope -1."""


class AllanCurve(NamedTuple):
    """The deviation of three axes over τ; k values of τ."""

    tau_s: FloatArray
    """(k,)"""
    factors: IntArray
    """(k,) samples per average."""
    deviation: FloatArray
    """(k, axes), unit of the rate."""
    low: FloatArray
    """(k, axes), lower end of the confidence interval."""
    high: FloatArray
    """(k, axes), upper end."""
    freedom: FloatArray
    """(k, axes), equivalent degrees of freedom."""
    types: IntArray
    """(k, axes), NoiseType."""


def averaging_factors(longest: int) -> IntArray:
    """Numbers of samples per average: PER_DECADE, evenly in the logarithm, up to a third of the longest run."""
    most = longest // PARTS_LEAST
    if most < 1:
        raise BadArgument(f"expected a run of at least {PARTS_LEAST} samples, got {longest}")
    wanted = np.logspace(0, np.log10(most), max(int(np.ceil(np.log10(most) * PER_DECADE)), 1) + 1)
    return np.unique(np.clip(np.rint(wanted), 1, most).astype(np.int64))


def allan_curve(runs: Sequence[FloatArray], rate_hz: float, factors: IntArray | None = None) -> AllanCurve:
    """Deviation of even runs, each (m, axes) at `rate_hz`, over all of them: no average reaches across a gap.

    Raises BadArgument where no run is long enough.
    """
    longest = max(runs, key=len)
    factors = averaging_factors(len(longest)) if factors is None else factors
    tau_s = factors / rate_hz
    phases = [_phase(run, rate_hz) for run in runs]
    lengths = [len(phase) for phase in phases]
    deviation = np.array([_deviation(phases, int(m), m / rate_hz) for m in factors])
    types = noise_types(longest, factors)
    freedom = np.array(
        [
            [sum(degrees_of_freedom(NoiseType(int(t)), int(m), n) for n in lengths if n > 2 * m) for t in row]
            for m, row in zip(factors, types, strict=True)
        ]
    )
    low, high = interval(deviation, freedom)
    return AllanCurve(tau_s, factors, deviation, low, high, freedom, types)


def _phase(run: FloatArray, rate_hz: float) -> FloatArray:
    """Integral of a run, (m + 1, axes); without its mean, of which sums of floats would suffer."""
    total = np.cumsum(run - run.mean(axis=0), axis=0) / rate_hz
    return np.concatenate((np.zeros((1, run.shape[1])), total))


def _deviation(phases: Sequence[FloatArray], m: int, tau_s: float) -> FloatArray:
    """(axes,) at one τ."""
    squares, count = np.zeros(phases[0].shape[1]), 0
    for phase in phases:
        if len(phase) > 2 * m:
            second = phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]
            squares += np.einsum("ij,ij->j", second, second)
            count += len(second)
    if not count:
        raise BadArgument(f"expected a run of at least {2 * m} samples for an average of {m}, got none")
    return np.sqrt(squares / count / 2) / tau_s


def interval(
    deviation: FloatArray, freedom: FloatArray, confidence: float = CONFIDENCE
) -> tuple[FloatArray, FloatArray]:
    """Both ends of the interval in which the true deviation lies with this probability (SP 1065, 5.3)."""
    tail = (1 - confidence) / 2
    high: FloatArray = deviation * np.sqrt(freedom / chi2.ppf(tail, freedom))
    low: FloatArray = deviation * np.sqrt(freedom / chi2.ppf(1 - tail, freedom))
    return low, high


def degrees_of_freedom(noise: NoiseType, m: int, n: int) -> float:
    """Equivalent degrees of freedom of the overlapping estimate: `n` points of phase, `m` per average (table 5).

    At least 1, where the formulas of some types fall below it.
    """
    if noise is NoiseType.QUANTISATION:
        found = (n + 1) * (n - 2 * m) / (2 * (n - m))
    elif noise is NoiseType.FLICKER_PHASE:
        found = float(np.exp(np.sqrt(np.log((n - 1) / (2 * m)) * np.log((2 * m + 1) * (n - 1) / 4))))
    elif noise is NoiseType.WHITE:
        found = (3 * (n - 1) / (2 * m) - 2 * (n - 2) / n) * 4 * m**2 / (4 * m**2 + 5)
    elif noise is NoiseType.FLICKER:
        found = 2 * (n - 2) ** 2 / (2.3 * n - 4.9) if m == 1 else 5 * n**2 / (4 * m * (n + 3 * m))
    else:
        found = (n - 2) / m * ((n - 1) ** 2 - 3 * m * (n - 1) + 4 * m**2) / (n - 3) ** 2
    return max(float(found), 1.0)


def noise_types(run: FloatArray, factors: IntArray) -> IntArray:
    """(k, axes) type of noise of a run (m, axes) at each average; where it is too short, as at the τ before.

    Noise of the angle (flicker of it, quantisation) falls fastest with τ, so it is none once another type was there.
    """
    found = np.full((len(factors), run.shape[1]), int(NoiseType.WHITE), dtype=np.int64)
    for row, m in enumerate(factors):
        clusters = len(run) // int(m)
        if clusters >= CLUSTERS_LEAST:
            averages = run[: clusters * int(m)].reshape(clusters, int(m), -1).mean(axis=1)
            found[row] = [int(_type_of(averages[:, axis])) for axis in range(run.shape[1])]
            if row:
                over = found[row - 1] <= int(NoiseType.WHITE)
                found[row, over] = np.minimum(found[row, over], int(NoiseType.WHITE))
        elif row:
            found[row] = found[row - 1]
    return found


def _type_of(averages: FloatArray) -> NoiseType:
    """Type of noise of averages (n,), by the autocorrelation at lag 1 (SP 1065, 5.5.6)."""
    for differences in range(DIFFERENCES_MOST + 1):
        centred = averages - averages.mean()
        power = float(centred @ centred)
        correlation = float(centred[1:] @ centred[:-1]) / power if power > 0 else 0.0
        delta = correlation / (1 + correlation)
        if delta < 0.25 or differences == DIFFERENCES_MOST:
            break
        averages = np.diff(averages)
    alpha = round(-2 * delta - 2 * differences)
    return NoiseType(min(max(alpha, -2), 2))
