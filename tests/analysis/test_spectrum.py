"""Density of known signals, windows, runs, spectrogram.
Peaks of known frequency and amplitude: between bins, with noise, with a wrong clock, with lost samples."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import welch
from scipy.stats import chi2

from imud.analysis import spectrum as analysis_spectrum
from imud.analysis.series import FloatArray, even_runs, grid_of
from imud.analysis.spectrum import bands_of, images_hz, peaks, power_spectrum, spectrogram, threshold, window_size
from imud.model.errors import BadArgument
from tests.analysis.synthetic import stamps_ns, three, white

RATE_HZ = 500.0


def test_density_bandwidth_and_windows() -> None:
    series = white(np.random.default_rng(1), 10_000, RATE_HZ, 1.0)
    found = power_spectrum([series[:, None]], RATE_HZ, 1024)
    frequency, density = welch(series, RATE_HZ, nperseg=1024)
    assert found.frequency_hz == pytest.approx(frequency)
    assert found.density[:, 0] == pytest.approx(density, rel=1e-9, abs=1e-15)
    series = white(np.random.default_rng(2), 200_000, RATE_HZ, 1e-2)
    found = power_spectrum([series[:, None]], RATE_HZ)
    assert found.density[5:-5, 0].mean() == pytest.approx(2 * 1e-4, rel=0.01), "one-sided: 2 N²"
    assert found.density[:, 0].sum() * found.bin_hz == pytest.approx(series.var(), rel=0.01)
    found = power_spectrum([white(np.random.default_rng(3), 5000, RATE_HZ, 1.0)[:, None]], RATE_HZ, 256)
    assert found.bandwidth_hz / found.bin_hz == pytest.approx(1.5, rel=1e-6)
    assert analysis_spectrum.noise_bandwidth(np.ones(10), 10.0) == pytest.approx(1.0)
    assert "1.50 bins" in found.words()
    random = np.random.default_rng(4)
    runs = [white(random, count, RATE_HZ, 1.0)[:, None] for count in (1000, 300, 600)]
    found = power_spectrum(runs, RATE_HZ, 512)
    assert (found.averages, found.unused) == (2 + 0 + 1, 300)
    parts = [power_spectrum([runs[0]], RATE_HZ, 512), power_spectrum([runs[2]], RATE_HZ, 512)]
    assert found.density == pytest.approx((2 * parts[0].density + parts[1].density) / 3)
    assert "ignores 300 samples in shorter runs" in found.words()


def test_the_length_of_windows() -> None:
    run = np.zeros((10_000, 3))
    assert window_size([run], 100.0) == 1024
    assert [window_size([np.zeros((n, 3))], 100.0) for n in (8703, 8704)] == [512, 1024], "17 half windows"
    assert window_size([np.zeros((10**6, 3))], 100.0) == 4096
    assert window_size([run], 100.0, 0.1) == 1000
    assert [window_size([np.zeros((16, 3))], 16.0, *given) for given in ([], [1.0])] == [16, 16]
    assert window_size([np.zeros((1 << 17, 3))], 1.0, 2.0**-16) == 1 << 16
    with pytest.raises(BadArgument, match=r"expected from 1.53e-05 Hz"):
        window_size([np.zeros((1 << 17, 3))], 1.0, 2.0**-17)
    with pytest.raises(BadArgument, match=r"resolution 0.001 Hz: expected from 0.01 Hz"):
        window_size([run], 100.0, 0.001)
    with pytest.raises(BadArgument, match="more than 0 Hz"):
        window_size([run], 100.0, 0.0)
    with pytest.raises(BadArgument, match="a run of at least 16"):
        window_size([np.zeros((10, 3))], 100.0)
    with pytest.raises(BadArgument, match="a run of at least 64"):
        power_spectrum([np.zeros((10, 3))], 100.0, 64)


def test_spectrograms() -> None:
    t_s = np.arange(20_000) / RATE_HZ
    series = np.where(t_s < 20, np.sin(2 * np.pi * 50 * t_s), np.sin(2 * np.pi * 120 * t_s))[:, None]
    found = spectrogram([series], [0.0], RATE_HZ, 500)
    strongest = found.frequency_hz[np.argmax(found.density, axis=1)]
    assert strongest[found.time_s < 19] == pytest.approx(50.0)
    assert strongest[found.time_s > 21] == pytest.approx(120.0)
    assert found.time_s[0] == pytest.approx(0.5)
    random = np.random.default_rng(5)
    runs = [white(random, 100_000, RATE_HZ, 1.0)[:, None], white(random, 50_000, RATE_HZ, 1.0)[:, None]]
    found = spectrogram(runs, [0.0, 300.0], RATE_HZ, 64)
    assert len(found.density) == len(found.time_s) <= 602
    assert np.isnan(found.density).all(axis=1).sum() == 1
    whole = power_spectrum(runs, RATE_HZ, 64)
    assert np.nanmean(found.density, axis=0) == pytest.approx(whole.density[:, 0], rel=0.02)
    assert (np.diff(found.time_s) > 0).all()
    assert len(spectrogram([runs[0][:64], runs[0][:63]], [0.0, 9.0], RATE_HZ, 64).time_s) == 1
    with pytest.raises(BadArgument, match="a run of at least 64"):
        spectrogram([np.zeros((10, 3))], [0.0], RATE_HZ, 64)


LINE_HZ = 400.0
SIZE = 1024
BIN_HZ = LINE_HZ / SIZE
BIN_PART = 0.05  # maximum error of a frequency, bins, also with 1 % lost samples


def line(count: int, frequency_hz: float, amplitude: float, rate_hz: float = LINE_HZ, phase: float = 0.3) -> FloatArray:
    return np.asarray(amplitude * np.sin(2 * np.pi * frequency_hz * np.arange(count) / rate_hz + phase))


def test_lines_noise_and_harmonics() -> None:
    for part in (0.0, 0.1, 0.5, 0.75):
        frequency = (200 + part) * BIN_HZ
        first = peaks(power_spectrum([three(line(20 * SIZE, frequency, 2.5))], LINE_HZ, SIZE))[0]
        assert first.frequency_hz == pytest.approx(frequency, abs=0.002 * BIN_HZ)
        assert first.amplitude == pytest.approx((2.5, 2.5, 2.5), rel=2e-3)
        assert first.total == pytest.approx(2.5 * np.sqrt(3), rel=2e-3)
    random = np.random.default_rng(7)
    for _ in range(6):
        noise = np.stack([white(random, 16 * SIZE, LINE_HZ, 1.0) for _ in range(3)], axis=1)
        assert peaks(power_spectrum([noise], LINE_HZ, SIZE)) == []
    series = line(20_000, 30.0, 1.0) + line(20_000, 60.0, 0.3) + line(20_000, 90.0, 0.1) + line(20_000, 77.0, 0.2)
    series += 0.01 * np.random.default_rng(8).standard_normal(20_000)
    found = peaks(power_spectrum([three(series)], LINE_HZ, SIZE))
    assert [round(peak.frequency_hz) for peak in found] == [30, 60, 77, 90]
    assert [(peak.harmonic_of, peak.multiple) for peak in found] == [(None, 1), (0, 2), (None, 1), (0, 3)]
    values = np.stack([line(9000, 50.0, a) for a in (0.1, 0.7, 0.2)], axis=1)
    values += 1e-3 * np.random.default_rng(9).standard_normal(values.shape)
    assert peaks(power_spectrum([values], LINE_HZ, SIZE))[0].axis == 1
    noise = white(np.random.default_rng(10), 100 * SIZE, LINE_HZ, 1.0)[:, None]
    few, many = (power_spectrum([noise[: k * SIZE]], LINE_HZ, SIZE) for k in (2, 100))
    assert threshold(many) == 4.0
    false_peaks = len(few.density) * chi2.sf(threshold(few) * chi2.median(2 * few.averages), 2 * few.averages)
    assert false_peaks == pytest.approx(0.001)
    assert images_hz(30.0, 400.0) == (370.0, 430.0)
    aliased = line(20_000, 370.0, 1.0)
    assert peaks(power_spectrum([three(aliased)], LINE_HZ, SIZE))[0].frequency_hz == pytest.approx(30.0, abs=1e-2)


def test_a_clock_that_is_off_and_missing_samples() -> None:
    """The crystal of a device at 400 Hz is 2 % fast, and 1 % of the samples are lost. The time stamps show both."""
    random = np.random.default_rng(0)
    true_hz, count = LINE_HZ * 1.02, 40_000
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
    naive = power_spectrum([values[keep]], LINE_HZ, SIZE)  # nominal rate, without the gaps
    assert abs(peaks(naive)[0].frequency_hz - frequency) > spectrum.bin_hz, "or else this test shows nothing"


def test_bands() -> None:
    series = white(np.random.default_rng(11), 50_000, LINE_HZ, 1.0)
    spectrum = power_spectrum([three(series)], LINE_HZ, SIZE)
    low, middle, high = bands_of(spectrum, [(0, 40), (40, 100.3), (100.3, 200)])
    together = np.sqrt(low.rms[0] ** 2 + middle.rms[0] ** 2 + high.rms[0] ** 2)
    assert together == pytest.approx(series.std(), rel=0.01)
    assert middle.rms[0] == pytest.approx(np.sqrt(2 * 60.3), rel=0.03)
    found = bands_of(power_spectrum([three(white(np.random.default_rng(12), 9000, LINE_HZ, 1.0))], LINE_HZ, SIZE))
    edges = [(band.low_hz, band.high_hz) for band in found]
    assert edges[-2:] == [(64.0, 128.0), (128.0, 200.0)]
    assert edges[0][0] == pytest.approx(3 * BIN_HZ)
    assert all(one[1] == other[0] for one, other in pairwise(edges))
    spectrum = power_spectrum([three(line(20_000, 50.0, 2.0))], LINE_HZ, SIZE)
    assert bands_of(spectrum, [(40, 60)])[0].rms[0] == pytest.approx(np.sqrt(2), rel=1e-3)
    for band in [(10.0, 300.0), (20.0, 10.0)]:
        spectrum = power_spectrum([three(line(2000, 50.0, 2.0))], LINE_HZ, 256)
        with pytest.raises(BadArgument, match="expected a band from 0 to 200 Hz"):
            bands_of(spectrum, [band])
