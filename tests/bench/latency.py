"""CPU time that a hold saves: imud and the bare loop, which reads and sends each sample immediately, alternating.

`make bench ARGS=latency`. Every round runs each load once, so that all loads have the same conditions. The rows show
the median of the ratios of all rounds. Shared memory uses its default of 5 ms unless a load requests a latency. The
bare loop with a wait before each read is the minimum for a Python process with batches, without clock, ledger and ring.
"""

from collections.abc import Iterator
from dataclasses import replace
from statistics import median

from tests.bench.rig import Load, Outcome, run
from tests.bench.rows import Row, at_least, at_most

CPU_AIM = 0.25  # goal: a quarter of the bare loop
DEVICES_AIM = 96  # goal on one core
LATENCY_MS = 10.0
# loads with the goal CPU_AIM
JUDGED = ("latency 10 ms", "at 100 Hz", "at 10 Hz, latency 20 ms")
FLEETS = (48, 64, 80, 96, 112)  # numbers of devices
APART_FRAMES = 50
"""Number of frames between the starts of two devices. A clock needs more CPU time until its fit has settled. On a real
gateway, imud also detects the devices one after another."""


def rows(*, quick: bool = False) -> Iterator[Row]:
    seconds, rounds = (2.0, 1) if quick else (4.0, 5)
    for encoding in ("binary", "json"):
        yield from compare(encoding, seconds, rounds)
    yield from fleets(seconds)


def compare(encoding: str, seconds: float, rounds: int) -> Iterator[Row]:
    at_once = Load(clients=10, encoding=encoding, seconds=seconds)
    loads = {
        "bare loop": replace(at_once, bare=True),
        "bare loop that waits 10 ms before a read": replace(at_once, bare=True, latency_ms=LATENCY_MS),
        "at once": at_once,
        "latency 10 ms": replace(at_once, latency_ms=LATENCY_MS),
        "at 100 Hz": replace(at_once, client_hz=100.0),
        "at 10 Hz, latency 20 ms": replace(at_once, client_hz=10.0, latency_ms=20.0),
    }
    found: dict[str, list[Outcome]] = {name: [] for name in loads}
    for _ in range(rounds):
        for name, load in loads.items():
            found[name].append(run(load))
    # the bare loop of the same round is the reference
    bare = found.pop("bare loop")
    yield Row(f"10 {encoding} clients, bare loop: CPU per sample", median(o.cpu_us_per_sample for o in bare), "us")
    for name, outcomes in found.items():
        words = f"10 {encoding} clients, {name}"
        yield Row(f"{words}: CPU per sample", median(o.cpu_us_per_sample for o in outcomes), "us")
        ratio = median(a.cpu_us_per_sample / b.cpu_us_per_sample for a, b in zip(outcomes, bare, strict=True))
        if name not in JUDGED:
            yield Row(f"{words}: CPU / bare loop", ratio, "x")
        else:
            yield at_most(f"{words}: CPU / bare loop", ratio, "x", CPU_AIM)
        yield Row(f"{words}: latency p50", median(o.p50_us for o in outcomes), "us")
        yield Row(f"{words}: latency p99", median(o.p99_us for o in outcomes), "us")
        yield at_most(f"{words}: samples lost", float(max(o.lost for o in outcomes)), "samples", 0)


def fleets(seconds: float) -> Iterator[Row]:
    most, load = 0, Load(seconds=seconds, phases=4, latency_ms=LATENCY_MS, apart=APART_FRAMES, warm_s=6.0)
    least = run(replace(load, devices=DEVICES_AIM, bare=True))
    words = f"{DEVICES_AIM} devices, bare loop that waits 10 ms before a read"
    yield Row(f"{words}: CPU per sample", least.cpu_us_per_sample, "us")
    yield Row(f"{words}: share of one core", least.cpu_share, "")
    for devices in FLEETS:
        outcome = run(replace(load, devices=devices))
        yield Row(f"{devices} devices, latency 10 ms: CPU per sample", outcome.cpu_us_per_sample, "us")
        yield Row(f"{devices} devices, latency 10 ms: samples lost", float(outcome.lost), "samples")
        yield Row(f"{devices} devices, latency 10 ms: share of one core", outcome.cpu_share, "")
        # stop at the first lost sample: more devices would only increase the loss
        if outcome.lost:
            break
        most = devices
    yield at_least("devices at 1 kHz on one core, latency 10 ms, without loss", float(most), "devices", DEVICES_AIM)
