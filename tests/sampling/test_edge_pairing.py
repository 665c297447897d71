"""Pairing of edges with samples by device time, with losses on both sides; decoding of pulses from edges."""

import pytest

from imud.contracts.lines import Edge
from imud.model.units import NS_PER_MS
from imud.sampling.edge_pairing import EdgePairing, PulseDecoder, rising_edges

# --- pulses -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reads", "pulses"),
    [
        ([[Edge(1000, True, 1), Edge(81_000, False, 2)]], [(1000, 1)]),  # the rising edge is the time of a pulse
        # the edges of a pulse may arrive in two reads
        ([[Edge(1000, True, 1)], [Edge(81_000, False, 2), Edge(500_000, True, 3)]], [(1000, 1), (500_000, 3)]),
        # computes a lost rising edge from the falling edge
        ([[Edge(1000, True, 1), Edge(581_000, False, 4)]], [(1000, 1), (501_000, 3)]),
    ],
)
def test_pulses(reads: list[list[Edge]], pulses: list[tuple[int, int]]) -> None:
    decoder = PulseDecoder(80_000)
    assert [pulse for edges in reads for pulse in decoder.decode(edges)] == pulses


def test_only_rising_edges() -> None:
    assert rising_edges([Edge(1, True, 1), Edge(2, False, 2), Edge(3, True, 3)]) == [(1, 1), (3, 3)]


# --- pairing ----------------------------------------------------------------------------------------------------------


PERIOD_NS = 10 * NS_PER_MS
LEAD_NS = 80_000
ERROR_NS = 100_000.0


def pair(pairing: EdgePairing, i: int, fit_off_ns: int = LEAD_NS) -> bool:
    """Pair sample `i`, whose event was at i periods. The fit is at the start of its frame."""
    at = i * PERIOD_NS
    return pairing.pair(at, at + NS_PER_MS, at + fit_off_ns, ERROR_NS, float(PERIOD_NS), 1.0)


def running(count: int = 100) -> EdgePairing:
    pairing = EdgePairing(LEAD_NS)
    for i in range(count):
        pairing.add_events([(i * PERIOD_NS, i)])
        pair(pairing, i)
    assert pairing.running
    return pairing


def test_each_event_is_paired_with_its_sample() -> None:
    pairing = running()
    pairing.add_events([(i * PERIOD_NS, i) for i in range(100, 116)])
    assert [(pair(pairing, i), pairing.number) for i in range(100, 116)] == [(True, i) for i in range(100, 116)]
    pairing = running()
    pairing.add_events([(i * PERIOD_NS, i) for i in (100, 102, 103)])
    assert [(pair(pairing, i), pairing.number) for i in (100, 101, 103)] == [(True, 100), (False, 100), (True, 103)]
    assert (pairing.events_unpaired, pairing.samples_unpaired) == (1, 1)


def test_distant_events_are_unpaired() -> None:
    pairing = running()
    at = 100 * PERIOD_NS
    pairing.add_events([(at - 3 * NS_PER_MS, 1), (at - 20_000, 2), (at + 5_000, 3), (at + 3 * NS_PER_MS, 4)])
    assert pair(pairing, 100)
    assert (pairing.stamp_ns, pairing.number) == (at + 5_000, 3)
    assert not pair(pairing, 101)
    pairing = running()
    pairing.add_events([(100 * PERIOD_NS + NS_PER_MS, 100)])
    assert not pair(pairing, 100)
    assert (pairing.events_unpaired, pairing.samples_unpaired) == (1, 1)


def test_a_line_begins_with_the_eighth_pair_after_a_restart() -> None:
    pairing, begins = EdgePairing(LEAD_NS), list[int]()
    for i in range(40):
        if i in (3, 20):
            pairing.restart()
        pairing.add_events([(i * PERIOD_NS, i)])
        before = pairing.running
        pair(pairing, i)
        begins += [i] if pairing.running and not before else []
    assert begins == [10, 27]


@pytest.mark.parametrize(("apart_ns", "error_ns"), [(NS_PER_MS, ERROR_NS), (0, 0.5 * PERIOD_NS)])
def test_it_begins_only_when_most_agree_and_the_fit_is_sure(apart_ns: int, error_ns: float) -> None:
    pairing = EdgePairing(LEAD_NS)
    for i in range(30):
        at = i * PERIOD_NS
        pairing.add_events([(at + (i % 4) * apart_ns, i)])
        assert not pairing.pair(at, at + NS_PER_MS, at + LEAD_NS, error_ns, float(PERIOD_NS), 1.0)
    assert not pairing.running


def test_lines_without_events_or_off_by_a_period_are_dropped() -> None:
    pairing = running()
    assert not any(pair(pairing, 100 + i) for i in range(8))
    assert not pairing.running
    assert pairing.learned
    pairing = running()
    for i in range(100, 364):
        pairing.add_events([(i * PERIOD_NS, i)])
        pair(pairing, i, PERIOD_NS + LEAD_NS)
    assert pairing.number < 364
    assert not pairing.learned or abs(pairing.delay_ns) < PERIOD_NS / 2


def test_events_without_samples_are_bounded() -> None:
    pairing = EdgePairing(LEAD_NS)
    pairing.add_events([(i, i) for i in range(4096 + 10)])
    assert pairing.events_unpaired == 10
