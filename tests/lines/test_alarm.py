"""ALARM line: its events, their rate, and the report of a wiring fault."""

from math import radians

import msgspec
import pytest

from imud.contracts.lines import AlarmRange, AlarmRanges, Edge
from imud.lines.alarm import AlarmCheck, AlarmLine, AlarmMonitor, AlarmVerdict, judge
from imud.model.event import EventKind
from imud.model.sample import Sample, Sync, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.support.signal_bench import SignalBench

FRESH_NS = 150 * 10**6

TICK_NS = 100 * NS_PER_MS
X_OFF = AlarmRange(1, -10, 10, False)
ON = AlarmRanges({"X": X_OFF, "Y": AlarmRange(0, -5, 5, True)}, "PIN7", "MOUNT")
SAMPLE = Sample("bow", 1, 0, 0, Sync.ARRIVAL, 0, 0)


@pytest.fixture
def signals() -> SignalBench:
    return SignalBench()


def test_an_active_alarm_at_the_start_edges_and_a_line_that_came_back_are_events(signals: SignalBench) -> None:
    line = AlarmLine(signals.raise_event)
    line.on_level(5, False)
    assert (line.active, line.raised, len(signals.events)) == (False, 0, 0)
    line = AlarmLine(signals.raise_event)
    line.on_level(5, True)
    assert (line.active, line.raised) == (True, 1)
    (event,) = signals.events
    assert (event.t_ns, event.kind, event.message) == (5, EventKind.ALARM, "alarm")
    assert event.detail == {"active": True, "raised": 1, "changes": 1}
    # The edge that arrived between opening the line and reading its level
    line.on_edges([Edge(10 * NS_PER_S, True, 1)])
    assert (len(signals.events), line.raised) == (1, 1)
    signals.events.clear()
    line = AlarmLine(signals.raise_event)
    line.on_level(0, False)
    line.on_edges([Edge(10 * NS_PER_S, True, 1)])
    line.on_edges([Edge(20 * NS_PER_S, False, 2)])
    assert [(event.t_ns, event.message) for event in signals.events] == [
        (10 * NS_PER_S, "alarm"), (20 * NS_PER_S, "alarm ended")
    ]  # fmt: skip
    assert (line.active, line.raised) == (False, 1)
    signals.events.clear()
    line = AlarmLine(signals.raise_event)
    line.on_level(0, True)
    line.on_level(NS_PER_S, None)
    assert line.active is None
    line.tick(10 * NS_PER_S)
    line.on_level(20 * NS_PER_S, True)
    assert (line.raised, len(signals.events)) == (2, 2)


def test_a_chattering_line_makes_one_event_a_second_and_the_last_state_is_reported(signals: SignalBench) -> None:
    line = AlarmLine(signals.raise_event)
    line.on_level(0, False)
    line.on_edges([Edge(NS_PER_S + n * NS_PER_MS, n % 2 == 0, n + 1) for n in range(1500)])
    assert [event.t_ns for event in signals.events] == [NS_PER_S, 2 * NS_PER_S]
    assert signals.events[1].message == "alarm (the line changed 1000 times)"
    assert (signals.events[1].detail, line.raised) == ({"active": True, "raised": 501, "changes": 1000}, 750)
    signals.events.clear()
    line = AlarmLine(signals.raise_event)
    line.on_level(0, True)
    line.on_edges([Edge(NS_PER_MS, False, 1)])
    line.tick(NS_PER_S - 1)
    assert len(signals.events) == 1
    line.tick(NS_PER_S)
    line.tick(3 * NS_PER_S)
    assert signals.messages() == ["alarm", "alarm ended"]


