"""Noise of the sensors of a device that lies still: deviation, coefficients, density, drift with temperature.

What limits it is found first: the rate by the stamps, the missing samples (`series`), and the frequency above which the
device's own low-pass filter takes the noise away. Below the τ that belongs to it the Allan deviation is that of the
filter, so the coefficients are fitted from there on.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from imud.analysis.allan import AllanCurve, allan_curve
from imud.analysis.noise_terms import BIAS_FACTOR, NoiseTerms, noise_terms
from imud.analysis.series import FloatArray, Grid, Readings, even_runs, grid_of, with_values
from imud.analysis.spectrum import Spectrum, power_spectrum

AXES: Final = ("x", "y", "z")
CORNER_SHARE: Final = 0.5
"""Half the power: -3 dB."""
CORNER_BINS: Final = 24
"""Bands, evenly in the logarithm, in which the roll-off is looked for."""
PLATEAU_LEAST, PLATEAU_MOST = 4, 8
"""Bands below that have to be flat within a factor of two for a roll-off to be one."""
FILTER_PERIODS: Final = 5.0
"""From so many periods of the corner frequency on, a first-order filter changes the Allan variance of white noise by
less than 5 %: the change is 3 / (4π) periods over τ."""
FLAT_LOW, FLAT_HIGH = 0.05, 0.6
"""Band in which the density is read, in parts of the corner frequency."""
KNOWN_PARTS: Final = 10
"""The deviation is known to about a quarter up to this part of the duration."""
STILL_S: Final = 1.0
"""Blocks in which rest is judged."""
STILL_FACTOR: Final = 4.0
"""A block that scatters by so much more than the median block was disturbed."""
BLOCKS_MOST: Final = 2000
"""Means over which the drift is fitted, at most."""
SPAN_LEAST_C: Final = 2.0
"""Least span of temperatures for a slope: many devices send whole degrees."""
BLOCKS_LEAST: Final = 8


@dataclass(frozen=True, slots=True)
class Drift:
    """Change of one axis with temperature, by least squares over means of blocks."""

    slope: float
    """ShownUnit of the rate per K."""
    sigma: float
    """Standard deviation of the slope, were the blocks independent."""
    r2: float
    """Share of the variance of the means that the line explains."""


@dataclass(frozen=True, slots=True)
class AxisNoise:
    """One axis, in the sensor's SI unit."""

    mean: float
    """The bias at rest; of an accelerometer gravity is in it."""
    spread: float
    """Standard deviation of the samples."""
    terms: NoiseTerms
    least_deviation: float
    """The least Allan deviation; over 0.664 it is what data sheets call bias instability, and no less than B."""
    least_tau_s: float
    least_at_end: bool
    """Whether it still falls where it is no longer known well: the true floor is lower."""
    density: float
    """Root of the one-sided spectral density where it is flat, per √Hz: √2 N of white noise."""
    drift: Drift | None
    """None where the temperature is not known, or hardly changed."""

    @property
    def bias_instability_most(self) -> float:
        """The least deviation over 0.664."""
        return self.least_deviation / BIAS_FACTOR


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """The noise of one sensor."""

    grid: Grid
    curve: AllanCurve
    spectrum: Spectrum
    axes: tuple[AxisNoise, AxisNoise, AxisNoise]
    corner_hz: float | None
    """Frequency above which the noise has less than half the power: the device's low-pass; None for none seen."""
    tau_least_s: float
    """The coefficients are fitted from here on."""
    flat_hz: tuple[float, float]
    """Band of the density."""
    disturbed_s: int
    """Seconds in which the device was moved or shaken, or which have an outlier."""
    still_s: int
    """Seconds that were looked at."""
    step: float | None
    """Least difference of two values, if the values are whole counts of it."""


def sensor_noise(readings: Readings, values: FloatArray) -> SensorNoise:
    """Analyse one sensor of `readings`; values (n, 3). Raises BadArgument where the series is too short."""
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
    """Frequency from which on all axes together have less than half the power of the band below it; None for none.

    Noise that falls with frequency from the begin on (random walk) has no corner: the power below has to be flat.
    """
    power = spectrum.density.mean(axis=0)
    if not power.any():
        return None
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
    """How many seconds scatter by far more than the others, and of how many."""
    size = max(round(STILL_S * rate_hz), 2)
    blocks = [run[: len(run) // size * size].reshape(-1, size, run.shape[1]).std(axis=1) for run in runs]
    spread = np.concatenate(blocks)
    if not len(spread):
        return 0, 0
    usual = np.median(spread, axis=0)
    return int((spread > STILL_FACTOR * np.maximum(usual, 1e-12)).any(axis=1).sum()), len(spread)


def _temperature(readings: Readings, t_ns: np.ndarray) -> FloatArray | None:
    """Temperature at samples, (k,), by the nearest sample before that had one; None where there is none."""
    if readings.temperature_c is None:
        return None
    known = np.isfinite(readings.temperature_c)
    if not known.any():
        return None
    place = np.searchsorted(readings.t_ns[known], t_ns, side="right") - 1
    return np.asarray(readings.temperature_c[known][np.maximum(place, 0)], dtype=np.float64)


def temperature_drift(temperature_c: FloatArray, values: FloatArray, rate_hz: float) -> Drift | None:
    """Fit values (n,) against temperatures (n,), over means of at least a second; None for too little change."""
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
    rest = float(((y - slope * x) ** 2).sum())
    total = float(y @ y)
    return Drift(slope, float(np.sqrt(rest / (count - 2) / (x @ x))), 1 - rest / total if total > 0 else 0.0)


def step_of(values: FloatArray) -> float | None:
    """Size of a count, where all values (n, axes) are whole counts of it; None for floats."""
    sorted_values = np.unique(values[:20_000])
    if len(sorted_values) < BLOCKS_LEAST:
        return None
    steps = np.diff(sorted_values)
    least = float(steps.min())
    counts = steps / least
    return least if np.abs(counts - np.rint(counts)).max() < 0.02 and np.rint(counts).max() < 1e4 else None
