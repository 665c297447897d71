"""Report of a noise analysis: the measurement, figures in units for people, comparison with a data sheet."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np

from imud import __version__
from imud.analysis.allan import NoiseType
from imud.analysis.noise import AXES, KNOWN_PARTS, AxisNoise, SensorNoise, sensor_noise
from imud.analysis.noise_terms import Coefficient, NoiseTerms
from imud.analysis.quantities import QUANTITIES, SI, TITLES, Quantity, ShownUnit, figure_text, short_exponent
from imud.analysis.series import Grid, Readings
from imud.cli.analysis.taking import Taken
from imud.cli.output import COLUMNS, paragraph, shortened
from imud.contracts.sensors.data_sheet import ModelFigures, SensorName
from imud.errors import ImudError
from imud.units import NS_PER_S

TITLE_WIDTH: Final = 23
UNIT_WIDTH: Final = 10
CELL_WIDTH: Final = 15
DISTURBED_SHARE: Final = 0.01
"""With more disturbed seconds than that the report says that it was no measurement at rest."""
WITHIN: Final = 1.1
"""A measured figure up to so much above that of the sheet is called within: coefficients are known to some per cent."""


@dataclass(frozen=True, slots=True)
class NoiseReport:
    """All that the outputs are made of."""

    taken: Taken
    sensors: dict[SensorName, SensorNoise]
    sheet: ModelFigures | None
    """What to compare with; None for nothing."""


def noise_report(taken: Taken, sheet: ModelFigures | None) -> NoiseReport:
    """Analyse both sensors. Raises ImudError where neither has values."""
    readings = readings_of(taken)
    sensors: dict[SensorName, SensorNoise] = {}
    if readings.gyro_rad_s is not None:
        sensors["gyro"] = sensor_noise(readings, readings.gyro_rad_s)
    if readings.accel_m_s2 is not None:
        sensors["accel"] = sensor_noise(readings, readings.accel_m_s2)
    if not sensors:
        raise ImudError(f"{taken.source}: {taken.device} sends neither angular rate nor acceleration")
    return NoiseReport(taken, sensors, sheet)


def readings_of(taken: Taken) -> Readings:
    """Return the samples. Raises ImudError where there are none."""
    if taken.readings is None or not len(taken.readings.t_ns):
        raise ImudError(f"{taken.source}: expected samples, found none")
    return taken.readings


# --- the measurement --------------------------------------------------------------------------------------------------


def circumstances(taken: Taken, *, full: bool = True) -> Iterator[tuple[str, str]]:
    """Name and text of each thing to know about a measurement."""
    readings = readings_of(taken)
    begun = "not known"
    if taken.begun_utc_ns is not None:
        begun = f"{datetime.fromtimestamp(taken.begun_utc_ns // NS_PER_S, UTC):%Y-%m-%d %H:%M:%S} UTC"
    yield "source", taken.source
    yield "device", f"{taken.device}, driver {taken.driver}, {taken.link}" if taken.link else taken.driver
    yield "identity", ", ".join(f"{key} {value}" for key, value in taken.identity.items()) or "not known"
    if full:
        yield "settings", ", ".join(f"{key} {value}" for key, value in taken.settings.items()) or "not read"
    yield "begun", begun
    yield "duration", f"{duration_words(readings.duration_s)}, {len(readings.t_ns)} samples"
    yield "stamps", taken.stamps
    lost = ", ".join(f"{cause.removeprefix('lost_')} {count}" for cause, count in taken.lost.items())
    yield "lost", f"by the ledger: {lost}" if lost else "nothing, by the ledger"
    yield "temperature", temperature_words(readings)
    yield "software", f"imud {__version__}"
    for note in taken.notes:
        yield "note", note


def duration_words(seconds: float) -> str:
    """Format a duration."""
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
    return f"{known.min():.4g} to {known.max():.4g} °C, from {known[0]:.4g} at the begin to {known[-1]:.4g} at the end"


def limits(report: NoiseReport, name: SensorName) -> Iterator[str]:
    """Sentences about what limits the figures of a sensor."""
    sensor = report.sensors[name]
    yield sensor.grid.words()
    if sensor.corner_hz is not None:
        yield (
            f"the noise has less than half its power above {sensor.corner_hz:.3g} Hz, as behind a low-pass filter: "
            f"the coefficients are fitted from τ = {sensor.tau_least_s:.3g} s on"
        )
    words = report.taken.sheet.filter_words(report.taken.settings, name)
    if words:
        yield f"the device's own filter: {words}"
    step = report.taken.sheet.gyro_step_rad_s if name == "gyro" else report.taken.sheet.accel_step_m_s2
    if step is not None or sensor.step is not None:
        size = step if step is not None else sensor.step
        where = "by the manual" if step is not None else "as the values show"
        yield f"values are whole counts of {size:.4g} {SI[name]} {where}"
    if sensor.disturbed_s > DISTURBED_SHARE * sensor.still_s:
        yield (
            f"NOT AT REST: {sensor.disturbed_s} of {sensor.still_s} seconds scatter by far more than the others; the "
            "device was moved or shaken, and the figures are those of that"
        )
    longest = sensor.curve.tau_s[-1]
    yield f"σ(τ) up to {longest:.3g} s; known to about a quarter up to {sensor.grid.duration_s / KNOWN_PARTS:.3g} s"


# --- figures ----------------------------------------------------------------------------------------------------------


def figure_of(axis: AxisNoise, quantity: Quantity) -> Coefficient | None:
    """One figure of an axis, SI; None where it is not known."""
    if quantity.key in NoiseTerms._fields:
        found: Coefficient = getattr(axis.terms, quantity.key)
        return found
    if quantity.key == "temperature_slope":
        return None if axis.drift is None else Coefficient(axis.drift.slope, axis.drift.sigma, 0.0)
    if quantity.key == "least_deviation":
        most = axis.bias_instability_most
        return Coefficient(None, 0.0, most) if axis.least_at_end else Coefficient(most, 0.0, 0.0)
    plain = {
        "noise_density": axis.density, "mean": axis.mean, "spread": axis.spread
    }  # fmt: skip
    value = plain[quantity.key]
    return Coefficient(value, 0.0, 0.0) if np.isfinite(value) else None


def cell(figure: Coefficient | None, unit: ShownUnit) -> str:
    """Format a figure: value and standard deviation, or what it is below."""
    if figure is None:
        return "-"
    if figure.value is None:
        return f"< {figure_text(figure.below * unit.factor)}"
    words = figure_text(figure.value * unit.factor)
    return f"{words} ±{short_exponent(f'{figure.sigma * unit.factor:.1g}')}" if figure.sigma else words


def rows(name: SensorName, sensor: SensorNoise) -> Iterator[tuple[str, str, str, list[str]]]:
    """Title, symbol, unit and a cell per axis of each figure."""
    for quantity in QUANTITIES[name]:
        figures = [figure_of(axis, quantity) for axis in sensor.axes]
        if quantity.key == "temperature_slope" and not any(figures):
            continue
        for unit in quantity.units:
            yield quantity.title, quantity.symbol, unit.name, [cell(figure, unit) for figure in figures]
        if quantity.key == "temperature_slope":
            shares = [f"{axis.drift.r2:.2f}" if axis.drift is not None else "-" for axis in sensor.axes]
            yield "  of it explained", "R²", "", shares


@dataclass(frozen=True, slots=True)
class Comparison:
    """One figure of a sheet beside what was measured."""

    quantity: Quantity
    stated: float
    """SI"""
    measured: float | None
    """Of the worst axis, SI, or its bound; None where the series leaves open whether it is within."""
    ratio: float | None

    @property
    def verdict(self) -> str:
        """One word."""
        if self.ratio is None:
            return "not resolved"
        return "within" if self.ratio <= WITHIN else "ABOVE"


def comparisons(report: NoiseReport, name: SensorName) -> list[Comparison]:
    """Compare what the sheet states; a bias instability with the least deviation, which is what sheets mean."""
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
    lines = [f"{report.taken.device}: noise"]
    for name, words in circumstances(report.taken):
        lines += paragraph(f"  {name:<13}", words)
    for sensor_name, sensor in report.sensors.items():
        lines += ["", *table(sensor_name, sensor)]
        for words in limits(report, sensor_name):
            lines += paragraph("  ", words)
        lines += compared(report, sensor_name)
    if report.sheet is None:
        lines += ["", *paragraph("", without_sheet(report))]
    return "\n".join(lines)


def without_sheet(report: NoiseReport) -> str:
    """Say why nothing is compared."""
    document = report.taken.sheet.document
    return (
        f"Not compared with a data sheet: {document or 'the driver has none'}. --sheet FILE compares with figures that "
        "you have"
    )


def table(name: SensorName, sensor: SensorNoise) -> list[str]:
    """The figures of a sensor."""
    head = f"{TITLES[name]:<{TITLE_WIDTH + UNIT_WIDTH}}" + "".join(f"{axis:>{CELL_WIDTH}}" for axis in AXES)
    lines = [head]
    for title, symbol, unit, cells in rows(name, sensor):
        label = f"{title} {symbol}".rstrip()
        words = f"  {shortened(label, TITLE_WIDTH):<{TITLE_WIDTH}}{unit:<{UNIT_WIDTH}}"
        lines.append((words + "".join(f"{one:>{CELL_WIDTH}}" for one in cells))[:COLUMNS])
    return lines


def compared(report: NoiseReport, name: SensorName) -> list[str]:
    """The comparison with the sheet."""
    found = comparisons(report, name)
    if not found or report.sheet is None:
        return []
    lines = paragraph("  ", f"compared with {report.sheet.source}, the worst axis:")
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
    """The report for programs; figures in SI, and beside them in the units of data sheets."""
    return {
        "measurement": measurement_object(report.taken),
        "sensors": {name: _sensor_object(report, name, sensor) for name, sensor in report.sensors.items()},
        "data_sheet": report.sheet.source if report.sheet is not None else None,
        "manual": report.taken.sheet.document,
    }


def measurement_object(taken: Taken) -> dict[str, Any]:
    """What is known of a measurement, for programs."""
    readings = readings_of(taken)
    warm = readings.temperature_c
    return {
        "imud": __version__, "source": taken.source, "device": taken.device, "driver": taken.driver,
        "link": taken.link, "identity": dict(taken.identity), "settings": dict(taken.settings),
        "begun_utc_ns": taken.begun_utc_ns, "duration_s": readings.duration_s, "samples": len(readings.t_ns),
        "stamps": taken.stamps, "lost": taken.lost, "notes": taken.notes,
        "temperature_c": None if warm is None else [float(np.nanmin(warm)), float(np.nanmax(warm))],
    }  # fmt: skip


def grid_object(name: SensorName, grid: Grid) -> dict[str, Any]:
    """Unit of a sensor and the even grid of its samples, for programs."""
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
