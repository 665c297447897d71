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
from scipy.signal import get_window

from imud.analysis.series import FloatArray
from imud.errors import BadArgument

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
