"""Report of a noise analysis: conditions of the measurement, noise values, comparison with a data sheet."""

import io
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure as MatplotlibFigure

from imud import __version__
from imud.analysis.noise import (
    AXES,
    KNOWN_PARTS,
    MOVED_SHARE,
    AxisNoise,
    Coefficient,
    NoiseTerms,
    NoiseType,
    SensorNoise,
    motion_words,
    sensor_noise,
    unverified_words,
)
from imud.analysis.plots import DPI, density_figure, deviation_figure, page_figure
from imud.analysis.quantities import (
    DEG_PER_RAD,
    MG_PER_M_S2,
    QUANTITIES,
    ROOT_S_PER_ROOT_H,
    S_PER_H,
    SI,
    TITLES,
    UG_PER_M_S2,
    Quantity,
    ShownUnit,
    figure_text,
    short_exponent,
)
from imud.analysis.series import Grid, Readings
from imud.cli.output import COLUMNS, paragraph, shortened
from imud.cli.sample_set import SampleSet
from imud.contracts.driver import DataSheet, Figure, ModelFigures, SensorFigures, SensorName
from imud.host.files import open_regular
from imud.model.errors import BadArgument, ImudError, reason_of
from imud.model.options import wrong_values
from imud.model.units import NS_PER_S

TITLE_WIDTH: Final = 23
UNIT_WIDTH: Final = 10
CELL_WIDTH: Final = 15
# Maximum ratio of a measured value to the value of the data sheet for the verdict "within". The error of a measured
# value is some per cent.
WITHIN: Final = 1.1


@dataclass(frozen=True, slots=True)
class NoiseReport:
    """Result of the analysis, the input of all outputs."""

    sample_set: SampleSet
    sensors: dict[SensorName, SensorNoise]
    sheet: ModelFigures | None  # values of a data sheet for the comparison; None for no comparison
    motion: str  # how the device moved; empty at rest
    unverified: str  # why the data do not show rest; empty if they do, or if the device moved


def noise_report(sample_set: SampleSet, sheet: ModelFigures | None) -> NoiseReport:
    """Analyse both sensors. Raises ImudError if the device sends neither angular rate nor acceleration."""
    readings = readings_of(sample_set)
    sensors: dict[SensorName, SensorNoise] = {}
    if readings.gyro_rad_s is not None:
        sensors["gyro"] = sensor_noise(readings, readings.gyro_rad_s)
    if readings.accel_m_s2 is not None:
        sensors["accel"] = sensor_noise(readings, readings.accel_m_s2)
    if not sensors:
        raise ImudError(f"{sample_set.source}: {sample_set.device} sends neither angular rate nor acceleration")
    motion = motion_words(readings)
    return NoiseReport(sample_set, sensors, sheet, motion, "" if motion else unverified_words(readings))


def readings_of(sample_set: SampleSet) -> Readings:
    """Return the samples. Raises ImudError if there are no samples."""
    if sample_set.readings is None or not len(sample_set.readings.t_ns):
        raise ImudError(f"{sample_set.source}: found no samples")
    return sample_set.readings


# --- the measurement --------------------------------------------------------------------------------------------------


def circumstances(sample_set: SampleSet, *, full: bool = True) -> Iterator[tuple[str, str]]:
    """Yield name and text of the conditions of a measurement. `full`: include the device settings."""
    readings = readings_of(sample_set)
    begun = "unknown"
    if sample_set.begun_utc_ns is not None:
        begun = f"{datetime.fromtimestamp(sample_set.begun_utc_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC"
    yield "source", sample_set.source
    link = sample_set.link
    yield "device", f"{sample_set.device}, driver {sample_set.driver}, {link}" if link else sample_set.driver
    yield "identity", ", ".join(f"{key} {value}" for key, value in sample_set.identity.items()) or "unknown"
    if full:
        yield "settings", ", ".join(f"{key} {value}" for key, value in sample_set.settings.items()) or "unknown"
    yield "start", begun
    yield "duration", f"{duration_words(readings.duration_s)}, {len(readings.t_ns)} samples"
    yield "time stamps", sample_set.stamps
    lost = ", ".join(f"{cause.removeprefix('lost_')} {count}" for cause, count in sample_set.lost.items())
    yield "lost", f"{lost} (ledger)" if lost else "0 samples (ledger)"
    yield "temperature", temperature_words(readings)
    yield "software", f"imud {__version__}"
    for note in sample_set.notes:
        yield "note", note


