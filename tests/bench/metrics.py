"""Cost of one scrape: CPU time, and the longest delay of a busy event loop.

A loop in the main thread runs without a pause while another thread renders the page. The delay is the longest time
between two turns of this loop.
"""

import asyncio
import time
from collections.abc import Callable, Iterator
from functools import partial
from threading import Event, Thread

from imud.formats.slot import encode_slot
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS
from imud.publishers.metrics.metric import Snapshot
from imud.publishers.metrics.publisher import Renderer, pause
from imud.publishers.metrics.rings import SAMPLES_MAX, motion_of
from tests.bench.rows import Row, at_most
from tests.support.metrics import client, equipped

STALL_MS_MAX = 1.0
"""Maximum delay of the loop, ms. At 1 kHz, a shorter delay affects one wake-up and causes no loss."""


def snapshot(devices: int) -> Snapshot:
    """Return a status with `devices` devices with all optional parts, and ten clients."""
    return Snapshot(
        tuple(equipped(f"imu{n}", n) for n in range(devices)), tuple(client(n, sent=5) for n in range(10)), (), 1
    )


def render_ms(devices: int, repeats: int) -> tuple[float, int]:
    """Return the CPU time of one rendering without pauses, ms, best of `repeats`, and the size in bytes."""
    renderer, shown = Renderer(pause=lambda: None), snapshot(devices)
    best_ns, size = 1 << 62, 0
    for _ in range(repeats):
        begin_ns = time.thread_time_ns()
        size = len(renderer.render(shown, "").body)
        best_ns = min(best_ns, time.thread_time_ns() - begin_ns)
    return best_ns / 1e6, size


async def stalls_ms(work: Callable[[], object], repeats: int) -> list[float]:
    longest = []
    for _ in range(repeats):
        # the thread waits for `go`, so that its start is not part of the delay
        go = Event()
        thread = Thread(target=lambda go=go: (go.wait(), work()))
        thread.start()
        worst_ns, last_ns = 0, time.perf_counter_ns()
        go.set()
        while thread.is_alive():
            await asyncio.sleep(0)
            now_ns = time.perf_counter_ns()
            worst_ns, last_ns = max(worst_ns, now_ns - last_ns), now_ns
        longest.append(worst_ns / 1e6)
    return sorted(longest)


def wall_ms(renderer: Renderer, shown: Snapshot) -> float:
    begin_ns = time.perf_counter_ns()
    renderer.render(shown, "")
    return (time.perf_counter_ns() - begin_ns) / 1e6


def motion_slots() -> bytes:
    return b"".join(
        encode_slot(
            Sample("bow", n, n * NS_PER_MS, 1, Sync.ARRIVAL, 0, 0, accel_m_s2=(0.1 * (n % 7), 0.2, 9.8)), 0
        )
        for n in range(1, SAMPLES_MAX + 1)
    )  # fmt: skip


def motion_ms(slots: bytes, repeats: int) -> float:
    """Return the CPU time of the motion of one device, ms, best of `repeats`."""
    best_ns = 1 << 62
    for _ in range(repeats):
        begin_ns = time.thread_time_ns()
        motion_of(slots, 0)
        best_ns = min(best_ns, time.thread_time_ns() - begin_ns)
    return best_ns / 1e6


def stall_rows(name: str, stalls: list[float], limit_ms: float | None = None) -> Iterator[Row]:
    best, median = stalls[0], stalls[len(stalls) // 2]
    yield at_most(f"{name}, best run", best, "ms", limit_ms) if limit_ms else Row(f"{name}, best run", best, "ms")
    yield Row(f"{name}, median run", median, "ms")


def rows(quick: bool = False) -> Iterator[Row]:
    repeats = 10 if quick else 60
    yield from stall_rows(
        "metrics: loop stall without scrape", asyncio.run(stalls_ms(lambda: time.sleep(0.01), repeats))
    )
    for devices in (1, 16):
        cpu_ms, size = render_ms(devices, repeats)
        yield Row(f"metrics: render {devices} devices, CPU", cpu_ms, "ms")
        yield Row(f"metrics: render {devices} devices, size", size / 1000, "kB")
        shown = snapshot(devices)
        yield Row(f"metrics: render {devices} devices, wall with pauses", wall_ms(Renderer(), shown), "ms")
        straight = asyncio.run(stalls_ms(partial(Renderer(pause=lambda: None).render, shown, ""), repeats))
        yield from stall_rows(f"metrics: loop stall, {devices} devices, no pauses", straight)
        paused = asyncio.run(stalls_ms(partial(Renderer().render, shown, ""), repeats))
        yield from stall_rows(f"metrics: loop stall, {devices} devices", paused, STALL_MS_MAX)
    slots = motion_slots()
    yield Row(f"metrics: motion of a device, {SAMPLES_MAX} samples, CPU", motion_ms(slots, repeats), "ms")
    moving = asyncio.run(stalls_ms(partial(motion_of, slots, 0, lambda _: pause()), repeats))
    yield from stall_rows("metrics: loop stall, motion of a device", moving, STALL_MS_MAX)
