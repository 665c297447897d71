"""The alarm line next to the angles: events, and a wiring fault with what to look at."""

from math import radians

import msgspec
import pytest

from imud.contracts.lines import Edge
from imud.event import EventKind
from imud.sample import Sample, Sync
from imud.signals.alarm_watch import FRESH_NS, AlarmWatch
from imud.units import NS_PER_MS, NS_PER_S

TICK_NS = 100 * NS_PER_MS
ON = {"ALARM_X": "-10,10,0,0", "ALARM_Y": "-5,5,0,1"}
SAMPLE = Sample("bow", 1, 0, 0, Sync.ARRIVAL, 0, 0)


class Bench:
    """A watch, its time, and what it tells."""

    def __init__(self) -> None:
        self.told: list[tuple[str, object]] = []
        self.watch = AlarmWatch(self._tell)
        self.now_ns = 0
        self.number = 0

    def _tell(self, now_ns: int, kind: EventKind, message: str, **detail: str | int | float | bool | None) -> None:
        assert kind is EventKind.ALARM
        assert now_ns <= self.now_ns
        self.told.append((message, detail.get("verdict")))

    def level(self, active: bool) -> None:
        self.number += 1
        self.watch.edges([Edge(self.now_ns, active, self.number)])

    def run(self, seconds: float, roll_deg: float | None, pitch_deg: float = 0.0, age_ns: int = 0) -> None:
        """Samples that old at every tick."""
        for _ in range(round(seconds * NS_PER_S / TICK_NS)):
            self.now_ns += TICK_NS
            angles = None if roll_deg is None else (radians(roll_deg), radians(pitch_deg), 0.0)
            t_ns = self.now_ns - age_ns
            self.watch.tick(self.now_ns, msgspec.structs.replace(SAMPLE, t_ns=t_ns, t_rx_ns=t_ns, euler_rad=angles))


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    made.watch.settings(ON)
    made.watch.level(0, False)
    return made


def test_a_line_that_does_as_it_is_set_is_no_news(bench: Bench) -> None:
    bench.run(3, 0)
    bench.level(True)
    bench.run(3, 20)
    assert [message for message, _ in bench.told] == ["alarm"]
    assert bench.watch.problem == ""


def test_a_wire_that_is_not_connected(bench: Bench) -> None:
    bench.run(3, 20)
    ((message, verdict),) = bench.told
    assert verdict == "stuck_low"
    assert message == (
        "line alarm: it is low while an angle is out of the range that the device is set to (X off, Y -5 to 5°): is "
        "the wire connected, and to the pin that has the alarm (PMUX5)?"
    )
    assert message == f"line alarm: {bench.watch.problem}"
    bench.level(True)
    bench.run(1, 20)
    assert bench.told[-1] == ("line alarm: it agrees with the angles again", "right")
    assert bench.watch.problem == ""


def test_a_line_that_is_inverted(bench: Bench) -> None:
    bench.level(True)
    bench.run(3, 0)
    assert "active_low" in bench.watch.problem
    assert bench.told[-1][1] == "stuck_high"


def test_the_other_axis(bench: Bench) -> None:
    bench.run(1, 0)
    bench.level(True)
    bench.run(1, 0, pitch_deg=20)
    assert bench.watch.problem == ""
    bench.run(3, 0, pitch_deg=20)
    assert "mounted" in bench.watch.problem


def test_nothing_is_said_without_settings_angles_level_or_fresh_samples(bench: Bench) -> None:
    bench.run(5, None)
    bench.run(5, 20, age_ns=FRESH_NS + 1)
    bench.watch.level(bench.now_ns, None)
    bench.run(5, 20)
    bench.watch.level(bench.now_ns, False)
    bench.watch.settings({})
    bench.run(5, 20)
    bench.watch.tick(bench.now_ns, None)
    assert bench.told == []


def test_settings_that_are_read_again_end_a_fault_only_when_they_differ(bench: Bench) -> None:
    bench.run(3, 20)
    bench.watch.settings(dict(ON))
    assert bench.watch.problem
    bench.watch.settings({**ON, "ALARM_Y": "-30,30,0,1"})
    assert bench.watch.problem == ""
    bench.run(3, 20)
    assert len(bench.told) == 1
