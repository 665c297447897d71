"""Peaks of a spectrum with frequency and amplitude between its bins, and the power of bands.

A line between two bins stands in both. Under a Hann window the ratio of the two largest of its bins gives its place
exactly (T. Grandke, 1983): with a = |X(k+1)| / |X(k)| the line is (2a - 1) / (a + 1) bins above k; and its amplitude is
that of bin k, less the window's loss at that distance. Noise and neighbouring lines disturb both.

A sensor cannot see from its samples whether a vibration is above half its rate: one at k · rate ± f stands at f.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import chi2

from imud.analysis.series import FloatArray
from imud.analysis.spectrum import Spectrum
from imud.errors import BadArgument

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
