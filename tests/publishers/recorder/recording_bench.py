"""Context of a recorder with records, time and workers of the test."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from imud.contracts.publisher import PutRecord
from imud.formats import records
from imud.formats.recording import RecordingReader
from imud.formats.records import Kind, Record
from imud.model.event import Event
from imud.model.units import NS_PER_S
from tests.support.event_loops import VirtualClock
from tests.support.publisher_context import publisher_context
from tests.support.signal_bench import HandWorkers

UTC_OFFSET_NS = 1_763_717_507 * NS_PER_S
EPOCH = 0x5F3A9C01


class HandSource:
    """Devices with records of the test."""

    def __init__(self) -> None:
        self.present = ["bow", "mast"]
        self.listening: list[PutRecord] = []
        # Called when the recorder describes a device, which takes time
        self.on_begin: Callable[[], None] = lambda: None

    def names(self) -> Sequence[str]:
        return self.present

    def begin_host(self, put: PutRecord) -> None:
        put(records.encode(Kind.CALL, records.NO_DEVICE, b""))

    def begin(self, device: str, put: PutRecord) -> None:
        put(records.encode(Kind.DEVICE, self.present.index(device), b""))
        self.listening = [put]
        self.on_begin()

    def check(self, device: str, put: PutRecord) -> None:
        put(records.encode(Kind.CHECK, self.present.index(device), b""))

    def end(self, put: PutRecord) -> None:
        self.listening = []

    def deliver(self, size: int = 50) -> None:
        for put in self.listening:
            put(records.encode_data(0, os.urandom(size), 1, -1))


class RecordingBench:
    """Time, devices, events and workers of a recorder."""

    def __init__(self) -> None:
        self.clock, self.source = VirtualClock(), HandSource()
        self.events: list[Event] = []
        self.workers = HandWorkers()
        # Called when the recorder reads the clocks, which can make a record
        self.on_clocks_read: Callable[[], None] = lambda: None
        self.context = publisher_context(
            list, EPOCH, self.clock.now_ns, recording=self.source, utc_offset_ns=self._utc_offset_ns,
            raise_event=self.events.append,
        )  # fmt: skip

    def _utc_offset_ns(self) -> int:
        self.on_clocks_read()
        return UTC_OFFSET_NS

    def advance(self, seconds: float) -> int:
        """Advance the time. Return CLOCK_MONOTONIC."""
        self.clock.advance(round(seconds * NS_PER_S))
        return self.clock.now_ns()


def records_in(path: Path) -> list[Record]:
    """Return the records of a complete recording with an end record."""
    with path.open("rb") as file:
        reader = RecordingReader(file, path.name)
        found = list(reader)
    assert reader.problems == []
    return found


def kinds_in(path: Path) -> list[int]:
    return [record.kind for record in records_in(path)]
