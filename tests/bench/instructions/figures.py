"""The stored figures by build of Python, and the comparison with a new measurement."""

import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

FILE: Final = Path(__file__).with_name("figures.json")
GROWTH_MOST: Final = 0.05
"""Maximum growth of a stage, as a share. Two runs of the same code agree within 0.5 %."""
LESS_NOTED: Final = 0.005  # report a decrease above this share
BUILD_MOST: Final = 0.01
"""Maximum difference of the stage `interpreter`, as a share. A larger difference means another build of Python."""
INTERPRETER: Final = "interpreter: a loop without imud"
"""The stage that does not use imud. It shows differences between two builds of Python."""

Figures = dict[str, int]


class Line(NamedTuple):
    stage: str
    now: int
    kept: int | None

    @property
    def growth(self) -> float:
        """Return the growth since the stored figure, as a share."""
        return self.now / self.kept - 1 if self.kept else 0.0

    @property
    def is_good(self) -> bool:
        return self.kept is not None and self.now <= self.kept * (1 + GROWTH_MOST)

    def __str__(self) -> str:
        if self.kept is None:
            return f"{self.stage:58} {self.now:8}  NO FIGURE"
        mark = "" if self.is_good else "  TOO MANY"
        return f"{self.stage:58} {self.now:8} {self.kept:8} {self.growth:+8.1%}{mark}"


def python_build() -> str:
    python = f"{platform.python_implementation()} {platform.python_version()}"
    return f"{python}, {platform.python_compiler()}, {platform.machine()}"


def load() -> dict[str, Figures]:
    return msgspec.json.decode(FILE.read_bytes(), type=dict[str, Figures])


def keep(build: str, measured: Mapping[str, int]) -> None:
    """Store the figures of one build. Keep the figures of stages that were not measured."""
    kept = load()
    kept[build] = {**kept.get(build, {}), **measured}
    FILE.write_bytes(msgspec.json.format(msgspec.json.encode(kept), indent=1) + b"\n")


def is_same_build(kept: Figures | None, measured: Mapping[str, int]) -> bool:
    """Return whether the figures are from this build of Python: the same loop takes the same number of instructions."""
    if kept is None or INTERPRETER not in kept:
        return False
    return abs(measured[INTERPRETER] / kept[INTERPRETER] - 1) <= BUILD_MOST


def compare(kept: Figures, measured: Mapping[str, int]) -> list[Line]:
    return [Line(stage, now, kept.get(stage)) for stage, now in measured.items()]
