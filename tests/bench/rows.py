"""A figure as `make bench` prints it and writes it to build/bench.json."""

from collections.abc import Iterable
from typing import Any, NamedTuple

from tests.support.results import Table


class Row(NamedTuple):
    """A figure with the name `CASE: FIGURE`.

    `reach` is its goal as text, `reached` the result; both are empty for a figure without a goal.
    """

    name: str
    value: float
    unit: str
    reach: str = ""
    reached: bool | None = None

    def __str__(self) -> str:
        mark = {True: "reached", False: "NOT REACHED", None: ""}[self.reached]
        return f"{self.name:64} {self.value:12.3f} {self.unit:12} {self.reach:10} {mark}".rstrip()


def at_most(name: str, value: float, unit: str, limit: float) -> Row:
    return Row(name, value, unit, f"<= {limit:g}", value <= limit)


def at_least(name: str, value: float, unit: str, limit: float) -> Row:
    return Row(name, value, unit, f">= {limit:g}", value >= limit)


def table(title: str, rows: Iterable[Row]) -> Table:
    """Return a table with one row per case and one column per figure."""
    cases: dict[str, dict[str, Any]] = {}
    for row in rows:
        case, _, figure = row.name.rpartition(": ")
        column = figure if row.unit in ("", "x") else f"{figure}, {row.unit}"
        cases.setdefault(case, {"case": case})[column] = row.value
    return Table(title, list(cases.values()))
