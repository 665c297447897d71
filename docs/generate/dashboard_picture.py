"""The picture of the dashboard in docs/monitoring.md: `python -m docs.generate.dashboard_picture` (four minutes).

A real Prometheus scrapes the real daemon, which runs on two simulated sensors. The link of one sensor is disturbed, and
the sensor is silent for SILENT_S. Places, titles, queries and legends come from the dashboard. Grafana draws them in
another style. `--seconds` changes the duration.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from math import isfinite
from pathlib import Path
from typing import Any, Final, NamedTuple

from docs.generate.dashboard import DASHBOARD, filled_in
from docs.generate.pictures import svg, text
from imud.cli.demo import child, daemon
from imud.client.connection import Client
from tests.monitoring.prometheus import RealPrometheus, real_prometheus
from tests.support.files import ROOT
from tests.support.surroundings import free_port

FILE: Final = ROOT / "docs/pictures/dashboard.svg"
SECONDS, SILENT_S, STEP_S = 220.0, 15.0, 2.0
CHOSEN: Final = "bow"
"""Device of the middle row."""
SENSORS: Final = {
    "bow": ("--device", "hipnuc-uart", "--rate", "100", "--faults", "flip=0.01,drop=0.005", "--seed", "7"),
    "mast": ("--device", "imu61x-uart", "--rate", "50", "--adapter", "usb-16ms"),
}
"""Arguments of `python -m imud.sim`, by name in the configuration."""
CELL_X, CELL_Y, MARGIN = 50, 30, 6
"""Size of a unit of Grafana's grid, and distance between panels, px."""
COLOURS: Final = ("#73bf69", "#f2cc0c", "#5794f2", "#ff780a", "#f2495c", "#b877d9", "#8ab8ff", "#c4162a")
UNITS: Final = {
    "s": ((1, "s"), (1e-3, "ms"), (1e-6, "µs")), "bytes": ((2**20, "MiB"), (2**10, "KiB")),
    "percentunit": ((0.01, "%"),), "cps": ((1, "/s"),), "hertz": ((1, "Hz"),), "ppm": ((1, "ppm"),),
    "celsius": ((1, "°C"),), "degree": ((1, "°"),), "accMS2": ((1, "m/s²"),), "none": ((1, ""),),
}  # fmt: skip
"""Factors and symbols of Grafana's units, the largest factor first."""


class Series(NamedTuple):
    """A line of a panel."""

    name: str
    points: Sequence[tuple[float, float]]


class Span(NamedTuple):
    """Interval on the time axis, Unix time, s."""

    begin_s: float
    end_s: float


@contextmanager
def sensors(folder: Path) -> Iterator[Mapping[str, subprocess.Popen[str]]]:
    """Run the simulated sensors, each behind `folder`/NAME."""
    with ExitStack() as stack:
        running = {}
        for name, words in SENSORS.items():
            argv = [sys.executable, "-m", "imud.sim", *words, "--path", str(folder / name)]
            running[name] = stack.enter_context(child(argv, "a simulator", stdout=subprocess.PIPE))
            assert running[name].stdout.readline(), f"expected the port of {name} on standard output"  # type: ignore[union-attr]
        yield running


def observed(seconds: float) -> tuple[list[str], int]:
    """Run all parts for this time. Return the parts of the picture and its height."""
    with tempfile.TemporaryDirectory(prefix="imud-") as name, ExitStack() as stack:
        folder = Path(name)
        modules = stack.enter_context(sensors(folder))
        devices: dict[str, dict[str, object]]
        devices = {one: {"driver": "auto", "uart": {"port": str(folder / one), "baud": "auto"}} for one in SENSORS}
        port = free_port()
        stack.enter_context(daemon(folder, devices, port))
        prometheus = stack.enter_context(real_prometheus(folder))
        prometheus.scrape(port)
        client = stack.enter_context(Client(str(folder / "imud.sock"), timeout_s=60))
        begin_s = time.time()
        silent = False
        for _ in client.watch(rate_hz=10):
            passed_s = time.time() - begin_s
            if silent != (0 < passed_s - seconds / 2 < SILENT_S):
                silent = not silent
                modules[CHOSEN].send_signal(signal.SIGSTOP if silent else signal.SIGCONT)
            if passed_s > seconds:
                break
        parts, height = drawn(prometheus, Span(begin_s, time.time()))
    ports = {str(folder / one): f"/dev/ttyUSB{number}" for number, one in enumerate(SENSORS)}
    return [_renamed(part, {f"127.0.0.1:{port}": "127.0.0.1:9321", **ports}) for part in parts], height


