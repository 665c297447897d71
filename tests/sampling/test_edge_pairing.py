"""Pairing of edges with samples by device time, with losses on both sides; decoding of pulses from edges."""

from collections.abc import Sequence

import pytest

from imud.contracts.lines import Edge
from imud.model.units import NS_PER_MS
from imud.sampling.edge_pairing import EdgePairing, MarkPairing, PulseDecoder, rising_edges

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


def test_each_event_is_paired_with_its_sample_and_distant_or_many_events_are_not() -> None:
    pairing = running()
    pairing.add_events([(i * PERIOD_NS, i) for i in range(100, 116)])
    assert [(pair(pairing, i), pairing.number) for i in range(100, 116)] == [(True, i) for i in range(100, 116)]
    pairing = running()
    pairing.add_events([(i * PERIOD_NS, i) for i in (100, 102, 103)])
    assert [(pair(pairing, i), pairing.number) for i in (100, 101, 103)] == [(True, 100), (False, 100), (True, 103)]
    assert (pairing.events_unpaired, pairing.samples_unpaired) == (1, 1)
    pairing = running()
    at = 100 * PERIOD_NS
    pairing.add_events([(at - 3 * NS_PER_MS, 1), (at - 20_000, 2), (at + 5_000, 3), (at + 3 * NS_PER_MS, 4)])
    assert pair(pairing, 100)
    assert (pairing.stamp_ns, pairing.number, pairing.events_unpaired) == (at + 5_000, 3, 2)
    assert not pair(pairing, 101)
    pairing = running()
    pairing.add_events([(100 * PERIOD_NS + NS_PER_MS, 100)])
    assert not pair(pairing, 100)
    assert (pairing.events_unpaired, pairing.samples_unpaired) == (1, 1)
    pairing = EdgePairing(LEAD_NS)
    pairing.add_events([(i, i) for i in range(4096 + 10)])
    assert pairing.events_unpaired == 10


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
    pairing, i = EdgePairing(LEAD_NS), 0
    while not pairing.running:
        pairing.add_events([(i * PERIOD_NS + 2_000_000 * (i in (2, 4, 6)), i)])
        pair(pairing, i)
        i += 1
    assert i == 12  # four more pairs, because the first eight pairs do not agree


@pytest.mark.parametrize(
    ("off_ns", "moved", "period_ns", "error_ns", "begins"),
    [
        # 0.45 periods
        (4_500_000, range(8), PERIOD_NS, ERROR_NS, True), (4_500_001, range(8), PERIOD_NS, ERROR_NS, False),
        # 1.4 times the error of the fit is below 0.45 periods
        (0, (), PERIOD_NS, 3_214_000, True), (0, (), PERIOD_NS, 3_215_000, False),
        # six of eight events agree: within 0.1 periods, at least 150 us
        (2_000_000, (2, 5), PERIOD_NS, ERROR_NS, True), (2_000_000, (2, 4, 6), PERIOD_NS, ERROR_NS, False),
        (1_000_000, (2, 4, 6), PERIOD_NS, ERROR_NS, True), (1_000_001, (2, 4, 6), PERIOD_NS, ERROR_NS, False),
        (150_000, (2, 4, 6), NS_PER_MS, ERROR_NS, True), (150_001, (2, 4, 6), NS_PER_MS, ERROR_NS, False),
    ],
)  # fmt: skip
def test_it_begins_only_when_most_agree_and_the_fit_is_sure(
    off_ns: int, moved: Sequence[int], period_ns: int, error_ns: float, begins: bool
) -> None:
    pairing = EdgePairing(LEAD_NS)
    for i in range(8):
        at = i * period_ns
        pairing.add_events([(at + off_ns * (i in moved), i)])
        assert not pairing.pair(at, at + NS_PER_MS, at + LEAD_NS, error_ns, float(period_ns), 1.0)
    assert pairing.running is begins


def test_lines_without_events_are_dropped_and_a_line_follows_32_events() -> None:
    pairing = running()
    assert [(pair(pairing, 100 + i), pairing.running) for i in range(8)] == [(False, i < 7) for i in range(8)]
    assert pairing.learned
    pairing = running()
    for i in range(100, 364):
        pairing.add_events([(i * PERIOD_NS, i)])
        pair(pairing, i, PERIOD_NS + LEAD_NS)
    assert pairing.number < 364
    assert not pairing.learned or abs(pairing.delay_ns) < PERIOD_NS / 2
    pairing, found = running(), list[bool]()
    for at in range(100 * PERIOD_NS, 164 * PERIOD_NS, PERIOD_NS):  # each event is later than its frame
        pairing.add_events([(at, 1)])
        found.append(pairing.pair(at, at - 1, at + LEAD_NS, ERROR_NS, float(PERIOD_NS), 1.0))
    assert (found, pairing.learned) == ([True] * 63 + [False], False)
    for slope, is_paired in ((1.1199, True), (1.1201, False)):
        pairing, at = running(), 100 * PERIOD_NS
        pairing.add_events([(at, 1)])
        assert pairing.pair(at, at + NS_PER_MS, at + LEAD_NS, ERROR_NS, float(PERIOD_NS), slope) is is_paired
    # The window is 30 us and eight spreads. The spread starts at 10 us and has a memory of 32 events.
    assert [running(count).learned for count in (23, 24)] == [False, True], "16 pairs after the eighth event"
    assert running(8).spread_ns == 10_000
    for count in (40, 500):
        for beyond in (0, 1):
            pairing, at = running(count), count * PERIOD_NS
            off_ns = int(30_000 + 8 * 10_000 * (31 / 32) ** (count - 8)) + beyond
            pairing.add_events([(at + off_ns, 1)])
            assert pair(pairing, count) == (not beyond)
    pairing = running(500)
    pairing.add_events([(500 * PERIOD_NS + 20_000, 500)])
    assert pair(pairing, 500)
    assert pairing.spread_ns == pytest.approx(20_000 / 32, abs=0.01)
    pair(pairing, 501)
    # gains of the 32nd of equally weighted points: 2 * 63 / (32 * 33) of the level, 6 / (32 * 33) of the slope
    assert pairing.due_ns - 501 * PERIOD_NS == pytest.approx(20_000 * (126 + 6) / (32 * 33), abs=1)


def test_a_pulse_belongs_to_the_sample_within_half_a_period() -> None:
    marks, half_ns = MarkPairing(), PERIOD_NS // 2
    marks.add_pulses([(PERIOD_NS - half_ns - 1, 1), (PERIOD_NS - half_ns, 2), (PERIOD_NS + half_ns, 3)])
    marks.add_sample(PERIOD_NS, 7, 0)
    marks.add_sample(PERIOD_NS, 7, PERIOD_NS)
    assert marks.take_marks() == [(PERIOD_NS - half_ns - 1, 1, None), (PERIOD_NS - half_ns, 2, 7)]
    marks.add_pulses([(PERIOD_NS + half_ns + number, 3 + number) for number in range(1, 1024)])
    marks.add_sample(2 * PERIOD_NS, 8, PERIOD_NS)
    assert [(mark.number, mark.seq) for mark in marks.take_marks()] == [(number, 8) for number in range(3, 1027)]
    marks.add_pulses([(3 * PERIOD_NS, number) for number in range(1025)])
    marks.add_sample(3 * PERIOD_NS, 9, PERIOD_NS)
    assert [mark.number for mark in marks.take_marks()] == [*range(1, 1025)]
