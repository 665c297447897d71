"""Events about notable status bits: set and cleared, with a limited rate."""

from itertools import pairwise
from typing import Any

from imud.contracts.driver import StatusBit, status_words
from imud.device.health import DeviceEvents
from imud.device.watches import StatusWatch
from imud.drivers import DRIVERS
from imud.model.event import Event, EventKind
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S

CLEAR_NS = 1 * 10**9
INTERVAL_NS = 1 * 10**9

TICK_NS = 100 * NS_PER_MS
OVER_RANGE, DISTURBED, AT_REST = 1 << 5, 1 << 4, 1 << 9


class FakePath:
    """A path with the status bits of the test."""

    def __init__(self) -> None:
        self.mask = self.status = 0
        self.last_sample_ns = 0

    def watch_status(self, mask: int) -> None:
        self.mask = mask

    def take_status(self) -> int:
        return self.status & self.mask


class WatchBench:
    def __init__(self) -> None:
        self.events: list[Event] = []
        self.watch = StatusWatch(DeviceEvents("bow", Ledger(), self.events.append))
        self.path: Any = FakePath()
        self.now_ns = 1000 * NS_PER_S

    def step(self, status: int | None, count: int = 1) -> list[str]:
        """Process samples with a status (None: no samples). Return the messages of the events."""
        before = len(self.events)
        for _ in range(count):
            self.now_ns += TICK_NS
            self.path.status = status or 0
            if status is not None:
                self.path.last_sample_ns = self.now_ns
            self.watch.tick(self.now_ns, DRIVERS["hipnuc-uart"], self.path)
        return [event.message for event in self.events[before:]]


def test_set_and_cleared_bits_raise_events() -> None:
    bench = WatchBench()
    assert bench.step(AT_REST, 20) == []
    assert bench.step(OVER_RANGE) == ["status: accelerometer over range"]
    assert bench.events[-1].kind is EventKind.ALARM
    assert bench.events[-1].detail == {"accelerometer over range": True}
    assert bench.step(0, CLEAR_NS // TICK_NS) == []
    assert bench.step(0, 3) == ["status: cleared: accelerometer over range"]
    assert bench.step(0, 100) == []
    bench = WatchBench()
    bench.step(DISTURBED)
    assert bench.step(None, 50) == []
    assert bench.step(DISTURBED, 5) == []
    assert bench.step(0, 12) == ["status: cleared: magnetic disturbance"]


def test_one_event_per_second_contains_all_changes() -> None:
    bench = WatchBench()
    messages = [message for i in range(600) for message in bench.step(OVER_RANGE if i // 14 % 2 else DISTURBED)]
    times = [event.t_ns for event in bench.events]
    assert len(messages) > 30
    assert min(b - a for a, b in pairwise(times)) >= INTERVAL_NS
    other = WatchBench()
    other.step(DISTURBED | OVER_RANGE)
    other.step(DISTURBED, 10)
    assert other.step(0) == ["status: cleared: accelerometer over range"]
    assert other.step(OVER_RANGE) == []
    assert other.step(0, 9) == ["status: accelerometer over range, cleared: magnetic disturbance"]


def test_the_bits_of_a_replaced_device_raise_events_again() -> None:
    bench = WatchBench()
    assert bench.step(DISTURBED | OVER_RANGE, 20)
    bench.path = FakePath()
    assert bench.step(AT_REST, 20) == []  # no bit of the previous device is cleared
    assert bench.step(DISTURBED) == ["status: magnetic disturbance"]
    assert bench.step(0, 20) == ["status: cleared: magnetic disturbance"]


def test_a_driver_without_notable_bits_is_not_watched() -> None:
    bench = WatchBench()
    bench.path.status = ~0
    bench.watch.tick(bench.now_ns, DRIVERS["imu61x-can"], bench.path)
    bench.watch.tick(bench.now_ns, None, None)
    assert bench.events == []


def test_words_of_a_status() -> None:
    bits = {0: StatusBit("first"), 9: StatusBit("tenth")}
    assert status_words(bits, 1 << 9 | 1 << 4) == ("tenth",)
    assert status_words(bits, None) == ()
