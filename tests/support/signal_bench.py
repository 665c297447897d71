"""What signals need around them: virtual time, lines in memory, threads that the test runs, and the events raised."""

from collections.abc import Callable
from dataclasses import replace

from imud.event import Event, EventKind
from imud.sim.ports.lines import MemoryInput, MemoryLines, MemoryOutput
from imud.worker import Round
from tests.support.virtual_time import VirtualClock

DEVICE = "bow"


class HandWorker:
    """A `Worker` without a thread: the test calls `work`."""

    def __init__(self, _name: str, work: Round, failed: Callable[[BaseException], None]) -> None:
        self.work, self.failed = work, failed
        self.rung = 0
        self.ended = False

    def ring(self) -> None:
        self.rung += 1

    def end(self) -> None:
        self.ended = True


class SignalBench:
    """The surroundings of the lines of one device."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.memory = MemoryLines(self.clock.now_ns)
        self.workers: list[HandWorker] = []
        self.factory = replace(self.memory.maker, start_worker=self.start_worker)
        self.events: list[Event] = []

    def input(self, key: str) -> MemoryInput:
        """The device's end of an input, once it was made."""
        return self.memory.inputs[f"{DEVICE} {key}"]

    def output(self, key: str) -> MemoryOutput:
        """The device's end of an output, once it was made."""
        return self.memory.outputs[f"{DEVICE} {key}"]

    def start_worker(self, name: str, work: Round, failed: Callable[[BaseException], None]) -> HandWorker:
        """As `StartWorker`."""
        self.workers.append(HandWorker(name, work, failed))
        return self.workers[-1]

    def raise_event(
        self, now_ns: int, kind: EventKind, message: str, **detail: str | int | float | bool | None
    ) -> None:
        """As `RaiseEvent`."""
        self.events.append(Event(now_ns, DEVICE, kind, message, dict(detail)))

    def messages(self, kind: EventKind | None = None) -> list[str]:
        """Messages of the events so far, of one kind or of all."""
        return [event.message for event in self.events if kind in (None, event.kind)]
