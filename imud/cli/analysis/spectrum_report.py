"""Report of a vibration analysis: density, peaks and bands as text and JSON, and as a picture."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from imud.analysis.noise import AXES
from imud.analysis.peaks import Peak, bands_of, images_hz, peaks
from imud.analysis.quantities import SI, TITLES, figure_text
from imud.analysis.series import FloatArray, Readings, even_runs, grid_of, with_values
from imud.analysis.spectrum import WINDOW_LEAST, power_spectrum, spectrogram, window_size
from imud.analysis.spectrum_plots import SensorVibration, spectrum_figure
from imud.cli.analysis.noise_page import picture
from imud.cli.analysis.noise_report import circumstances, grid_object, measurement_object, readings_of
from imud.cli.analysis.taking import Taken
from imud.cli.output import paragraph
from imud.contracts.sensors.data_sheet import SensorName
from imud.errors import ImudError
from imud.units import NS_PER_S

NAME_WIDTH: Final = 6
NUMBER_WIDTH: Final = 10
GRAM_PART: Final = 4
"""Windows of the spectrogram are so much shorter than those of the spectrum: when, rather than which frequency."""


@dataclass(frozen=True, slots=True)
class SpectrumSettings:
    """What the user chose."""

    sensors: tuple[SensorName, ...] = ("accel", "gyro")
    resolution_hz: float | None = None
    """Distance of bins; None: by the length of the series."""
    bands_hz: tuple[tuple[float, float], ...] | None = None
    """None: octaves."""


@dataclass(frozen=True, slots=True)
class SpectrumReport:
    """All that the outputs are made of."""

    taken: Taken
    sensors: dict[SensorName, SensorVibration]


def spectrum_report(taken: Taken, settings: SpectrumSettings) -> SpectrumReport:
    """Analyse the chosen sensors. Raises ImudError where none of them has values."""
    readings = readings_of(taken)
    sensors: dict[SensorName, SensorVibration] = {}
    for name in settings.sensors:
        values = readings.accel_m_s2 if name == "accel" else readings.gyro_rad_s
        if values is not None:
            sensors[name] = sensor_vibration(readings, values, settings)
    if not sensors:
        raise ImudError(f"{taken.source}: {taken.device} sends no values of {' or '.join(settings.sensors)}")
    return SpectrumReport(taken, sensors)


def sensor_vibration(readings: Readings, values: FloatArray, settings: SpectrumSettings) -> SensorVibration:
    """Analyse one sensor, values (n, 3). Raises BadArgument where the series is too short."""
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


# --- words ------------------------------------------------------------------------------------------------------------


def limits(taken: Taken, name: SensorName, sensor: SensorVibration) -> Iterator[str]:
    """Sentences about what limits the spectrum of a sensor."""
    half = sensor.spectrum.rate_hz / 2
    yield sensor.grid.words()
    yield sensor.spectrum.words()
    own = taken.sheet.filter_words(taken.settings, name)
    yield (
        f"aliasing: what vibrates above {half:.4g} Hz, half the rate, and passes the device's own filter "
        f"({own or 'which no manual states'}) stands below it: a line at f may be one at "
        f"{sensor.spectrum.rate_hz:.4g} Hz - f. Measured at another rate, such a line moves"
    )


def peak_words(number: int, peak: Peak) -> str:
    """Name a peak: its number, and of which other it is a multiple."""
    if peak.harmonic_of is None:
        return f"P{number}"
    return f"P{number} = {peak.multiple} × P{peak.harmonic_of + 1}"


def peak_lines(sensor: SensorVibration) -> list[str]:
    """A table of the peaks."""
    if not sensor.peaks:
        return ["  no line stands out of the noise"]
    head = f"  {'peak':<13}{'Hz':>10}" + "".join(f"{axis:>{NUMBER_WIDTH}}" for axis in AXES)
    lines = [f"{head}{'over noise':>13}"]
    for number, peak in enumerate(sensor.peaks, start=1):
        values = "".join(f"{figure_text(value):>{NUMBER_WIDTH}}" for value in peak.amplitude)
        lines.append(f"  {peak_words(number, peak):<13}{peak.frequency_hz:>10.3f}{values}{peak.floor_ratio:>12.3g}x")
    return lines


def band_lines(sensor: SensorVibration) -> list[str]:
    """A table of the bands."""
    lines = [f"  {'band, Hz':<23}" + "".join(f"{axis:>{NUMBER_WIDTH}}" for axis in AXES)]
    for band in sensor.bands:
        words = f"{band.low_hz:.4g} to {band.high_hz:.4g}"
        lines.append(f"  {words:<23}" + "".join(f"{figure_text(value):>{NUMBER_WIDTH}}" for value in band.rms))
    return lines


def text(report: SpectrumReport) -> str:
    """Format the report in 80 columns."""
    lines = [f"{report.taken.device}: vibration"]
    for name, words in circumstances(report.taken, full=False):
        lines += paragraph(f"  {name:<13}", words)
    for sensor_name, sensor in report.sensors.items():
        lines += ["", f"{TITLES[sensor_name]}: lines, peak amplitude in {SI[sensor_name]}", *peak_lines(sensor)]
        lines += ["", f"{TITLES[sensor_name]}: RMS of bands in {SI[sensor_name]}", *band_lines(sensor)]
        for words in limits(report.taken, sensor_name, sensor):
            lines += paragraph("  ", words)
    return "\n".join(lines)


def spectrum_file(report: SpectrumReport, kind: str) -> bytes:
    """The content of a picture, `.svg` or `.png`."""
    facts = dict(circumstances(report.taken, full=False))
    lines = [f"{facts['identity']}; {facts['begun']}; {facts['duration']}; {facts['software']}"]
    for name, sensor in report.sensors.items():
        grid, spectrum = sensor.grid, sensor.spectrum
        lines.append(
            f"{TITLES[name]}: {grid.rate_hz:.4f} Hz, {grid.missing} samples missing, {spectrum.averages} windows, "
            f"{spectrum.window.capitalize()}, noise bandwidth {spectrum.bandwidth_hz:.3g} Hz"
        )
    return picture(spectrum_figure(report.sensors, f"Vibration of {report.taken.device}", lines), kind)


# --- JSON -------------------------------------------------------------------------------------------------------------


def as_object(report: SpectrumReport) -> dict[str, Any]:
    """The report for programs, SI."""
    return {
        "measurement": measurement_object(report.taken),
        "sensors": {
            name: _sensor_object(report.taken, name, sensor) for name, sensor in report.sensors.items()
        },
    }  # fmt: skip


def _sensor_object(taken: Taken, name: SensorName, sensor: SensorVibration) -> dict[str, Any]:
    spectrum = sensor.spectrum
    return {
        **grid_object(name, sensor.grid),
        "window": spectrum.window,
        "window_samples": spectrum.size,
        "bin_hz": spectrum.bin_hz,
        "bandwidth_hz": spectrum.bandwidth_hz,
        "averages": spectrum.averages,
        "device_filter": taken.sheet.filter_words(taken.settings, name),
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
