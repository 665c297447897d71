"""Deadlines: no drift, lateness counted, missed ones passed over and counted."""

from imud.runtime.polled.schedule import Deadlines, Schedule

MS = 1_000_000


def schedule(rate_hz: float = 1000.0, begin_ns: int = 5 * MS) -> Schedule:
    return Schedule(rate_hz, begin_ns, Deadlines())


def test_deadlines_do_not_drift_with_late_reads() -> None:
    one = schedule()
    for number in range(1000):
        assert one.due_ns == 5 * MS + number * MS
        one.begun(one.due_ns + 200_000)
        one.done(one.due_ns + 900_000)
    assert (one.counts.polls, one.counts.late, one.counts.missed) == (1000, 0, 0)
    assert one.counts.sum_late_ns == 1000 * 200_000
    assert one.counts.worst_ns == 200_000


def test_later_than_a_quarter_of_the_period_is_late() -> None:
    one = schedule()
    for late_ns in (250_000, 250_001, 999_999):
        one.begun(one.due_ns + late_ns)
        one.done(one.due_ns + late_ns)
    assert one.counts.late == 2


def test_missed_deadlines_are_counted_and_the_rest_stays_in_step() -> None:
    one = schedule()
    one.begun(5 * MS)
    one.done(5 * MS + 3_400_000)  # 6 and 7 passed and their whole periods with them; 8 is 0.4 ms late
    assert one.counts.missed == 2
    assert one.due_ns == 8 * MS
    one.begun(8 * MS + 400_000)
    one.done(8 * MS + 500_000)
    assert one.due_ns == 9 * MS
    assert one.counts.missed == 2


def test_read_that_ends_right_at_a_deadline_misses_none() -> None:
    one = schedule()
    one.done(6 * MS + 999_999)
    assert (one.due_ns, one.counts.missed) == (6 * MS, 0)
    one.done(8 * MS)
    assert (one.due_ns, one.counts.missed) == (8 * MS, 1)


def test_counts_go_on_over_schedules() -> None:
    counts = Deadlines()
    for _ in range(2):
        one = Schedule(50.0, 0, counts)
        one.begun(0)
        one.done(1)
    assert counts.polls == 2
