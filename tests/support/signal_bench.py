"""GPIO lines without hardware: one device in memory and simulated time, and gpiod 2 with simulated chips."""

import errno
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gpiod as real

from imud.host.threads import Job
from imud.lines.gpio import EVENT
from imud.model.event import Event, EventKind
from imud.sim.ports.pins import MemoryInput, MemoryLines, MemoryOutput
from tests.support.event_loops import VirtualClock

DEVICE = "bow"


class HandWorker:
    """A `Worker` without a thread. The test calls `work`."""

    def __init__(self, _name: str, job: Job) -> None:
        self.work, self.failed = job.do_round, job.round_failed
        self.rung = 0
        self.ended = False

    def ring(self) -> None:
        self.rung += 1

    def end(self) -> bool:
        self.ended = True
        return True


class HandWorkers(list[HandWorker]):
    def start(self, name: str, job: Job) -> HandWorker:
        self.append(HandWorker(name, job))
        return self[-1]


class SignalBench:
    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.memory = MemoryLines(self.clock.now_ns)
        self.workers = HandWorkers()
        self.factory = replace(self.memory.maker, start_worker=self.workers.start)
        self.events: list[Event] = []

    def input(self, key: str) -> MemoryInput:
        return self.memory.inputs[f"{DEVICE} {key}"]

    def output(self, key: str) -> MemoryOutput:
        return self.memory.outputs[f"{DEVICE} {key}"]

    def raise_event(
        self, now_ns: int, kind: EventKind, message: str, /, **detail: str | int | float | bool | None
    ) -> None:
        assert isinstance(kind, EventKind)
        assert now_ns >= 0
        self.events.append(Event(now_ns, DEVICE, kind, message, dict(detail)))

    def messages(self, kind: EventKind | None = None) -> list[str]:
        return [event.message for event in self.events if kind in (None, event.kind)]


class FakeRequest:
    """A requested line. `feed` adds events like the kernel."""

    def __init__(self, settings: Any) -> None:
        self.settings = settings
        self.fd, self._far = os.pipe()
        self.released = False
        self.value = False
        self.error = 0

    def feed(self, *events: tuple[int, int, int]) -> None:
        os.write(self._far, b"".join(EVENT.pack(t_ns, kind, 0, seqno, seqno) for t_ns, kind, seqno in events))

    def get_value(self, _offset: int) -> bool:
        if self.error:
            raise OSError(self.error, "by the test")
        return self.value

    def release(self) -> None:
        assert not self.released
        self.released = True
        os.close(self.fd)
        os.close(self._far)


class FakeGpiod:
    line = real.line
    LineSettings = real.LineSettings

    def __init__(self, devices: Path, **chips: tuple[str, tuple[str, ...]]) -> None:
        self.chips = chips
        self.errors: dict[str, int] = {}
        self.refusal = 0
        self.holder = ""
        self.requests: list[FakeRequest] = []
        self.asked: list[tuple[str, int, str, int | None]] = []
        for name in chips:
            (devices / name).touch()

    def Chip(self, path: str) -> "FakeChip":
        name = os.path.basename(path)
        if number := self.errors.get(name, 0 if name in self.chips else errno.ENOTTY):
            raise OSError(number, "by the test")
        return FakeChip(*self.chips[name], self.holder)

    def request_lines(
        self, path: str, config: dict[int, Any], consumer: str, event_buffer_size: int | None
    ) -> FakeRequest:
        ((offset, settings),) = config.items()
        self.asked.append((os.path.basename(path), offset, consumer, event_buffer_size))
        if self.refusal:
            raise OSError(self.refusal, "by the test")
        self.requests.append(FakeRequest(settings))
        return self.requests[-1]


class FakeChip:
    def __init__(self, label: str, names: tuple[str, ...], holder: str) -> None:
        self._label, self._names, self._holder = label, names, holder

    def __enter__(self) -> "FakeChip":
        return self

    def __exit__(self, *_error: object) -> None: ...

    def get_info(self) -> SimpleNamespace:
        return SimpleNamespace(label=self._label, num_lines=len(self._names))

    def get_line_info(self, offset: int) -> SimpleNamespace:
        return SimpleNamespace(name=self._names[offset], consumer=self._holder)
