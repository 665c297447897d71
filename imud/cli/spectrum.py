"""Report of a vibration analysis: density, peaks and bands as text and JSON, and as a picture."""

import argparse
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from time import monotonic
from typing import Any, Final

import numpy as np

from imud.analysis.noise import AXES
from imud.analysis.plots import SensorVibration, spectrum_figure
from imud.analysis.quantities import SI, TITLES, figure_text
from imud.analysis.series import FloatArray, Readings, even_runs, grid_of, with_values
from imud.analysis.spectrum import (
    WINDOW_LEAST,
    Peak,
    Spectrum,
    bands_of,
    images_hz,
    peaks,
    power_spectrum,
    spectrogram,
    window_size,
)
from imud.cli.arguments import connect, statuses
from imud.cli.noise import circumstances, grid_object, measurement_object, picture, readings_of
from imud.cli.output import COLUMNS, paragraph, shortened
from imud.cli.sample_set import LATENCY_MS, SILENCE_S, Collector, SampleSet, heard, status_of
from imud.contracts.driver import SensorName
from imud.model.errors import BadArgument, ImudError
from imud.model.units import NS_PER_S

NAME_WIDTH: Final = 6
NUMBER_WIDTH: Final = 10
# Window of the spectrum divided by the window of the spectrogram. Shorter windows show times better, frequencies less
# well.
GRAM_PART: Final = 4


@dataclass(frozen=True, slots=True)
class SpectrumOptions:
    """Options of the command line."""

    sensors: tuple[SensorName, ...] = ("accel", "gyro")
    resolution_hz: float | None = None  # Distance of two frequency bins, Hz. None: depends on the number of samples.
    bands_hz: tuple[tuple[float, float], ...] | None = None  # Bands of the RMS, Hz. None: octaves.


@dataclass(frozen=True, slots=True)
class SpectrumReport:
    """Result of the analysis, the input of all outputs."""

    sample_set: SampleSet
    sensors: dict[SensorName, SensorVibration]


def spectrum_report(sample_set: SampleSet, settings: SpectrumOptions) -> SpectrumReport:
    """Analyse the chosen sensors. Raises ImudError if the device does not send values of these sensors."""
    readings = readings_of(sample_set)
    sensors: dict[SensorName, SensorVibration] = {}
    for name in settings.sensors:
        values = readings.accel_m_s2 if name == "accel" else readings.gyro_rad_s
        if values is not None:
            sensors[name] = sensor_vibration(readings, values, settings)
    if not sensors:
        raise ImudError(f"{sample_set.source}: {sample_set.device} sends no values of {' or '.join(settings.sensors)}")
    return SpectrumReport(sample_set, sensors)


