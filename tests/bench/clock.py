"""Accuracy of the clock in a simulation: `python -m tests.bench.clock` prints the table.

The simulation knows the true time of each sample. A row is a combination of an arrival profile, a rate and a crystal.
Its figures are from all seeds, after the fit has settled for 70 s. `clock_lines` prints the second table, for lines and
UTC. `--short` uses one seed, 1 Hz and 100 Hz.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

from imud.model.sample import Measurement, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock
from imud.sim.ports.arrival import PROFILES, ArrivalModel, ArrivalProfile, Crystal
from tests.bench.clock_figures import ArrivalFigures, Spread
from tests.support.results import ProgramRun, Table, add_json, printed, rows_of

TICK_NS = NS_PER_MS  # HI91 has a device time in ms
TICK_MODULUS = 1 << 32  # u32, wraps after 49.7 days
SETTLED_NS = 70 * NS_PER_S  # the fit and its error no longer change much
SECONDS = {1: 240, 100: 150, 200: 150, 400: 120, 1000: 120}  # duration of a run by rate
BAUD_OF_RATE = {1: 115_200, 100: 115_200, 200: 460_800, 400: 921_600, 1000: 921_600}
CRYSTALS = {
    "0 ppm": Crystal(0.0), "+50 ppm": Crystal(50.0), "-50 ppm": Crystal(-50.0), "+5 %": Crystal(50_000.0),
    "-5 %": Crystal(-50_000.0), "drift": Crystal(20.0, 0.1),
}  # fmt: skip
"""Crystals by name. `drift`: 20 ppm, then a change of 0.1 ppm/s between -10 and +10 ppm around it."""


class Point(NamedTuple):
    off_ns: int
    t_err_ns: int
    fitted: bool
    truth_ns: int


@dataclass(frozen=True, slots=True)
class Accuracy:
    rms_ns: float  # Root mean square of the errors relative to the true time, ns. A constant error is included.
    sigma_ns: float
    """Standard deviation of the errors around their mean, ns: the error after a calibration of the constant part."""
    p999_ns: float
    mean_t_err_ns: float
    share: float
    share_settling: float


def clock_for(model: ArrivalModel) -> SampleClock:
    return SampleClock(
        "bench", tick_ns=TICK_NS, tick_modulus=TICK_MODULUS, byte_ns=model.byte_ns, hold_ns=model.profile.hold_ns
    )


def run(model: ArrivalModel, count: int) -> list[Point]:
    clock = clock_for(model)
    points = []
    for a in model.run(count):
        ticks = a.dev_ns // TICK_NS % TICK_MODULUS
        s = clock.sample(Measurement(a.size_bytes, a.trailing_bytes, ticks), a.t_rx_ns, 0)
        points.append(Point(s.t_ns - a.t_ns, s.t_err_ns, s.sync is Sync.REGRESSION, a.t_ns))
    return points


def accuracy(points: Sequence[Point], settle_ns: int = SETTLED_NS) -> Accuracy:
    begin = points[0].truth_ns
    return summary(
        [p for p in points if p.truth_ns - begin > settle_ns], [p for p in points if p.truth_ns - begin <= settle_ns]
    )


def summary(settled: Sequence[Point], settling: Sequence[Point]) -> Accuracy:
    n = len(settled)
    mean = sum(p.off_ns for p in settled) / n
    return Accuracy(
        rms_ns=sqrt(sum(p.off_ns**2 for p in settled) / n),
        sigma_ns=sqrt(sum((p.off_ns - mean) ** 2 for p in settled) / n),
        p999_ns=sorted(abs(p.off_ns) for p in settled)[int(n * 0.999)],
        mean_t_err_ns=sum(p.t_err_ns for p in settled) / n, share=_share(settled), share_settling=_share(settling),
    )  # fmt: skip


def _share(points: Sequence[Point]) -> float:
    return sum(abs(p.off_ns) <= 2 * p.t_err_ns for p in points) / len(points)


def over_seeds(profile: ArrivalProfile, rate_hz: int, crystal: Crystal, seeds: Sequence[int]) -> Accuracy:
    settled: list[Point] = []
    settling: list[Point] = []
    for seed in seeds:
        points = run(ArrivalModel(profile, rate_hz, seed, crystal, BAUD_OF_RATE[rate_hz]), rate_hz * SECONDS[rate_hz])
        begin = points[0].truth_ns
        for p in points:
            (settled if p.truth_ns - begin > SETTLED_NS else settling).append(p)
    return summary(settled, settling)


# columns with a range over the crystals
FIGURES = ("sigma_ns", "rms_ns", "p999_ns", "mean_t_err_ns")


def _spread_us(values: Sequence[float]) -> Spread:
    return float(round(min(values) / 1000)), float(round(max(values) / 1000))


def table(seeds: Sequence[int], rates: Sequence[int]) -> Iterator[ArrivalFigures]:
    """Yield the rows of the table. Each value is a range from the best to the worst crystal."""
    for profile in PROFILES:
        for rate_hz in rates:
            all_of = [over_seeds(profile, rate_hz, crystal, seeds) for crystal in CRYSTALS.values()]
            sigma, rms, p999, t_err = (_spread_us([getattr(a, figure) for a in all_of]) for figure in FIGURES)
            # a share is from the worst crystal
            share, settling = min(a.share for a in all_of), min(a.share_settling for a in all_of)
            yield ArrivalFigures(profile.name, rate_hz, sigma, rms, p999, t_err, round(share, 3), round(settling, 3))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.clock")
    parser.add_argument("--short", "--quick", action="store_true")
    add_json(parser)
    args, program_run, found = parser.parse_args(), ProgramRun(), []
    for one in table((1,), (1, 100)) if args.short else table((1, 2, 3), tuple(SECONDS)):
        found += rows_of([one])
        print(printed(found[-1]), flush=True)
    program_run.save(args.json, [Table("", found)])


if __name__ == "__main__":
    main()
