"""Noise of a device at rest: Allan deviation, coefficients, noise density, drift with temperature.

The low-pass filter of the device removes noise above its corner frequency. At small τ, the Allan deviation shows the
filter, not the sensor. Therefore imud first finds the corner frequency and fits the coefficients at larger τ only.
Reference: NIST Special Publication 1065 (SP 1065).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from math import degrees
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import nnls
from scipy.signal import welch
from scipy.stats import chi2

from imud.analysis.series import FloatArray, Grid, IntArray, Readings, even_runs, grid_of, with_values
from imud.analysis.spectrum import Spectrum, power_spectrum
from imud.attitude.gravity import REST_M_S2
from imud.model.errors import BadArgument
from imud.model.units import NS_PER_S, STANDARD_GRAVITY_M_S2

CONFIDENCE: Final = 0.683  # probability of the confidence intervals: one sigma
PER_DECADE: Final = 12  # number of τ per decade
# Length of the longest run divided by the largest τ. A larger τ has about one degree of freedom.
PARTS_LEAST: Final = 3
# Minimum number of averages to find the noise type. With 30 (SP 1065, 5.5.6), the error of the power is 0.4.
CLUSTERS_LEAST: Final = 60


class NoiseType(IntEnum):
    """Noise type of a rate. The value is the power α of the spectrum, S(f) ∝ f^α."""

    RATE_RANDOM_WALK = -2  # slope of the deviation: +1/2
    FLICKER = -1  # bias instability, slope 0
    WHITE = 0  # angle or velocity random walk, slope -1/2
    FLICKER_PHASE = 1
    QUANTISATION = 2  # slope of the deviation: -1


class AllanCurve(NamedTuple):
    """Allan deviation of all axes over k values of τ."""

    tau_s: FloatArray  # averaging times, s, shape (k,)
    factors: IntArray  # number of samples per average, shape (k,)
    deviation: FloatArray  # deviation in the unit of the rate, shape (k, axes)
    low: FloatArray  # lower ends of the confidence intervals, shape (k, axes)
    high: FloatArray  # upper ends of the confidence intervals, shape (k, axes)
    freedom: FloatArray  # equivalent degrees of freedom, shape (k, axes)
    types: IntArray  # noise types (NoiseType), shape (k, axes)


def averaging_factors(longest: int) -> IntArray:
    """Return the numbers of samples per average, PER_DECADE per decade, up to a third of the longest run."""
    most = longest // PARTS_LEAST
    if most < 1:
        raise BadArgument(f"expected a run of at least {PARTS_LEAST} samples, got {longest}")
    wanted = np.logspace(0, np.log10(most), max(int(np.ceil(np.log10(most) * PER_DECADE)), 1) + 1)
    return np.unique(np.clip(np.rint(wanted), 1, most).astype(np.int64))


def allan_curve(runs: Sequence[FloatArray], rate_hz: float, factors: IntArray | None = None) -> AllanCurve:
    """Return the overlapping Allan deviation of runs of the shape (m, axes) at `rate_hz`.

    No average contains samples of two runs. Raises BadArgument if no run is long enough.
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
    """Return the integral of a run, shape (m + 1, axes)."""
    # without the mean, which would increase the rounding errors of the sum
    total = np.cumsum(run - run.mean(axis=0), axis=0) / rate_hz
    return np.concatenate((np.zeros((1, run.shape[1])), total))


def _deviation(phases: Sequence[FloatArray], m: int, tau_s: float) -> FloatArray:
    """Return the deviation of each axis at one τ, shape (axes,)."""
    squares, count = np.zeros(phases[0].shape[1]), 0
    for phase in phases:
        if len(phase) > 2 * m:
            second = phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]
            squares += np.einsum("ij,ij->j", second, second)
            count += len(second)
    if not count:
        raise BadArgument(f"expected a run of at least {2 * m} samples for averages of {m} samples, got shorter runs")
    return np.sqrt(squares / count / 2) / tau_s


