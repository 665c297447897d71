"""Measured figures of docs/measurements.md, stored in `clock_figures.json`: two tables and two plots.

`python -m tests.bench.clock --keep` and `python -m tests.bench.clock_lines --keep` measure and store the figures.
`python -m docs.generate.references` creates the tables, and `python -m docs.generate.clock_pictures` the plots.
"""

from collections.abc import Iterable, Iterator, Sequence
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
ARRIVAL_COLUMNS: Final = (0, 1, 3, 5, 7)
"""Columns of docs/measurements.md: arrival, rate, rms, mean t_err, settling."""
LINE_COLUMNS: Final = (0, 1, 2, 3, 4, 6)
"""Columns of docs/measurements.md: source, over, rate, σ, mean, mean t_err."""
SAME_WITH_SOUT: Final = {
    "usb-1ms", "usb-16ms, crystal +5 %", "usb-16ms, crystal -5 %", "usb-16ms, crystal drift",
    "usb-16ms, 1 % of edges lost", "usb-16ms, 5 % extra edges",
}  # fmt: skip
"""Rows that docs/measurements.md omits: SOUT has the same error on each link."""
SHOWN_RATES_HZ: Final = (1, 100, 1000)  # rates in the table of docs/measurements.md; the plot has all rates

Spread = tuple[float, float]
"""Minimum and maximum over all crystals, µs."""


class ArrivalFigures(msgspec.Struct, frozen=True):
    arrival: str
    rate_hz: int
    sigma_us: Spread
    rms_us: Spread
    p999_us: Spread
    mean_t_err_us: Spread
    share: float
    """Share of samples within 2 × t_err_ns after settling, for the worst crystal."""
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
    # keep the other table if only one was measured
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


def markdown(head: str, found: Iterable[ArrivalFigures | LineFigures]) -> Iterator[str]:
    yield head
    for one in found:
        yield one.row()


def tables() -> dict[str, str]:
    """Return the tables of docs/measurements.md by their markers, with the most important columns and rows."""
    figures = kept()
    return {
        "arrivals": _table(
            ARRIVAL_HEAD, (one for one in figures.arrivals if one.rate_hz in SHOWN_RATES_HZ), ARRIVAL_COLUMNS
        ),
        "lines": _table(LINE_HEAD, (one for one in figures.lines if _is_shown(one)), LINE_COLUMNS),
    }


def _is_shown(figures: LineFigures) -> bool:
    return figures.over not in SAME_WITH_SOUT and (figures.source != "SOUT" or figures.rate_hz == 100)


def _table(head: str, found: Iterable[ArrivalFigures | LineFigures], columns: Sequence[int]) -> str:
    """Return a table with some columns, with blank lines around it: <details> requires them."""
    rows = [line.split("|") for line in "\n".join(markdown(head, found)).splitlines()]
    return "\n" + "\n".join("|" + "|".join(row[1 + column] for column in columns) + "|" for row in rows) + "\n"