def duration_words(seconds: float) -> str:
    """Format a duration as hours, minutes and seconds."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def temperature_words(readings: Readings) -> str:
    """Format the range of the temperature."""
    if readings.temperature_c is None:
        return "not sent by the device"
    known = readings.temperature_c[np.isfinite(readings.temperature_c)]
    return f"{known.min():.4g} to {known.max():.4g} °C, from {known[0]:.4g} at the start to {known[-1]:.4g} at the end"


def limits(report: NoiseReport, name: SensorName) -> Iterator[str]:
    """Yield sentences about the limits of the values of a sensor."""
    sensor = report.sensors[name]
    yield sensor.grid.words()
    if sensor.corner_hz is not None:
        yield (
            f"low-pass filter: the noise has less than half of its power above {sensor.corner_hz:.3g} Hz; imud fits "
            f"the coefficients from τ = {sensor.tau_least_s:.3g} s"
        )
    words = report.sample_set.sheet.filter_words(report.sample_set.settings, name)
    if words:
        yield f"filter of the device: {words}"
    step = report.sample_set.sheet.gyro_step_rad_s if name == "gyro" else report.sample_set.sheet.accel_step_m_s2
    if step is not None or sensor.step is not None:
        size = step if step is not None else sensor.step
        origin = "in the manual" if step is not None else "found in the values"
        yield f"resolution: the values are multiples of {size:.4g} {SI[name]} ({origin})"
    if sensor.disturbed_s > MOVED_SHARE * sensor.still_s:
        yield (
            f"DISTURBED: in {sensor.disturbed_s} of {sensor.still_s} seconds, the values scatter much more than in "
            "the other seconds; the device moved or vibrated, and the results contain this motion"
        )
    longest = sensor.curve.tau_s[-1]
    yield (
        f"σ(τ) up to τ = {longest:.3g} s; the error is below about 25 % up to τ = "
        f"{sensor.grid.duration_s / KNOWN_PARTS:.3g} s"
    )


# --- figures ----------------------------------------------------------------------------------------------------------


def figure_of(axis: AxisNoise, quantity: Quantity) -> Coefficient | None:
    """Return one value of an axis in SI units; None if it is unknown."""
    if quantity.key in NoiseTerms._fields:
        found: Coefficient = getattr(axis.terms, quantity.key)
        return found
    if quantity.key == "temperature_slope":
        return None if axis.drift is None else Coefficient(axis.drift.slope, axis.drift.sigma, 0.0)
    if quantity.key == "least_deviation":
        most = axis.bias_instability_most
        return Coefficient(None, 0.0, most) if axis.least_at_end else Coefficient(most, 0.0, 0.0)
    value = {"noise_density": axis.density, "mean": axis.mean, "spread": axis.spread}[quantity.key]
    return Coefficient(value, 0.0, 0.0) if np.isfinite(value) else None


def cell(figure: Coefficient | None, unit: ShownUnit) -> str:
    """Format a value with its standard deviation, or its upper bound."""
    if figure is None:
        return "-"
    if figure.value is None:
        return f"< {figure_text(figure.below * unit.factor)}"
    words = figure_text(figure.value * unit.factor)
    return f"{words} ±{short_exponent(f'{figure.sigma * unit.factor:.1g}')}" if figure.sigma else words


def rows(name: SensorName, sensor: SensorNoise) -> Iterator[tuple[str, str, str, list[str]]]:
    """Yield the rows of the table: title, symbol, unit, and one cell per axis."""
    for quantity in QUANTITIES[name]:
        figures = [figure_of(axis, quantity) for axis in sensor.axes]
        if quantity.key == "temperature_slope" and not any(figures):
            continue
        for unit in quantity.units:
            yield quantity.title, quantity.symbol, unit.name, [cell(figure, unit) for figure in figures]
        if quantity.key == "temperature_slope":
            shares = [f"{axis.drift.r2:.2f}" if axis.drift is not None else "-" for axis in sensor.axes]
            yield "  explained share", "R²", "", shares


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of one measured value with the value of a data sheet."""

    quantity: Quantity
    stated: float  # value of the data sheet, SI
    # Measured value or upper bound of the worst axis, SI. None if the series is too short for a verdict.
    measured: float | None
    ratio: float | None

    @property
    def verdict(self) -> str:
        """Verdict as a word."""
        if self.ratio is None:
            return "not resolved"
        return "within" if self.ratio <= WITHIN else "ABOVE"


