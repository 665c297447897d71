"""Times of reads: deadlines without drift, turns on a busy bus, edges of a data-ready line."""

from imud.contracts.codec import Poll
from imud.device.polled_bus import Deadlines, ReadySchedule, RoundRobin, Schedule
from tests.device.test_polled_bus import ASK, Sink, Wire
from tests.support.event_loops import VirtualClock, run_virtually, virtual_buses

QUIET_NS = 500 * 10**6

MS = 1_000_000
BEGIN = 1000 * MS


def schedule(rate_hz: float = 1000.0, begin_ns: int = 5 * MS) -> Schedule:
    return Schedule(rate_hz, begin_ns, Deadlines())


def test_deadlines_do_not_drift_and_counters_continue() -> None:
    one = schedule()
    for number in range(1000):
        assert one.due_ns == 5 * MS + number * MS
        one.begun(one.due_ns + 200_000)
        one.done(one.due_ns + 900_000)
    assert (one.counts.polls, one.counts.late, one.counts.missed) == (1000, 0, 0)
    assert (one.counts.sum_late_ns, one.counts.worst_ns) == (1000 * 200_000, 200_000)
    counts = Deadlines()
    for _ in range(2):
        one = Schedule(50.0, 0, counts)
        one.begun(0)
        one.done(1)
    assert counts.polls == 2


def test_late_and_missed_deadlines_are_counted() -> None:
    one = schedule()
    for late_ns in (250_000, 250_001, 999_999):
        one.begun(one.due_ns + late_ns)
        one.done(one.due_ns + late_ns)
    assert one.counts.late == 2
    one = schedule()
    one.begun(5 * MS)
    one.done(5 * MS + 3_400_000)  # deadlines 6 and 7 have passed with their periods; 8 is 0.4 ms late
    assert (one.counts.missed, one.due_ns) == (2, 8 * MS)
    one.begun(8 * MS + 400_000)
    one.done(8 * MS + 500_000)
    assert (one.due_ns, one.counts.missed) == (9 * MS, 2)
    one = schedule()
    one.done(6 * MS + 999_999)
    assert (one.due_ns, one.counts.missed) == (6 * MS, 0)
    one.done(8 * MS)
    assert (one.due_ns, one.counts.missed) == (8 * MS, 1)


# --- turns ------------------------------------------------------------------------------------------------------------


def test_devices_alternate_even_after_a_return() -> None:
    counts = [Deadlines() for _ in range(3)]
    turns = [RoundRobin(100, one) for one in counts]
    now_ns, order = 100, []
    for number in range(30):
        first = min(turns, key=lambda turn: turn.due_ns)
        assert first.due_ns <= now_ns  # a turn is always due
        order.append(turns.index(first))
        first.begun(now_ns)
        now_ns += 1000 if number % 7 else 500_000
        first.done(now_ns)
    assert order == [0, 1, 2] * 10
    assert [one.polls for one in counts] == [10] * 3
    assert [one.late + one.missed + one.worst_ns for one in counts] == [0] * 3
    busy, back = RoundRobin(0, Deadlines()), RoundRobin(50, Deadlines())
    busy.done(49)
    assert busy.due_ns < back.due_ns
    busy.done(60)
    assert back.due_ns < busy.due_ns


def test_a_busy_bus_delivers_each_reading_immediately() -> None:
    """A read is always due, so that the thread is never idle."""
    clock = VirtualClock()

    async def body() -> None:
        buses, sinks = virtual_buses(clock), [Sink(), Sink()]
        for sink in sinks:
            wire = Wire()
            wire.rate_hz, wire.takes_time = 0.0, lambda: clock.advance(1000)
            buses.get("wire").join(wire, Deadlines(), sink.on_readings).start((Poll(ASK),))
        for sink in sinks:
            await sink.enough.wait()
            assert sink.calls == len(sink.readings) > 20
        buses.end()

    run_virtually(clock, body())


# --- edges ------------------------------------------------------------------------------------------------------------


def by_edges(rate_hz: float = 100.0) -> ReadySchedule:
    """Return a schedule after its first, immediate read."""
    made = ReadySchedule(rate_hz, BEGIN, Deadlines())
    assert made.due_ns == BEGIN
    read(made, BEGIN, 0)
    return made


