"""Plots show the values of the analysis on axes with units."""

from dataclasses import replace

import numpy as np
import pytest

from imud.analysis.noise import AllanCurve, SensorNoise, sensor_noise
from imud.analysis.plots import SensorVibration, density_figure, deviation_figure, page_figure, spectrum_figure, thinned
from imud.analysis.quantities import DEG_PER_RAD, S_PER_H
from imud.analysis.series import Readings, grid_of
from imud.analysis.spectrum import bands_of, peaks, power_spectrum, spectrogram
from tests.analysis.synthetic import stamps_ns, white

RATE_HZ = 100.0
COUNT = 8000


@pytest.fixture(scope="module")
def sensor() -> SensorNoise:
    random = np.random.default_rng(1)
    values = np.stack([white(random, COUNT, RATE_HZ, 1e-3) for _ in range(3)], axis=1)
    return sensor_noise(Readings(stamps_ns(COUNT, RATE_HZ), values, None, None), values)


def test_plots_are_drawn_in_units_of_data_sheets(sensor: SensorNoise) -> None:
    (axes,) = deviation_figure("gyro", sensor).axes
    lines = {line.get_label(): line for line in axes.get_lines()}
    drawn = np.asarray(lines["y"].get_ydata())
    assert drawn == pytest.approx(sensor.curve.deviation[:, 1] * DEG_PER_RAD * S_PER_H)
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert "deg/h" in axes.get_ylabel()
    assert (len(axes.collections), len(axes.get_lines())) == (3, 6), "an interval and a fit for each axis"
    low, high = axes.get_ylim()
    assert high > 20 * low
    part = replace(sensor, curve=AllanCurve._make(values[20:24] for values in sensor.curve))
    low, high = deviation_figure("gyro", part).axes[0].get_ylim()
    assert high == pytest.approx(10 * low), "the axis has at least one decade"
    (axes,) = density_figure("accel", sensor).axes
    assert "µg/√Hz" in axes.get_ylabel()
    middle = np.asarray(axes.get_lines()[0].get_ydata())[-10:].mean()
    assert middle == pytest.approx(np.sqrt(2) * 1e-3 / 9.80665e-6, rel=0.05)
    filtered = replace(sensor, corner_hz=20.0, tau_least_s=0.25)
    drawings = [draw("gyro", filtered).axes[0] for draw in (deviation_figure, density_figure)]
    assert [(len(axes.patches), len(axes.get_lines())) for axes in drawings] == [(1, 6), (1, 4)]
    figure = page_figure({"gyro": sensor, "accel": sensor}, ["first line", "second line"])
    assert [axes.get_xlabel() for axes in figure.axes] == ["τ, s", "τ, s", "f, Hz", "f, Hz"]
    assert figure.get_size_inches() == pytest.approx((8.27, 11.69 * 0.0105 * 2 + 0.5 + 6.4)), "A4 is 8.27 in wide"
    assert "first line\nsecond line" in [text.get_text() for text in figure.texts]
    frequency = np.arange(1.0, 1001.0)
    density = np.stack([frequency, np.ones(1000)], axis=1)
    few, power = thinned(frequency, density)
    assert len(few) == 121, "60 bands per decade, without the empty bands"
    assert power[:, 0] == pytest.approx(few)
    assert power[:, 1] == pytest.approx(1.0)


def test_peaks_are_named_in_the_picture() -> None:
    t_s = np.arange(COUNT) / RATE_HZ
    values = np.repeat(np.sin(2 * np.pi * 12.5 * t_s)[:, None], 3, axis=1)
    values += 0.01 * np.random.default_rng(2).standard_normal(values.shape)
    spectrum = power_spectrum([values], RATE_HZ)
    gram = spectrogram([values], [0.0], RATE_HZ, 128)
    vibration = SensorVibration(
        grid_of(stamps_ns(COUNT, RATE_HZ)), spectrum, gram, tuple(peaks(spectrum)), tuple(bands_of(spectrum))
    )
    figure = spectrum_figure({"accel": vibration}, "title", ["line"])
    assert [(axes.get_title(), axes.get_xlabel()) for axes in figure.axes] == [
        ("Power spectral density of the accelerometer", "f, Hz"),
        ("Spectrogram of the accelerometer, sum of all axes", "time, s"), ("", ""),
    ]  # fmt: skip
    assert [text.get_text() for text in figure.axes[0].texts] == ["P1 12.50 Hz"]
    assert figure.axes[0].get_xlim() == (0.0, 50.0)
    even = replace(vibration, spectrum=replace(spectrum, density=np.ones_like(spectrum.density)), peaks=())
    low, high = spectrum_figure({"accel": even}, "", []).axes[0].get_ylim()
    assert (low, high) == pytest.approx((0.0501187, 19.95262), rel=1e-5), "two decades and the margins"