def _renamed(part: str, names: Mapping[str, str]) -> str:
    """Replace the port and the paths of this run by values of a real host."""
    for name, real in names.items():
        part = part.replace(name, real)
    return part


def drawn(prometheus: RealPrometheus, span: Span) -> tuple[list[str], int]:
    """Return the parts of all panels, and the height."""
    parts: list[str] = []
    bottom = 0
    for panel in DASHBOARD.document()["panels"]:
        place = panel["gridPos"]
        box = Box(place["x"] * CELL_X, place["y"] * CELL_Y, place["w"] * CELL_X, place["h"] * CELL_Y)
        bottom = max(bottom, round(box.y + box.height))
        if panel["type"] == "row":
            parts.append(box.say(8, 20, panel["title"].replace("$device", CHOSEN), "#fff", 15))
            continue
        parts.append(box.frame())
        parts.append(box.say(12, 22, panel["title"], "#ccccdc", 13))
        parts += KINDS[panel["type"]](box, panel, found(prometheus, panel, span), span)
    return parts, bottom


def found(prometheus: RealPrometheus, panel: Mapping[str, Any], span: Span) -> list[Series]:
    """Return the results of the panel's queries with the names of its legends."""
    series = []
    for target in panel["targets"]:
        expression = filled_in(target["expr"], device=CHOSEN if "$device" in target["expr"] else ".+", window="10s")
        for row in prometheus.query_range(expression, span.begin_s, span.end_s, STEP_S):
            points = [(float(t), float(value)) for t, value in row["values"] if isfinite(float(value))]
            series.append(Series(named(target["legendFormat"], row["metric"]), points))
    return [one for one in series if one.points]


def named(legend: str, labels: Mapping[str, str]) -> str:
    """Return a legend with its labels. Without a legend, return the labels that distinguish the devices."""
    for name, value in labels.items():
        legend = legend.replace(f"{{{{{name}}}}}", value)
    return legend or "  ".join(labels.get(name, "") for name in ("device", "driver", "link", "product", "firmware"))


def shown(value: float, unit: str) -> str:
    """Return a value with its unit."""
    rows = UNITS[unit]
    factor, sign = next((row for row in rows if abs(value) >= row[0]), rows[-1])
    return f"{value / factor:.3g} {sign}".strip() if value else "0"


class Box(NamedTuple):
    """Place of a panel, px."""

    x: float
    y: float
    width: float
    height: float

    def frame(self) -> str:
        """Return the background of the panel."""
        return (
            f"<rect x='{self.x + MARGIN / 2:g}' y='{self.y + MARGIN / 2:g}' width='{self.width - MARGIN:g}' "
            f"height='{self.height - MARGIN:g}' rx='3' fill='#181b1f' stroke='#2c3235'/>"
        )

    def say(self, x: float, y: float, words: str, fill: str, size: int, more: str = "") -> str:
        """Return a line of text at a point of the panel."""
        return text(self.x + x, self.y + y, words, more).replace("font-size='13' fill='#333'",
                                                                 f"font-size='{size}' fill='{fill}'")  # fmt: skip

    def chart(self) -> "Box":
        """Return the area of the lines."""
        return Box(self.x + 62, self.y + 34, self.width - 80, self.height - 34 - 38)


def _nothing(box: Box) -> list[str]:
    return [box.say(box.width / 2, box.height / 2 + 8, "No data", "#777", 13, "text-anchor='middle'")]


def _lines(box: Box, panel: Mapping[str, Any], series: list[Series], span: Span) -> list[str]:
    """Draw a line for each series, three numbers on each axis, and the legend."""
    if not series:
        return _nothing(box)
    unit, chart = panel["fieldConfig"]["defaults"]["unit"], box.chart()
    values = [value for one in series for _, value in one.points]
    low, high = min(0.0, *values) if min(values) < max(values) / 2 else min(values), max(values)
    if high - low < 1e-12:
        low, high = low - 0.5, high + 0.5
    parts = []
    for number in range(3):
        y = chart.y + chart.height * (1 - number / 2)
        parts.append(f"<path d='M{chart.x:.0f} {y:.0f}h{chart.width:.0f}' stroke='#2c3235'/>")
        words = shown(low + (high - low) * number / 2, unit)
        parts.append(box.say(58, y - box.y + 4, words, "#999", 10, "text-anchor='end'"))
    for number, one in enumerate(series):
        parts.append(_path(chart, one, (low, high), span, COLOURS[number % len(COLOURS)]))
    return parts + _legend(box, [one.name for one in series])


