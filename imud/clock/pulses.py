"""Edges made into pulses: the rising edge is the pulse, the falling one stands in for it when it got lost."""

from collections.abc import Sequence

from imud.contracts.lines import Edge

Stamp = tuple[int, int]
"""(CLOCK_MONOTONIC of a rising edge, its number)."""


class Pulses:
    """Rising edges of pulses of known width out of the edges of a line, in order."""

    __slots__ = ("_risen", "_width_ns")

    def __init__(self, width_ns: int) -> None:
        self._width_ns = width_ns
        self._risen = 0

    def take(self, edges: Sequence[Edge]) -> list[Stamp]:
        """The pulses in `edges`; one whose rising edge is missing is counted back from its falling edge."""
        pulses: list[Stamp] = []
        for t_ns, rising, number in edges:
            if rising:
                self._risen = number
                pulses.append((t_ns, number))
            elif self._risen != number - 1:
                pulses.append((t_ns - self._width_ns, number - 1))
        return pulses


def rising(edges: Sequence[Edge]) -> list[Stamp]:
    """Rising edges only, for pulses of unknown width."""
    return [(edge.t_ns, edge.number) for edge in edges if edge.rising]
