"""Number of devices at 1 kHz that imud serves on one core without lost samples: `make bench ARGS=devices`."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from tests.bench.rig import Load, run
from tests.bench.rows import Row, at_least, at_most

RSS_LIMIT_MB = 40.0  # goal with one device
FLEETS = (0.0, (1, 4, 16, 32, 48, 64), 32), (10.0, (80, 112, 160, 200, 250), 250)
"""Latency, ms; numbers of devices; goal on one core."""
APART_FRAMES = 200
"""Number of frames between the starts of two devices. A clock needs more CPU time until its fit has settled. On a real
gateway, imud also detects the devices one after another."""


def rows(*, quick: bool = False) -> Iterator[Row]:
    for latency_ms, sizes, aim in FLEETS:
        yield from growth(2.0 if quick else 4.0, latency_ms, sizes, aim)


def growth(seconds: float, latency_ms: float, sizes: Sequence[int], aim: int) -> Iterator[Row]:
    """Yield the CPU time by number of devices, and the largest number of devices on one core without lost samples."""
    most, load = 0, Load(seconds=seconds, phases=4, latency_ms=latency_ms or None)
    loads = [replace(load, devices=aim, bare=True), *(replace(load, devices=devices) for devices in sizes)]
    if latency_ms:  # the measurement begins after the start of the last device
        loads = [replace(one, apart=APART_FRAMES, warm_s=4.0 + one.devices * APART_FRAMES / 1e3) for one in loads]
    for one in loads:
        outcome = run(one)
        words = f"{one.devices} devices at 1 kHz, latency {latency_ms:g} ms{', bare loop' * one.bare}"
        yield Row(f"{words}: CPU per sample", outcome.cpu_us_per_sample, "µs")
        yield Row(f"{words}: share of one core", outcome.cpu_share, "")
        if one.bare:
            continue
        yield Row(f"{words}: samples lost", float(outcome.lost), "samples")
        if one.devices == 1:
            yield at_most(f"{words}: RSS", outcome.rss_mb, "MB", RSS_LIMIT_MB)
        if outcome.lost:  # more devices would only increase the loss
            break
        most = one.devices
    words = f"latency {latency_ms:g} ms, largest number without a loss: devices on one core"
    yield at_least(words, float(most), "", aim)