def _path(chart: Box, one: Series, limits: tuple[float, float], span: Span, colour: str) -> str:
    """Draw a series as a line, with a gap if points are missing."""
    moves, before_s = "", 0.0
    for t_s, value in one.points:
        x = chart.x + chart.width * (t_s - span.begin_s) / (span.end_s - span.begin_s)
        y = chart.y + chart.height * (limits[1] - value) / (limits[1] - limits[0])
        moves += f"{'L' if t_s - before_s < 1.5 * STEP_S else 'M'}{x:.0f} {y:.1f}"
        before_s = t_s
    return f"<path d='{moves}' fill='none' stroke='{colour}' stroke-width='1.3'/>"


def _legend(box: Box, names: Sequence[str]) -> list[str]:
    parts, x = [], 14.0
    for number, name in enumerate(names):
        if x + 14 + 6 * len(name) > box.width:
            parts.append(box.say(x, box.height - 14, "…", "#999", 10))
            break
        fill = COLOURS[number % len(COLOURS)]
        parts.append(
            f"<rect x='{box.x + x:.0f}' y='{box.y + box.height - 21:.0f}' width='8' height='3' fill='{fill}'/>"
        )
        parts.append(box.say(x + 12, box.height - 14, name, "#999", 10))
        x += 24 + 6 * len(name)
    return parts


def _stat(box: Box, panel: Mapping[str, Any], series: list[Series], _span: Span) -> list[str]:
    """Draw the newest values in large letters."""
    unit, parts = panel["fieldConfig"]["defaults"]["unit"], []
    for number, one in enumerate(series):
        x = box.width * (number + 0.5) / len(series)
        words = shown(one.points[-1][1], unit)
        parts.append(box.say(x, box.height - 42, words, COLOURS[0], 24, "text-anchor='middle'"))
        parts.append(box.say(x, box.height - 18, one.name, "#999", 11, "text-anchor='middle'"))
    return parts or _nothing(box)


def _table(box: Box, _panel: Mapping[str, Any], series: list[Series], _span: Span) -> list[str]:
    """Draw a row of text for each series."""
    return [box.say(14, 52 + 22 * number, one.name, "#ccccdc", 11) for number, one in enumerate(series)]


def _heatmap(box: Box, panel: Mapping[str, Any], series: list[Series], span: Span) -> list[str]:
    """Return the counts of each bucket. The buckets of Prometheus contain the counts of all lower buckets."""
    rows = sorted((one for one in series if one.name != "+Inf"), key=lambda one: float(one.name))
    if not rows:
        return _nothing(box)
    chart, unit = box.chart(), panel["fieldConfig"]["defaults"]["unit"]
    below: Mapping[float, float] = {}
    height = chart.height / len(rows)
    counts = []
    for number, one in enumerate(rows):
        now = dict(one.points)
        counts += [
            (t_s, number, value - below.get(t_s, 0.0)) for t_s, value in now.items() if t_s < span.end_s - STEP_S
        ]
        below = now
    most = max(count for _, _, count in counts) or 1.0
    width = chart.width * STEP_S / (span.end_s - span.begin_s)
    parts = [
        f"<rect x='{chart.x + chart.width * (t_s - span.begin_s) / (span.end_s - span.begin_s):.1f}' "
        f"y='{chart.y + chart.height - height * (number + 1):.1f}' width='{width:.1f}' height='{height:.1f}' "
        f"fill='#f2cc0c' fill-opacity='{min(0.15 + count / most, 1):.2f}'/>"
        for t_s, number, count in counts
        if count > 0
    ]
    for number in (0, len(rows) // 2, len(rows) - 1):
        y = chart.y + chart.height - height * number - box.y
        parts.append(box.say(58, y, shown(float(rows[number].name), unit), "#999", 10, "text-anchor='end'"))
    return parts


KINDS: Final = {"timeseries": _lines, "stat": _stat, "table": _table, "heatmap": _heatmap}


def main() -> None:
    """Write the picture."""
    arguments = argparse.ArgumentParser(description="Write docs/pictures/dashboard.svg.")
    arguments.add_argument("--seconds", type=float, default=SECONDS)
    parts, height = observed(arguments.parse_args().seconds)
    width = 24 * CELL_X
    ground = f"<rect width='{width}' height='{height}' fill='#111217'/>"
    FILE.write_text(svg(width, height, "The dashboard on a daemon with two simulated sensors", [ground, *parts]))


if __name__ == "__main__":
    main()
