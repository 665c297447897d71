"""Limit of alerts: one at a time, and a maximum number per hour."""

from imud.model.units import NS_PER_S
from imud.publishers.recorder.flight import Alert, AlertGate

HOUR_NS = 3600 * NS_PER_S

AFTER_NS = 30 * NS_PER_S


def alert(t_ns: int, reason: str = "a blow") -> Alert:
    return Alert(t_ns, "bow", reason)


def test_an_alert_is_due_once_with_all_later_alerts() -> None:
    gate = AlertGate(AFTER_NS, 6)
    assert gate.take_due(0) is None
    assert gate.add(alert(5))
    assert gate.add(alert(6, "another"))
    assert gate.take_due(5 + AFTER_NS - 1) is None
    assert gate.take_due(5 + AFTER_NS) == alert(5)
    assert gate.take_due(5 + AFTER_NS) is None
    assert gate.left_out == 0
    gate.add(alert(7))
    assert gate.take_due(8, at_once=True) == alert(7)  # at the end of imud


def test_alerts_per_hour_are_limited_and_the_first_ignored_alert_is_reported() -> None:
    gate = AlertGate(0, 2)
    for t_ns in (0, 10):
        assert gate.add(alert(t_ns))
        assert gate.take_due(t_ns) is not None
    assert [gate.add(alert(t_ns)) for t_ns in (20, 21, HOUR_NS - 1)] == [False, True, True]
    assert gate.take_due(HOUR_NS) is None
    assert gate.left_out == 3
    assert gate.add(alert(HOUR_NS))
    assert gate.take_due(HOUR_NS) == alert(HOUR_NS)
    assert gate.add(alert(HOUR_NS + 9)) is False
