"""Edge of a read, by time stamps only."""

from math import sqrt

import pytest

from imud.contracts.lines import Edge, ReadyOptions
from imud.sampling.path import ReadyEdges

KEPT = 1024

MS = 1_000_000
EXACT = ReadyOptions(line="Y", bias_us=0)


def edge(number: int, t_ns: int | None = None) -> Edge:
    """Return an edge at number · 1 ms by default."""
    return Edge(number * MS if t_ns is None else t_ns, True, number)


def edges(*numbers: int, settings: ReadyOptions = EXACT) -> ReadyEdges:
    made = ReadyEdges(settings, MS)
    made.on_edges([edge(number) for number in numbers])
    return made


def read(made: ReadyEdges, start_ms: float, end_ms: float) -> tuple[int, int] | None:
    """Return the number of the edge and its time, ns."""
    stamp = made.match(round(start_ms * MS), round(end_ms * MS))
    return (stamp.number, stamp.t_ns) if stamp is not None else None


def test_a_read_is_of_the_newest_edge_before_it_and_the_others_are_missed() -> None:
    made = edges(1, 2, 3)
    assert [read(made, at, at + 0.2) for at in (1.1, 2.0, 3.3)] == [(1, MS), (2, 2 * MS), (3, 3 * MS)]
    assert made.missed == 0
    made = edges(1, 2, 3, 4)
    assert read(made, 1.1, 1.2) == (1, MS)
    assert read(made, 4.2, 4.3) == (4, 4 * MS)
    assert made.missed == 2
    made = edges(1, 5)
    assert read(made, 1.1, 1.2) == (1, MS)
    assert read(made, 5.1, 5.2) == (5, 5 * MS)
    assert (made.missed, made.interval_ns) == (3, MS)


def test_edges_read_twice_or_before_a_restart_are_not_missed() -> None:
    made = edges(1, 2)
    assert [read(made, at, at + 0.1) for at in (1.1, 1.5, 2.1)] == [(1, MS), (1, MS), (2, 2 * MS)]
    assert made.missed == 0
    made = edges(1, 2, 3, 4)
    read(made, 1.1, 1.2)
    made.restart()
    assert read(made, 4.1, 4.2) == (4, 4 * MS)
    assert made.missed == 0


def test_a_read_without_an_edge_has_no_time_stamp() -> None:
    made = edges(2, 3)
    assert read(made, 1.9, 1.95) is None
    assert read(made, 4.5, 4.6) == (3, 3 * MS)
    assert read(made, 4.6, 4.7) is None
    assert read(ReadyEdges(EXACT, MS), 1, 2) is None
    made = edges(1, 2, 3)
    assert read(made, 1.1, 1.2) == (1, MS)
    assert read(made, 400, 401) == (3, 3 * MS)
    assert read(made, 402, 403) is None
    made.on_edges([edge(4, 500 * MS)])
    assert read(made, 1300, 1301) is None
    made = edges(*range(1, 3 * KEPT))
    assert read(made, 2 * KEPT - 0.5, 2 * KEPT - 0.4) is None
    assert read(made, 2 * KEPT + 0.1, 2 * KEPT + 0.2) == (2 * KEPT, 2 * KEPT * MS)
    assert read(made, 3 * KEPT - 0.9, 3 * KEPT - 0.8) == (3 * KEPT - 1, (3 * KEPT - 1) * MS)


def test_the_error_is_that_of_the_stamp_and_of_the_assumption() -> None:
    plain, assumed = edges(1).match(MS, MS + 1), edges(1, settings=ReadyOptions(line="Y")).match(MS, MS + 1)
    assert plain is not None
    assert assumed is not None
    assert plain.err_ns == pytest.approx(3_000, abs=2)
    assert assumed.err_ns == pytest.approx(3_000 + 100_000 / sqrt(3), abs=2)


@pytest.mark.parametrize(("end_ms", "either"), [(1.999, False), (2.0, True), (2.7, True)])
def test_new_values_during_a_read_may_be_those_that_were_read(end_ms: float, either: bool) -> None:
    stamp = edges(1, 2).match(round(1.9 * MS), round(end_ms * MS))
    assert stamp is not None
    assert stamp.number == 1
    assert stamp.err_ns == pytest.approx(MS / sqrt(2) if either else 3_000, abs=10)


@pytest.mark.parametrize(("offset_us", "t_ns"), [(-400, 600_000), (50, 1_050_000), (500, 1_100_000)])
def test_the_offset_moves_the_stamp_but_not_behind_the_read(offset_us: float, t_ns: int) -> None:
    stamp = edges(1, settings=ReadyOptions(line="Y", offset_us=offset_us)).match(round(1.1 * MS), 2 * MS)
    assert stamp is not None
    assert stamp.t_ns == t_ns
