"""A figure as `make bench` prints it and writes it to build/bench.json."""

from typing import NamedTuple


class Row(NamedTuple):
    """A figure. `reach` is its goal as text, `reached` the result; both are empty for a figure without a goal."""

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
