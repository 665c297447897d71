"""Turns on a line that is never idle."""

from imud.contracts.polling import Poll
from imud.runtime.polled.bus import Buses
from imud.runtime.polled.round_robin import RoundRobin
from imud.runtime.polled.schedule import Deadlines
from tests.runtime.polled.test_bus import ASK, Sink, Wire, run


def test_all_take_turns_whatever_a_turn_takes() -> None:
    counts = [Deadlines() for _ in range(3)]
    turns = [RoundRobin(100, one) for one in counts]
    now_ns, order = 100, []
    for number in range(30):
        first = min(turns, key=lambda turn: turn.due_ns)
        assert first.due_ns <= now_ns  # always due
        order.append(turns.index(first))
        first.begun(now_ns)
        now_ns += 1000 if number % 7 else 500_000
        first.done(now_ns)
    assert order == [0, 1, 2] * 10
    assert [one.polls for one in counts] == [10] * 3
    assert [one.late + one.missed + one.worst_ns for one in counts] == [0] * 3


def test_who_comes_back_waits_for_its_turn() -> None:
    busy, back = RoundRobin(0, Deadlines()), RoundRobin(50, Deadlines())
    busy.done(49)
    assert busy.due_ns < back.due_ns
    busy.done(60)
    assert back.due_ns < busy.due_ns


def test_on_a_bus_every_reading_is_handed_over_at_once() -> None:
    """Something is always due there, so that no idle moment comes to do it in."""

    async def body(buses: Buses) -> None:
        wires = [Wire(), Wire()]
        sinks = [Sink(), Sink()]
        for wire, sink in zip(wires, sinks, strict=True):
            wire.rate_hz = 0.0
            buses.get("wire").join(wire, Deadlines(), sink.take).start((Poll(ASK),))
        for sink in sinks:
            await sink.enough.wait()
        for sink in sinks:
            assert sink.calls == len(sink.readings) > 20

    run(body)
