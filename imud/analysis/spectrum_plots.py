"""Plots of a vibration analysis, as figures of matplotlib that the caller writes to a file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from imud.analysis.noise import AXES
from imud.analysis.noise_plots import COLOURS
from imud.analysis.peaks import Band, Peak
from imud.analysis.quantities import SI, TITLES
from imud.analysis.series import Grid
from imud.analysis.spectrum import Spectrogram, Spectrum
from imud.contracts.sensors.data_sheet import SensorName

RANGE_DB: Final = 80.0
"""Of the colours, below the strongest."""
LABELS_MOST: Final = 6
SPAN_LEAST: Final = 100.0
"""Of a density, from the lowest to the highest that is shown."""
SPECTRUM_INCHES: Final = (9.0, 3.6)


@dataclass(frozen=True, slots=True)
class SensorVibration:
    """Vibration as one sensor sees it."""

    grid: Grid
    spectrum: Spectrum
    spectrogram: Spectrogram
    peaks: tuple[Peak, ...]
    """The strongest first."""
    bands: tuple[Band, ...]


def spectrum_figure(sensors: Mapping[SensorName, SensorVibration], title: str, lines: Sequence[str]) -> Figure:
    """Density and spectrogram of each sensor, one below the other; what was measured stands below the title."""
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
    """Density of the three axes with the peaks named."""
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
    if high < SPAN_LEAST * low:  # noise alone would look like lines
        axes.set_ylim(low / 10, high * 10)
    axes.set_title(f"Power spectral density of the {TITLES[name]}", fontsize=9)
    axes.grid(visible=True, which="major", color="#ddd", linewidth=0.6)
    axes.tick_params(which="both", labelsize=8)
    axes.legend(fontsize=8, loc="upper right")


def draw_spectrogram(figure: Figure, axes: Axes, name: SensorName, sensor: SensorVibration) -> None:
    """Density over time, of the axes together, in dB."""
    gram = sensor.spectrogram
    power = 10 * np.log10(np.maximum(gram.density[:, 1:], 1e-300))
    top = float(np.nanmax(power))
    low = max(top - RANGE_DB, float(np.nanpercentile(power, 2)))
    mesh = axes.pcolormesh(
        gram.time_s, gram.frequency_hz[1:], power.T, vmin=low, vmax=top, cmap="viridis", shading="nearest",
        rasterized=True,
    )  # fmt: skip
    axes.set(xlabel="time, s", ylabel="f, Hz")
    axes.set_title(f"Spectrogram of the {TITLES[name]}, axes together", fontsize=9)
    axes.tick_params(which="both", labelsize=8)
    bar = figure.colorbar(mesh, ax=axes, pad=0.01)
    bar.set_label(f"dB of ({SI[name]})²/Hz", fontsize=8)
    bar.ax.tick_params(labelsize=8)
