"""`make soak ARGS=--single`: one device at 1 kHz, ten clients, one stuck client. No loss, and memory must not grow."""

import tempfile
from contextlib import ExitStack
from pathlib import Path
from time import monotonic, sleep

from tests.bench.rig import Load, ask, rss_mb, start_readers, start_server, start_writer

SLOPE_LIMIT_MB_PER_H = 2.0
SETTLE_S = 20.0  # start-up is not part of the slope


def slope_mb_per_h(points: list[tuple[float, float]]) -> float:
    """Return the least-squares slope of resident memory, MB/h."""
    n = len(points)
    mean_t = sum(t for t, _ in points) / n
    mean_m = sum(m for _, m in points) / n
    spread = sum((t - mean_t) ** 2 for t, _ in points)
    return 3600 * sum((t - mean_t) * (m - mean_m) for t, m in points) / spread if spread else 0.0


def run_single(seconds: float) -> int:
    load = Load(clients=10, seconds=seconds, stuck=True)
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-soak-") as name, ExitStack() as stack:
        folder = Path(name)
        writer = start_writer(stack, folder, load)
        server = start_server(stack, folder, writer.line().split(), load)
        readers = start_readers(stack, folder, load)
        writer.say("go")
        points: list[tuple[float, float]] = []
        begun = monotonic()
        while (elapsed := monotonic() - begun) < seconds:
            sleep(min(1.0, seconds - elapsed + 0.01))
            if elapsed > SETTLE_S:
                points.append((elapsed, rss_mb(server.popen.pid)))
        refused = int(writer.line())
        sleep(0.1)
        status = ask(folder / "s")[0]
        readers.say("end")
        figures = readers.line()
    lost = sum(v for k, v in status.ledger.items() if k.startswith("lost_"))
    slope = slope_mb_per_h(points) if len(points) > 1 else 0.0
    print(
        f"frames written {load.frames}, rejected by the pty {refused}, samples {status.ledger['samples']}, lost {lost}"
    )
    print(f"first client: {figures}")
    if points:
        print(
            f"RSS {points[0][1]:.2f} MB at {points[0][0]:.0f} s, {points[-1][1]:.2f} MB at the end, {slope:+.3f} MB/h"
        )
    good = lost == 0 and refused == 0 and status.ledger["samples"] == load.frames and slope < SLOPE_LIMIT_MB_PER_H
    print("passed" if good and '"gaps": 0' in figures else "FAILED")
    return 0 if good and '"gaps": 0' in figures else 1
