"""Power spectral density and spectrogram of even runs (P. D. Welch, 1967), at the true rate of the sensor.

Windows of equal length, half overlapping, each without its mean, under a Hann window; they lie inside runs, so none
reaches across a gap. The density is one-sided: its integral over 0 to half the rate is the power. A line of amplitude A
stands in it with A²/2 over the equivalent noise bandwidth of the window, 1.5 bins for Hann (F. J. Harris, 1978).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import median_filter
from scipy.signal import get_window
from scipy.stats import chi2

from imud.analysis.series import FloatArray
from imud.model.errors import BadArgument

WINDOW: Final = "hann"
WINDOW_MOST: Final = 1 << 16
"""Samples per window, at most; more bins than anybody looks at."""
WINDOW_LEAST: Final = 16
WINDOW_USUAL: Final = 1 << 12
AVERAGES_WANTED: Final = 16
"""Windows that are averaged, if there are samples enough: the spread of a bin is then about 1/4."""
ROWS_MOST: Final = 600
"""Columns of a spectrogram, at most; of a longer series some windows each are averaged."""
PIECE: Final = 256
"""Windows that are transformed at once, so that memory does not grow with the series."""


@dataclass(frozen=True, slots=True)
class Spectrum:
    """One-sided power spectral density."""

    rate_hz: float
    frequency_hz: FloatArray
    """(k,) from 0 to half the rate."""
    density: FloatArray
    """(k, axes), unit² per Hz."""
    window: str
    size: int
    """Samples per window."""
    bandwidth_hz: float
    """Equivalent noise bandwidth of the window."""
    averages: int
    """Windows averaged; half overlapping ones are nearly independent."""
    unused: int
    """Samples in runs that are shorter than a window."""

    @property
    def bin_hz(self) -> float:
        """Distance of two frequencies."""
        return self.rate_hz / self.size

    def words(self) -> str:
        """Describe how it was made, in one sentence."""
        unused = f", {self.unused} samples in runs shorter than that are left out" if self.unused else ""
        return (
            f"Welch, {self.averages} windows of {self.size} samples ({self.size / self.rate_hz:.3g} s), half "
            f"overlapping, {self.window.capitalize()}; bins of {self.bin_hz:.4g} Hz, equivalent noise bandwidth "
            f"{self.bandwidth_hz:.4g} Hz ({self.bandwidth_hz / self.bin_hz:.2f} bins){unused}"
        )


@dataclass(frozen=True, slots=True)
class Spectrogram:
    """Density over time, of the axes together."""

    time_s: FloatArray
    """(r,) middle of each row, from the begin of the first run on."""
    frequency_hz: FloatArray
    """(k,)"""
    density: FloatArray
    """(r, k), the sum over the axes, unit² per Hz; rows of NaN where samples are missing."""


def window_size(runs: Sequence[FloatArray], rate_hz: float, resolution_hz: float | None = None) -> int:
    """Samples per window: a power of two that gives averages enough, or of a resolution (distance of bins).

    Raises BadArgument for a resolution that the runs are too short for, or the rate too low.
    """
    longest = max(len(run) for run in runs)
    if resolution_hz is not None:
        if not resolution_hz > 0:
            raise BadArgument(f"resolution: expected more than 0 Hz, got {resolution_hz:g}")
        size = round(rate_hz / resolution_hz)
        if not WINDOW_LEAST <= size <= min(longest, WINDOW_MOST):
            raise BadArgument(
                f"resolution {resolution_hz:g} Hz: expected from {rate_hz / min(longest, WINDOW_MOST):.3g} Hz (the "
                f"longest run without a gap has {longest} samples) to {rate_hz / WINDOW_LEAST:.3g} Hz"
            )
        return size
    if longest < WINDOW_LEAST:
        raise BadArgument(f"expected a run of at least {WINDOW_LEAST} samples without a longer gap, got {longest}")
    wanted = min(2 * longest // (AVERAGES_WANTED + 1), WINDOW_USUAL)
    return max(1 << (wanted.bit_length() - 1), WINDOW_LEAST) if wanted else WINDOW_LEAST


def power_spectrum(runs: Sequence[FloatArray], rate_hz: float, size: int | None = None) -> Spectrum:
    """Density of even runs, each (m, axes) at `rate_hz`, over all of them. Raises BadArgument for runs too short."""
    size = window_size(runs, rate_hz) if size is None else size
    window = get_window(WINDOW, size)
    used = [run for run in runs if len(run) >= size]
    if not used:
        raise BadArgument(f"expected a run of at least {size} samples without a longer gap, got none")
    total, averages = np.zeros((size // 2 + 1, used[0].shape[1])), 0
    for run in used:
        for rows in _pieces(run, size):
            total += _powers(rows, window, rate_hz).sum(axis=0)
            averages += len(rows)
    return Spectrum(
        rate_hz, _frequencies(size, rate_hz), total / averages, WINDOW, size, noise_bandwidth(window, rate_hz),
        averages, sum(len(run) for run in runs if len(run) < size),
    )  # fmt: skip


def _frequencies(size: int, rate_hz: float) -> FloatArray:
    """(k,) of a window of so many samples."""
    return np.asarray(np.arange(size // 2 + 1) * (rate_hz / size), dtype=np.float64)


def noise_bandwidth(window: FloatArray, rate_hz: float) -> float:
    """Width of the rectangle that lets through as much of white noise, Hz."""
    return float(rate_hz * (window**2).sum() / window.sum() ** 2)


def _pieces(run: FloatArray, size: int) -> list[FloatArray]:
    """Half overlapping windows of a run, (some, axes, size) each."""
    windows = sliding_window_view(run, size, axis=0)[:: size // 2]
    return [windows[at : at + PIECE] for at in range(0, len(windows), PIECE)]


def _powers(rows: FloatArray, window: FloatArray, rate_hz: float) -> FloatArray:
    """One-sided densities (rows, k, axes) of windows (rows, axes, size)."""
    size = len(window)
    transformed = np.fft.rfft((rows - rows.mean(axis=2, keepdims=True)) * window, axis=2)
    power = np.abs(transformed) ** 2 / (rate_hz * (window**2).sum())
    power[:, :, 1 : (size + 1) // 2] *= 2  # not the bins at 0 and, of an even number, at half the rate
    return np.asarray(np.moveaxis(power, 2, 1))


def spectrogram(runs: Sequence[FloatArray], starts_s: Sequence[float], rate_hz: float, size: int) -> Spectrogram:
    """Density over time of even runs, (m, axes) each, that begin at these times.

    Where there are more than ROWS_MOST windows, neighbours are averaged; a row of NaN stands between two runs. Raises
    BadArgument for runs too short.
    """
    window = get_window(WINDOW, size)
    used = [(run, start) for run, start in zip(runs, starts_s, strict=True) if len(run) >= size]
    if not used:
        raise BadArgument(f"expected a run of at least {size} samples without a longer gap, got none")
    in_all = sum((len(run) - size) // (size // 2) + 1 for run, _ in used)
    together = -(-in_all // ROWS_MOST)
    times: list[FloatArray] = []
    rows: list[FloatArray] = []
    for run, start_s in used:
        powers = np.concatenate([_powers(piece, window, rate_hz).sum(axis=2) for piece in _pieces(run, size)])
        middle = start_s + (np.arange(len(powers)) * (size // 2) + size / 2) / rate_hz
        groups = np.arange(0, len(powers), together)
        count = np.diff([*groups, len(powers)])
        if rows:
            times.append(np.array([start_s]))
            rows.append(np.full((1, powers.shape[1]), np.nan))
        times.append(np.add.reduceat(middle, groups) / count)
        rows.append(np.add.reduceat(powers, groups, axis=0) / count[:, None])
    return Spectrogram(np.concatenate(times), _frequencies(size, rate_hz), np.concatenate(rows))


PEAKS_MOST: Final = 10
FLOOR_BINS: Final = 61
"""Bins whose median is the floor of the one in the middle."""
FLOOR_FACTOR: Final = 4.0
"""A peak is at least 6 dB above the floor,"""
FALSE_PEAKS: Final = 0.001
"""and so far that noise makes so many peaks in a whole spectrum."""
NEIGHBOURS: Final = 3
"""A line is the highest bin within so many on either side: the main lobe of the window is four bins wide."""
FIRST_BIN: Final = 3
"""Below are the means that each window is freed of."""
HARMONIC_BINS: Final = 0.6
"""A peak so close to a multiple of a lower one is called its harmonic."""
HARMONICS_MOST: Final = 12
BAND_RATIO: Final = 2.0
BANDS_MOST: Final = 24


@dataclass(frozen=True, slots=True)
class Peak:
    """One line of a spectrum."""

    frequency_hz: float
    amplitude: tuple[float, ...]
    """Of each axis, peak value, in the unit of the sensor: A of A sin(2π f t)."""
    floor_ratio: float
    """Its power over that of the noise around it."""
    axis: int
    """The axis with the largest amplitude."""
    harmonic_of: int | None
    """Place in the list of the peak that it is a multiple of; None for none."""
    multiple: int
    """Which multiple; 1 for none."""

    @property
    def total(self) -> float:
        """Root of the sum of the squares of the axes' amplitudes."""
        return float(np.sqrt(sum(one**2 for one in self.amplitude)))


