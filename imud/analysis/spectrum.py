"""Power spectral density, spectrogram and peaks of runs at the true rate of the sensor (P. D. Welch, 1967).

The windows have equal length, overlap by half, and contain samples of one run only. imud removes the mean of each
window and applies a Hann window. The density is one-sided: its integral from 0 to half of the rate is the power. The
density of a line with the amplitude A is A²/2 divided by the equivalent noise bandwidth, 1.5 bins for Hann (F. J.
Harris, 1978).
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
WINDOW_MOST: Final = 1 << 16  # maximum number of samples per window
WINDOW_LEAST: Final = 16
WINDOW_USUAL: Final = 1 << 12
# Wanted number of averaged windows. The relative standard deviation of a bin is then about 1/4.
AVERAGES_WANTED: Final = 16
# Maximum number of rows of a spectrogram. In a longer series, a row is the mean of several windows.
ROWS_MOST: Final = 600
PIECE: Final = 256  # Number of windows in one transform. It limits the memory.


@dataclass(frozen=True, slots=True)
class Spectrum:
    """One-sided power spectral density."""

    rate_hz: float
    frequency_hz: FloatArray  # frequencies from 0 to half of the rate, Hz, shape (k,)
    density: FloatArray  # density, unit² per Hz, shape (k, axes)
    window: str
    size: int  # number of samples per window
    bandwidth_hz: float  # equivalent noise bandwidth of the window, Hz
    averages: int  # Number of averaged windows. Windows that overlap by half are nearly independent.
    unused: int  # number of samples in runs that are shorter than a window

    @property
    def bin_hz(self) -> float:
        """Distance of two frequencies, Hz."""
        return self.rate_hz / self.size

    def words(self) -> str:
        """Describe the parameters of the spectrum."""
        unused = f"; imud ignores {self.unused} samples in shorter runs" if self.unused else ""
        return (
            f"Welch, {self.averages} windows of {self.size} samples ({self.size / self.rate_hz:.3g} s) with half "
            f"overlap, {self.window.capitalize()}; bins of {self.bin_hz:.4g} Hz, equivalent noise bandwidth "
            f"{self.bandwidth_hz:.4g} Hz ({self.bandwidth_hz / self.bin_hz:.2f} bins){unused}"
        )


@dataclass(frozen=True, slots=True)
class Spectrogram:
    """Density over time, sum of all axes."""

    time_s: FloatArray  # middle of each row after the start of the first run, s, shape (r,)
    frequency_hz: FloatArray  # frequencies, Hz, shape (k,)
    density: FloatArray  # Density, unit² per Hz, shape (r, k). A row of NaN marks a gap.


def window_size(runs: Sequence[FloatArray], rate_hz: float, resolution_hz: float | None = None) -> int:
    """Return the number of samples per window: for a resolution, or a power of two with enough averages.

    Raises BadArgument if the runs are too short or the rate is too low for the resolution.
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
        raise BadArgument(f"expected a run of at least {WINDOW_LEAST} samples without a long gap, got {longest}")
    # half-overlapping windows: n windows need (n + 1) / 2 lengths
    wanted = min(2 * longest // (AVERAGES_WANTED + 1), WINDOW_USUAL)
    return max(1 << (wanted.bit_length() - 1), WINDOW_LEAST) if wanted else WINDOW_LEAST


def power_spectrum(runs: Sequence[FloatArray], rate_hz: float, size: int | None = None) -> Spectrum:
    """Return the density of runs of the shape (m, axes) at `rate_hz`. Raises BadArgument if all runs are too short."""
    size = window_size(runs, rate_hz) if size is None else size
    window = get_window(WINDOW, size)
    used = [run for run in runs if len(run) >= size]
    if not used:
        raise BadArgument(f"expected a run of at least {size} samples without a long gap, got shorter runs")
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
    """Return the frequencies of a window of `size` samples, Hz, shape (k,)."""
    return np.asarray(np.arange(size // 2 + 1) * (rate_hz / size), dtype=np.float64)


def noise_bandwidth(window: FloatArray, rate_hz: float) -> float:
    """Return the width of a rectangular filter that passes the same power of white noise, Hz."""
    return float(rate_hz * (window**2).sum() / window.sum() ** 2)


def _pieces(run: FloatArray, size: int) -> list[FloatArray]:
    """Return the half-overlapping windows of a run as arrays of the shape (up to PIECE, axes, size)."""
    windows = sliding_window_view(run, size, axis=0)[:: size // 2]
    return [windows[at : at + PIECE] for at in range(0, len(windows), PIECE)]


def _powers(rows: FloatArray, window: FloatArray, rate_hz: float) -> FloatArray:
    """Return the one-sided densities, shape (rows, k, axes), of windows of the shape (rows, axes, size)."""
    size = len(window)
    transformed = np.fft.rfft((rows - rows.mean(axis=2, keepdims=True)) * window, axis=2)
    power = np.abs(transformed) ** 2 / (rate_hz * (window**2).sum())
    power[:, :, 1 : (size + 1) // 2] *= 2  # add the negative frequencies, except at 0 and at half of the rate
    return np.asarray(np.moveaxis(power, 2, 1))


def spectrogram(runs: Sequence[FloatArray], starts_s: Sequence[float], rate_hz: float, size: int) -> Spectrogram:
    """Return the density over time of runs of the shape (m, axes). `starts_s`: start time of each run.

    For more than ROWS_MOST windows, a row is a mean of neighbours. A row of NaN separates two runs. Raises BadArgument
    if all runs are too short.
    """
    window = get_window(WINDOW, size)
    used = [(run, start) for run, start in zip(runs, starts_s, strict=True) if len(run) >= size]
    if not used:
        raise BadArgument(f"expected a run of at least {size} samples without a long gap, got shorter runs")
    in_all = sum((len(run) - size) // (size // 2) + 1 for run, _ in used)
    # rounded up
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
FLOOR_BINS: Final = 61  # number of bins of the noise floor, the median around a bin
FLOOR_FACTOR: Final = 4.0  # minimum power of a peak divided by the noise floor: 6 dB
FALSE_PEAKS: Final = 0.001  # expected number of false peaks in a spectrum of noise
NEIGHBOURS: Final = 3  # Number of lower bins on each side of a peak. The main lobe of the window is four bins wide.
FIRST_BIN: Final = 3  # Lowest bin of a peak. The removed mean disturbs the lower bins.
HARMONIC_BINS: Final = 0.6  # maximum distance of a harmonic from the multiple of the fundamental frequency, bins
HARMONICS_MOST: Final = 12
BAND_RATIO: Final = 2.0
BANDS_MOST: Final = 24


@dataclass(frozen=True, slots=True)
class Peak:
    """Peak of a spectrum: a line of vibration."""

    frequency_hz: float
    amplitude: tuple[float, ...]  # amplitude A of A sin(2π f t) for each axis, in the unit of the sensor
    floor_ratio: float  # power of the peak divided by the noise floor
    axis: int  # index of the axis with the largest amplitude
    harmonic_of: int | None  # index of the fundamental peak in the list; None if the peak is not a harmonic
    multiple: int  # frequency divided by the fundamental frequency; 1 if the peak is not a harmonic

    @property
    def total(self) -> float:
        """Amplitude of all axes: root of the sum of squares."""
        return float(np.sqrt(sum(one**2 for one in self.amplitude)))


@dataclass(frozen=True, slots=True)
class Band:
    """RMS of a frequency band."""

    low_hz: float
    high_hz: float
    rms: tuple[float, ...]  # RMS of each axis, in the unit of the sensor


def peaks(spectrum: Spectrum, most: int = PEAKS_MOST) -> list[Peak]:
    """Return the peaks in the sum of all axes, the strongest first."""
    power = spectrum.density.sum(axis=1)
    # not 0: it is a divisor
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
    """Return the minimum ratio of a peak to the noise floor, from χ², at least FLOOR_FACTOR."""
    # axes are not counted as averages: their noise can be correlated
    freedom = 2 * spectrum.averages
    level = float(chi2.isf(FALSE_PEAKS / len(spectrum.frequency_hz), freedom) / chi2.median(freedom))
    return max(level, FLOOR_FACTOR)


def _line(spectrum: Spectrum, power: FloatArray, place: int, ratio: float) -> Peak:
    shift = _shift(power, place)
    loss = (1 - shift**2) / np.sinc(shift)  # of a Hann window for a line between two bins
    amplitude = np.sqrt(2 * spectrum.density[place] * spectrum.bandwidth_hz) * loss
    return Peak(
        float((place + shift) * spectrum.bin_hz), tuple(map(float, amplitude)), ratio, int(np.argmax(amplitude)), None,
        1,
    )  # fmt: skip


def _shift(power: FloatArray, place: int) -> float:
    """Return the distance from the largest bin of a line to the line, -0.5 to 0.5 bins."""
    above, below = power[place + 1], power[place - 1]
    side = 1 if above >= below else -1
    # ratio of the two largest bins of a Hann window, at most 1
    ratio = float(np.sqrt(max(above, below) / power[place]))
    return side * max((2 * ratio - 1) / (ratio + 1), 0.0)


def _named(line: Peak, lines: Sequence[Peak], bin_hz: float) -> Peak:
    """Return the line as a harmonic of the first stronger line if its frequency is a multiple of that frequency."""
    for number, other in enumerate(lines):
        multiple = round(line.frequency_hz / other.frequency_hz)
        near = abs(line.frequency_hz - multiple * other.frequency_hz) <= HARMONIC_BINS * bin_hz
        if 2 <= multiple <= HARMONICS_MOST and near and other.total > line.total:
            return Peak(line.frequency_hz, line.amplitude, line.floor_ratio, line.axis, number, multiple)
    return line


def bands_of(spectrum: Spectrum, edges_hz: Sequence[tuple[float, float]] | None = None) -> list[Band]:
    """Return the RMS of each band, by default octaves. Raises BadArgument for a band outside 0 to half of the rate."""
    half = spectrum.rate_hz / 2
    found = []
    for low, high in _octaves(spectrum) if edges_hz is None else edges_hz:
        if not 0 <= low < high <= half * (1 + 1e-6):
            raise BadArgument(
                f"band {low:g}-{high:g} Hz: expected a band from 0 to {half:g} Hz (half of the rate), lower end first"
            )
        share = _shares(spectrum, low, high)
        rms = np.sqrt(share @ spectrum.density * spectrum.bin_hz)
        found.append(Band(low, high, tuple(map(float, rms))))
    return found


def _shares(spectrum: Spectrum, low_hz: float, high_hz: float) -> FloatArray:
    """Return the share of each bin inside a band, shape (k,). A bin is one bin width wide, but does not go below 0."""
    half = spectrum.bin_hz / 2
    left = np.maximum(spectrum.frequency_hz - half, 0)
    right = np.minimum(spectrum.frequency_hz + half, spectrum.rate_hz / 2)
    inside = np.minimum(right, high_hz) - np.maximum(left, low_hz)
    share: FloatArray = np.clip(inside, 0, None) / (right - left)
    return share


def _octaves(spectrum: Spectrum) -> list[tuple[float, float]]:
    """Return the octaves from the third bin to half of the rate. The first and the last octave can be shorter."""
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
    """Return the two lowest frequencies above half of the rate that appear at `frequency_hz` (aliases)."""
    return rate_hz - frequency_hz, rate_hz + frequency_hz
