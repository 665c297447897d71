"""Page of a noise report for a supplier: one HTML file with everything in it, or a picture (SVG, PNG)."""

import io
import re
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any, Final

from matplotlib import rc_context
from matplotlib.figure import Figure as MatplotlibFigure

from imud.analysis.noise import AXES, SensorNoise
from imud.analysis.noise_plots import DPI, density_figure, deviation_figure, page_figure
from imud.analysis.quantities import QUANTITIES, TITLES, figure_text
from imud.cli.analysis.noise_report import (
    NoiseReport,
    circumstances,
    comparisons,
    figure_of,
    limits,
    rows,
    text,
    without_sheet,
)
from imud.contracts.sensors.data_sheet import SensorName
from imud.errors import BadArgument, reason_of

KINDS: Final = (".html", ".svg", ".png")
REPEATABLE: Final[Any] = {"svg.hashsalt": "imud", "svg.fonttype": "none", "font.family": "DejaVu Sans"}
"""The same input makes the same file; text stays text."""
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
    """Return the kind of a file by its end. Raises BadArgument for others than KINDS."""
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise BadArgument(f"{path}: expected a name that ends in {', '.join(KINDS)}")
    return kind


def write_file(path: Path, content: bytes) -> None:
    """Write the file, over an older one. Raises BadArgument with the reason."""
    try:
        path.write_bytes(content)
    except OSError as error:
        raise BadArgument(f"{path}: {reason_of(error)}") from error


def noise_file(report: NoiseReport, kind: str) -> bytes:
    """The content of a report of one of KINDS."""
    if kind == ".html":
        return html(report).encode()
    return picture(page_figure(report.sensors, text(report).splitlines()), kind)


def picture(figure: MatplotlibFigure, kind: str) -> bytes:
    """A figure as the content of an SVG or PNG file."""
    buffer = io.BytesIO()
    with rc_context(REPEATABLE):
        metadata = {"Date": None, "Creator": "imud"} if kind == ".svg" else {"Software": "imud"}
        figure.savefig(buffer, format=kind[1:], dpi=DPI, metadata=metadata)
    return buffer.getvalue()


def inline_svg(figure: MatplotlibFigure) -> str:
    """A figure as an element of an HTML page, without the head of a file of its own."""
    content = picture(figure, ".svg").decode()
    return re.sub(r"^.*?(?=<svg)", "", content, count=1, flags=re.DOTALL)


def html(report: NoiseReport) -> str:
    """The whole page; it loads nothing."""
    device = escape(report.taken.device)
    parts = [
        "<!DOCTYPE html>", "<html lang='en'><head><meta charset='utf-8'>", f"<title>{device}: noise</title>",
        f"<style>{STYLE}</style></head><body>", f"<h1>Noise of {device}</h1>", *_facts(report),
    ]  # fmt: skip
    for name, sensor in report.sensors.items():
        parts += _sensor(report, name, sensor)
    if report.sheet is None:
        parts.append(f"<p>{escape(without_sheet(report))}.</p>")
    parts += [f"<h2>How it was made</h2>{METHOD}", "</body></html>", ""]
    return "\n".join(parts)


METHOD: Final = (
    "<p>Overlapping Allan deviation with 68 % intervals by χ² and the equivalent degrees of freedom of the type of "
    "noise at each τ (NIST SP 1065); coefficients by a weighted non-negative fit of "
    "σ² = 3Q²/τ² + N²/τ + (2 ln 2/π)B² + K²τ/3 + R²τ²/2 (IEEE Std 952); ± is one standard deviation; a coefficient "
    "that the series does not resolve has a bound of two. The noise density is one-sided, √2 N of white noise. Drift "
    "with temperature by least squares over means. Axes as published by imud.</p>"
)


def _facts(report: NoiseReport) -> Iterator[str]:
    yield "<table>"
    for name, words in circumstances(report.taken):
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
    """Figures in the units of data sheets, then the same in SI."""
    heads = "".join(f"<th class='number'>{axis}</th>" for axis in AXES)
    yield f"<table><tr><th>figure</th><th></th><th>unit</th>{heads}</tr>"
    for title, symbol, unit, cells in rows(name, sensor):
        numbers = "".join(f"<td class='number'>{escape(one)}</td>" for one in cells)
        yield f"<tr><td>{title}</td><td>{symbol}</td><td>{unit}</td>{numbers}</tr>"
    yield f"</table><details><summary>in SI units</summary><table><tr><th>figure</th><th>unit</th>{heads}</tr>"
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
    yield f"<h3>Compared with {escape(report.sheet.source)}</h3>"
    yield "<table><tr><th>figure</th><th>unit</th><th class='number'>stated</th>"
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