def read(made: ReadySchedule, start_ns: int, takes_ns: int = MS // 5) -> None:
    made.begun(start_ns)
    made.done(start_ns + takes_ns)


def test_a_read_is_late_after_a_quarter_of_the_interval() -> None:
    made = by_edges()
    assert made.due_ns == BEGIN + QUIET_NS
    for number in range(1, 100):
        t_ns = BEGIN + number * MS
        made.on_edges([t_ns], MS)
        assert (made.due_ns, made.period_ns) == (t_ns, MS)
        read(made, t_ns + 100_000)
        assert made.due_ns == t_ns + QUIET_NS
    assert (made.counts.polls, made.counts.late, made.counts.missed) == (100, 0, 0)
    assert (made.counts.sum_late_ns, made.counts.worst_ns) == (99 * 100_000, 100_000)
    made = by_edges()
    for number, late_ns in enumerate((250_000, 250_001, 900_000), 1):
        made.on_edges([BEGIN + number * MS], MS)
        read(made, BEGIN + number * MS + late_ns, 0)
    assert made.counts.late == 2


def test_an_edge_is_read_once_and_counted_by_its_time() -> None:
    """The loop reports the edge late: a read after the edge already has its values."""
    made = by_edges()
    made.on_edges([BEGIN + MS], MS)
    read(made, BEGIN + 2 * MS + 100_000)
    made.on_edges([BEGIN + 2 * MS], MS)
    assert made.due_ns == BEGIN + 2 * MS + QUIET_NS
    made.on_edges([BEGIN + 2 * MS + 100_001], MS)
    assert made.due_ns == BEGIN + 2 * MS + 100_001
    made = by_edges()
    for number in range(1, 100):
        t_ns = BEGIN + number * MS
        made.noticed(t_ns + 30_000)
        assert made.due_ns == t_ns + 30_000
        told_first = number % 3 == 0  # the loop knows the time before the read starts
        if told_first:
            made.on_edges([t_ns], MS)
            assert made.due_ns == t_ns
        read(made, t_ns + 100_000)
        assert made.has_read(t_ns + 100_000)
        assert not made.has_read(t_ns + 100_001)
        assert made.due_ns == t_ns + (0 if told_first else 30_000) + QUIET_NS
        if not told_first:
            made.on_edges([t_ns], MS)
            assert made.due_ns == t_ns + QUIET_NS  # no second read
    made.on_edges([BEGIN + 100 * MS], MS)
    assert (made.counts.polls, made.counts.late, made.counts.missed) == (100, 0, 0)
    assert (made.counts.sum_late_ns, made.counts.worst_ns) == (99 * 100_000, 100_000)
    made = by_edges()
    for number in range(1, 6):
        made.noticed(BEGIN + number * MS + 10_000)
        read(made, BEGIN + number * MS + (300_000 if number == 4 else 20_000))
    assert made.counts.polls == 1
    made.on_edges([BEGIN + number * MS for number in range(1, 7)], MS)
    assert (made.counts.polls, made.counts.late, made.counts.worst_ns) == (6, 1, 300_000)
    made.noticed(BEGIN + 8 * MS + 10_000)  # no read for 6 and 7
    read(made, BEGIN + 8 * MS + 20_000)
    made.on_edges([BEGIN + 7 * MS, BEGIN + 8 * MS], MS)
    assert (made.counts.polls, made.counts.sum_late_ns) == (7, 4 * 20_000 + 300_000 + 20_000)


def test_two_edges_end_the_use_of_deadlines() -> None:
    made = by_edges()
    made.noticed(BEGIN + MS)
    read(made, BEGIN + MS)
    read(made, made.due_ns)
    assert not made.by_edges
    made.noticed(BEGIN + 600 * MS)  # a single edge can be a disturbance: no read
    assert made.due_ns < BEGIN + 600 * MS
    made.on_edges([BEGIN + 600 * MS], 600 * MS)
    assert not made.by_edges
    made.on_edges([BEGIN + 601 * MS], MS)
    assert made.by_edges
    made.noticed(BEGIN + 602 * MS)
    assert made.due_ns == BEGIN + 602 * MS
    made = by_edges()
    read(made, made.due_ns)
    t_ns = made.due_ns + 3 * MS
    deadline_ns = made.due_ns
    made.on_edges([t_ns], QUIET_NS)
    assert (made.by_edges, made.due_ns) == (False, deadline_ns)
    made.on_edges([t_ns + QUIET_NS + 1], QUIET_NS)
    assert not made.by_edges
    made.on_edges([t_ns + QUIET_NS + MS], MS)
    assert (made.by_edges, made.due_ns) == (True, t_ns + QUIET_NS + MS)


def test_missing_edges_start_the_use_of_deadlines() -> None:
    made = by_edges(100.0)
    at_ns = made.due_ns + 7
    read(made, at_ns)
    assert not made.by_edges
    for number in range(1, 5):
        assert made.due_ns == at_ns + number * 10 * MS
        read(made, made.due_ns)
    assert (made.period_ns, made.counts.polls, made.counts.worst_ns) == (10 * MS, 6, 0)
    made = by_edges()
    made.on_edges([BEGIN + 400 * MS], 400 * MS)
    read(made, BEGIN + 400 * MS)
    assert made.due_ns == BEGIN + 1600 * MS
    made = by_edges(100.0)
    read(made, made.due_ns, 35 * MS)
    assert made.counts.missed == 2