def comparisons(report: NoiseReport, name: SensorName) -> list[Comparison]:
    """Compare the values of the data sheet with the measured values.

    The bias instability of a data sheet is compared with the minimum Allan deviation, as data sheets define it.
    """
    if report.sheet is None:
        return []
    stated = getattr(report.sheet, name)
    found = []
    for quantity in QUANTITIES[name]:
        figure = getattr(stated, quantity.key, None)
        if figure is None:
            continue
        key = "least_deviation" if quantity.key == "bias_instability" else quantity.key
        source = next(one for one in QUANTITIES[name] if one.key == key)
        measured = [one for axis in report.sensors[name].axes if (one := figure_of(axis, source)) is not None]
        known = [abs(one.value) for one in measured if one.value is not None]
        bounds = [one.below for one in measured if one.value is None]
        worst = max([*known, *bounds]) if measured and all(one <= WITHIN * figure for one in bounds) else None
        found.append(Comparison(quantity, figure, worst, None if worst is None else worst / figure))
    return found


# --- text -------------------------------------------------------------------------------------------------------------


def text(report: NoiseReport) -> str:
    """Format the report in 80 columns."""
    lines = [f"{report.sample_set.device}: noise"]
    if report.motion:
        lines += paragraph("  ", not_at_rest(report))
    if report.unverified:
        lines += paragraph("  ", report.unverified)
    for name, words in circumstances(report.sample_set):
        lines += paragraph(f"  {name:<13}", words)
    for sensor_name, sensor in report.sensors.items():
        lines += ["", *table(sensor_name, sensor)]
        for words in limits(report, sensor_name):
            lines += paragraph("  ", words)
        lines += compared(report, sensor_name)
    if report.sheet is None:
        lines += ["", *paragraph("", without_sheet(report))]
    return "\n".join(lines)


def not_at_rest(report: NoiseReport) -> str:
    """Return the warning about a device that moved."""
    return (
        f"NOT AT REST: {report.motion}. All values below contain this motion; they are not the noise of the sensor. "
        "Measure again with the device at rest"
    )


def without_sheet(report: NoiseReport) -> str:
    """Return the reason for no comparison, and the next step."""
    document = report.sample_set.sheet.document
    return (
        f"No comparison with a data sheet: {document or 'the driver contains no data sheet'}. To compare with your own "
        "values, use --sheet FILE"
    )


def table(name: SensorName, sensor: SensorNoise) -> list[str]:
    """Format the table of a sensor."""
    head = f"{TITLES[name]:<{TITLE_WIDTH + UNIT_WIDTH}}" + "".join(f"{axis:>{CELL_WIDTH}}" for axis in AXES)
    lines = [head]
    for title, symbol, unit, cells in rows(name, sensor):
        label = f"{title} {symbol}".rstrip()
        words = f"  {shortened(label, TITLE_WIDTH):<{TITLE_WIDTH}}{unit:<{UNIT_WIDTH}}"
        lines.append((words + "".join(f"{narrow(one):>{CELL_WIDTH}}" for one in cells))[:COLUMNS])
    return lines


