"""Edges made into pulses."""

from imud.clock.pulses import Pulses, rising
from imud.contracts.lines import Edge


def test_a_pulse_is_its_rising_edge() -> None:
    assert Pulses(80_000).take([Edge(1000, True, 1), Edge(81_000, False, 2)]) == [(1000, 1)]


def test_the_halves_of_a_pulse_may_come_apart() -> None:
    pulses = Pulses(80_000)
    assert pulses.take([Edge(1000, True, 1)]) == [(1000, 1)]
    assert pulses.take([Edge(81_000, False, 2), Edge(500_000, True, 3)]) == [(500_000, 3)]


def test_a_falling_edge_alone_is_counted_back() -> None:
    pulses = Pulses(80_000)
    assert pulses.take([Edge(1000, True, 1), Edge(581_000, False, 4)]) == [(1000, 1), (501_000, 3)]


def test_only_rising_edges() -> None:
    assert rising([Edge(1, True, 1), Edge(2, False, 2), Edge(3, True, 3)]) == [(1, 1), (3, 3)]