def sensor_vibration(readings: Readings, values: FloatArray, settings: SpectrumOptions) -> SensorVibration:
    """Analyse one sensor; `values` has the shape (n, 3). Raises BadArgument if the series is too short."""
    t_ns, values = with_values(readings.t_ns, values)
    grid = grid_of(t_ns)
    runs = even_runs(grid, values, smooth=True)
    size = window_size(runs, grid.rate_hz, settings.resolution_hz)
    spectrum = power_spectrum(runs, grid.rate_hz, size)
    starts = [float(t_ns[first] - readings.t_ns[0]) / NS_PER_S for first, _ in grid.runs]
    gram = spectrogram(runs, starts, grid.rate_hz, max(size // GRAM_PART, min(size, WINDOW_LEAST)))
    return SensorVibration(
        grid, spectrum, gram, tuple(peaks(spectrum)), tuple(bands_of(spectrum, settings.bands_hz))
    )  # fmt: skip


# --- text -------------------------------------------------------------------------------------------------------------


def limits(sample_set: SampleSet, name: SensorName, sensor: SensorVibration) -> Iterator[str]:
    """Yield sentences about the limits of the spectrum of a sensor."""
    half = sensor.spectrum.rate_hz / 2
    yield sensor.grid.words()
    yield sensor.spectrum.words()
    own = sample_set.sheet.filter_words(sample_set.settings, name)
    yield (
        f"aliasing: vibration above {half:.4g} Hz (half of the rate) that passes the filter of the device "
        f"({own or 'unknown, no manual states it'}) appears below {half:.4g} Hz: a line at f can be a line at "
        f"{sensor.spectrum.rate_hz:.4g} Hz - f. To check a line, measure at another rate: an alias moves"
    )


def peak_words(number: int, peak: Peak) -> str:
    """Return the name of a peak: its number, and the fundamental peak of a harmonic."""
    if peak.harmonic_of is None:
        return f"P{number}"
    return f"P{number} = {peak.multiple} × P{peak.harmonic_of + 1}"


def peak_lines(sensor: SensorVibration) -> list[str]:
    """Format the table of the peaks."""
    if not sensor.peaks:
        return ["  no line is above the noise"]
    head = f"  {'peak':<13}{'Hz':>10}" + "".join(f"{axis:>{NUMBER_WIDTH}}" for axis in AXES)
    lines = [f"{head}{'over noise':>13}"]
    for number, peak in enumerate(sensor.peaks, start=1):
        values = "".join(f"{figure_text(value):>{NUMBER_WIDTH}}" for value in peak.amplitude)
        lines.append(f"  {peak_words(number, peak):<13}{peak.frequency_hz:>10.3f}{values}{peak.floor_ratio:>12.3g}x")
    return lines


def band_lines(sensor: SensorVibration) -> list[str]:
    """Format the table of the bands."""
    lines = [f"  {'band, Hz':<23}" + "".join(f"{axis:>{NUMBER_WIDTH}}" for axis in AXES)]
    for band in sensor.bands:
        words = f"{band.low_hz:.4g} to {band.high_hz:.4g}"
        lines.append(f"  {words:<23}" + "".join(f"{figure_text(value):>{NUMBER_WIDTH}}" for value in band.rms))
    return lines


def text(report: SpectrumReport) -> str:
    """Format the report in 80 columns."""
    lines = [f"{report.sample_set.device}: vibration"]
    for name, words in circumstances(report.sample_set, full=False):
        lines += paragraph(f"  {name:<13}", words)
    for sensor_name, sensor in report.sensors.items():
        lines += ["", f"{TITLES[sensor_name]}: lines, peak amplitude in {SI[sensor_name]}", *peak_lines(sensor)]
        lines += ["", f"{TITLES[sensor_name]}: RMS of bands in {SI[sensor_name]}", *band_lines(sensor)]
        for words in limits(report.sample_set, sensor_name, sensor):
            lines += paragraph("  ", words)
    return "\n".join(lines)


def spectrum_file(report: SpectrumReport, kind: str) -> bytes:
    """Return the content of a picture file of the kind `.svg` or `.png`."""
    facts = dict(circumstances(report.sample_set, full=False))
    lines = [f"{facts['identity']}; {facts['start']}; {facts['duration']}; {facts['software']}"]
    for name, sensor in report.sensors.items():
        grid, spectrum = sensor.grid, sensor.spectrum
        lines.append(
            f"{TITLES[name]}: {grid.rate_hz:.4f} Hz, {grid.missing} samples lost, {spectrum.averages} windows, "
            f"{spectrum.window.capitalize()}, noise bandwidth {spectrum.bandwidth_hz:.3g} Hz"
        )
    return picture(spectrum_figure(report.sensors, f"Vibration of {report.sample_set.device}", lines), kind)


# --- JSON -------------------------------------------------------------------------------------------------------------


def as_object(report: SpectrumReport) -> dict[str, Any]:
    """Return the report for `--json` in SI units."""
    return {
        "measurement": measurement_object(report.sample_set),
        "sensors": {
            name: _sensor_object(report.sample_set, name, sensor) for name, sensor in report.sensors.items()
        },
    }  # fmt: skip


def _sensor_object(sample_set: SampleSet, name: SensorName, sensor: SensorVibration) -> dict[str, Any]:
    spectrum = sensor.spectrum
    return {
        **grid_object(name, sensor.grid),
        "window": spectrum.window,
        "window_samples": spectrum.size,
        "bin_hz": spectrum.bin_hz,
        "bandwidth_hz": spectrum.bandwidth_hz,
        "averages": spectrum.averages,
        "device_filter": sample_set.sheet.filter_words(sample_set.settings, name),
        "peaks": [
            {
                "frequency_hz": peak.frequency_hz,
                "amplitude": list(peak.amplitude),
                "over_noise": peak.floor_ratio,
                "harmonic_of": peak.harmonic_of,
                "multiple": peak.multiple,
                "images_hz": list(images_hz(peak.frequency_hz, spectrum.rate_hz)),
            }
            for peak in sensor.peaks
        ],
        "bands": [{"low_hz": band.low_hz, "high_hz": band.high_hz, "rms": list(band.rms)} for band in sensor.bands],
        "frequency_hz": spectrum.frequency_hz.tolist(),
        "density": spectrum.density.T.tolist(),
    }


REDRAW_S: Final = 1.0
KEPT_S: Final = 10.0  # Time span of the live spectrum, s. A longer span would hide changes.
PAST_ROWS: Final = 8  # number of rows of the spectrogram
HEIGHT: Final = 8  # number of rows of the curve
PEAKS_SHOWN: Final = 5
RANGE_DB: Final = 60.0
SHADES: Final = " ░▒▓█"
BARS: Final = " ▁▂▃▄▅▆▇█"
CLEAR: Final = "\x1b[H\x1b[2J"


def live(args: argparse.Namespace, settings: SpectrumOptions) -> int:
    """Redraw the spectrum until Ctrl-C. Raises ImudError."""
    name = settings.sensors[0]
    with connect(args) as asking, connect(args) as listening:
        status_of(statuses(asking), args.input)
        collector = Collector(args.input)
        view = LiveView(args.input, name)
        drawn_s = monotonic()
        with suppress(KeyboardInterrupt):
            samples = listening.watch([args.input], timeout_s=SILENCE_S, latency_ms=LATENCY_MS)
            for sample in heard(samples, args.input):
                if sample is None:
                    sys.stdout.write(f"{CLEAR}{args.input} sends no samples; find the reason with `imud status`\n")
                    sys.stdout.flush()
                    continue
                collector.add(sample)
                if monotonic() - drawn_s >= REDRAW_S:
                    drawn_s = monotonic()
                    collector.drop_before(sample.t_ns - round(KEPT_S * NS_PER_S))
                    sys.stdout.write(CLEAR + view.page(collector, settings) + "\n")
                    sys.stdout.flush()
    return 0


class LiveView:
    """Live view: curve, spectrogram and peaks as text."""

    def __init__(self, device: str, name: SensorName) -> None:
        self._device = device
        self._name: SensorName = name
        self._past: deque[str] = deque(maxlen=PAST_ROWS)

    def page(self, collector: Collector, settings: SpectrumOptions) -> str:
        """Format the view of the collected samples in 80 columns."""
        readings = collector.readings()
        values = readings.accel_m_s2 if self._name == "accel" else readings.gyro_rad_s
        if values is None:
            return f"{self._device} sends no values of the {TITLES[self._name]}"
        try:
            sensor = sensor_vibration(readings, values, settings)
        except BadArgument as error:  # still too few samples
            return f"{self._device}: {error}"
        return "\n".join(self._lines(sensor))

    def _lines(self, sensor: SensorVibration) -> list[str]:
        columns = in_columns(sensor.spectrum)
        decibels = 10 * np.log10(np.maximum(columns, 1e-300))  # log10(0) is -infinity
        # next multiple of 10 dB: the scale does not move with each redraw
        top = 10 * int(np.ceil(decibels.max() / 10))
        level = np.clip((decibels - top + RANGE_DB) / RANGE_DB, 0, 1)
        self._past.appendleft("".join(SHADES[min(int(one * len(SHADES)), len(SHADES) - 1)] for one in level))
        grid, spectrum = sensor.grid, sensor.spectrum
        head = (
            f"{shortened(self._device, 16)} {TITLES[self._name]}: {grid.rate_hz:.3f} Hz, {grid.missing} lost, "
            f"bins of {spectrum.bin_hz:.3g} Hz"
        )
        unit = f"dB of ({SI[self._name]})²/Hz"
        return [
            head, f"{top} {unit}", *curve_rows(level), axis_line(spectrum.rate_hz / 2),
            f"{top - RANGE_DB:.0f} {unit}; last {len(self._past)} s, newest row first:", *self._past,
            f"lines, peak amplitude in {SI[self._name]}",
            *peak_lines(sensor)[: PEAKS_SHOWN + 1],
        ]  # fmt: skip


def in_columns(spectrum: Spectrum) -> FloatArray:
    """Return the maximum density in each column of the terminal, sum of all axes, shape (COLUMNS,)."""
    power = spectrum.density[1:].sum(axis=1)
    column = (np.arange(len(power)) * COLUMNS) // len(power)
    found = np.full(COLUMNS, 0.0)
    # the maximum, not the mean: a narrow line stays visible
    np.maximum.at(found, column, power)
    if len(power) < COLUMNS:
        found = power[np.arange(COLUMNS) * len(power) // COLUMNS]
    return np.asarray(found, dtype=np.float64)


def curve_rows(level: FloatArray) -> list[str]:
    """Format the curve as HEIGHT rows of bars. `level` has the shape (COLUMNS,) and values from 0 to 1."""
    eighths = np.rint(level * HEIGHT * (len(BARS) - 1)).astype(int)
    rows = []
    for row in range(HEIGHT - 1, -1, -1):
        inside = np.clip(eighths - row * (len(BARS) - 1), 0, len(BARS) - 1)
        rows.append("".join(BARS[one] for one in inside).rstrip())
    return rows


def axis_line(half_hz: float) -> str:
    """Format the frequency axis with five labels: 0, 1/4, 1/2, 3/4 and all of `half_hz`."""
    line = [" "] * COLUMNS
    for quarter in range(5):
        words = f"{half_hz * quarter / 4:.4g}" + (" Hz" if quarter == 4 else "")
        place = round((COLUMNS - 1) * quarter / 4)
        begin = min(max(place - len(words) // 2, 0), COLUMNS - len(words))
        line[begin : begin + len(words)] = words
    return "".join(line)
