"""A measurement as it is printed and written to build/bench.json."""

from typing import NamedTuple


class Row(NamedTuple):
    """One figure. `reach` is what was aimed at in words, `reached` whether it was; both empty for a plain figure."""

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
