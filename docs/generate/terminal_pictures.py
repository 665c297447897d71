"""Draws pictures of docs/recording.md and docs/views.md: `python -m docs.generate.terminal_pictures` (`make pictures`).

`recording_info.svg`: output of `imud info` for a recording of two simulated devices. `top.svg` and `top_device.svg`:
the two screens of `imud top` with the same daemon. `flight.svg`: the flight recorder of a daemon with a device that
hits an obstacle: the samples of the device, and the content of the snapshot.
"""

import asyncio
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from math import exp, hypot, sin
from pathlib import Path
from secrets import token_hex

import msgspec

from docs.generate.pictures import FOLDER, svg, terminal, text
from imud.cli.top import TopApp, TopFeed
from imud.contracts.publisher import Batch
from imud.drivers.hipnuc.uart.codec import encode_hi91
from imud.formats.recording import RecordingReader
from imud.formats.records import Kind
from imud.model.event import EventKind
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.recording.player import Player
from tests.support.daemon_process import RunningDaemon, running_daemon
from tests.support.files import CaptureWriter

MODULES = {
    "bow": ("hipnuc-uart", "/dev/ttyUSB0", "--rate", "100"),
    "mast": ("imu61x-uart", "/dev/ttyUSB1", "--rate", "100", "--faults", "cut=0.002,flip=0.002"),
}
RUN_S, LIMIT_S = 20.0, 60.0
SIZE = (80, 24)

# --- the terminal -----------------------------------------------------------------------------------------------------


@contextmanager
def modules() -> Iterator[dict[str, dict[str, object]]]:
    with ExitStack() as stack:
        devices: dict[str, dict[str, object]] = {}
        for name, (driver, shown, *options) in MODULES.items():
            port = f"/tmp/tty{token_hex(2)}"
            assert len(port) == len(shown), "the lines of the pages would get another length"
            argv = [sys.executable, "-m", "imud.sim", "--device", driver, "--path", port, *options]
            process = subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            stack.enter_context(process)
            stack.callback(process.communicate, timeout=LIMIT_S)
            assert process.stdout is not None
            assert process.stdout.readline()
            devices[name] = {"driver": driver, "uart": {"port": port, "baud": 115200}}
        yield devices


def renamed(words: str, devices: dict[str, dict[str, object]]) -> str:
    for name, device in devices.items():
        port = msgspec.convert(device["uart"], dict[str, str | int])["port"]
        words = words.replace(str(port), MODULES[name][1])
    return words


async def screens(daemon: RunningDaemon) -> tuple[str, str]:
    app = TopApp(TopFeed(str(daemon.socket)))
    async with app.run_test(size=SIZE) as pilot:
        await pilot.pause(RUN_S / 2)
        overview = app.export_screenshot(title="imud top")
        await pilot.press("down", "enter")  # the device with faults, which has events
        await pilot.pause(RUN_S)
        page = app.export_screenshot(title="imud top: Enter")
        await pilot.press("p")  # do not draw while the screens close
        return overview, page


def offline(picture: str) -> str:
    picture = re.sub(r"@font-face\s*\{.*?\}", "", picture, flags=re.DOTALL)
    assert "http" not in picture.replace("http://www.w3.org/2000/svg", "").replace("https://www.textualize.io", "")
    return picture.replace("Fira Code", "DejaVu Sans Mono")


def live_pictures() -> Iterator[tuple[str, str]]:
    with tempfile.TemporaryDirectory(prefix="imud-") as made:
        folder = Path(made)
        recorder = {"enabled": True, "directory": str(folder / "recordings")}
        with (
            modules() as devices,
            running_daemon(
                folder, devices, limit_s=LIMIT_S, python=(), log_level="info", metrics={"enabled": False},
                recorder=recorder,
            ) as daemon,
        ):  # fmt: skip
            overview, page = asyncio.run(screens(daemon))
        yield "top.svg", offline(renamed(overview, devices))
        yield "top_device.svg", offline(renamed(page, devices))
        (file,) = (folder / "recordings").glob("*.imudrec")
        argv = [sys.executable, "-m", "imud", "info", file.name]
        done = subprocess.run(argv, capture_output=True, text=True, timeout=LIMIT_S, check=True, cwd=file.parent)
        lines = [f"$ imud info {file.name}", *renamed(done.stdout, devices).splitlines()]
        yield "recording_info.svg", terminal(lines, "imud info of a recording")


