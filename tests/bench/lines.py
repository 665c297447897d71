"""GPIO lines: CPU time per edge, delay of triggers, and the reason why the ioctl of a trigger keeps the GIL."""

import asyncio
import ctypes
import os
import threading
import time
from collections.abc import Callable, Sequence
from statistics import mean

from gpiod.edge_event import EdgeEvent

from imud.contracts.lines import TriggerStamp
from imud.lines.gpio import EVENT, READ_EVENTS, LineEventDecoder
from imud.lines.trigger import Trigger
from imud.model.units import NS_PER_S, NS_PER_US
from tests.bench.rows import Row

FIONREAD = 0x541B
"""An ioctl that a pipe answers immediately, like a GPIO controller in the processor."""


class PipeLine:
    title = "pipe"

    def __init__(self, ioctl: Callable[..., int]) -> None:
        self._ioctl = ioctl
        self._ends: tuple[int, int] = (-1, -1)
        self._answer = ctypes.byref(ctypes.c_int())

    def open(self) -> None:
        self._ends = os.pipe()

    def set(self, _active: bool) -> None:
        self._ioctl(self._ends[0], FIONREAD, self._answer)

    def close(self) -> None:
        for end in self._ends:
            os.close(end)


def _per_edge_us(read: Callable[[], object], edges: int, times: int) -> float:
    """Return the CPU time per edge, µs, best of five runs."""
    best = float("inf")
    for _ in range(5):
        begin_ns = time.thread_time_ns()
        for _ in range(times):
            read()
        best = min(best, (time.thread_time_ns() - begin_ns) / times / edges)
    return best / NS_PER_US


def _reading(quick: bool) -> list[Row]:
    near, far = os.pipe()
    events, times = LineEventDecoder(), 200 if quick else 2000
    found = []
    for count in (2, READ_EVENTS):
        # two edges of a pulse, and the maximum number of edges in one read
        data = b"".join(EVENT.pack(n, 1, 0, n, n) for n in range(1, count + 1))

        def read(data: bytes = data) -> None:
            os.write(far, data)
            events.decode(os.read(near, READ_EVENTS * EVENT.size))

        found.append(
            Row(f"{count} edges per read, CPU per edge (includes the write)", _per_edge_us(read, count, times), "us")
        )
    found.append(
        Row("object of gpiod for an edge, CPU", _per_edge_us(lambda: EdgeEvent(1, 1, 0, 1, 1), 1, times), "us")
    )
    os.close(near)
    os.close(far)
    return found


async def _trigger(
    rate_hz: float, seconds: float, library: type[ctypes.CDLL], busy: bool
) -> tuple[Trigger, Sequence[TriggerStamp], float]:
    line = PipeLine(library(None).ioctl)
    line.open()
    trigger, stamps, stop = Trigger(line, rate_hz, time.monotonic_ns), list[TriggerStamp](), threading.Event()
    load = threading.Thread(target=_compute, args=(stop,))
    if busy:
        load.start()
    begin_s = time.process_time()
    trigger.start(stamps.extend, print)
    await asyncio.sleep(seconds)
    trigger.stop()
    used_s = time.process_time() - begin_s
    stop.set()
    if busy:
        load.join()
    line.close()
    return trigger, stamps, used_s


def _compute(stop: threading.Event) -> None:
    while not stop.is_set():
        sum(range(1000))


def rows(*, quick: bool = False) -> list[Row]:
    seconds = 2.0 if quick else 10.0
    found = _reading(quick)
    for rate_hz in (100.0, 1000.0):
        trigger, stamps, used_s = asyncio.run(_trigger(rate_hz, seconds, ctypes.PyDLL, False))
        counts, title = trigger.counts, f"SIN at {rate_hz:g} Hz"
        found += [
            Row(f"{title}: from deadline to edge, mean", counts.mean_late_ns / NS_PER_US, "us"),
            Row(f"{title}: worst", counts.worst_late_ns / NS_PER_US, "us"),
            Row(f"{title}: error of the time stamp, mean", mean(stamp.err_ns for stamp in stamps) / NS_PER_US, "us"),
            Row(f"{title}: deadlines missed", 100 * counts.missed / (counts.missed + counts.edges), "%"),
            Row(f"{title}: CPU per edge", used_s / counts.edges * NS_PER_S / NS_PER_US, "us"),
        ]
    # PyDLL keeps the GIL during the ioctl, CDLL releases it
    for name, library in (("GIL kept", ctypes.PyDLL), ("GIL released", ctypes.CDLL)):
        _, stamps, _ = asyncio.run(_trigger(40.0, seconds, library, True))
        error_us = mean(stamp.err_ns for stamp in stamps) / NS_PER_US
        found.append(Row(f"SIN beside a computing thread, {name}: error of the time stamp", error_us, "us"))
    return found
