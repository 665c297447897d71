"""Contract of a publisher: it outputs samples and events, and never makes the pipeline wait."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from socket import socket
from typing import Any, Final, Protocol

from imud.attitude.conventions import Convention
from imud.attitude.published import PublishedAxes, as_sent
from imud.contracts.command import Actions, CalibrationResult, Calibrations
from imud.contracts.lines import UtcReference, WatchLine
from imud.contracts.setting import AppliedSettings, SettingsPlan, SettingsReport
from imud.contracts.status import ClientStatus, DeviceStatus, FlightStatus, MqttStatus, OutputStatus, RecorderStatus
from imud.formats.slot import encode_slots
from imud.model.event import Event
from imud.model.options import Options
from imud.model.sample import Sample

PutRecord = Callable[[bytes], None]
"""Takes a whole record (`imud.formats.records`); returns at once. Called in the event loop's thread."""

TakeSnapshot = Callable[[socket], float]
"""Sends what a flight recorder has to a client's socket, a recording, and closes it; returns at once how many seconds
that is. Raises ServerError. Called in the event loop's thread."""


class RecordingSource(Protocol):
    """The devices and the host's clocks of a daemon, as recorders see them. Synchronization: the loop's thread only."""

    def names(self) -> Sequence[str]:
        """Names of the devices there are."""
        ...

    def begin_host(self, put: PutRecord) -> None:
        """Describe the host's clocks, and pass on their readings from now on; again for one that listens already."""
        ...

    def begin(self, device: str, put: PutRecord) -> None:
        """Describe a device, and pass on all that it delivers; again for one that listens already. No-op if absent."""
        ...

    def check(self, device: str, put: PutRecord) -> None:
        """Pass on the newest sample and the ledger of a device as a record. No-op if absent."""
        ...

    def end(self, put: PutRecord) -> None:
        """Pass on nothing of any device any more, nor of the host."""
        ...


AS_SENT: Final = as_sent()
"""Axes and angles of HiPNUC modules: what a batch has of which nothing else is said."""
DeviceLedger = tuple[str, str, Mapping[str, int]]
"""Name of a device, its driver as in `DeviceStatus.driver`, its ledger now."""


class Batch:
    """Samples completed by one read of one device, oldest first, at least one; shared by all publishers, immutable."""

    __slots__ = ("_converted", "_slots", "device", "device_id", "frame", "samples")

    def __init__(self, device: str, device_id: int, samples: Sequence[Sample], frame: PublishedAxes = AS_SENT) -> None:
        self.device = device
        self.device_id = device_id
        """The daemon's number of the device, as in slots."""
        self.samples = samples
        self.frame = frame
        """Axes and angles of the samples."""
        self._slots: list[bytes] | None = None
        self._converted: dict[Convention, Batch] | None = None

    def slots(self) -> list[bytes]:
        """The samples as slots (`imud.formats.slot`), encoded on first use."""
        slots = self._slots
        if slots is None:
            slots = self._slots = encode_slots(self.samples, self.device_id)
        return slots

    def converted(self, convention: Convention | None) -> "Batch":
        """Return the samples in a convention, turned on first use; None is as they are published."""
        rotation = None if convention is None else self.frame.rotation_to(convention)
        if convention is None or rotation is None:
            return self
        if self._converted is None:
            self._converted = {}
        made = self._converted.get(convention)
        if made is None:
            made = Batch(self.device, self.device_id, rotation.samples(self.samples), self.frame)
            self._converted[convention] = made
        return made


class Publisher(Protocol):
    """An output of samples. Every method returns at once and is called in the event loop's thread only."""

    @property
    def publish(self) -> Callable[[Batch], None] | None:
        """Gives samples to readers; drops and counts them for slow readers. None for an output without samples.

        It stays the same from `start` on: the daemon looks it up once.
        """
        ...

    def start(self) -> None:
        """Open what it needs (files, sockets, threads). Raises ServerError. Needs a running asyncio loop."""
        ...

    def add_device(self, name: str, device_id: int) -> None:
        """Prepare for a device that the configuration added."""
        ...

    def remove_device(self, name: str) -> None:
        """Remove a device that left the configuration."""
        ...

    def event(self, event: Event) -> None:
        """Give an event to readers."""
        ...

    def tick(self, now_ns: int) -> None:
        """Send heartbeats and ledgers, check time-outs; called ten times a second."""
        ...

    def close(self) -> None:
        """Release everything; may be called twice."""
        ...


