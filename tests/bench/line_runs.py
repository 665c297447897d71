"""Runs of a clock with simulated devices with GPIO lines. A run returns samples with their true times."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from imud.contracts.lines import Edge, SoutTiming, UtcReference
from imud.model.sample import Measurement, Sample, Sync
from imud.model.units import NS_PER_S
from imud.sampling.clock import SampleClock
from imud.sim.ports.arrival import Arrival, ArrivalModel
from tests.bench import line_model
from tests.bench.clock import TICK_MODULUS, TICK_NS, clock_for

UTC_OFFSET_NS = 1_790_000_000_123_456_789  # CLOCK_REALTIME minus CLOCK_MONOTONIC
REFERENCE = UtcReference(UTC_OFFSET_NS, 20_000)  # with an error of 20 us


class DatedSample(NamedTuple):
    sample: Sample
    truth_ns: int
    number: int
    begun_ns: int = 0  # latest possible start of the frame according to its arrival, ns

    @property
    def off_ns(self) -> int:
        return self.sample.t_ns - self.truth_ns


def measurement(a: Arrival, ticks: int | None = None, pps_age: int | None = None) -> Measurement:
    ticks = (a.dev_ns // TICK_NS if ticks is None else ticks) % TICK_MODULUS
    return Measurement(a.size_bytes, a.trailing_bytes, ticks, pps_age_ms=pps_age)


def begun_ns(model: ArrivalModel, a: Arrival) -> int:
    return a.t_rx_ns - (a.size_bytes + a.trailing_bytes) * model.byte_ns


def sout_clock(model: ArrivalModel, timing: SoutTiming | None = None) -> SampleClock:
    return SampleClock(
        "bench", tick_ns=TICK_NS, tick_modulus=TICK_MODULUS, byte_ns=model.byte_ns, hold_ns=model.profile.hold_ns,
        sout=timing,
    )  # fmt: skip


def with_sout(
    clock: SampleClock, reads: Sequence[line_model.LineRead], *, silent: range = range(0)
) -> list[DatedSample]:
    dated = []
    for i, read in enumerate(reads):
        if i not in silent:
            clock.add_edges("sout", read.edges)
        for a, number in zip(read.arrivals, read.numbers, strict=True):
            dated.append(DatedSample(clock.sample(measurement(a), a.t_rx_ns, 0), line_model.measured_ns(a), number))
    return dated


def run_sout(
    model: ArrivalModel, seconds: int, faults: line_model.LineFaults, timing: SoutTiming | None = None
) -> list[DatedSample]:
    reads = line_model.simulate_reads(model.run(int(model.rate_hz) * seconds), model.seed, faults)
    return with_sout(sout_clock(model, timing), reads)


def run_pps(model: ArrivalModel, seconds: int, *, silent_s: range = range(0)) -> list[DatedSample]:
    """Run a device that sends its time since the last pulse per second. No pulse arrives in the seconds `silent_s`."""
    clock, dated = clock_for(model), []
    arrivals = list(model.run(int(model.rate_hz) * seconds))
    first_s = arrivals[0].t_ns // NS_PER_S
    pulses = [
        p for p in line_model.pulses_per_second(arrivals, model.seed) if p.t_ns // NS_PER_S - first_s not in silent_s
    ]
    given = 0
    for a in arrivals:
        due: list[Edge] = [p for p in pulses[given : given + 3] if p.t_ns <= a.t_rx_ns]
        given += len(due)
        clock.add_edges("pps", due)
        # without a new pulse, the time since the last pulse continues to rise
        newest = max((p.t_ns // NS_PER_S for p in pulses[:given] if p.t_ns <= a.t_ns), default=a.t_ns // NS_PER_S)
        age = line_model.pps_age_ms(a, model.crystal.skew_ppm) + 1000 * (a.t_ns // NS_PER_S - newest)
        dated.append(
            DatedSample(clock.sample(measurement(a, pps_age=age % 8192), a.t_rx_ns, 0), a.t_ns, 0, begun_ns(model, a))
        )
    return dated


def run_utc(
    model: ArrivalModel, seconds: int, *, turn_ms: int, ahead_ns: int = 0, reference: UtcReference = REFERENCE,
    turn_at: float = 0.25, back_at: float = 1.0,
) -> tuple[list[DatedSample], SampleClock]:  # fmt: skip
    """Run a device with UTC in ms modulo `turn_ms` in its counter, from the share `turn_at` to `back_at` of the run."""
    clock, dated = clock_for(model), []
    clock.set_utc_reference(reference)
    count = int(model.rate_hz) * seconds
    for i, a in enumerate(model.run(count)):
        utc = i >= turn_at * count and i < back_at * count
        ticks = (a.t_ns + UTC_OFFSET_NS + ahead_ns) // TICK_NS % turn_ms if utc else None
        dated.append(DatedSample(clock.sample(measurement(a, ticks), a.t_rx_ns, 0), a.t_ns, 0, begun_ns(model, a)))
    return dated, clock


def run_triggers(model: ArrivalModel, seconds: int, answered: float) -> tuple[list[DatedSample], SampleClock, int]:
    """Run a device that answers most triggers. Also return the number of triggers without a reply."""
    clock, dated, missed = clock_for(model), [], 0
    for stamp, a in line_model.triggered(model, int(model.rate_hz) * seconds, answered):
        clock.add_triggers([stamp])
        if a is None:
            missed += 1
        else:
            dated.append(DatedSample(clock.sample(measurement(a), a.t_rx_ns, 0), a.t_ns, stamp.number))
    return dated, clock, missed


def after(dated: Sequence[DatedSample], seconds: float) -> list[DatedSample]:
    return [t for t in dated if t.truth_ns - dated[0].truth_ns > seconds * NS_PER_S]


def share_honest(dated: Sequence[DatedSample]) -> float:
    return sum(abs(t.off_ns) <= 2 * t.sample.t_err_ns for t in dated) / len(dated)


def steepest(dated: Sequence[DatedSample]) -> float:
    """Return the largest error of a time step divided by the step. Skip samples limited by the start of their frame."""
    return max(
        abs(b.off_ns - a.off_ns) / (b.truth_ns - a.truth_ns) for a, b in pairwise(dated) if b.sample.t_ns != b.begun_ns
    )


def syncs(dated: Sequence[DatedSample]) -> set[Sync]:
    return {t.sample.sync for t in dated}