class Monitored:
    def __init__(self, signals: SignalBench) -> None:
        self.signals = signals
        self.monitor = AlarmMonitor(signals.raise_event)
        self.monitor.set_ranges(ON)
        self.monitor.line.on_level(0, False)
        self.number = 0

    @property
    def now_ns(self) -> int:
        return self.signals.clock.now_ns()

    @property
    def verdicts(self) -> list[tuple[str, object]]:
        assert all(event.kind is EventKind.ALARM and event.t_ns <= self.now_ns for event in self.signals.events)
        return [(event.message, event.detail.get("verdict")) for event in self.signals.events]

    def edge(self, active: bool) -> None:
        self.number += 1
        self.monitor.line.on_edges([Edge(self.now_ns, active, self.number)])

    def run(self, seconds: float, roll_deg: float | None, pitch_deg: float = 0.0, age_ns: int = 0) -> None:
        """Samples with this age at each tick."""
        for _ in range(round(seconds * NS_PER_S / TICK_NS)):
            self.signals.clock.advance(TICK_NS)
            angles = None if roll_deg is None else (radians(roll_deg), radians(pitch_deg), 0.0)
            t_ns = self.now_ns - age_ns
            self.monitor.tick(self.now_ns, msgspec.structs.replace(SAMPLE, t_ns=t_ns, t_rx_ns=t_ns, euler_rad=angles))


@pytest.fixture
def it(signals: SignalBench) -> Monitored:
    return Monitored(signals)


def test_a_correct_line_causes_no_event(it: Monitored) -> None:
    it.run(3, 0)
    it.edge(True)
    it.run(3, 20)
    assert [message for message, _ in it.verdicts] == ["alarm"]
    assert it.monitor.problem == ""


def test_a_wire_that_is_not_connected(it: Monitored) -> None:
    it.run(3, 20)
    ((message, verdict),) = it.verdicts
    assert verdict == "stuck_low"
    assert message == (
        "line alarm: it is low while an angle is out of the range in the device settings (X off, Y -5 to 5°): is the "
        "wire connected to the alarm pin (PIN7)?"
    )
    assert message == f"line alarm: {it.monitor.problem}"
    it.edge(True)
    it.run(1, 20)
    assert it.verdicts[-1] == ("line alarm: it agrees with the angles again", "right")
    assert it.monitor.problem == ""


def test_a_line_that_is_inverted(it: Monitored) -> None:
    it.edge(True)
    it.run(3, 0)
    assert "active_low" in it.monitor.problem
    assert it.verdicts[-1][1] == "stuck_high"


def test_the_other_axis(it: Monitored) -> None:
    it.run(1, 0)
    it.edge(True)
    it.run(1, 0, pitch_deg=20)
    assert it.monitor.problem == ""
    it.run(3, 0, pitch_deg=20)
    assert "mounting" in it.monitor.problem
    assert it.monitor.problem.endswith("(MOUNT)?")


def test_no_verdict_without_settings_angles_level_or_fresh_samples(it: Monitored) -> None:
    it.run(5, None)
    it.run(5, 20, age_ns=FRESH_NS + 1)
    it.monitor.line.on_level(it.now_ns, None)
    it.run(5, 20)
    it.monitor.line.on_level(it.now_ns, False)
    it.monitor.set_ranges(None)
    it.run(5, 20)
    it.monitor.tick(it.now_ns, None)
    assert it.verdicts == []


def test_settings_that_are_read_again_end_a_fault_only_when_they_differ(it: Monitored) -> None:
    it.run(3, 20)
    it.monitor.set_ranges(ON._replace(by_axis=dict(ON.by_axis)))
    assert it.monitor.problem
    it.monitor.set_ranges(ON._replace(by_axis={"X": X_OFF, "Y": AlarmRange(0, -30, 30, True)}))
    assert it.monitor.problem == ""
    it.run(3, 20)
    assert len(it.verdicts) == 1


FAULT_NS = 2 * 10**9
MARGIN_DEG = 0.5
SETTLE_NS = 200 * 10**6

ROLL, PITCH = 0, 1
BOTH = {"X": AlarmRange(PITCH, -10, 10, True), "Y": AlarmRange(ROLL, -5, 5, True)}
ONLY_Y = {"X": AlarmRange(PITCH, -10, 10, False), "Y": AlarmRange(ROLL, -5, 5, True)}


