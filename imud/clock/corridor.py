"""What a latency timer hides: all lines that fit between the arrivals and the arrivals less the timer's period.

A message waits in the adapter between nothing and the timer's period, so the truth lies under every arrival and above
every arrival less that period. Where the timer beats with the samples (100 Hz on 16 ms, or two crystals 30 ppm apart)
the luckiest wait creeps from nothing to the step between phases and falls back, once in a minute or an hour, and an
envelope alone follows it. The corridor says how far the truth can be from it, and its middle is the better guess.
"""

from dataclasses import dataclass

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Corridor:
    """All lines between two bounds, seen from the newest point; relative to the line the heights are above."""

    lowest_ns: float
    """Lowest value of any such line at the newest point."""
    highest_ns: float
    slope_lowest: float
    slope_highest: float


def corridor(ceiling: list[Point], floor: list[Point], x: float) -> Corridor | None:
    """The lines under all points of `ceiling` and above all of `floor` up to `x`; None where there are none.

    Points are (device ns, ns), the corners of two convex chains; every pair of them bounds the slope, so with some ten
    corners each this is exact and cheap.
    """
    steepest, flattest = 1.0, -1.0
    for xc, yc in ceiling:
        for xf, yf in floor:
            room, apart = yc - yf, xc - xf
            if apart > 0:
                steepest = min(steepest, room / apart)
            elif apart < 0:
                flattest = max(flattest, room / apart)
            elif room < 0:
                return None
    if flattest > steepest:
        return None
    highest = min(y + steepest * (x - xc) for xc, y in ceiling)
    lowest = max(y + flattest * (x - xf) for xf, y in floor)
    return Corridor(lowest, highest, flattest, steepest)