@dataclass(frozen=True, slots=True)
class Band:
    """The power of a band."""

    low_hz: float
    high_hz: float
    rms: tuple[float, ...]
    """Of each axis, in the unit of the sensor."""


def peaks(spectrum: Spectrum, most: int = PEAKS_MOST) -> list[Peak]:
    """Lines of the axes together, the strongest first."""
    power = spectrum.density.sum(axis=1)
    floor = np.maximum(median_filter(power, size=min(FLOOR_BINS, len(power)), mode="nearest"), 1e-300)
    ratio = power / floor
    found = [
        place
        for place in range(FIRST_BIN, len(power) - 1)
        if ratio[place] >= threshold(spectrum) and power[place] == power[max(place - NEIGHBOURS, 0) : place + 4].max()
    ]
    found = sorted(found, key=lambda place: -power[place])[:most]
    lines = [_line(spectrum, power, place, float(ratio[place])) for place in found]
    lines = sorted(lines, key=lambda line: -line.total)
    return [_named(line, lines, spectrum.bin_hz) for line in lines]


def threshold(spectrum: Spectrum) -> float:
    """Ratio to the floor that a peak has to reach: by χ², and at least FLOOR_FACTOR.

    The least that averaging gives: axes that are alike add nothing.
    """
    freedom = 2 * spectrum.averages
    level = float(chi2.isf(FALSE_PEAKS / len(spectrum.frequency_hz), freedom) / chi2.median(freedom))
    return max(level, FLOOR_FACTOR)


