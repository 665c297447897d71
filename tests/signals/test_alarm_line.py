"""The alarm line: what is an event, what is counted, and how a chattering line is kept from flooding."""

import pytest

from imud.contracts.lines import Edge
from imud.event import EventKind
from imud.signals.alarm_line import AlarmLine
from imud.units import NS_PER_MS, NS_PER_S


class Told:
    """The events."""

    def __init__(self) -> None:
        self.events: list[tuple[int, str, dict[str, object]]] = []

    def __call__(self, now_ns: int, kind: EventKind, message: str, **detail: str | int | float | bool | None) -> None:
        assert kind is EventKind.ALARM
        self.events.append((now_ns, message, dict(detail)))


@pytest.fixture
def told() -> Told:
    return Told()


def test_no_alarm_at_the_beginning_is_no_news(told: Told) -> None:
    line = AlarmLine(told)
    line.level(5, False)
    assert (line.active, line.raised, len(told.events)) == (False, 0, 0)


def test_an_alarm_at_the_beginning_is(told: Told) -> None:
    line = AlarmLine(told)
    line.level(5, True)
    assert (line.active, line.raised) == (True, 1)
    assert told.events == [(5, "alarm", {"active": True, "raised": 1, "changes": 1})]


def test_edges_are_events_at_their_own_time(told: Told) -> None:
    line = AlarmLine(told)
    line.level(0, False)
    line.edges([Edge(10 * NS_PER_S, True, 1)])
    line.edges([Edge(20 * NS_PER_S, False, 2)])
    assert [(t_ns, message) for t_ns, message, _ in told.events] == [
        (10 * NS_PER_S, "alarm"), (20 * NS_PER_S, "no alarm any more")
    ]  # fmt: skip
    assert (line.active, line.raised) == (False, 1)


def test_a_line_that_chatters_makes_one_event_a_second(told: Told) -> None:
    line = AlarmLine(told)
    line.level(0, False)
    line.edges([Edge(NS_PER_S + n * NS_PER_MS, n % 2 == 0, n + 1) for n in range(1500)])
    assert [t_ns for t_ns, _, _ in told.events] == [NS_PER_S, 2 * NS_PER_S]
    assert told.events[1][1:] == (
        "alarm (the line changed 1000 times)", {"active": True, "raised": 501, "changes": 1000}
    )  # fmt: skip
    assert line.raised == 750


def test_the_last_state_is_always_told(told: Told) -> None:
    line = AlarmLine(told)
    line.level(0, True)
    line.edges([Edge(NS_PER_MS, False, 1)])
    line.tick(NS_PER_S - 1)
    assert len(told.events) == 1
    line.tick(NS_PER_S)
    line.tick(3 * NS_PER_S)
    assert [message for _, message, _ in told.events] == ["alarm", "no alarm any more"]


def test_what_is_known_already_is_nothing_new(told: Told) -> None:
    """The edge that came between opening the line and reading its level."""
    line = AlarmLine(told)
    line.level(0, True)
    line.edges([Edge(10 * NS_PER_S, True, 1)])
    assert (len(told.events), line.raised) == (1, 1)


def test_a_line_that_went_away_and_came_back(told: Told) -> None:
    line = AlarmLine(told)
    line.level(0, True)
    line.unknown()
    assert line.active is None
    line.tick(10 * NS_PER_S)
    line.level(20 * NS_PER_S, True)
    assert line.raised == 2
    assert len(told.events) == 2
