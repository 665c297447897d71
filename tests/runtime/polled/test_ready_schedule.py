"""Edges instead of deadlines, deadlines instead of edges."""

from imud.runtime.polled.ready_schedule import ReadySchedule
from imud.runtime.polled.schedule import Deadlines
from imud.signals.ready_edges import QUIET_NS

MS = 1_000_000
BEGIN = 1000 * MS


def schedule(rate_hz: float = 100.0) -> ReadySchedule:
    """One whose first read, which waits for nothing, is over at once."""
    made = ReadySchedule(rate_hz, BEGIN, Deadlines())
    assert made.due_ns == BEGIN
    read(made, BEGIN, 0)
    return made


def read(made: ReadySchedule, start_ns: int, takes_ns: int = MS // 5) -> None:
    made.begun(start_ns)
    made.done(start_ns + takes_ns)


def test_an_edge_is_due_at_once_and_nothing_without_one() -> None:
    made = schedule()
    assert made.due_ns == BEGIN + QUIET_NS
    for number in range(1, 100):
        t_ns = BEGIN + number * MS
        made.seen(t_ns, MS)
        assert (made.due_ns, made.period_ns) == (t_ns, MS)
        read(made, t_ns + 100_000)
        assert made.due_ns == t_ns + QUIET_NS
    assert (made.counts.polls, made.counts.late, made.counts.missed) == (100, 0, 0)
    assert made.counts.sum_late_ns == 99 * 100_000
    assert made.counts.worst_ns == 100_000


def test_later_than_a_quarter_of_the_interval_is_late() -> None:
    made = schedule()
    for number, late_ns in enumerate((250_000, 250_001, 900_000), 1):
        made.seen(BEGIN + number * MS, MS)
        read(made, BEGIN + number * MS + late_ns, 0)
    assert made.counts.late == 2


def test_an_edge_that_was_read_already_is_not_read_again() -> None:
    """It was told late: a read that began after it had its values."""
    made = schedule()
    made.seen(BEGIN + MS, MS)
    read(made, BEGIN + 2 * MS + 100_000)
    made.seen(BEGIN + 2 * MS, MS)
    assert made.due_ns == BEGIN + 2 * MS + QUIET_NS
    made.seen(BEGIN + 2 * MS + 100_001, MS)
    assert made.due_ns == BEGIN + 2 * MS + 100_001


def test_without_edges_deadlines_come_again() -> None:
    made = schedule(100.0)
    at_ns = made.due_ns + 7
    read(made, at_ns)
    assert not made.by_edges
    for number in range(1, 5):
        assert made.due_ns == at_ns + number * 10 * MS
        read(made, made.due_ns)
    assert made.period_ns == 10 * MS
    assert made.counts.polls == 6
    assert made.counts.worst_ns == 0


def test_rare_edges_are_waited_for_longer() -> None:
    made = schedule()
    made.seen(BEGIN + 400 * MS, 400 * MS)
    read(made, BEGIN + 400 * MS)
    assert made.due_ns == BEGIN + 1600 * MS


def test_one_edge_is_no_return_two_are() -> None:
    made = schedule()
    read(made, made.due_ns)
    t_ns = made.due_ns + 3 * MS
    deadline_ns = made.due_ns
    made.seen(t_ns, QUIET_NS)
    assert (made.by_edges, made.due_ns) == (False, deadline_ns)
    made.seen(t_ns + QUIET_NS + 1, QUIET_NS)
    assert not made.by_edges
    made.seen(t_ns + QUIET_NS + MS, MS)
    assert (made.by_edges, made.due_ns) == (True, t_ns + QUIET_NS + MS)


def test_deadlines_without_a_read_are_missed() -> None:
    made = schedule(100.0)
    read(made, made.due_ns, 35 * MS)
    assert made.counts.missed == 2
