"""CPU time and latency of imud and the bare loop: pty → decode → clock → shared memory → socket client, in one run.

`make bench ARGS=latency`. Every round runs each load once, so that all loads have the same conditions. The rows show
the median of all rounds. The bare loop reads and sends each sample immediately. With a wait before each read, it is the
minimum for a Python process with batches, without clock, ledger and ring. Shared memory uses its default of 5 ms unless
a load requests a latency. With one client, a load also records the device: the CPU time includes the threads of the
recorder.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from statistics import median

from tests.bench.rig import Load, Outcome, run
from tests.bench.rows import Row, at_most

CPU_LIMITS = {1: 1.5, 10: 1.4, 100: 2.0}  # goals: imud / bare loop by number of clients
P99_LIMIT = 2.0  # goal: p99 of imud / bare loop
CPU_AIM = 0.35  # goal with a hold: imud / bare loop
RECORDED_LIMIT = 1.15  # goal: CPU with / without a recording
LATENCY_MS = 10.0
VARIED = 10  # number of clients with all loads
# loads with the goal CPU_AIM
JUDGED = ("latency 10 ms", "at 100 Hz", "at 10 Hz, latency 20 ms")


def rows(*, quick: bool = False) -> Iterator[Row]:
    seconds, rounds = (2.0, 1) if quick else (4.0, 5)
    for encoding in ("binary", "json"):
        for clients in (1, VARIED) if quick else CPU_LIMITS:
            yield from compare(Load(clients=clients, encoding=encoding, seconds=seconds), rounds)


def loads_of(plain: Load) -> dict[str, Load]:
    loads = {"bare loop": replace(plain, bare=True), "default latency": plain}
    if plain.clients == 1:
        loads["default latency, recorded"] = replace(plain, recorded=True)
    if plain.clients == VARIED:
        loads["bare loop that waits 10 ms before a read"] = replace(plain, bare=True, latency_ms=LATENCY_MS)
        loads["latency 10 ms"] = replace(plain, latency_ms=LATENCY_MS)
        loads["at 100 Hz"] = replace(plain, client_hz=100.0)
        loads["at 10 Hz, latency 20 ms"] = replace(plain, client_hz=10.0, latency_ms=20.0)
    return loads


def compare(plain: Load, rounds: int) -> Iterator[Row]:
    loads = loads_of(plain)
    found: dict[str, list[Outcome]] = {name: [] for name in loads}
    for _ in range(rounds):
        for name, load in loads.items():
            found[name].append(run(load))
    # the bare loop of the same round is the reference
    bare, default = found["bare loop"], found["default latency"]
    for name, outcomes in found.items():
        words = f"1 kHz, {plain.clients} {plain.encoding} clients, {name}"
        yield Row(f"{words}: CPU per sample", median(o.cpu_us_per_sample for o in outcomes), "µs")
        yield Row(f"{words}: latency p50", median(o.p50_us for o in outcomes), "µs")
        yield Row(f"{words}: latency p99", median(o.p99_us for o in outcomes), "µs")
        if not loads[name].bare:
            yield at_most(f"{words}: samples lost", float(max(o.lost for o in outcomes)), "samples", 0)
        ratio, words = ratio_of("cpu_us_per_sample", outcomes, bare), f"{words}: CPU / bare loop"
        if outcomes is default:
            yield at_most(words, ratio, "x", CPU_LIMITS[plain.clients])
            yield at_most(f"{words}, p99", ratio_of("p99_us", outcomes, bare), "x", P99_LIMIT)
        elif name in JUDGED:
            yield at_most(words, ratio, "x", CPU_AIM)
        elif outcomes is not bare:
            yield Row(words, ratio, "x")
    if recorded := found.get("default latency, recorded"):
        ratio = ratio_of("cpu_us_per_sample", recorded, default)
        words = f"1 kHz, {plain.clients} {plain.encoding} clients, default latency, recorded: CPU / not recorded"
        yield at_most(words, ratio, "x", RECORDED_LIMIT)


def ratio_of(figure: str, some: Sequence[Outcome], others: Sequence[Outcome]) -> float:
    return median(float(getattr(a, figure) / getattr(b, figure)) for a, b in zip(some, others, strict=True))