def angles(x_deg: float, y_deg: float) -> Vector3:
    """Roll is about Y, pitch about X."""
    return radians(y_deg), radians(x_deg), radians(77)


@pytest.mark.manual("B 2.2.4 alarm level")
def test_verdicts_and_at_the_limit_either_level_is_right() -> None:
    for ranges, euler_rad, level, verdict in (
        (BOTH, angles(0, 0), False, AlarmVerdict.RIGHT), (BOTH, angles(0, 0), True, AlarmVerdict.STUCK_HIGH),
        (BOTH, angles(0, -6), True, AlarmVerdict.RIGHT), (BOTH, angles(12, 12), False, AlarmVerdict.STUCK_LOW),
        (BOTH, angles(-12, 0), False, AlarmVerdict.STUCK_LOW), (BOTH, angles(7, 0), True, AlarmVerdict.STUCK_HIGH),
        (ONLY_Y, angles(20, 0), False, AlarmVerdict.RIGHT), (ONLY_Y, angles(20, 0), True, AlarmVerdict.STUCK_HIGH),
        (BOTH, angles(9.6, 0), False, AlarmVerdict.UNKNOWN), (BOTH, angles(9.6, 7), False, AlarmVerdict.STUCK_LOW),
        (BOTH, angles(10.4, 0), True, AlarmVerdict.UNKNOWN), (BOTH, None, True, AlarmVerdict.UNKNOWN),
        ({}, angles(0, 0), True, AlarmVerdict.UNKNOWN),
    ):  # fmt: skip
        assert judge(ranges, euler_rad, level) is verdict
    for at in (-5, 5):
        for off in (-0.9, 0.9):
            assert judge(ONLY_Y, angles(0, at + off * MARGIN_DEG), True) is AlarmVerdict.UNKNOWN
    assert judge(ONLY_Y, angles(0, 5 + 1.1 * MARGIN_DEG), True) is AlarmVerdict.RIGHT
    assert judge(ONLY_Y, angles(0, -5 + 1.1 * MARGIN_DEG), False) is AlarmVerdict.RIGHT


def test_a_lasting_contradiction_is_reported_once() -> None:
    check, changes = AlarmCheck(ONLY_Y), []
    step_ns = 10 * NS_PER_MS
    for number in range(1000):
        out = 100 <= number < 200 or number >= 300
        level = 103 <= number < 203  # it lags; the wire is broken from 300 on
        change = check.add_sample(number * step_ns, angles(0, 9.0 if out else 0.0), level)
        if change:
            changes.append((number, change))
    assert changes == [(SETTLE_NS // step_ns, AlarmVerdict.RIGHT), (300 + FAULT_NS // step_ns, AlarmVerdict.STUCK_LOW)]
    assert check.verdict is AlarmVerdict.STUCK_LOW


def run(levels_of_y: bool, *, stuck: bool = False) -> AlarmVerdict:
    """A device that tilts about X, then about Y. Its line follows the tilt about Y, the tilt about X, or no tilt."""
    check = AlarmCheck(ONLY_Y)
    for number in range(4000):
        x_deg, y_deg = (9.0, 0.0) if number % 2000 < 500 else (0.0, 9.0) if number % 2000 < 1000 else (0.0, 0.0)
        level = not stuck and (y_deg if levels_of_y else x_deg) > 5
        check.add_sample(number * 10 * NS_PER_MS, angles(x_deg, y_deg), level)
        if number % 2000 == 900:
            verdict = check.verdict
    return verdict


def test_exchanged_axes_are_distinguished_from_a_line_that_is_not_connected() -> None:
    assert run(levels_of_y=True) is AlarmVerdict.RIGHT
    assert run(levels_of_y=False) is AlarmVerdict.OTHER_AXIS
    assert run(levels_of_y=True, stuck=True) is AlarmVerdict.STUCK_LOW
    check = AlarmCheck(ONLY_Y)
    for number in range(1000):
        check.add_sample(number * 10 * NS_PER_MS, angles(0, 9), level=False)
    assert check.verdict is AlarmVerdict.STUCK_LOW
