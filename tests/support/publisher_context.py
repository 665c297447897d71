"""`PublisherContext` for tests of outputs. Without arguments it has no device, no line and no recording."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from imud.contracts.lines import DriveLine, UtcReference, WatchLine
from imud.contracts.publisher import (
    DeviceControl,
    DeviceLedger,
    Latencies,
    OutputFacts,
    PublisherClock,
    PublisherContext,
    PutRecord,
    RecordingSource,
)
from imud.contracts.status import DeviceStatus
from imud.model.errors import CommandError
from imud.model.event import Event
from imud.model.ledger import LEDGER_FIELDS, NOTHING_LOST


class NothingRecorded:
    def names(self) -> Sequence[str]:
        return ()

    def begin_host(self, put: PutRecord) -> None:
        pass

    def begin(self, device: str, put: PutRecord) -> None:
        pass

    def check(self, device: str, put: PutRecord) -> None:
        pass

    def end(self, put: PutRecord) -> None:
        pass


class NoLine:
    def tick(self, now_ns: int) -> None:
        pass

    def close(self) -> None:
        pass


class FakeLatencies:
    """Latency requests by requester: latency, ns, and devices."""

    def __init__(self) -> None:
        self.asked: dict[str, tuple[int, tuple[str, ...] | None]] = {}

    def ask(self, who: str, latency_ns: int, devices: Collection[str] | None = None) -> None:
        self.asked[who] = (latency_ns, None if devices is None else tuple(devices))

    def release(self, who: str) -> None:
        self.asked.pop(who, None)


def _no_device(name: str) -> DeviceControl:
    raise CommandError(f"{name}: no such device")


def _no_line(*_: object) -> Any:
    return NoLine()


@dataclass(frozen=True)
class FakeDevices:
    status: Callable[[], Sequence[DeviceStatus]]
    control: Callable[[str], DeviceControl]
    recording: RecordingSource
    each_status: Callable[[], Iterator[DeviceStatus]]
    ledgers: Callable[[], Sequence[DeviceLedger]]
    losses: Callable[[str], tuple[int, ...]]


@dataclass
class FakeOwner:
    send_event: Callable[[Event], None]

    def tick_soon(self) -> None: ...

    def end_with(self, error: BaseException) -> None:
        raise error


def publisher_context(
    status: Callable[[], Sequence[DeviceStatus]] = list, epoch: int = 1, now_ns: Callable[[], int] = lambda: 0,
    control: Callable[[str], DeviceControl] = _no_device, *, cpu_ns: Callable[[], int] = lambda: 0,
    utc_offset_ns: Callable[[], int] = lambda: 0, utc_reference: Callable[[], UtcReference | None] = lambda: None,
    each_status: Callable[[], Iterator[DeviceStatus]] | None = None,
    ledgers: Callable[[], Sequence[DeviceLedger]] | None = None, recording: RecordingSource | None = None,
    outputs: OutputFacts | None = None, latencies: Latencies | None = None, watch_line: WatchLine = _no_line,
    drive_line: DriveLine = _no_line,
    raise_event: Callable[[Event], None] = lambda _event: None,
    losses: Callable[[str], tuple[int, ...]] = lambda _name: NOTHING_LOST,
) -> PublisherContext:  # fmt: skip
    devices = FakeDevices(
        status, control, recording or NothingRecorded(), each_status or (lambda: iter(status())),
        ledgers or (lambda: [(d.name, d.driver, tuple(d.ledger.get(f, 0) for f in LEDGER_FIELDS)) for d in status()]),
        losses,
    )  # fmt: skip
    return PublisherContext(
        epoch, PublisherClock(now_ns, utc_offset_ns, utc_reference, cpu_ns), devices, outputs or OutputFacts(),
        latencies or FakeLatencies(), watch_line, drive_line, FakeOwner(raise_event),
    )  # fmt: skip