def _line(spectrum: Spectrum, power: FloatArray, place: int, ratio: float) -> Peak:
    shift = _shift(power, place)
    loss = (1 - shift**2) / np.sinc(shift)
    amplitude = np.sqrt(2 * spectrum.density[place] * spectrum.bandwidth_hz) * loss
    return Peak(
        float((place + shift) * spectrum.bin_hz), tuple(map(float, amplitude)), ratio, int(np.argmax(amplitude)), None,
        1,
    )  # fmt: skip


def _shift(power: FloatArray, place: int) -> float:
    """Bins from a bin to the line of which it is the largest, -0.5 to 0.5."""
    above, below = power[place + 1], power[place - 1]
    side = 1 if above >= below else -1
    ratio = float(np.sqrt(max(above, below) / power[place]))
    return side * min(max((2 * ratio - 1) / (ratio + 1), 0.0), 0.5)


def _named(line: Peak, lines: Sequence[Peak], bin_hz: float) -> Peak:
    """Name the lowest stronger line of which this one is a multiple."""
    for number, other in enumerate(lines):
        multiple = round(line.frequency_hz / other.frequency_hz)
        near = abs(line.frequency_hz - multiple * other.frequency_hz) <= HARMONIC_BINS * bin_hz
        if 2 <= multiple <= HARMONICS_MOST and near and other.total > line.total:
            return Peak(line.frequency_hz, line.amplitude, line.floor_ratio, line.axis, number, multiple)
    return line


def bands_of(spectrum: Spectrum, edges_hz: Sequence[tuple[float, float]] | None = None) -> list[Band]:
    """RMS of each band, octaves by default. Raises BadArgument for a band outside 0 to half the rate."""
    half = spectrum.rate_hz / 2
    found = []
    for low, high in _octaves(spectrum) if edges_hz is None else edges_hz:
        if not 0 <= low < high <= half * (1 + 1e-6):
            raise BadArgument(
                f"band {low:g}-{high:g} Hz: expected 0 to {half:g} Hz, half the rate, the lower end first"
            )
        share = _shares(spectrum, low, high)
        rms = np.sqrt(share @ spectrum.density * spectrum.bin_hz)
        found.append(Band(low, high, tuple(map(float, rms))))
    return found


def _shares(spectrum: Spectrum, low_hz: float, high_hz: float) -> FloatArray:
    """(k,) part of each bin that lies in a band. A bin reaches half its width to both sides, but not below 0."""
    half = spectrum.bin_hz / 2
    left = np.maximum(spectrum.frequency_hz - half, 0)
    right = np.minimum(spectrum.frequency_hz + half, spectrum.rate_hz / 2)
    inside = np.minimum(right, high_hz) - np.maximum(left, low_hz)
    share: FloatArray = np.clip(inside, 0, None) / (right - left)
    return share


def _octaves(spectrum: Spectrum) -> list[tuple[float, float]]:
    """Octaves downwards from half the rate to the third bin, the highest first cut at it."""
    high = spectrum.rate_hz / 2
    least = spectrum.bin_hz * FIRST_BIN
    exponent = int(np.floor(np.log2(high)))
    edges = [high]
    while len(edges) < BANDS_MOST and edges[-1] > least:
        low = BAND_RATIO**exponent
        if low < edges[-1]:
            edges.append(max(low, least))
        exponent -= 1
    return list(zip(edges[:0:-1], edges[-2::-1], strict=True))


def images_hz(frequency_hz: float, rate_hz: float) -> tuple[float, float]:
    """The two lowest frequencies above half the rate that stand at `frequency_hz` in the spectrum as well."""
    return rate_hz - frequency_hz, rate_hz + frequency_hz
