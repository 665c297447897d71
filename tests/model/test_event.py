"""Stored events: groups, order, limits."""

import msgspec

from imud.model.event import Event, EventKind, EventLog, kind_of

S = 1_000_000_000


def event(t_s: int, kind: EventKind = EventKind.LOSS, message: str = "", device: str = "bow") -> Event:
    return Event(t_s * S, device, kind, message)


def seen(log: EventLog, since_s: int = 0, limit: int = 10, *devices: str) -> list[tuple[int, int, int]]:
    found = log.newest(since_s * S, limit, devices or None)
    return [(one.first_ns // S, one.t_ns // S, one.count) for one in found.events]


def test_repeated_events_are_one_group_while_they_continue() -> None:
    log = EventLog()
    for t_s in (0, 1, 61, 122):
        log.add(event(t_s, message=f"{t_s} samples lost"))
    assert seen(log) == [(0, 61, 3), (122, 122, 1)]
    assert [one.message for one in log.newest(0, 10).events] == ["61 samples lost", "122 samples lost"]
    assert [b'"count"' in msgspec.json.encode(one) for one in log.newest(0, 10).events] == [True, False]
    log.add(event(123, EventKind.ALARM, "active"))
    log.add(event(124, EventKind.ALARM, "inactive"))
    log.add(event(125, EventKind.ALARM, "active"))
    assert seen(log, 123) == [(124, 124, 1), (123, 125, 2)]
    log = EventLog()
    for t_s, phase in enumerate(("begin", "turn", "turn", "end")):
        log.add(Event(t_s * S, "bow", EventKind.CALIBRATION, str(t_s), {"kind": "magnetometer", "phase": phase}))
    assert seen(log) == [(0, 0, 1), (1, 2, 2), (3, 3, 1)]


def test_devices_are_merged_by_time_and_events_of_the_daemon_always_included() -> None:
    log = EventLog()
    for t_s, device in ((1, "bow"), (2, "mast"), (3, ""), (4, "bow")):
        log.add(event(t_s, EventKind.UP, str(t_s), device))
    assert [one[1] for one in seen(log)] == [1, 2, 3, 4]
    assert [one[1] for one in seen(log, 0, 2)] == [3, 4]
    assert [one[1] for one in seen(log, 0, 10, "mast")] == [2, 3]
    assert [one[1] for one in seen(log, 3)] == [3, 4]
    log.remove("bow")
    assert [one[1] for one in seen(log)] == [2, 3]
    assert [kind_of(name) for name in ("up", "of a newer imud")] == [EventKind.UP, "of a newer imud"]


def test_the_oldest_groups_are_removed_and_the_reply_says_since_when_it_is_complete() -> None:
    log = EventLog(5)
    log.add(event(70, device="mast"))
    assert [log.newest(since, 10).since_ns for since in (0, 9)] == [5, 9]
    for number in range(1003):
        log.add(event(61 + number // 1000, EventKind.UP, str(number)) if number else event(0, EventKind.UP, "1"))
    found, since_ns = log.newest(0, 2000, ["bow"]).events, log.newest(0, 2000).since_ns
    assert (len(found), found[0].message, since_ns) == (1000, "3", 61 * S + 1)
    assert [log.newest(0, *one).since_ns for one in ((2, None), (9, ["mast"]))] == [62 * S + 1, 5]
    for message, count in (("0", 1), ("1002", 2)):
        log.add(event(62, EventKind.UP, message))
        assert log.newest(0, 2000, ["bow"]).events[-1].count == count
