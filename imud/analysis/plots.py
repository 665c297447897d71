"""Plots of noise and vibration as matplotlib figures. The caller writes the files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imud.analysis.noise import AXES, SensorNoise
from imud.analysis.quantities import DENSITY, DEVIATION, SI, TITLES
from imud.analysis.series import FloatArray, Grid
from imud.analysis.spectrum import Band, Peak, Spectrogram, Spectrum
from imud.contracts.driver import SensorName

# Colours of x, y and z, the same in all pictures of imud
COLOURS: Final = ("#c0392b", "#2e8b57", "#1f5fa8")
POINTS_PER_DECADE: Final = 60  # Number of points of a density per decade. Each point is a mean.
PAGE_INCHES: Final = (8.27, 11.69)  # page size A4, inches
PLOT_INCHES: Final = (7.6, 4.4)
TEXT_POINTS: Final = 7.0
LINE_PART: Final = 0.0105  # height of a line of text as a share of the page
DPI: Final = 150


def deviation_figure(name: SensorName, sensor: SensorNoise) -> Figure:
    """Return the plot of the Allan deviation of a sensor."""
    figure = Figure(figsize=PLOT_INCHES, layout="constrained")
    draw_deviation(figure.subplots(), name, sensor)
    return figure


def density_figure(name: SensorName, sensor: SensorNoise) -> Figure:
    """Return the plot of the noise density of a sensor."""
    figure = Figure(figsize=PLOT_INCHES, layout="constrained")
    draw_density(figure.subplots(), name, sensor)
    return figure


def page_figure(sensors: Mapping[SensorName, SensorNoise], lines: Sequence[str]) -> Figure:
    """Return a page with the text of the report and the plots below."""
    text_inches = PAGE_INCHES[1] * LINE_PART * len(lines) + 0.5
    plots_inches = 6.4
    figure = Figure(figsize=(PAGE_INCHES[0], text_inches + plots_inches))
    height = text_inches + plots_inches
    figure.text(
        0.06, 1 - 0.25 / height, "\n".join(lines), family="DejaVu Sans Mono", size=TEXT_POINTS, va="top",
        linespacing=1.25,
    )  # fmt: skip
    places = figure.subplots(
        2, len(sensors), squeeze=False,
        gridspec_kw={
            "top": plots_inches / height - 0.01, "bottom": 0.5 / height, "left": 0.1, "right": 0.98, "wspace": 0.26,
            "hspace": 0.32,
        },
    )  # fmt: skip
    for column, (name, sensor) in enumerate(sensors.items()):
        draw_deviation(places[0, column], name, sensor)
        draw_density(places[1, column], name, sensor)
    return figure


def draw_deviation(axes: Axes, name: SensorName, sensor: SensorNoise) -> None:
    """Draw the Allan deviation with its confidence interval and the fitted curve."""
    curve, unit = sensor.curve, DEVIATION[name]
    fitted_at = np.geomspace(max(curve.tau_s[0], sensor.tau_least_s), curve.tau_s[-1], 100)
    for number, (label, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        noise = sensor.axes[number]
        axes.fill_between(
            curve.tau_s, curve.low[:, number] * unit.factor, curve.high[:, number] * unit.factor, color=colour,
            alpha=0.15, linewidth=0,
        )  # fmt: skip
        axes.plot(curve.tau_s, curve.deviation[:, number] * unit.factor, color=colour, label=label, linewidth=1.4)
        fitted = noise.terms.deviation(fitted_at) * unit.factor
        if (fitted > 0).all():
            axes.plot(fitted_at, fitted, color=colour, linewidth=0.8, linestyle=":")
    if sensor.corner_hz is not None:
        # grey: the filter of the device dominates, the fit ignores these points
        axes.axvspan(curve.tau_s[0], sensor.tau_least_s, color="#999", alpha=0.12, linewidth=0)
    axes.set(xscale="log", yscale="log", xlabel="τ, s", ylabel=f"σ(τ), {unit.name}")
    axes.set_title(f"Allan deviation, {TITLES[name]}; band 68 %, dotted fit", fontsize=8)
    _finish(axes)


def draw_density(axes: Axes, name: SensorName, sensor: SensorNoise) -> None:
    """Draw the root of the density, and the band in which imud reads the noise density."""
    spectrum, unit = sensor.spectrum, DENSITY[name]
    frequency, density = thinned(spectrum.frequency_hz[1:], spectrum.density[1:])
    for number, (label, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        axes.plot(frequency, np.sqrt(density[:, number]) * unit.factor, color=colour, label=label, linewidth=1.0)
    axes.axvspan(*sensor.flat_hz, color="#1f5fa8", alpha=0.06, linewidth=0)
    if sensor.corner_hz is not None:
        axes.axvline(sensor.corner_hz, color="#555", linewidth=0.8, linestyle="--")
    axes.set(xscale="log", yscale="log", xlabel="f, Hz", ylabel=f"√S(f), {unit.name}")
    axes.set_title(f"Noise density, {TITLES[name]}; measured in the shaded band", fontsize=8)
    _finish(axes)


def thinned(frequency_hz: FloatArray, density: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average a density, shape (k, axes), in logarithmic bands. Without averaging, a long series is a dense cloud."""
    bands = max(int(np.log10(frequency_hz[-1] / frequency_hz[0]) * POINTS_PER_DECADE), 1)
    edges = np.geomspace(frequency_hz[0], frequency_hz[-1], bands + 1)
    band = np.clip(np.searchsorted(edges, frequency_hz, side="right") - 1, 0, bands - 1)
    starts = np.flatnonzero(np.diff(band, prepend=-1))
    count = np.diff([*starts, len(band)])
    middle = np.add.reduceat(frequency_hz, starts) / count
    return middle, np.add.reduceat(density, starts, axis=0) / count[:, None]