class DeviceControl(Protocol):
    """What clients with the permission may do to one device. Answers are values that JSON can carry."""

    @property
    def actions(self) -> Actions:
        """Its actions now, by name."""
        ...

    async def act(self, name: str, arguments: Mapping[str, Any]) -> object:
        """Run an action and return its answer. Raises ImudError."""
        ...

    @property
    def calibrations(self) -> Calibrations:
        """Its guided calibrations now, by kind."""
        ...

    async def calibrate(self, kind: str, *, save: bool) -> CalibrationResult:
        """Run a guided calibration to its end. Raises ImudError."""
        ...

    def stop_calibration(self) -> bool:
        """End the calibration that runs; return whether there was one."""
        ...

    async def settings_report(self, *, fresh: bool) -> SettingsReport:
        """Return its own settings: asked for now if `fresh`, otherwise as reported last. Raises ImudError."""
        ...

    async def settings_plan(self, given: Mapping[str, Any] | None, *, save: bool) -> SettingsPlan:
        """Return what would make it as `given` (None: as declared). Raises ImudError."""
        ...

    async def settings_apply(self, given: Mapping[str, Any] | None, *, save: bool) -> AppliedSettings:
        """Make it as `given` (None: as declared). Raises ImudError, with nothing written."""
        ...


class Latencies(Protocol):
    """Where consumers of samples ask for the latency they need: samples of a device may wait for the strictest."""

    def ask(self, who: str, latency_ns: int, devices: Collection[str] | None = None) -> None:
        """Ask for samples of `devices` (None: of all) at most so late, in place of what `who` asked for before."""
        ...

    def release(self, who: str) -> None:
        """Ask for nothing any more; no-op for one that does not ask."""
        ...


class Devices(Protocol):
    """The devices of the daemon. Only `imud.daemon`, which no output may import, implements this type.

    Synchronization: the event loop's thread only, the iterator included.
    """

    @property
    def recording(self) -> RecordingSource:
        """The source of records of all devices."""
        ...

    def status(self) -> Sequence[DeviceStatus]:
        """Return the state of every device."""
        ...

    def each_status(self) -> Iterator[DeviceStatus]:
        """Return an iterator that makes the state of a device in each step. Use it for a reply in several pieces."""
        ...

    def ledgers(self) -> Sequence[DeviceLedger]:
        """Return the ledger of every device. The complete state costs five times as much CPU time."""
        ...

    def control(self, name: str) -> DeviceControl:
        """Return the device of this name. Raises CommandError if the device does not exist."""
        ...


@dataclass(frozen=True, slots=True)
class PublisherClock:
    """Clocks of the host and of the event loop."""

    now_ns: Callable[[], int]
    """Returns CLOCK_MONOTONIC, ns. Any thread may call it."""
    utc_offset_ns: Callable[[], int]
    """Returns CLOCK_REALTIME minus CLOCK_MONOTONIC, ns."""
    utc_reference: Callable[[], UtcReference | None]
    """Returns this offset with its error; None if CLOCK_REALTIME is not synchronized. Any thread may call it."""
    cpu_ns: Callable[[], int]
    """Returns the CPU time of the event loop's thread, ns."""


@dataclass(frozen=True, slots=True)
class OutputFacts:
    """Facts that outputs publish about themselves for other outputs. An output removes its facts when it closes.

    Synchronization: the event loop's thread only.
    """

    clients: list[Callable[[], Sequence[ClientStatus]]] = field(default_factory=list)
    """Functions that return the clients of an output."""
    recorders: list[Callable[[], RecorderStatus]] = field(default_factory=list)
    flights: list[Callable[[], FlightStatus]] = field(default_factory=list)
    sentences: list[Callable[[], Sequence[OutputStatus]]] = field(default_factory=list)
    """Functions that return the state of the ports of an output that sends sentences."""
    mqtts: list[Callable[[], MqttStatus]] = field(default_factory=list)
    snapshots: list[TakeSnapshot] = field(default_factory=list)
    """Functions of flight recorders that send a snapshot."""
    rings: dict[str, str] = field(default_factory=dict)
    """Path of the ring file of each device in shared memory."""
    without_ring: set[str] = field(default_factory=set)
    """Devices that have no ring file because imud cannot create it now."""


@dataclass(frozen=True, slots=True)
class PublisherContext:
    """The parts of the daemon that outputs may use."""

    epoch: int
    """Random number of this start of the daemon, 64 bits. Readers use it to recognize a restart."""
    clock: PublisherClock
    devices: Devices
    outputs: OutputFacts
    latencies: Latencies
    """Register of the latencies that readers need."""
    watch_line: WatchLine
    """Watches a GPIO line that belongs to no device."""
    raise_event: Callable[[Event], None]
    """Sends an event of the daemon to all outputs."""


@dataclass(frozen=True, slots=True)
class PublisherType:
    """Row of a publisher."""

    name: str
    """The top-level key in the configuration."""
    settings: type[Options]
    make: Callable[[Any, PublisherContext], Publisher]
    wanted: Callable[[Any], bool] = attrgetter("enabled")
    """Whether there is anything to do with these settings."""
    required: bool = True
    """Whether the daemon ends when it cannot start at the beginning; otherwise it is tried again and again."""
