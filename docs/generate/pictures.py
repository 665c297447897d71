"""Draws the pictures of README.md and docs/frames.md: `python -m docs.generate.pictures` (`make pictures`).

`terminal.svg` shows the output of commands for a simulated device. `time_stamps.svg` shows a simulation with a known
truth: a device at 100 Hz behind a USB adapter that holds bytes for up to 16 ms. `frame_axes.svg` and
`frame_mountings.svg` of docs/frames.md show the rotations of imud.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from math import hypot
from pathlib import Path
from typing import NamedTuple

import msgspec

from imud.attitude.conventions import FLU_LEVEL, RFU_ENU, Convention, body_axes
from imud.attitude.published import matrix_from_axes
from imud.attitude.rotation import IDENTITY, Matrix3, matrix_times, transposed
from imud.cli.arguments import statuses
from imud.cli.demo import daemon, device, simulator
from imud.cli.status import page
from imud.client.connection import Client
from imud.model.sample import Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.ports.arrival import USB_16MS, ArrivalModel, Crystal
from tests.bench.clock import run
from tests.support.files import ROOT

FOLDER = ROOT / "docs/pictures"
NAMES = "font-family='DejaVu Sans, Verdana, sans-serif'"
RATE_HZ, SECONDS, SEED = 100, 60, 7
PORT = "/dev/ttyUSB0"
COMMANDS = ("devices", "status", "watch --rate 5 --count 6")


def svg(width: int, height: int, title: str, parts: Sequence[str]) -> str:
    head = f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width} {height}' width='{width}' height='{height}'>"
    return "\n".join([head, f"<title>{escape(title)}</title>", *parts, "</svg>", ""])


def text(x: float, y: float, words: str, more: str = "") -> str:
    return f"<text x='{x:.1f}' y='{y:.1f}' {NAMES} font-size='13' fill='#333' {more}>{escape(words)}</text>"


# --- the terminal -----------------------------------------------------------------------------------------------------


def terminal(lines: Sequence[str], title: str = "imud devices, status and watch in a terminal") -> str:
    step, left, top = 17, 14, 42
    width, height = left * 2 + round(max(map(len, lines)) * 7.25), top + step * len(lines)
    parts = [f"<rect width='{width}' height='{height}' rx='8' fill='#1d2430'/>"]
    parts += [
        f"<circle cx='{18 + 18 * i}' cy='16' r='5.5' fill='{fill}'/>"
        for i, fill in enumerate(("#ec6a5e", "#f4be4f", "#61c454"))
    ]
    for number, line in enumerate(lines):
        fill = "#8fd18f" if line.startswith("$ ") else "#dde3ec"
        parts.append(
            f"<text x='{left}' y='{top + step * number}' xml:space='preserve' fill='{fill}' font-size='12' "
            f"font-family='DejaVu Sans Mono, Menlo, Consolas, monospace'>{escape(line)}</text>"
        )
    return svg(width, height, title, parts)


def session() -> list[str]:
    """Return the commands and their output for a daemon with a simulated device."""
    lines: list[str] = []
    with tempfile.TemporaryDirectory(prefix="imud-") as name:
        folder = Path(name)
        with (
            simulator(folder, [("hipnuc-uart", 0)], RATE_HZ, ""),
            daemon(folder, {"bow": device(folder, "hipnuc-uart", "")}, 0),
        ):
            path = str(folder / "imud.sock")
            with Client(path, timeout_s=20) as client:
                for _ in zip(client.watch(), range(20 * RATE_HZ), strict=False):
                    pass
                found = [
                    msgspec.structs.replace(one, link=one.link.replace(str(folder / "port"), PORT))
                    for one in statuses(client)
                ]
            for words in COMMANDS:
                argv = [sys.executable, "-m", "imud", *words.split(), "--socket", path]
                done = subprocess.run(argv, capture_output=True, text=True, timeout=30, check=True)
                said = done.stdout.replace(str(folder / "port"), PORT)
                if words == "status":  # the length of the port's name decides the line breaks
                    said = page(found)
                lines += [f"$ imud {words}", *said.splitlines(), ""]
    return lines[:-1]


# --- time stamp errors ------------------------------------------------------------------------------------------------


class Stamp(NamedTuple):
    t_s: float
    arrival_ms: float
    """Arrival time of the last byte minus true time, ms."""
    off_ms: float
    error_ms: float


def stamps(seconds: int = SECONDS) -> list[Stamp]:
    model = ArrivalModel(USB_16MS, RATE_HZ, SEED, Crystal(50.0), 115_200)
    arrivals = list(model.run(seconds * RATE_HZ))
    points = run(ArrivalModel(USB_16MS, RATE_HZ, SEED, Crystal(50.0), 115_200), seconds * RATE_HZ)
    begin = arrivals[0].t_ns
    return [
        Stamp(
            (a.t_ns - begin) / NS_PER_S,
            (a.t_rx_ns - a.t_ns) / NS_PER_MS,
            p.off_ns / NS_PER_MS,
            p.t_err_ns / NS_PER_MS,
        )
        for a, p in zip(arrivals, points, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class Panel:
    top: float
    low_ms: float
    high_ms: float
    step_ms: float
    left: float = 60.0
    width: float = 680.0
    height: float = 190.0
    seconds: float = SECONDS

    def x(self, t_s: float) -> float:
        return self.left + self.width * t_s / self.seconds

    def y(self, value_ms: float) -> float:
        inside = min(max(value_ms, self.low_ms), self.high_ms)
        return self.top + self.height * (self.high_ms - inside) / (self.high_ms - self.low_ms)

    def axes(self, title: str) -> Iterator[str]:
        yield text(self.left, self.top - 10, title, "font-weight='bold'")
        for number in range(round((self.high_ms - self.low_ms) / self.step_ms) + 1):
            value = self.low_ms + number * self.step_ms
            dark = "#888" if value == 0 else "#ddd"
            yield self._line(self.left, self.y(value), self.left + self.width, self.y(value), dark)
            yield text(self.left - 8, self.y(value) + 4, f"{value:g} ms", "text-anchor='end'")
        for t_s in range(0, round(self.seconds) + 1, 10):
            yield text(self.x(t_s), self.top + self.height + 18, f"{t_s} s", "text-anchor='middle'")

    def dots(self, points: Sequence[tuple[float, float]], fill: str) -> str:
        moves = "".join(f"M{self.x(t):.1f} {self.y(v):.1f}h0" for t, v in points)
        return f"<path d='{moves}' stroke='{fill}' stroke-width='1.7' stroke-linecap='round'/>"

    def band(self, points: Sequence[tuple[float, float]], fill: str) -> str:
        upper = [f"{self.x(t):.1f} {self.y(v):.1f}" for t, v in points]
        lower = [f"{self.x(t):.1f} {self.y(-v):.1f}" for t, v in reversed(points)]
        return f"<path d='M{' L'.join([*upper, *lower])}z' fill='{fill}'/>"

    def _line(self, x1: float, y1: float, x2: float, y2: float, stroke: str) -> str:
        return f"<path d='M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}' stroke='{stroke}' stroke-width='1'/>"


def time_stamps(samples: Sequence[Stamp]) -> str:
    """Draw arrival times at the top and time stamps of imud at the bottom, both relative to the true time."""
    above, below = Panel(top=40, low_ms=0, high_ms=25, step_ms=5), Panel(top=300, low_ms=-4, high_ms=4, step_ms=2)
    drawn = samples[::3]  # a file of 80 kB; every third sample is not in step with the timer
    parts = [
        "<rect width='760' height='540' fill='#fff'/>",
        *above.axes("Arrival of a sample's last byte: 7 to 24 ms after the measurement"),
        above.dots([(s.t_s, s.arrival_ms) for s in drawn], "#c0392b"),
        *below.axes("Error of the time stamp t_ns (dots), and the error that imud states, ±t_err_ns (band)"),
        below.band([(s.t_s, s.error_ms) for s in samples[::10]], "#cfe3f7"),
        below.dots([(s.t_s, s.off_ms) for s in drawn], "#1f5fa8"),
    ]
    return svg(760, 540, "Error of time stamps behind a USB adapter with a latency timer of 16 ms", parts)


# --- axes and mountings -----------------------------------------------------------------------------------------------

COLOURS = ("#c0392b", "#2e8b57", "#1f5fa8")
FORWARD, LEFT, UP = (0.80, -0.42), (-0.76, -0.34), (0.0, -0.95)
"""Directions of the axes of the body on the page, per unit of length."""
BODY_PANEL, MOUNTING_PANEL = (250, 275), (250, 260)


def on_page(vector: Vector3, scale: float) -> tuple[float, float]:
    """Return the place of a body vector (x forward, y left, z up) on the page, seen from behind, right and above."""
    x, y, z = vector
    return (
        scale * (x * FORWARD[0] + y * LEFT[0] + z * UP[0]),
        scale * (x * FORWARD[1] + y * LEFT[1] + z * UP[1]),
    )


def arrow(centre: tuple[float, float], vector: Vector3, scale: float, label: str, fill: str) -> Iterator[str]:
    dx, dy = on_page(vector, scale)
    x, y = centre[0] + dx, centre[1] + dy
    length = hypot(dx, dy)
    ux, uy = dx / length, dy / length
    head = [(x, y), (x - 11 * ux - 4.5 * uy, y - 11 * uy + 4.5 * ux), (x - 11 * ux + 4.5 * uy, y - 11 * uy - 4.5 * ux)]
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in head)
    line = f"M{centre[0]:.1f} {centre[1]:.1f}L{x - 8 * ux:.1f} {y - 8 * uy:.1f}"
    yield f"<path d='{line}' stroke='{fill}' stroke-width='3'/>"
    yield f"<polygon points='{points}' fill='{fill}'/>"
    yield text(x + 13 * ux, y + 13 * uy + 5, label, f"text-anchor='middle' style='fill:{fill};font-weight:bold'")


def block(centre: tuple[float, float], mounting: Matrix3, size: Vector3, scale: float, fill: str) -> Iterator[str]:
    corners = {
        (i, j, k): on_page(matrix_times(mounting, (i * size[0], j * size[1], k * size[2])), scale)
        for i in (-1, 1)
        for j in (-1, 1)
        for k in (-1, 1)
    }
    faces = []
    for axis in range(3):
        for side in (-1, 1):
            normal = [0.0, 0.0, 0.0]
            normal[axis] = side
            outward = matrix_times(mounting, (normal[0], normal[1], normal[2]))
            if outward[0] * -0.55 + outward[1] * -0.55 + outward[2] * 0.6 > 0.01:  # towards the viewer
                faces.append([corners[key] for key in _around(axis, side)])
    for face in faces:
        points = " ".join(f"{centre[0] + x:.1f},{centre[1] + y:.1f}" for x, y in face)
        yield f"<polygon points='{points}' fill='{fill}' fill-opacity='0.75' stroke='#555' stroke-linejoin='round'/>"


def _around(axis: int, side: int) -> list[tuple[int, int, int]]:
    found = []
    for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1)):
        key = [a, b]
        key.insert(axis, side)
        found.append((key[0], key[1], key[2]))
    return found


def columns(matrix: Matrix3) -> Matrix3:
    return transposed(matrix)


def axes_panel(left: float, title: str, lines: Sequence[str], to_body: Matrix3) -> Iterator[str]:
    centre = (left + BODY_PANEL[0] / 2, 132.0)
    yield text(left + 12, 24, title, "style='font-weight:bold'")
    yield from block(centre, IDENTITY, (0.45, 0.28, 0.12), 70, "#e8edf3")
    nose = on_page((0.45, 0.0, 0.12), 70)
    yield f"<circle cx='{centre[0] + nose[0]:.1f}' cy='{centre[1] + nose[1]:.1f}' r='4' fill='#555'/>"
    for axis, name, fill in zip(columns(to_body), "xyz", COLOURS, strict=True):
        yield from arrow(centre, axis, 84, name, fill)
    for number, line in enumerate(lines):
        yield text(left + 12, 258 + 18 * number, line)


def frame_axes() -> str:
    panels = (
        ("HiPNUC, as sent", ("roll about y: right side down", "pitch about x: nose up", "yaw 0 north, + to the left"),
         RFU_ENU.to_body),
        ("IMU61x, as sent (assumed)", ("roll about x: left side up", "pitch about y: nose down", "yaw + to the left"),
         FLU_LEVEL.to_body),
        ("enu-flu", ("roll about x: left side up", "pitch about y: nose down", "yaw 0 east, + to the left"),
         transposed(body_axes(Convention.ENU_FLU))),
        ("ned-frd", ("roll about x: right side down", "pitch about y: nose up", "yaw 0 north, + to the right"),
         transposed(body_axes(Convention.NED_FRD))),
    )  # fmt: skip
    width, height = BODY_PANEL[0] * len(panels), BODY_PANEL[1] + 40
    parts = [f"<rect width='{width}' height='{height}' fill='#fff'/>"]
    for number, (title, lines, to_body) in enumerate(panels):
        parts += axes_panel(BODY_PANEL[0] * number, title, lines, to_body)
    return svg(
        width, height, "Axes of devices and of both conventions; the dot is the front, positive angles below", parts
    )


MOUNTINGS = (
    ("lies straight", "x", "y", "z"),
    ("upside down", "x", "-y", "-z"),
    ("turned 90° to the left", "-y", "x", "z"),
    ("turned 90° to the right", "y", "-x", "z"),
    ("on its right side", "x", "-z", "y"),
    ("its x axis points up", "-z", "y", "x"),
)
"""Title and `axes` of a sensor. Its own axes are x forward, y left, z up on its top."""


def frame_mountings() -> str:
    """Draw sensors with their printed axes in a body that points to the upper right."""
    per_row = 3
    rows = -(-len(MOUNTINGS) // per_row)
    width, height = MOUNTING_PANEL[0] * per_row, MOUNTING_PANEL[1] * rows
    parts = [f"<rect width='{width}' height='{height}' fill='#fff'/>"]
    for number, (title, x, y, z) in enumerate(MOUNTINGS):
        left, top = MOUNTING_PANEL[0] * (number % per_row), MOUNTING_PANEL[1] * (number // per_row)
        centre = (left + MOUNTING_PANEL[0] / 2, top + 118.0)
        matrix = matrix_from_axes(x, y, z)
        parts.append(text(left + 12, top + 22, title, "style='font-weight:bold'"))
        parts += arrow((left + 22, top + 212), (1.0, 0.0, 0.0), 46, "front", "#999")
        parts += block(centre, matrix, (0.45, 0.35, 0.12), 70, "#f3ecd9")
        for axis, name, fill in zip(columns(matrix), "xyz", COLOURS, strict=True):
            parts += arrow(centre, axis, 74, name, fill)
        parts.append(text(left + 12, top + 240, f"axes: {{x: {x}, y: {y}, z: {z}}}"))
    return svg(
        width, height, "Mountings of a sensor and the axes to configure; x, y, z are printed on the sensor", parts
    )


if __name__ == "__main__":
    (FOLDER / "frame_axes.svg").write_text(frame_axes())
    (FOLDER / "frame_mountings.svg").write_text(frame_mountings())
    (FOLDER / "terminal.svg").write_text(terminal(session()))
    (FOLDER / "time_stamps.svg").write_text(time_stamps(stamps()))