# --- the flight recorder ----------------------------------------------------------------------------------------------

RATE_HZ, SENT_S, HIT_S = 100, 36, 24.0
KEPT_S, AFTER_S, BOUND_M_S2 = 12.0, 5.0, 40.0
HIT_M_S2, DECAY_S, RING_RAD_S = 75.0, 0.4, 70.0


@dataclass
class Flight:
    sent: list[Sample] = field(default_factory=list)
    saved: list[Sample] = field(default_factory=list)
    begins_ns: list[int] = field(default_factory=list)
    words: str = ""


def magnitude(sample: Sample) -> float:
    assert sample.accel_m_s2 is not None
    return hypot(*sample.accel_m_s2)


def hit_module(file: Path) -> None:
    """Return a device that moves slowly and hits an obstacle at HIT_S."""
    with file.open("wb") as out:
        writer = CaptureWriter(out, driver="hipnuc-uart", baud=115200)
        for number in range(SENT_S * RATE_HZ):
            t_s = number / RATE_HZ
            up = 9.8 + 0.8 * sin(2.1 * t_s) + 0.3 * sin(17 * t_s)
            if t_s >= HIT_S:
                up += HIT_M_S2 * exp((HIT_S - t_s) / DECAY_S) * abs(sin(RING_RAD_S * (t_s - HIT_S + 0.02)))
            frame = encode_hi91(
                system_time_ms=number * 1000 // RATE_HZ, accel_m_s2=(0.0, 0.0, up), gyro_rad_s=(0.0, 0.0, 0.0),
                mag_t=(0.0, 0.0, 0.0), euler_rad=(0.0, 0.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0),
                temperature_c=20.0, pressure_pa=1e5,
            )  # fmt: skip
            writer.write(frame, number * NS_PER_S // RATE_HZ + 8 * NS_PER_MS)


def flight() -> Flight:
    """Run the daemon with this device until a snapshot exists. Return the content of the snapshot."""
    found = Flight()
    with tempfile.TemporaryDirectory(prefix="imud-") as made:
        folder = Path(made)
        hit_module(folder / "capture")
        settings = {
            "enabled": True, "minutes": KEPT_S / 60, "after_s": AFTER_S, "acceleration_m_s2": BOUND_M_S2,
            "device_lost": False,
        }  # fmt: skip
        device = {"driver": "hipnuc-uart", "replay": {"path": str(folder / "capture"), "speed": "recorded"}}
        recorder = {"directory": str(folder / "recordings"), "flight": settings}
        more = {"log_level": "info", "metrics": {"enabled": False}, "recorder": recorder}
        with running_daemon(folder, {"bow": device}, limit_s=LIMIT_S, python=(), **more) as daemon:
            with daemon.client() as client, daemon.client() as listener:
                events = listener.events(timeout_s=LIMIT_S)
                for sample in client.watch(["bow"], timeout_s=LIMIT_S):
                    found.sent.append(sample)
                    if sample.t_ns - found.sent[0].t_ns > (SENT_S - 2) * NS_PER_S:
                        break
                event = next(one for one in events if one.kind is EventKind.RECORDER)
            found.words = event.message.partition(": ")[2]
            read_snapshot(Path(str(event.detail["file"])), found)
    return found


def read_snapshot(file: Path, found: Flight) -> None:
    segment_begins = False

    def publish(batch: Batch) -> None:
        nonlocal segment_begins
        if segment_begins:
            found.begins_ns.append(batch.samples[0].t_ns)
        segment_begins = False
        found.saved.extend(batch.samples)

    player = Player(publish)
    with file.open("rb") as opened:
        for record in RecordingReader(opened, file.name):
            segment_begins |= record.kind == Kind.PATH
            player.play([record])


@dataclass(frozen=True)
class Scale:
    zero_ns: int
    left: float = 56.0
    width: float = 680.0
    bottom: float = 250.0
    high: float = 190.0
    most_m_s2: float = 90.0

    def x(self, t_ns: int) -> float:
        return self.left + self.width * ((t_ns - self.zero_ns) / NS_PER_S + HIT_S) / SENT_S

    def y(self, value_m_s2: float) -> float:
        return self.bottom - self.high * min(value_m_s2, self.most_m_s2) / self.most_m_s2

    def curve(self, samples: list[Sample], stroke: str, width: float) -> str:
        points = " L".join(f"{self.x(one.t_ns):.1f} {self.y(magnitude(one)):.1f}" for one in samples)
        return f"<path d='M{points}' fill='none' stroke='{stroke}' stroke-width='{width}'/>"

    def line(self, x: float, top: float, stroke: str, dash: str = "") -> str:
        return (
            f"<path d='M{x:.1f} {top}V{self.bottom}' stroke='{stroke}' stroke-dasharray='{dash}' stroke-width='1.5'/>"
        )


def flight_svg(found: Flight) -> str:
    hit = next(one for one in found.sent if magnitude(one) > BOUND_M_S2)
    scale = Scale(hit.t_ns)
    begin, end = scale.x(found.saved[0].t_ns), scale.x(found.saved[-1].t_ns)
    edges = [*map(scale.x, found.begins_ns), end]
    parts = [
        "<rect width='760' height='345' fill='#fff'/>",
        text(
            scale.left, 24, "|a| of a module that hits something; in blue what the snapshot has", "font-weight='bold'"
        ),
        f"<rect x='{begin:.1f}' y='60' width='{end - begin:.1f}' height='190' fill='#eaf2fb'/>",
        *(text(scale.left - 8, scale.y(v) + 4, f"{v}", "text-anchor='end'") for v in (0, 20, 40, 60, 80)),
        text(scale.left - 44, 50, "m/s²"),
        f"<path d='M{scale.left} {scale.y(BOUND_M_S2):.1f}h{scale.width}' stroke='#c0392b' stroke-dasharray='5 4'/>",
        text(scale.left + 4, scale.y(BOUND_M_S2) - 5, f"acceleration_m_s2: {BOUND_M_S2:g}", "style='fill:#c0392b'"),
        scale.curve(found.sent, "#b5b5b5", 1.2),
        scale.curve(found.saved, "#1f5fa8", 1.2),
        scale.line(scale.x(hit.t_ns), 48, "#c0392b"),
        text(scale.x(hit.t_ns) + 5, 56, "alert", "style='fill:#c0392b'"),
        scale.line(end, 48, "#1f5fa8"),
        text(end + 5, 56, f"saved, after_s: {AFTER_S:g}", "style='fill:#1f5fa8'"),
        f"<path d='M{scale.left} {scale.bottom}h{scale.width}' stroke='#888'/>",
    ]
    for t_s in range(-20, 11, 5):
        x = scale.x(hit.t_ns + t_s * NS_PER_S)
        parts.append(text(x, scale.bottom + 18, f"{t_s} s", "text-anchor='middle'"))
    for number, (left, right) in enumerate(pairwise(edges), 1):
        parts.append(
            f"<rect x='{left:.1f}' y='284' width='{right - left:.1f}' height='24' fill='#cfe3f7' stroke='#1f5fa8'/>"
        )
        parts.append(text((left + right) / 2, 301, f"segment {number}", "text-anchor='middle'"))
    parts.append(text(scale.left, 333, f"event: {found.words}"))
    return svg(760, 345, "A snapshot of the flight recorder", parts)


if __name__ == "__main__":
    for name, content in live_pictures():
        (FOLDER / name).write_text(content)
    (FOLDER / "flight.svg").write_text(flight_svg(flight()))
