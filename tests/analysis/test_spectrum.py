"""Density of known signals, windows, runs, spectrogram."""

import numpy as np
import pytest
from scipy.signal import welch

from imud.analysis.spectrum import noise_bandwidth, power_spectrum, spectrogram, window_size
from imud.model.errors import BadArgument
from tests.analysis.synthetic import white

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
    assert noise_bandwidth(np.ones(10), 10.0) == pytest.approx(1.0)
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
    assert len(found.time_s) <= 602
    assert np.isnan(found.density).all(axis=1).sum() == 1
    whole = power_spectrum(runs, RATE_HZ, 64)
    assert np.nanmean(found.density, axis=0) == pytest.approx(whole.density[:, 0], rel=0.02)
    assert (np.diff(found.time_s) > 0).all()
    assert len(spectrogram([runs[0][:64], runs[0][:63]], [0.0, 9.0], RATE_HZ, 64).time_s) == 1
    with pytest.raises(BadArgument, match="a run of at least 64"):
        spectrogram([np.zeros((10, 3))], [0.0], RATE_HZ, 64)