def interval(
    deviation: FloatArray, freedom: FloatArray, confidence: float = CONFIDENCE
) -> tuple[FloatArray, FloatArray]:
    """Return both ends of the confidence interval of the deviation (SP 1065, 5.3)."""
    tail = (1 - confidence) / 2
    high: FloatArray = deviation * np.sqrt(freedom / chi2.ppf(tail, freedom))
    low: FloatArray = deviation * np.sqrt(freedom / chi2.ppf(1 - tail, freedom))
    return low, high


def degrees_of_freedom(noise: NoiseType, m: int, n: int) -> float:
    """Return the equivalent degrees of freedom of the overlapping estimate (SP 1065, table 5), at least 1.

    `n`: number of phase points; `m`: number of samples per average.
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
    """Return the noise types of a run, shape (m, axes), at each averaging factor; shape (k, axes).

    If the run is too short for a factor, the type is equal to the type at the previous factor.
    """
    found = np.full((len(factors), run.shape[1]), int(NoiseType.WHITE), dtype=np.int64)
    for row, m in enumerate(factors):
        clusters = len(run) // int(m)
        if clusters >= CLUSTERS_LEAST:
            averages = run[: clusters * int(m)].reshape(clusters, int(m), -1).mean(axis=1)
            found[row] = [int(_type_of(averages[:, axis])) for axis in range(run.shape[1])]
            if row:
                # phase noise decreases fastest with τ: it cannot follow another noise type
                over = found[row - 1] <= int(NoiseType.WHITE)
                found[row, over] = np.minimum(found[row, over], int(NoiseType.WHITE))
        elif row:
            found[row] = found[row - 1]
    return found


def _type_of(averages: FloatArray) -> NoiseType:
    """Return the noise type of averages, shape (n,), from the autocorrelation at lag 1 (SP 1065, 5.5.6)."""
    for differences in (0, 1):
        centred = averages - averages.mean()
        power = float(centred @ centred)
        correlation = float(centred[1:] @ centred[:-1]) / power if power > 0 else 0.0
        delta = correlation / (1 + correlation)
        alpha = round(-2 * delta - 2 * differences)
        # stationary enough: no differencing. A second difference would only find α < -2.
        if delta < 0.25:
            break
        averages = np.diff(averages)
    return NoiseType(min(max(alpha, -2), 2))


BIAS_FACTOR: Final = float(np.sqrt(2 * np.log(2) / np.pi))  # minimum deviation of flicker noise divided by B: 0.664
ROUNDS: Final = 12
POINTS_LEAST: Final = 6
# Minimum square of a coefficient in its standard deviations. Below that, the series does not resolve it.
RESOLVED_SIGMAS: Final = 2.0
# Number of points per octave. They use nearly the same averages and count as one independent point.
POINTS_PER_OCTAVE: Final = PER_DECADE * float(np.log10(2))


class Coefficient(NamedTuple):
    """Coefficient of one axis, in the SI unit of the sensor."""

    value: float | None  # value; None if other noise hides the coefficient, or if the series is too short
    sigma: float  # approximate standard deviation of `value`; 0 if `value` is None
    below: float  # upper bound of the coefficient, two standard deviations


class NoiseTerms(NamedTuple):
    """Coefficients of one axis. The units are for a rate in rad/s."""

    quantisation: Coefficient  # quantisation Q, rad
    random_walk: Coefficient  # random walk N, rad/s/√Hz = rad/√s: the line with the slope -1/2 at τ = 1 s
    bias_instability: Coefficient  # bias instability B, rad/s
    rate_random_walk: Coefficient  # rate random walk K, rad/s/√s
    rate_ramp: Coefficient  # rate ramp R, rad/s²

    def deviation(self, tau_s: FloatArray) -> FloatArray:
        """Return the Allan deviation of these coefficients, shape (k,)."""
        squares = np.array([(term.value or 0.0) ** 2 for term in self])
        return np.asarray(np.sqrt(basis(tau_s) @ squares))


def basis(tau_s: FloatArray) -> FloatArray:
    """Return the variance at each τ of coefficients of 1, in the order of NoiseTerms, shape (k, 5)."""
    ones = np.ones_like(tau_s)
    return np.stack([3 / tau_s**2, 1 / tau_s, BIAS_FACTOR**2 * ones, tau_s / 3, tau_s**2 / 2], axis=1)


def noise_terms(curve: AllanCurve, axis: int, tau_least_s: float = 0.0) -> NoiseTerms:
    """Fit the coefficients of one axis to the points with τ ≥ `tau_least_s`. Raises BadArgument for too few points."""
    used = curve.tau_s >= tau_least_s * (1 - 1e-9)
    if used.sum() < POINTS_LEAST:
        raise BadArgument(
            f"expected at least {POINTS_LEAST} points of the Allan deviation from τ = {tau_least_s:.3g} s, got "
            f"{used.sum()}; record a longer series"
        )
    variance, freedom = curve.deviation[used, axis] ** 2, curve.freedom[used, axis]
    # constant values have no noise
    if not variance.any():
        return NoiseTerms(*(Coefficient(None, 0.0, 0.0) for _ in NoiseTerms._fields))
    shapes = basis(curve.tau_s[used])
    scale = (variance[:, None] / shapes).min(axis=0)  # upper bound of each term: scaled terms are near 1
    scale = np.where(scale > 0, scale, variance.max())
    chosen = list(range(shapes.shape[1]))
    squares, spread = _fit(shapes * scale, variance, freedom, chosen)
    bounds = squares + RESOLVED_SIGMAS * spread
    while len(chosen) > 1:
        weakest = min(chosen, key=lambda term: squares[term] / spread[term])
        if squares[weakest] > RESOLVED_SIGMAS * spread[weakest]:
            break
        # fit again without the term that is least significant
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
    """Return the squares of the chosen terms, shape (5,), and their standard deviations. Other terms are zero."""
    fitted, squares, spread = variance, np.zeros(shapes.shape[1]), np.zeros(shapes.shape[1])
    # avoids a division by zero in the weights
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


AXES: Final = ("x", "y", "z")
CORNER_SHARE: Final = 0.5  # share of the power at the corner frequency: -3 dB
CORNER_BINS: Final = 24  # number of logarithmic bands for the search of the corner frequency
# Minimum and maximum number of bands below the corner frequency that must be flat within a factor of 2
PLATEAU_LEAST, PLATEAU_MOST = 4, 8
# Minimum τ of the fit, in periods of the corner frequency. At this τ, a first-order filter changes the Allan variance
# of white noise by less than 5 %: 3 / (4π) periods divided by τ.
FILTER_PERIODS: Final = 5.0
FLAT_LOW, FLAT_HIGH = 0.05, 0.6  # band of the noise density, as shares of the corner frequency
KNOWN_PARTS: Final = 10  # minimum ratio of the duration to τ: the error of the deviation is then below about 25 %
STILL_S: Final = 1.0  # length of the blocks that imud checks for motion, s
STILL_FACTOR: Final = 4.0  # minimum standard deviation of a disturbed block, as a multiple of the median block
MOVED_SHARE: Final = 0.01  # maximum share of blocks with motion in a measurement at rest
RAISED: Final = 1.1  # maximum ratio of two standard deviations: with these blocks, and without them
BLOCKS_MOST: Final = 2000  # maximum number of means for the fit of the drift
SPAN_LEAST_C: Final = 2.0  # Minimum range of the temperature for a drift, °C. Many devices send whole degrees.
BLOCKS_LEAST: Final = 8


@dataclass(frozen=True, slots=True)
class Drift:
    """Linear change of one axis with temperature: least-squares fit of block means."""

    slope: float  # slope, unit of the rate per K
    sigma: float  # standard deviation of the slope if the blocks are independent
    r2: float  # share of the variance of the means that the line explains, R²


@dataclass(frozen=True, slots=True)
class AxisNoise:
    """Noise of one axis, in the SI unit of the sensor."""

    mean: float  # mean at rest: the bias; for an accelerometer with gravity
    spread: float  # standard deviation of the samples
    terms: NoiseTerms
    # Minimum Allan deviation. Divided by 0.664, it is the bias instability of data sheets, which is at least B.
    least_deviation: float
    least_tau_s: float
    least_at_end: bool  # whether the minimum is at the largest reliable τ: the true minimum is then smaller
    density: float  # Root of the one-sided spectral density in its flat band, per √Hz. For white noise it is √2 N.
    drift: Drift | None  # drift with temperature; None if the temperature is unknown or nearly constant

    @property
    def bias_instability_most(self) -> float:
        """Minimum Allan deviation divided by 0.664."""
        return self.least_deviation / BIAS_FACTOR


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Noise of one sensor."""

    grid: Grid
    curve: AllanCurve
    spectrum: Spectrum
    axes: tuple[AxisNoise, AxisNoise, AxisNoise]
    corner_hz: float | None  # corner frequency of the device's low-pass filter, Hz; None if the noise shows no filter
    tau_least_s: float  # minimum τ of the fit, s
    flat_hz: tuple[float, float]  # band of the noise density, Hz
    disturbed_s: int  # number of seconds with motion, vibration or an outlier
    still_s: int  # number of checked seconds
    # Resolution: minimum difference of two values, if all values are multiples of it. Otherwise None.
    step: float | None


