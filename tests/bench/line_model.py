"""A simulated device with GPIO lines and known true times: SOUT pulses, lost and extra edges, and lost frames.

The measurement is at the rising edge. The pulse takes 80 µs. Then the frame of `ArrivalModel` starts. The kernel
time-stamps an edge some microseconds late. On a busy host, some edges are late by some hundred microseconds.
"""

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from random import Random
from typing import NamedTuple

from imud.contracts.lines import Edge, TriggerStamp
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sim.ports.arrival import Arrival, ArrivalModel

PULSE_NS = 80 * NS_PER_US  # SOUT pulse of HiPNUC devices
SIN_NS = 125 * NS_PER_US  # from the trigger to the measurement
LATENCY_NS = 3 * NS_PER_US  # minimum delay of the kernel's time stamp
JITTER_NS = 4 * NS_PER_US  # mean of the exponential part
STALL_SHARE = 0.01  # share of delayed edges on a busy host
STALL_NS = 200 * NS_PER_US
"""Delay of the kernel's interrupt thread: minimum LATENCY_NS plus an exponential part with the mean JITTER_NS.
STALL_SHARE of the edges on a busy host wait for another thread, with the mean STALL_NS."""


@dataclass(frozen=True, slots=True)
class LineFaults:
    pulse_loss: float = 0.0
    edge_loss: float = 0.0
    frame_loss: float = 0.0
    extra: float = 0.0  # number of false pulses per true pulse, at random times
    loaded: bool = False


class LineRead(NamedTuple):
    edges: list[Edge]
    arrivals: list[Arrival]
    numbers: list[int]
    stamps_ns: list[int]


def measured_ns(arrival: Arrival) -> int:
    """Return the true time of a measurement, ns: the rising edge of its pulse."""
    return arrival.t_ns - PULSE_NS


def simulate_reads(arrivals: Iterable[Arrival], seed: int, faults: LineFaults) -> list[LineRead]:
    random = Random(f"lines {seed}")
    all_of = list(arrivals)
    pulses = [(measured_ns(a), i) for i, a in enumerate(all_of)]
    edges, numbers, stamps = _edges(pulses, random, faults)
    reads = []
    at = 0
    index = {id(a): i for i, a in enumerate(all_of)}
    for t_rx_ns, group in groupby(all_of, key=lambda a: a.t_rx_ns):
        begin = at
        while at < len(edges) and edges[at].t_ns <= t_rx_ns:
            at += 1
        kept = [a for a in group if random.random() >= faults.frame_loss]
        indices = [index[id(a)] for a in kept]
        reads.append(LineRead(edges[begin:at], kept, [numbers[i] for i in indices], [stamps[i] for i in indices]))
    return reads


def late_ns(random: Random, *, loaded: bool) -> int:
    """Return a random delay of the kernel's time stamp, ns."""
    late = LATENCY_NS + random.expovariate(1 / JITTER_NS)
    if loaded and random.random() < STALL_SHARE:
        late += random.expovariate(1 / STALL_NS)
    return int(late)


def _edges(
    pulses: Sequence[tuple[int, int]], random: Random, faults: LineFaults
) -> tuple[list[Edge], list[int], list[int]]:
    both: list[tuple[int, int, int | None]] = []  # time stamps of rising and falling edge, number of the pulse
    for t_ns, i in pulses:
        rise = t_ns + late_ns(random, loaded=faults.loaded)
        # the falling edge has a later time stamp than the rising edge
        both.append((rise, max(t_ns + PULSE_NS + late_ns(random, loaded=faults.loaded), rise + 1000), i))
    both += [extra for extra in _extra(pulses, random, faults) if _is_free(extra, both)]
    both.sort()
    seen: list[Edge] = []
    numbers, stamps = [0] * len(pulses), [0] * len(pulses)
    number = 0
    for rise, fall, pulse in both:
        if pulse is not None:
            numbers[pulse], stamps[pulse] = number + 1, rise
        whole = pulse is not None and random.random() < faults.pulse_loss
        for t_ns, rising in ((rise, True), (fall, False)):
            number += 1
            if not whole and random.random() >= faults.edge_loss:
                seen.append(Edge(t_ns, rising, number))
    return seen, numbers, stamps


def _extra(
    pulses: Sequence[tuple[int, int]], random: Random, faults: LineFaults
) -> Iterator[tuple[int, int, int | None]]:
    first, last = pulses[0][0], pulses[-1][0]
    for _ in range(int(len(pulses) * faults.extra)):
        at = random.randrange(first, last)
        yield at, at + random.randrange(5 * NS_PER_US, 500 * NS_PER_US), None


def _is_free(extra: tuple[int, int, int | None], pulses: Sequence[tuple[int, int, int | None]]) -> bool:
    at = bisect_right(pulses, extra)
    # skip extra pulses that would overlap another pulse
    return (at == 0 or pulses[at - 1][1] < extra[0]) and (at == len(pulses) or extra[1] < pulses[at][0])


def restarted(model: ArrivalModel, count: int, silent_ns: int) -> Iterator[Arrival]:
    """Yield the arrivals of a device that restarts halfway after `silent_ns`, with a counter that starts at 3 s."""
    last = None
    for last in model.run(count // 2):
        yield last
    assert last is not None
    again = replace(
        model, crystal=replace(model.crystal, start_ns=3_000_000_000), begin_ns=last.t_rx_ns + silent_ns,
        seed=model.seed + 1,
    )  # fmt: skip
    yield from again.run(count - count // 2)


def pulses_per_second(arrivals: Sequence[Arrival], seed: int) -> list[Edge]:
    """Return a pulse for every whole second of the host, from before the first frame on, with late time stamps."""
    random = Random(f"pps {seed}")
    first, last = arrivals[0].t_ns // NS_PER_S, arrivals[-1].t_ns // NS_PER_S
    return [
        Edge(second * NS_PER_S + late_ns(random, loaded=False), True, 2 * i + 1)
        for i, second in enumerate(range(first, last + 1))
    ]


def pps_age_ms(arrival: Arrival, skew_ppm: float) -> int:
    """Return the value that the device sends: time since the last whole second of the host, rounded down to ms."""
    return int(arrival.t_ns % NS_PER_S * (1 + skew_ppm * 1e-6)) // NS_PER_MS


def triggered(model: ArrivalModel, count: int, answered: float) -> Iterator[tuple[TriggerStamp, Arrival | None]]:
    """Yield triggers at regular host times with the replies 125 µs (± 20 µs) later. `answered` is the share of replies.

    The reply contains the device time of the trigger, rounded down to ms.
    """
    random = Random(f"trigger {model.seed}")
    skew = 1 + model.crystal.skew_ppm * 1e-6
    for number, a in enumerate(model.run(count), start=1):
        shift_ns = SIN_NS + random.randrange(-20 * NS_PER_US, 20 * NS_PER_US)
        t_ns = model.begin_ns + int((number - 1) * NS_PER_S / model.rate_hz)
        stamp = TriggerStamp(t_ns + random.randrange(-10 * NS_PER_US, 10 * NS_PER_US), 6 * NS_PER_US, number)
        dev_ns = model.crystal.start_ns + int((t_ns - model.begin_ns) * skew)
        answer = Arrival(t_ns, dev_ns, a.size_bytes, 0, a.t_rx_ns - a.t_ns + t_ns + shift_ns)
        yield stamp, answer if random.random() < answered else None
