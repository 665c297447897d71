"""Measured figures of docs/measurements.md, stored in `clock_figures.json`.

`python -m tests.bench.clock --keep` and `python -m tests.bench.clock_lines --keep` measure and store the figures.
`python -m docs.generate.clock_pictures` draws the plots.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

FILE: Final = Path(__file__).with_suffix(".json")
ARRIVAL_HEAD: Final = (
    "| arrival | rate, Hz | σ, µs | rms, µs | p99.9, µs | mean t_err, µs | in 2 t_err | settling |\n|" + "---|" * 8
)
LINE_HEAD: Final = (
    "| source | over | rate, Hz | σ, µs | mean, µs | p99.9, µs | mean t_err, µs | in 2 t_err | settling | by it |\n|"
    + "---|" * 10
)
WHOLE_FROM_US: Final = 10.0  # larger values have no decimals

Spread = tuple[float, float]  # minimum and maximum over all crystals, µs


class ArrivalFigures(msgspec.Struct, frozen=True):
    arrival: str
    rate_hz: int
    sigma_us: Spread
    rms_us: Spread
    p999_us: Spread
    mean_t_err_us: Spread
    share: float  # share of samples within 2 × t_err_ns after settling, for the worst crystal
    settling: float

    def row(self) -> str:
        micro = " | ".join(map(spread, (self.sigma_us, self.rms_us, self.p999_us, self.mean_t_err_us)))
        return f"| {self.arrival} | {self.rate_hz} | {micro} | {self.share:.3f} | {self.settling:.3f} |"


class LineFigures(msgspec.Struct, frozen=True):
    source: str
    over: str
    rate_hz: int
    sigma_us: float
    mean_us: float
    p999_us: float
    mean_t_err_us: float
    share: float
    settling: float
    by_it: float

    def row(self) -> str:
        micro = " | ".join(map(microseconds, (self.sigma_us, self.mean_us, self.p999_us, self.mean_t_err_us)))
        shares = f"{self.share:.3f} | {self.settling:.3f} | {self.by_it:.3f}"
        return f"| {self.source} | {self.over} | {self.rate_hz} | {micro} | {shares} |"


class ClockFigures(msgspec.Struct, frozen=True):
    arrivals: tuple[ArrivalFigures, ...] = ()
    lines: tuple[LineFigures, ...] = ()


def kept() -> ClockFigures:
    return msgspec.json.decode(FILE.read_bytes(), type=ClockFigures)


def keep(*, arrivals: Sequence[ArrivalFigures] | None = None, lines: Sequence[LineFigures] | None = None) -> None:
    # keep the other figures if only one was measured
    old = kept() if FILE.exists() else ClockFigures()
    new = ClockFigures(
        old.arrivals if arrivals is None else tuple(arrivals), old.lines if lines is None else tuple(lines)
    )
    FILE.write_bytes(msgspec.json.format(msgspec.json.encode(new), indent=1) + b"\n")


def spread(values: Spread) -> str:
    """Return the smallest and the largest value in whole µs, or one value if both are equal."""
    low, high = (f"{one:.0f}" for one in values)
    return low if low == high else f"{low}–{high}"


def microseconds(value: float) -> str:
    return f"{value:.0f}" if abs(value) > WHOLE_FROM_US else f"{value:.1f}"