def narrow(cell: str) -> str:
    """Return a cell with a space before it in its column."""
    return cell if len(cell) < CELL_WIDTH else cell.replace(" ±", "±")


def compared(report: NoiseReport, name: SensorName) -> list[str]:
    """Format the comparison with the data sheet."""
    found = comparisons(report, name)
    if not found or report.sheet is None:
        return []
    lines = paragraph("  ", f"comparison with {report.sheet.source}, worst axis:")
    for one in found:
        unit = one.quantity.units[0]
        measured = "-" if one.measured is None else figure_text(one.measured * unit.factor)
        ratio = "" if one.ratio is None else f" = {one.ratio:.2f} times"
        lines.append(
            f"    {one.quantity.title:<{TITLE_WIDTH}}{measured:>9} of {figure_text(one.stated * unit.factor)} "
            f"{unit.name}{ratio}: {one.verdict}"
        )
    return lines


# --- JSON -------------------------------------------------------------------------------------------------------------


def as_object(report: NoiseReport) -> dict[str, Any]:
    """Return the report for `--json`. Values are in SI units and in the units of data sheets."""
    return {
        "measurement": measurement_object(report.sample_set),
        "at_rest": not report.motion,
        "motion": report.motion or None,
        "not_verified": report.unverified or None,
        "sensors": {name: _sensor_object(report, name, sensor) for name, sensor in report.sensors.items()},
        "data_sheet": report.sheet.source if report.sheet is not None else None,
        "manual": report.sample_set.sheet.document,
    }


def measurement_object(sample_set: SampleSet) -> dict[str, Any]:
    """Return the conditions of a measurement for `--json`."""
    readings = readings_of(sample_set)
    warm = readings.temperature_c
    return {
        "imud": __version__, "source": sample_set.source, "device": sample_set.device, "driver": sample_set.driver,
        "link": sample_set.link, "identity": dict(sample_set.identity), "settings": dict(sample_set.settings),
        "begun_utc_ns": sample_set.begun_utc_ns, "duration_s": readings.duration_s, "samples": len(readings.t_ns),
        "stamps": sample_set.stamps, "lost": sample_set.lost, "notes": sample_set.notes,
        "temperature_c": None if warm is None else [float(np.nanmin(warm)), float(np.nanmax(warm))],
    }  # fmt: skip


def grid_object(name: SensorName, grid: Grid) -> dict[str, Any]:
    """Return the unit of a sensor and the time grid of its samples for `--json`."""
    return {
        "unit": SI[name],
        "rate_hz": grid.rate_hz,
        "missing": grid.missing,
        "filled": grid.filled,
        "runs": len(grid.runs),
        "stamp_scatter_s": grid.scatter_s,
    }


def _sensor_object(report: NoiseReport, name: SensorName, sensor: SensorNoise) -> dict[str, Any]:
    curve = sensor.curve
    return {
        **grid_object(name, sensor.grid),
        "corner_hz": sensor.corner_hz,
        "fitted_from_s": sensor.tau_least_s,
        "disturbed_s": sensor.disturbed_s,
        "step": sensor.step,
        "axes": {label: _axis_object(name, axis) for label, axis in zip(AXES, sensor.axes, strict=True)},
        "allan": {
            "tau_s": curve.tau_s.tolist(),
            "deviation": curve.deviation.T.tolist(),
            "low": curve.low.T.tolist(),
            "high": curve.high.T.tolist(),
            "degrees_of_freedom": curve.freedom.T.tolist(),
            "noise": [[NoiseType(int(one)).name.lower() for one in axis] for axis in curve.types.T],
        },
        "psd": {
            "frequency_hz": sensor.spectrum.frequency_hz.tolist(),
            "density": sensor.spectrum.density.T.tolist(),
            "bandwidth_hz": sensor.spectrum.bandwidth_hz,
            "averages": sensor.spectrum.averages,
        },
        "compared": [
            {"figure": one.quantity.key, "stated": one.stated, "measured": one.measured, "ratio": one.ratio}
            for one in comparisons(report, name)
        ],
    }