def sensor_noise(readings: Readings, values: FloatArray) -> SensorNoise:
    """Analyse one sensor of `readings`; `values` has the shape (n, 3). Raises BadArgument for too few samples."""
    t_ns, values = with_values(readings.t_ns, values)
    grid = grid_of(t_ns)
    runs = even_runs(grid, values)
    curve = allan_curve(runs, grid.rate_hz)
    spectrum = power_spectrum(runs, grid.rate_hz)
    corner_hz = corner_of(spectrum)
    tau_least_s = FILTER_PERIODS / corner_hz if corner_hz is not None else 0.0
    top_hz = corner_hz if corner_hz is not None else grid.rate_hz / 2
    flat_hz = (FLAT_LOW * top_hz, FLAT_HIGH * top_hz)
    disturbed, looked_at = _disturbed(runs, grid.rate_hz)
    temperature = _temperature(readings, t_ns)
    axes = [
        _axis(number, values, curve, spectrum, tau_least_s, flat_hz, grid, temperature) for number in range(len(AXES))
    ]
    return SensorNoise(
        grid, curve, spectrum, (axes[0], axes[1], axes[2]), corner_hz, tau_least_s, flat_hz, disturbed, looked_at,
        step_of(values),
    )  # fmt: skip


def _axis(
    number: int, values: FloatArray, curve: AllanCurve, spectrum: Spectrum, tau_least_s: float,
    flat_hz: tuple[float, float], grid: Grid, temperature: FloatArray | None,
) -> AxisNoise:  # fmt: skip
    own = values[:, number]
    known = curve.tau_s <= max(grid.duration_s / KNOWN_PARTS, curve.tau_s[0])
    used = np.flatnonzero(known & (curve.tau_s >= tau_least_s))
    lowest = int(used[np.argmin(curve.deviation[used, number])]) if len(used) else len(curve.tau_s) - 1
    inside = (spectrum.frequency_hz >= flat_hz[0]) & (spectrum.frequency_hz <= flat_hz[1])
    density = float(np.sqrt(spectrum.density[inside, number].mean())) if inside.any() else float("nan")
    return AxisNoise(
        float(own.mean()), float(own.std()), noise_terms(curve, number, tau_least_s),
        float(curve.deviation[lowest, number]), float(curve.tau_s[lowest]), not len(used) or lowest == used[-1],
        density, temperature_drift(temperature, own, grid.rate_hz) if temperature is not None else None,
    )  # fmt: skip