def _finish(axes: Axes) -> None:
    axes.grid(visible=True, which="major", color="#ccc", linewidth=0.6)
    axes.grid(visible=True, which="minor", color="#eee", linewidth=0.4)
    low, high = axes.get_ylim()
    if high < 10 * low:  # show at least one decade: otherwise small noise looks large, and the axis has few numbers
        axes.set_ylim(low / np.sqrt(10 * low / high), high * np.sqrt(10 * low / high))
    axes.tick_params(which="both", labelsize=7)
    axes.xaxis.label.set_fontsize(8)
    axes.yaxis.label.set_fontsize(8)
    axes.legend(fontsize=8, loc="best")


RANGE_DB: Final = 80.0  # range of the colours, dB
LABELS_MOST: Final = 6
SPAN_LEAST: Final = 100.0  # minimum ratio of the largest to the smallest value on the axis of a density
SPECTRUM_INCHES: Final = (9.0, 3.6)


@dataclass(frozen=True, slots=True)
class SensorVibration:
    """Vibration that one sensor measures."""

    grid: Grid
    spectrum: Spectrum
    spectrogram: Spectrogram
    peaks: tuple[Peak, ...]  # peaks, the strongest first
    bands: tuple[Band, ...]


def spectrum_figure(sensors: Mapping[SensorName, SensorVibration], title: str, lines: Sequence[str]) -> Figure:
    """Return density and spectrogram of each sensor in rows. `lines`: text below the title."""
    rows = 2 * len(sensors)
    figure = Figure(
        figsize=(SPECTRUM_INCHES[0], SPECTRUM_INCHES[1] * rows * 0.8 + 0.2 * len(lines)), layout="constrained"
    )
    figure.suptitle("\n".join([title, *lines]), fontsize=9)
    places = figure.subplots(rows, 1, squeeze=False)[:, 0]
    for number, (name, sensor) in enumerate(sensors.items()):
        draw_spectrum(places[2 * number], name, sensor)
        draw_spectrogram(figure, places[2 * number + 1], name, sensor)
    return figure


def draw_spectrum(axes: Axes, name: SensorName, sensor: SensorVibration) -> None:
    """Draw the density of the three axes with the names of the peaks."""
    spectrum = sensor.spectrum
    for number, (label, colour) in enumerate(zip(AXES, COLOURS, strict=True)):
        axes.plot(
            spectrum.frequency_hz[1:], spectrum.density[1:, number], color=colour, label=label, linewidth=0.9, alpha=0.9
        )
    for number, peak in enumerate(sensor.peaks[:LABELS_MOST], start=1):
        place = int(np.argmin(np.abs(spectrum.frequency_hz - peak.frequency_hz)))
        axes.annotate(
            f"P{number} {peak.frequency_hz:.2f} Hz", (peak.frequency_hz, spectrum.density[place].max()),
            textcoords="offset points", xytext=(4, 3), fontsize=7, color="#333",
        )  # fmt: skip
    axes.set(yscale="log", xlabel="f, Hz", ylabel=f"S(f), ({SI[name]})²/Hz", xlim=(0, spectrum.rate_hz / 2))
    axes.margins(y=0.15)
    low, high = axes.get_ylim()
    if high < SPAN_LEAST * low:  # otherwise noise looks like lines
        axes.set_ylim(low / 10, high * 10)
    axes.set_title(f"Power spectral density of the {TITLES[name]}", fontsize=9)
    axes.grid(visible=True, which="major", color="#ddd", linewidth=0.6)
    axes.tick_params(which="both", labelsize=8)
    axes.legend(fontsize=8, loc="upper right")


def draw_spectrogram(figure: Figure, axes: Axes, name: SensorName, sensor: SensorVibration) -> None:
    """Draw the density over time, sum of all axes, in dB."""
    gram = sensor.spectrogram
    power = 10 * np.log10(np.maximum(gram.density[:, 1:], 1e-300))
    top = float(np.nanmax(power))
    # rows of NaN mark gaps
    low = max(top - RANGE_DB, float(np.nanpercentile(power, 2)))
    mesh = axes.pcolormesh(
        gram.time_s, gram.frequency_hz[1:], power.T, vmin=low, vmax=top, cmap="viridis", shading="nearest",
        rasterized=True,
    )  # fmt: skip
    axes.set(xlabel="time, s", ylabel="f, Hz")
    axes.set_title(f"Spectrogram of the {TITLES[name]}, sum of all axes", fontsize=9)
    axes.tick_params(which="both", labelsize=8)
    bar = figure.colorbar(mesh, ax=axes, pad=0.01)
    bar.set_label(f"dB of ({SI[name]})²/Hz", fontsize=8)
    bar.ax.tick_params(labelsize=8)