def _axis_object(name: SensorName, axis: AxisNoise) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for quantity in QUANTITIES[name]:
        figure = figure_of(axis, quantity)
        if figure is None:
            found[quantity.key] = None
            continue
        units: Mapping[str, float | None] = {
            unit.name: None if figure.value is None else figure.value * unit.factor for unit in quantity.units
        }
        found[quantity.key] = {"value": figure.value, "sigma": figure.sigma or None, "si": quantity.si, **units}
        if figure.value is None:
            found[quantity.key]["below"] = figure.below
    found["temperature_r2"] = axis.drift.r2 if axis.drift is not None else None
    found["least_tau_s"] = axis.least_tau_s
    return found


KINDS: Final = (".html", ".svg", ".png")
# Options of matplotlib: the same input produces the same file, and SVG text stays text
REPEATABLE: Final[Any] = {"svg.hashsalt": "imud", "svg.fonttype": "none", "font.family": "DejaVu Sans"}
STYLE: Final = """
body { font: 15px/1.45 'DejaVu Sans', Verdana, sans-serif; color: #222; max-width: 60em; margin: 2em auto;
       padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; margin: 1em 0; font-size: 0.9em; }
td, th { padding: 0.25em 0.8em; border-bottom: 1px solid #ddd; text-align: left; vertical-align: top; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
svg { max-width: 100%; height: auto; } .above { color: #b00; font-weight: bold; }
@media print { body { margin: 0; max-width: none; } figure { break-inside: avoid; } }
"""


def kind_of(path: Path) -> str:
    """Return the suffix of a file. Raises BadArgument if it is not in KINDS."""
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise BadArgument(f"{path}: expected a file name that ends in {', '.join(KINDS)}")
    return kind


def write_file(path: Path, content: bytes) -> None:
    """Write the file. Replace an existing file. Raises BadArgument if writing fails."""
    try:
        path.write_bytes(content)
    except OSError as error:
        raise BadArgument(f"cannot write {path}: {reason_of(error)}") from error


def noise_file(report: NoiseReport, kind: str) -> bytes:
    """Return the content of a report file; `kind` is in KINDS."""
    if kind == ".html":
        return html(report).encode()
    return picture(page_figure(report.sensors, text(report).splitlines()), kind)


def picture(figure: MatplotlibFigure, kind: str) -> bytes:
    """Return a figure as the content of an SVG or PNG file."""
    buffer = io.BytesIO()
    with rc_context(REPEATABLE):
        metadata = {"Date": None, "Creator": "imud"} if kind == ".svg" else {"Software": "imud"}
        figure.savefig(buffer, format=kind[1:], dpi=DPI, metadata=metadata)
    return buffer.getvalue()


def inline_svg(figure: MatplotlibFigure) -> str:
    """Return a figure as an element of an HTML page, without the head of an SVG file."""
    content = picture(figure, ".svg").decode()
    return re.sub(r"^.*?(?=<svg)", "", content, count=1, flags=re.DOTALL)


def html(report: NoiseReport) -> str:
    """Return the HTML page. The page loads no other files."""
    device = escape(report.sample_set.device)
    parts = [
        "<!DOCTYPE html>", "<html lang='en'><head><meta charset='utf-8'>", f"<title>{device}: noise</title>",
        f"<style>{STYLE}</style></head><body>", f"<h1>Noise of {device}</h1>", *_facts(report),
    ]  # fmt: skip
    if report.motion:
        parts.append(f"<p class='above'>{escape(not_at_rest(report))}.</p>")
    for name, sensor in report.sensors.items():
        parts += _sensor(report, name, sensor)
    if report.sheet is None:
        parts.append(f"<p>{escape(without_sheet(report))}.</p>")
    parts += [f"<h2>Method</h2>{METHOD}", "</body></html>", ""]
    return "\n".join(parts)