def corner_of(spectrum: Spectrum) -> float | None:
    """Return the frequency above which the power of all axes is less than half of the power below; None without one.

    The power below the corner must be flat. Noise that decreases at all frequencies (random walk) has no corner.
    """
    power = spectrum.density.mean(axis=0)
    if not power.any():
        return None
    # equal weight for all axes; without the bin at 0 Hz
    whitened = (spectrum.density[:, power > 0] / power[power > 0]).mean(axis=1)[1:]
    frequency = spectrum.frequency_hz[1:]
    edges = np.geomspace(frequency[0], frequency[-1], CORNER_BINS + 1)
    band = np.clip(np.searchsorted(edges, frequency, side="right") - 1, 0, CORNER_BINS - 1)
    count = np.bincount(band, minlength=CORNER_BINS)
    power = np.asarray(np.bincount(band, whitened, CORNER_BINS) / np.maximum(count, 1))
    full = np.flatnonzero(count)
    for place in range(PLATEAU_LEAST, len(full)):
        here, below = full[place], power[full[max(place - PLATEAU_MOST, 0) : place]]
        plateau = float(np.median(below))
        flat = below.max() < plateau / CORNER_SHARE and below.min() > plateau * CORNER_SHARE
        if flat and (power[full[place:]] < CORNER_SHARE * plateau).all():
            return float(frequency[np.flatnonzero(band == here)[0]])
    return None


