"""Peaks of known frequency and amplitude: between bins, with noise, with a wrong clock, with lost samples."""

from itertools import pairwise

import numpy as np
import pytest

from imud.analysis.series import FloatArray, even_runs, grid_of
from imud.analysis.spectrum import bands_of, images_hz, peaks, power_spectrum, threshold
from imud.model.errors import BadArgument
from tests.analysis.synthetic import stamps_ns, three, white

RATE_HZ = 400.0
SIZE = 1024
BIN_HZ = RATE_HZ / SIZE
BIN_PART = 0.05  # maximum error of a frequency, bins, also with 1 % lost samples


def line(count: int, frequency_hz: float, amplitude: float, rate_hz: float = RATE_HZ, phase: float = 0.3) -> FloatArray:
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency_hz * np.arange(count) / rate_hz + phase))


def test_lines_noise_and_harmonics() -> None:
    for part in (0.0, 0.1, 0.5, 0.75):
        frequency = (200 + part) * BIN_HZ
        first = peaks(power_spectrum([three(line(20 * SIZE, frequency, 2.5))], RATE_HZ, SIZE))[0]
        assert first.frequency_hz == pytest.approx(frequency, abs=0.002 * BIN_HZ)
        assert first.amplitude == pytest.approx((2.5, 2.5, 2.5), rel=2e-3)
        assert first.total == pytest.approx(2.5 * np.sqrt(3), rel=2e-3)
    random = np.random.default_rng(7)
    for _ in range(6):
        noise = np.stack([white(random, 16 * SIZE, RATE_HZ, 1.0) for _ in range(3)], axis=1)
        assert peaks(power_spectrum([noise], RATE_HZ, SIZE)) == []
    series = line(20_000, 30.0, 1.0) + line(20_000, 60.0, 0.3) + line(20_000, 90.0, 0.1) + line(20_000, 77.0, 0.2)
    series += 0.01 * np.random.default_rng(8).standard_normal(20_000)
    found = peaks(power_spectrum([three(series)], RATE_HZ, SIZE))
    assert [round(peak.frequency_hz) for peak in found] == [30, 60, 77, 90]
    assert [(peak.harmonic_of, peak.multiple) for peak in found] == [(None, 1), (0, 2), (None, 1), (0, 3)]
    values = np.stack([line(9000, 50.0, a) for a in (0.1, 0.7, 0.2)], axis=1)
    values += 1e-3 * np.random.default_rng(9).standard_normal(values.shape)
    assert peaks(power_spectrum([values], RATE_HZ, SIZE))[0].axis == 1
    noise = white(np.random.default_rng(10), 100 * SIZE, RATE_HZ, 1.0)[:, None]
    few, many = (power_spectrum([noise[: k * SIZE]], RATE_HZ, SIZE) for k in (2, 100))
    assert threshold(few) > threshold(many) == 4.0
    assert images_hz(30.0, 400.0) == (370.0, 430.0)
    aliased = line(20_000, 370.0, 1.0)
    assert peaks(power_spectrum([three(aliased)], RATE_HZ, SIZE))[0].frequency_hz == pytest.approx(30.0, abs=1e-2)


def test_a_clock_that_is_off_and_missing_samples() -> None:
    """The crystal of a device at 400 Hz is 2 % fast, and 1 % of the samples are lost. The time stamps show both."""
    random = np.random.default_rng(0)
    true_hz, count = RATE_HZ * 1.02, 40_000
    frequency = 63.7
    values = np.stack([line(count, frequency, 0.5, true_hz), np.zeros(count), np.zeros(count)], axis=1)
    values += 0.2 * random.standard_normal((count, 3))
    keep = np.sort(random.choice(count, round(count * 0.99), replace=False))
    t_ns = stamps_ns(count, true_hz)[keep] + random.normal(0, 50_000, len(keep)).astype(np.int64)
    grid = grid_of(t_ns)
    runs = even_runs(grid, values[keep], smooth=True)
    spectrum = power_spectrum(runs, grid.rate_hz, SIZE)
    found = peaks(spectrum)[0]
    assert abs(found.frequency_hz - frequency) < BIN_PART * spectrum.bin_hz
    assert found.axis == 0
    assert found.amplitude[0] == pytest.approx(0.5, rel=0.03)
    naive = power_spectrum([values[keep]], RATE_HZ, SIZE)  # nominal rate, without the gaps
    assert abs(peaks(naive)[0].frequency_hz - frequency) > spectrum.bin_hz, "or else this test shows nothing"


def test_bands() -> None:
    series = white(np.random.default_rng(11), 50_000, RATE_HZ, 1.0)
    spectrum = power_spectrum([three(series)], RATE_HZ, SIZE)
    low, middle, high = bands_of(spectrum, [(0, 40), (40, 100.3), (100.3, 200)])
    together = np.sqrt(low.rms[0] ** 2 + middle.rms[0] ** 2 + high.rms[0] ** 2)
    assert together == pytest.approx(series.std(), rel=0.01)
    assert middle.rms[0] == pytest.approx(np.sqrt(2 * 60.3), rel=0.03)
    found = bands_of(power_spectrum([three(white(np.random.default_rng(12), 9000, RATE_HZ, 1.0))], RATE_HZ, SIZE))
    edges = [(band.low_hz, band.high_hz) for band in found]
    assert edges[-2:] == [(64.0, 128.0), (128.0, 200.0)]
    assert edges[0][0] == pytest.approx(3 * BIN_HZ)
    assert all(one[1] == other[0] for one, other in pairwise(edges))
    spectrum = power_spectrum([three(line(20_000, 50.0, 2.0))], RATE_HZ, SIZE)
    assert bands_of(spectrum, [(40, 60)])[0].rms[0] == pytest.approx(np.sqrt(2), rel=1e-3)
    for band in [(10.0, 300.0), (20.0, 10.0)]:
        spectrum = power_spectrum([three(line(2000, 50.0, 2.0))], RATE_HZ, 256)
        with pytest.raises(BadArgument, match="expected a band from 0 to 200 Hz"):
            bands_of(spectrum, [band])
