"""CPU time and latency of imud and the bare loop: pty → decode → clock → shared memory → socket client, in one run."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from tests.bench.rig import Load, Outcome, run
from tests.bench.rows import Row, at_least, at_most

CPU_LIMITS = {1: 1.6, 10: 1.5, 100: 2.0}  # goals: imud / bare loop by number of clients
P99_LIMIT = 2.0  # goal: p99 of imud / bare loop
DEVICES_AIM = 32
RSS_LIMIT_MB = 45.0  # goal with one device


def rows(*, quick: bool = False) -> Iterator[Row]:
    seconds = 2.0 if quick else 6.0
    for encoding in ("binary", "json"):
        for clients in (1, 10) if quick else (1, 10, 100):
            yield from compare(Load(clients=clients, encoding=encoding, seconds=seconds), rounds=1 if quick else 3)
    yield from growth(seconds, (1, 16, 48) if quick else (1, 4, 16, 32, 48, 64))


def compare(load: Load, rounds: int) -> Iterator[Row]:
    pairs = [(run(load), run(replace(load, bare=True))) for _ in range(rounds)]
    # the best of the rounds: other programs on the host only increase CPU time and latency
    imud = min((a for a, _ in pairs), key=lambda o: o.cpu_us_per_sample)
    bare = min((b for _, b in pairs), key=lambda o: o.cpu_us_per_sample)
    name = f"1 kHz, {load.clients} {load.encoding} clients"
    for who, outcome in (("bare loop", bare), ("imud", imud)):
        yield Row(f"{name}: CPU per sample, {who}", outcome.cpu_us_per_sample, "us")
    yield at_most(f"{name}: CPU ratio", imud.cpu_us_per_sample / bare.cpu_us_per_sample, "x", CPU_LIMITS[load.clients])
    quiet_imud = min((a for a, _ in pairs), key=lambda o: o.p99_us)
    quiet_bare = min((b for _, b in pairs), key=lambda o: o.p99_us)
    for who, outcome in (("bare loop", quiet_bare), ("imud", quiet_imud)):
        yield Row(f"{name}: latency p50, {who}", outcome.p50_us, "us")
        yield Row(f"{name}: latency p99, {who}", outcome.p99_us, "us")
        yield Row(f"{name}: latency max, {who}", outcome.max_us, "us")
    yield at_most(f"{name}: p99 ratio", quiet_imud.p99_us / quiet_bare.p99_us, "x", P99_LIMIT)
    yield at_most(f"{name}: samples lost, imud", float(max(a.lost for a, _ in pairs)), "samples", 0)


def many(devices: int, seconds: float) -> tuple[Outcome, Outcome]:
    load = Load(devices=devices, seconds=seconds, phases=4)
    return run(load), run(replace(load, bare=True))


def growth(seconds: float, sizes: Sequence[int]) -> Iterator[Row]:
    """Yield the CPU time by number of devices, and the largest number of devices on one core without lost samples."""
    most = 0
    for devices in sizes:
        imud, bare = many(devices, seconds)
        yield Row(f"{devices} devices at 1 kHz: CPU per sample, imud", imud.cpu_us_per_sample, "us")
        yield Row(f"{devices} devices at 1 kHz: CPU per sample, bare loop", bare.cpu_us_per_sample, "us")
        yield Row(f"{devices} devices at 1 kHz: share of one core, imud", imud.cpu_share, "")
        yield Row(f"{devices} devices at 1 kHz: samples lost, imud", float(imud.lost), "samples")
        yield Row(f"{devices} devices at 1 kHz: RSS, imud", imud.rss_mb, "MB")
        if imud.lost == 0:
            most = devices
        if devices == 1:
            yield at_most("RSS with 1 device", imud.rss_mb, "MB", RSS_LIMIT_MB)
    yield at_least("devices at 1 kHz on one core without loss", float(most), "devices", DEVICES_AIM)