def _disturbed(runs: list[FloatArray], rate_hz: float) -> tuple[int, int]:
    """Return the number of seconds with a much larger scatter than usual, and the number of checked seconds."""
    size = max(round(STILL_S * rate_hz), 2)
    blocks = [run[: len(run) // size * size].reshape(-1, size, run.shape[1]).std(axis=1) for run in runs]
    spread = np.concatenate(blocks)
    if not len(spread):
        return 0, 0
    # the median ignores disturbed seconds
    usual = np.median(spread, axis=0)
    return int((spread > STILL_FACTOR * np.maximum(usual, 1e-12)).any(axis=1).sum()), len(spread)


class RestLimits(NamedTuple):
    """Limits of one second of a sensor at rest, SI. They hold for any sensor, with or without noise."""

    quantity: str
    unit: str
    length: float  # length of the mean vector at rest
    mean: float  # maximum difference from `length`
    scatter: float  # maximum standard deviation of an axis
    change: float  # maximum difference of the mean of an axis from its median


# The bias of a gyroscope with a factory calibration is below 1 °/s and changes by less than 0.5 °/s during the warm-up.
# A noise density of 0.05 °/s/√Hz scatters by 1.1 °/s at 1 kHz, an accelerometer with 400 µg/√Hz by 0.09 m/s².
GYRO_AT_REST: Final = RestLimits("angular rate", "rad/s", 0.0, 0.0175, 0.025, 0.01)
ACCEL_AT_REST: Final = RestLimits("acceleration", "m/s²", STANDARD_GRAVITY_M_S2, REST_M_S2, 0.15, 0.1)
# Minimum standard deviation of a tone that is a vibration, by quantity, and its minimum ratio to the power density of
# the neighbouring frequencies
TONES: Final = {"angular rate": 0.003, "acceleration": 0.03}
TONE_RATIO: Final = 20.0
TONE_S: Final = 8.0  # length of the segments of the power density, s
TONE_LEAST, TONE_MOST = 256, 8192  # minimum and maximum length of these segments, samples
TONE_BINS: Final = range(6, 16)  # distances of neighbouring frequencies, without the width of a tone
TONE_FIRST: Final = 4  # first frequency of a tone; the noise of lower frequencies is not white
# Maximum change of an angle from second to second, and of roll and pitch from their median, at rest
ANGLE_AT_REST_RAD: Final = 0.0087
STEEP_RAD: Final = 1.3  # minimum pitch at which roll and yaw of a device at rest can jump
# Minimum step of the mean rate when a slow turn starts, rad/s and standard errors. A warm-up causes at most 0.04 °/s.
TURN_STEP_RAD_S, TURN_SIGMAS = 0.001745, 8.0
TURN_S: Final = 5  # number of seconds before and after the step; the median ignores a short bump


def motion_words(readings: Readings) -> str:
    """Return how the device moved in the worst seconds; empty if it was at rest."""
    found: list[str] = []
    for values, limits in ((readings.gyro_rad_s, GYRO_AT_REST), (readings.accel_m_s2, ACCEL_AT_REST)):
        if values is not None and (motion := _motion(*with_values(readings.t_ns, values), limits)):
            found.append(motion)
    if not found and readings.gyro_rad_s is not None:
        found.append(_turn_step(readings.t_ns, readings.gyro_rad_s))
    return "; ".join(filter(None, (*found, _turn(readings))))


def unverified_words(readings: Readings) -> str:
    """Return why the data do not show rest; empty if they show it."""
    angles, gyro, accel = readings.euler_rad, readings.gyro_rad_s, readings.accel_m_s2
    if angles is not None and np.isfinite(angles[:, 2]).sum() >= BLOCKS_LEAST:
        return ""
    if gyro is None:
        return "rest is not verified: the data contain neither angular rates nor a heading, which show slow turns"
    mean = np.nanmean(gyro, axis=0)
    if accel is None:
        words, rate = "rest is not verified: without angles and accelerations, a turn at the mean", np.sqrt(mean @ mean)
    else:
        words = "rest around the vertical axis is not verified: without a heading, a steady turn at the mean vertical"
        rate = abs(mean @ (up := np.nanmean(accel, axis=0))) / np.sqrt(up @ up)
    return f"{words} angular rate of {degrees(rate):.2g} °/s is the same as the bias of the sensor"


def _turn_step(t_ns: IntArray, gyro_rad_s: FloatArray) -> str:
    """Return the start or end of a slow turn; empty without one."""
    t_ns, values = with_values(t_ns, gyro_rad_s)
    if len(t_ns) < BLOCKS_LEAST or len(mean := _blocks(t_ns, values).mean(axis=1)) < 2 * TURN_S:
        return ""
    level = np.median(np.lib.stride_tricks.sliding_window_view(mean, TURN_S, axis=0), axis=-1)
    steps = np.abs(level[TURN_S:] - level[:-TURN_S])
    error = np.median(np.abs(np.diff(mean, axis=0)), axis=0) / np.sqrt(TURN_S)
    if not (steps > np.maximum(TURN_STEP_RAD_S, TURN_SIGMAS * error)).any():
        return ""
    most, step = (f"{degrees(rate):.2g} °/s" for rate in (TURN_STEP_RAD_S, steps.max()))
    after_s = (int(steps.max(axis=1).argmax()) + TURN_S) * STILL_S
    words = f"got {step} after {after_s:.0f} s: a slow turn started or ended"
    return f"angular rate: expected a step of the mean of at most {most}, {words}"


def _blocks(t_ns: IntArray, values: FloatArray) -> FloatArray:
    """Return the values in blocks of one second, shape (blocks, n, axes)."""
    size = max(round(STILL_S * NS_PER_S / float(np.median(np.diff(t_ns)))), 2)
    return values[: len(values) // size * size].reshape(-1, size, values.shape[1])


def _turn(readings: Readings) -> str:
    """Return how roll, pitch or yaw changed; empty if they did not change."""
    angles = readings.euler_rad
    if angles is None:
        return ""
    usable = ~(np.abs(angles[:, 1]) > STEEP_RAD)
    t_ns, angles = readings.t_ns[usable], angles[usable]
    for name, column in zip(("roll", "pitch", "yaw"), angles.T, strict=True):
        good = np.isfinite(column)
        if good.sum() < BLOCKS_LEAST or not len(blocks := _blocks(t_ns[good], np.unwrap(column[good])[:, None])):
            continue
        mean = blocks.mean(axis=1)[:, 0]
        changes = np.abs(np.diff(mean, prepend=mean[:1]))
        if name != "yaw":
            changes = np.maximum(changes, np.abs(mean - np.median(mean)))
        count = int((changes > ANGLE_AT_REST_RAD).sum())
        if count > MOVED_SHARE * len(changes):
            return (
                f"{name}: expected a change of at most {degrees(ANGLE_AT_REST_RAD):.1f}° in each second, got up to "
                f"{degrees(changes.max()):.3g}° in {count} of {len(changes)} seconds"
            )
    return ""


def _tone(t_ns: IntArray, values: FloatArray, limits: RestLimits) -> str:
    """Return the strongest tone of a vibration; empty without a vibration."""
    rate_hz = NS_PER_S / float(np.median(np.diff(t_ns)))
    if len(values) < TONE_LEAST:
        return ""
    size = min(max(round(TONE_S * rate_hz), TONE_LEAST), TONE_MOST, len(values))
    frequency_hz, density = welch(values, rate_hz, nperseg=size, axis=0)
    edge, bins = TONE_BINS[-1], len(density)
    wide = np.pad(density, ((edge, edge), (0, 0)), constant_values=np.nan)
    near = [wide[edge + at : edge + at + bins] for one in TONE_BINS for at in (one, -one)]
    floor = np.nanmedian(near, axis=0)
    power = sum(np.roll(density, at, axis=0) for at in (-1, 0, 1)) * frequency_hz[1]
    is_tone = (density > TONE_RATIO * floor) & (np.sqrt(power) > TONES[limits.quantity])
    is_tone[:TONE_FIRST] = False
    if not is_tone.any():
        return ""
    place = int(np.where(is_tone, power, 0.0).max(axis=1).argmax())
    return (
        f"{limits.quantity}: expected no vibration, got {np.sqrt(power[place].max()):.2g} {limits.unit} at "
        f"{frequency_hz[place]:.3g} Hz"
    )


def _motion(t_ns: IntArray, values: FloatArray, limits: RestLimits) -> str:
    if len(t_ns) < BLOCKS_LEAST or not len(blocks := _blocks(t_ns, values)):
        return ""
    mean = blocks.mean(axis=1)
    for words, found, limit in (
        (
            f"difference of the mean from {limits.length:.4g} {limits.unit}",
            np.abs(np.sqrt((mean**2).sum(axis=1)) - limits.length),
            limits.mean,
        ),
        ("standard deviation", blocks.std(axis=1).max(axis=1), limits.scatter),
        ("change of the mean", np.abs(mean - np.median(mean, axis=0)).max(axis=1), limits.change),
    ):
        at_rest = found <= limit
        count = int((~at_rest).sum())
        # a short strong motion also determines the standard deviation of a long measurement
        if count > MOVED_SHARE * len(found) or (
            count and float(blocks.std(axis=(0, 1)).max()) > RAISED * float(blocks[at_rest].std(axis=(0, 1)).max())
        ):
            return (
                f"{limits.quantity}: expected a {words} of at most {limit:.3g} {limits.unit} in each second, got up to "
                f"{found.max():.3g} {limits.unit} in {count} of {len(found)} seconds"
            )
    return _tone(t_ns, values, limits)


def _temperature(readings: Readings, t_ns: np.ndarray) -> FloatArray | None:
    """Return the temperature at each sample, shape (k,), from the newest earlier temperature; None without one."""
    if readings.temperature_c is None:
        return None
    known = np.isfinite(readings.temperature_c)
    if not known.any():
        return None
    place = np.searchsorted(readings.t_ns[known], t_ns, side="right") - 1
    return np.asarray(readings.temperature_c[known][np.maximum(place, 0)], dtype=np.float64)


def temperature_drift(temperature_c: FloatArray, values: FloatArray, rate_hz: float) -> Drift | None:
    """Fit values to temperatures, both of the shape (n,). None if the temperature is nearly constant."""
    # means over at least 1 s
    size = max(round(STILL_S * rate_hz), -(-len(values) // BLOCKS_MOST), 1)
    count = len(values) // size
    if count < BLOCKS_LEAST:
        return None
    warm = temperature_c[: count * size].reshape(count, size).mean(axis=1)
    mean = values[: count * size].reshape(count, size).mean(axis=1)
    if warm.max() - warm.min() < SPAN_LEAST_C:
        return None
    x, y = warm - warm.mean(), mean - mean.mean()
    slope = float(x @ y / (x @ x))
    # sum of squares that the line does not explain
    rest = float(((y - slope * x) ** 2).sum())
    total = float(y @ y)
    return Drift(slope, float(np.sqrt(rest / (count - 2) / (x @ x))), 1 - rest / total if total > 0 else 0.0)


def step_of(values: FloatArray) -> float | None:
    """Return the resolution if all values, shape (n, axes), are multiples of it; otherwise None."""
    sorted_values = np.unique(values[:20_000])
    if len(sorted_values) < BLOCKS_LEAST:
        return None
    steps = np.diff(sorted_values)
    least = float(steps.min())
    counts = steps / least
    # float values have no common step
    return least if np.abs(counts - np.rint(counts)).max() < 0.02 and np.rint(counts).max() < 1e4 else None