METHOD: Final = (
    "<p>Overlapping Allan deviation. The 68 % intervals use χ² and the equivalent degrees of freedom of the noise type "
    "at each τ (NIST SP 1065). The coefficients are a weighted non-negative fit of "
    "σ² = 3Q²/τ² + N²/τ + (2 ln 2/π)B² + K²τ/3 + R²τ²/2 (IEEE Std 952). ± is one standard deviation. For a coefficient "
    "that the series does not resolve, the table contains an upper bound of two standard deviations. The noise density "
    "is one-sided; for white noise it is √2 N. The temperature drift is a least-squares fit of mean values. The axes "
    "are the axes that imud publishes.</p>"
)


def _facts(report: NoiseReport) -> Iterator[str]:
    yield "<table>"
    for name, words in circumstances(report.sample_set):
        yield f"<tr><th>{escape(name)}</th><td>{escape(words)}</td></tr>"
    yield "</table>"


def _sensor(report: NoiseReport, name: SensorName, sensor: SensorNoise) -> Iterator[str]:
    yield f"<h2>{TITLES[name].capitalize()}</h2>"
    yield f"<figure>{inline_svg(deviation_figure(name, sensor))}</figure>"
    yield from _figures(name, sensor)
    yield from _compared(report, name)
    yield "<ul>"
    yield from (f"<li>{escape(words)}</li>" for words in limits(report, name))
    yield "</ul>"
    yield f"<figure>{inline_svg(density_figure(name, sensor))}</figure>"
    yield f"<p>{escape(sensor.spectrum.words())}.</p>"


def _figures(name: SensorName, sensor: SensorNoise) -> Iterator[str]:
    """Yield the table in the units of data sheets, then the table in SI units."""
    heads = "".join(f"<th class='number'>{axis}</th>" for axis in AXES)
    yield f"<table><tr><th>value</th><th></th><th>unit</th>{heads}</tr>"
    for title, symbol, unit, cells in rows(name, sensor):
        numbers = "".join(f"<td class='number'>{escape(one)}</td>" for one in cells)
        yield f"<tr><td>{title}</td><td>{symbol}</td><td>{unit}</td>{numbers}</tr>"
    yield f"</table><details><summary>in SI units</summary><table><tr><th>value</th><th>unit</th>{heads}</tr>"
    for quantity in QUANTITIES[name]:
        figures = [figure_of(axis, quantity) for axis in sensor.axes]
        words = ["-" if one is None or one.value is None else f"{one.value:.4g}" for one in figures]
        numbers = "".join(f"<td class='number'>{one}</td>" for one in words)
        yield f"<tr><td>{quantity.title}</td><td>{quantity.si}</td>{numbers}</tr>"
    yield "</table></details>"


def _compared(report: NoiseReport, name: SensorName) -> Iterator[str]:
    found = comparisons(report, name)
    if not found or report.sheet is None:
        return
    yield f"<h3>Comparison with {escape(report.sheet.source)}</h3>"
    yield "<table><tr><th>value</th><th>unit</th><th class='number'>data sheet</th>"
    yield "<th class='number'>measured, worst axis</th><th class='number'>ratio</th><th></th></tr>"
    for one in found:
        unit = one.quantity.units[0]
        measured = "-" if one.measured is None else figure_text(one.measured * unit.factor)
        ratio = "-" if one.ratio is None else f"{one.ratio:.2f}"
        mark = " class='above'" if one.verdict == "ABOVE" else ""
        yield (
            f"<tr><td>{one.quantity.title}</td><td>{unit.name}</td>"
            f"<td class='number'>{figure_text(one.stated * unit.factor)}</td><td class='number'>{measured}</td>"
            f"<td class='number'>{ratio}</td><td{mark}>{one.verdict}</td></tr>"
        )
    yield "</table>"


SHEET_BYTES_MOST: Final = 65_536  # maximum size of a file with data sheet values, bytes


