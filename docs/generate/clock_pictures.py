"""Draws both plots of docs/measurements/timestamps.md: `make report` calls `draw`."""

from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from imud.cli.noise import picture
from tests.bench.clock_figures import ArrivalFigures, LineFigures
from tests.support.results import ROOT, Results

FOLDER: Final = ROOT / "docs/pictures"
RATE_COLOURS: Final = {1: "#8e44ad", 100: "#1f5fa8", 200: "#2e8b57", 400: "#d68910", 1000: "#c0392b"}
SOURCE_COLOURS: Final = {"SOUT": "#1f5fa8", "PPS": "#2e8b57", "UTC": "#d68910", "SIN trigger": "#c0392b"}
STEP: Final = 0.15
"""Distance between two rates of one arrival profile on the x axis."""
LEAST_US: Final = 0.1
"""Smallest drawn value, µs. Smaller values are drawn here, because a logarithmic scale has no zero."""
ROW_INCHES: Final = 0.19


def arrivals_figure(found: Sequence[ArrivalFigures]) -> Figure:
    figure = Figure(figsize=(8.2, 4.6), layout="constrained")
    axes = figure.subplots()
    names = list(dict.fromkeys(one.arrival for one in found))
    rates = list(dict.fromkeys(one.rate_hz for one in found))
    for one in found:
        x = names.index(one.arrival) + STEP * (rates.index(one.rate_hz) - (len(rates) - 1) / 2)
        colour = RATE_COLOURS[one.rate_hz]
        axes.plot([x, x], _shown(one.rms_us), color=colour, linewidth=5, marker="o", markersize=5)
        axes.plot([x, x], _shown(one.mean_t_err_us), color="#222", linewidth=1.2, marker="_", markersize=7)
    axes.set_xticks(range(len(names)), names)
    axes.set(yscale="log", ylabel="µs", title="Error of time stamps without lines, from the best to the worst crystal")
    keys = [Line2D([], [], color=RATE_COLOURS[hz], linewidth=5, label=f"rms, {hz} Hz") for hz in rates]
    keys.append(Line2D([], [], color="#222", linewidth=1.2, marker="_", label="reported: mean t_err"))
    axes.legend(handles=keys, fontsize=8, ncols=2, loc="upper left")
    _finish(axes)
    axes.grid(visible=False, axis="x")
    return figure


def lines_figure(found: Sequence[LineFigures]) -> Figure:
    figure = Figure(figsize=(8.2, ROW_INCHES * len(found) + 1.2), layout="constrained")
    axes = figure.subplots()
    for place, one in enumerate(found):
        colour = SOURCE_COLOURS[one.source]
        scatter, mean, stated = _shown((one.sigma_us, abs(one.mean_us), one.mean_t_err_us))
        axes.plot([scatter], [place], color=colour, marker="o", markersize=6, linestyle="")
        axes.plot([mean], [place], color=colour, marker="o", markersize=6, markerfacecolor="none", linestyle="")
        axes.plot([stated], [place], color="#222", marker="|", markersize=9, markeredgewidth=1.6, linestyle="")
    labels = [f"{one.source}, {one.over}, {one.rate_hz} Hz" for one in found]
    axes.set_yticks(range(len(found)), labels, fontsize=7)
    axes.set(xscale="log", xlabel="µs", title="Error of time stamps with lines and UTC")
    axes.set_ylim(len(found) - 0.5, -0.5)
    axes.legend(
        handles=[
            Line2D([], [], color="#555", marker="o", linestyle="", label="σ"),
            Line2D([], [], color="#555", marker="o", markerfacecolor="none", linestyle="", label="mean, either sign"),
            Line2D([], [], color="#222", marker="|", markersize=9, linestyle="", label="reported: mean t_err"),
        ],
        fontsize=8, loc="upper right",
    )  # fmt: skip
    _finish(axes)
    return figure


def _shown(values: Sequence[float]) -> list[float]:
    return [float(one) for one in np.maximum(values, LEAST_US)]


def _finish(axes: Axes) -> None:
    axes.title.set_fontsize(10)
    axes.grid(visible=True, which="major", color="#ddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", labelsize=7.5)


def draw(arrivals: Results, lines: Results) -> None:
    """Draw the results of `tests.bench.clock` and `tests.bench.clock_lines`."""
    found = msgspec.convert(arrivals.tables[0].rows, list[ArrivalFigures])
    (FOLDER / "clock_arrivals.svg").write_bytes(picture(arrivals_figure(found), ".svg"))
    rows = msgspec.convert(lines.tables[0].rows, list[LineFigures])
    (FOLDER / "clock_lines.svg").write_bytes(picture(lines_figure(rows), ".svg"))