class GyroSheet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data sheet values of a gyroscope."""

    random_walk_deg_sqrt_h: Figure = None  # angle random walk
    noise_density_deg_s_sqrt_hz: Figure = None
    bias_instability_deg_h: Figure = None
    rate_random_walk_deg_h_sqrt_h: Figure = None
    temperature_slope_deg_h_k: Figure = None

    def figures(self) -> SensorFigures:
        """Convert to SI."""
        return SensorFigures(
            random_walk=_si(self.random_walk_deg_sqrt_h, DEG_PER_RAD * ROOT_S_PER_ROOT_H),
            noise_density=_si(self.noise_density_deg_s_sqrt_hz, DEG_PER_RAD),
            bias_instability=_si(self.bias_instability_deg_h, DEG_PER_RAD * S_PER_H),
            rate_random_walk=_si(self.rate_random_walk_deg_h_sqrt_h, DEG_PER_RAD * S_PER_H * ROOT_S_PER_ROOT_H),
            temperature_slope=_si(self.temperature_slope_deg_h_k, DEG_PER_RAD * S_PER_H),
        )


class AccelSheet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data sheet values of an accelerometer."""

    random_walk_m_s_sqrt_h: Figure = None  # velocity random walk
    noise_density_ug_sqrt_hz: Figure = None
    bias_instability_mg: Figure = None
    rate_random_walk_mg_sqrt_h: Figure = None
    temperature_slope_mg_k: Figure = None

    def figures(self) -> SensorFigures:
        """Convert to SI."""
        return SensorFigures(
            random_walk=_si(self.random_walk_m_s_sqrt_h, ROOT_S_PER_ROOT_H),
            noise_density=_si(self.noise_density_ug_sqrt_hz, UG_PER_M_S2),
            bias_instability=_si(self.bias_instability_mg, MG_PER_M_S2),
            rate_random_walk=_si(self.rate_random_walk_mg_sqrt_h, MG_PER_M_S2 * ROOT_S_PER_ROOT_H),
            temperature_slope=_si(self.temperature_slope_mg_k, MG_PER_M_S2),
        )


class SheetFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of a file with data sheet values."""

    source: str = ""  # document, revision and page, for the report
    gyro: GyroSheet = GyroSheet()
    accel: AccelSheet = AccelSheet()


def _si(value: float | None, factor: float) -> float | None:
    return None if value is None else value / factor


def read_sheet(path: Path) -> ModelFigures:
    """Read a file with data sheet values. Raises BadArgument if the file is invalid."""
    try:
        with open_regular(path) as file:
            text = file.read(SHEET_BYTES_MOST + 1)
    except OSError as error:
        raise BadArgument(f"--sheet {path}: {reason_of(error)}") from error
    if len(text) > SHEET_BYTES_MOST:
        raise BadArgument(f"--sheet {path}: expected at most {SHEET_BYTES_MOST} bytes; is it the data sheet itself?")
    try:
        tree: Any = msgspec.yaml.decode(text)
    except msgspec.DecodeError as error:
        raise BadArgument(f"--sheet {path}: expected YAML: {reason_of(error)}") from None
    if not isinstance(tree, dict):
        raise BadArgument(f"--sheet {path}: expected a mapping with the keys source, gyro, accel")
    wrong = [str(one) for one in wrong_values(SheetFile, tree, "figure")]
    if wrong:
        raise BadArgument(f"--sheet {path}: {'; '.join(wrong)}")
    try:
        sheet = msgspec.convert(tree, SheetFile)
    except msgspec.ValidationError as error:
        raise BadArgument(f"--sheet {path}: {reason_of(error)}") from None
    return ModelFigures(gyro=sheet.gyro.figures(), accel=sheet.accel.figures(), source=sheet.source or str(path))


def figures_for(sheet: DataSheet, product: str, given: ModelFigures | None) -> ModelFigures | None:
    """Return the values for the comparison: the user's file, otherwise the manual of the model, otherwise None."""
    return given if given is not None else sheet.figures_of(product)
