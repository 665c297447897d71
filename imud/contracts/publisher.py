"""Contract of a publisher: it outputs samples and events and never delays the device."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from socket import socket
from typing import Any, ClassVar, Final, NamedTuple, Protocol, cast

from imud.attitude.conventions import Convention
from imud.attitude.published import PublishedAxes, as_sent
from imud.contracts.command import CalibrationResult, Calibrations, LastCalibration, Verbs
from imud.contracts.driver import Driver
from imud.contracts.firmware import FirmwareControl
from imud.contracts.lines import DriveLine, LineOptions, UtcReference, WatchLine
from imud.contracts.link import Claim, HostProblem
from imud.contracts.registry import load
from imud.contracts.setting import AppliedSettings, SettingsPlan, SettingsReport
from imud.contracts.status import (
    ClientStatus,
    DeviceStatus,
    FlightStatus,
    MqttStatus,
    OutputState,
    OutputStatus,
    RecorderStatus,
    RulesStatus,
)
from imud.formats.slot import SLOT_BYTES, decode_slots, encode_slots, slot_seqs, slot_times_ns
from imud.model.event import Event, EventLog
from imud.model.options import Options
from imud.model.sample import Sample

# Receives a complete record (`imud.formats.records`) and does not block. Called in the thread of the event loop.
PutRecord = Callable[[bytes], None]

# Starts to send the data of a flight recorder as a recording to a client's socket, which it then closes. Returns the
# length of the recording, s, without blocking. Raises ServerError. Called in the thread of the event loop.
TakeSnapshot = Callable[[socket], float]


class RecordingSource(Protocol):
    """Data of devices and host clocks for recorders. `imud.device` implements it, and outputs may not import that part.
    Synchronization: the thread of the loop only."""

    def names(self) -> Sequence[str]:
        """Return the names of the present devices."""
        ...

    def begin_host(self, put: PutRecord) -> None:
        """Describe the host clocks, then report each of their readings. Call again to repeat the description."""
        ...

    def begin(self, device: str, put: PutRecord) -> None:
        """Describe a device if it exists, then pass on all its data. A second call repeats the description."""
        ...

    def check(self, device: str, put: PutRecord) -> None:
        """Write the newest sample and the ledger of a device as a record. Do nothing if the device is absent."""
        ...

    def end(self, put: PutRecord) -> None:
        """Stop the recording of all devices and of the host."""
        ...


AS_SENT: Final = as_sent()  # axes and angles of HiPNUC devices: default of a batch
# Name of a device, its driver as in `DeviceStatus.driver`, and its present ledger
DeviceLedger = tuple[str, str, tuple[int, ...]]


class Batch:
    """Samples from one read of one device, oldest first, at least one. All publishers share the object. Immutable.

    A batch has sample objects and packed slots: the first use of the other form makes it. An output that needs only
    slots thus creates no sample objects.
    """

    __slots__ = ("_converted", "_packed", "_samples", "device", "device_id", "frame")

    is_packed: ClassVar = False  # whether the path made slots without sample objects

    def __init__(self, device: str, device_id: int, samples: Sequence[Sample], frame: PublishedAxes = AS_SENT) -> None:
        self.device = device
        self.device_id = device_id  # number of the device in slots
        self.frame = frame  # axes and angles of the samples
        self._samples: Sequence[Sample] | None = samples
        self._packed: bytes | None = None
        self._converted: dict[Convention, Batch] | None = None

    @property
    def samples(self) -> Sequence[Sample]:
        """Sample objects."""
        if self._samples is None:
            self._samples = decode_slots(self.packed, self.device)
        return self._samples

    @property
    def packed(self) -> bytes:
        """Slots (`imud.formats.slot`) back to back."""
        if self._packed is None:
            slots = encode_slots(self.samples, self.device_id)
            self._packed = slots[0] if len(slots) == 1 else b"".join(slots)
        return self._packed

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.packed) // SLOT_BYTES if self.is_packed else len(self.samples)

    @property
    def seqs(self) -> tuple[int, int]:
        """Sequence numbers of the first and the last sample."""
        return slot_seqs(self.packed) if self.is_packed else (self.samples[0].seq, self.samples[-1].seq)

    @property
    def times_ns(self) -> Sequence[int]:
        """Time stamps of the samples (`t_ns`)."""
        return slot_times_ns(self.packed) if self.is_packed else [sample.t_ns for sample in self.samples]

    def converted(self, convention: Convention | None) -> "Batch":
        """Return the samples in a convention; None: as published. The first call rotates them."""
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


class SlotBatch(Batch):
    """Batch of valid slots without sample objects."""

    __slots__ = ("packed",)

    is_packed = True
    packed: bytes  # an attribute, because a property costs a function call for each use

    def __init__(self, device: str, device_id: int, packed: bytes, frame: PublishedAxes = AS_SENT) -> None:
        self.device = device
        self.device_id = device_id
        self.frame = frame
        self.packed = packed
        self._samples = self._converted = None


class Publisher(Protocol):
    """Output of samples. Every method returns without blocking. Called in the thread of the event loop only."""

    @property
    def publish(self) -> Callable[[Batch], None] | None:
        """Method that sends samples to readers, and drops and counts samples for slow readers. None: no samples. The
        daemon reads the property once, after `start`."""
        ...

    def start(self) -> None:
        """Open files, sockets and threads. Raises ServerError. Requires a running asyncio loop."""
        ...

    def add_device(self, name: str, device_id: int) -> None:
        """Prepare for a device that was added to the configuration."""
        ...

    def remove_device(self, name: str) -> None:
        """Remove a device that was removed from the configuration."""
        ...

    @property
    def event(self) -> Callable[[Event], None] | None:
        """Method that sends an event to readers. None: no events."""
        ...

    def tick(self, now_ns: int) -> None:
        """Send heartbeats and ledgers and check timeouts. Called twice per second, and ten times per second after
        calls of `OutputOwner.tick_soon`."""
        ...

    def close(self) -> None:
        """Release everything. A second call does nothing."""
        ...


class SettingsControl(Protocol):
    """Settings of one device for clients with permission. All methods raise ImudError. `imud.device` implements it, and
    outputs may not import that part."""

    async def report(self, *, fresh: bool) -> SettingsReport:
        """Return the device settings; with `fresh`, read them first."""
        ...

    async def plan(self, given: Mapping[str, Any] | None, *, save: bool) -> SettingsPlan:
        """Return the steps that change the device settings to `given` (None: declared settings)."""
        ...

    async def apply(self, given: Mapping[str, Any] | None, *, save: bool) -> AppliedSettings:
        """Change the device settings to `given` (None: declared settings). Raises an error before the first write."""
        ...


class DeviceControl(Protocol):
    """Operations on one device for clients with permission. Results are values that JSON can represent. `imud.device`
    implements it, and outputs may not import that part."""

    @property
    def settings(self) -> SettingsControl:
        """Settings of the device."""
        ...

    @property
    def verbs(self) -> Verbs:
        """Present verbs of the device, by name."""
        ...

    async def act(self, name: str, arguments: Mapping[str, Any]) -> object:
        """Run a verb and return its result. Raises ImudError."""
        ...

    @property
    def calibrations(self) -> Calibrations:
        """Present guided calibrations of the device, by kind."""
        ...

    @property
    def last_calibrations(self) -> Mapping[str, LastCalibration]:
        """Result of the last calibration of each kind, of this run of imud or an earlier one."""
        ...

    @property
    def firmware(self) -> FirmwareControl:
        """Firmware update of the device."""
        ...

    async def calibrate(self, kind: str, *, save: bool) -> CalibrationResult:
        """Run a guided calibration to its end. Raises ImudError."""
        ...

    def stop_calibration(self) -> bool:
        """Stop the running calibration. Return whether a calibration was running."""
        ...


class Latencies(Protocol):
    """Latency requests of publishers. The strictest request limits the hold of a device. `imud.device` implements it,
    and outputs may not import that part."""

    def ask(self, who: str, latency_ns: int, devices: Collection[str] | None = None) -> None:
        """Request a latency for samples of `devices` (None: of all), in place of the previous request of `who`."""
        ...

    def release(self, who: str) -> None:
        """Withdraw the request of `who`. Do nothing if there is no request."""
        ...


class Devices(Protocol):
    """The devices of the daemon. Only `imud.daemon`, which no output may import, implements this type. Synchronization:
    the event loop's thread only, the iterator included."""

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
        """Return name, driver and counters (in the order of LEDGER_FIELDS) of every device."""
        ...

    def losses(self, name: str) -> tuple[int, ...]:
        """Return the counters of losses of a device (`Ledger.losses`); zeros if the device does not exist."""
        ...

    def control(self, name: str) -> DeviceControl:
        """Return the device of this name. Raises CommandError if the device does not exist."""
        ...


@dataclass(frozen=True, slots=True)
class PublisherClock:
    """Clocks of the host and of the event loop."""

    now_ns: Callable[[], int]  # Returns CLOCK_MONOTONIC, ns. Any thread may call it.
    # Returns CLOCK_REALTIME minus CLOCK_MONOTONIC, ns, at most one tick old. Any thread may call it.
    utc_offset_ns: Callable[[], int]
    # Returns this offset with its error; None if CLOCK_REALTIME is not synchronized. Any thread may call it.
    utc_reference: Callable[[], UtcReference | None]
    cpu_ns: Callable[[], int]  # returns the CPU time of the event loop's thread, ns


@dataclass(frozen=True, slots=True)
class OutputFacts:
    """Facts that outputs publish about themselves for other outputs. An output removes its facts when it closes.
    Synchronization: the event loop's thread only."""

    # Functions that return the clients of an output
    clients: list[Callable[[], Sequence[ClientStatus]]] = field(default_factory=list)
    recorders: list[Callable[[], RecorderStatus]] = field(default_factory=list)
    flights: list[Callable[[], FlightStatus]] = field(default_factory=list)
    # Functions that return the state of the ports of an output, by the name of the output
    ports: dict[str, Callable[[], Sequence[OutputStatus]]] = field(default_factory=dict)
    mqtts: list[Callable[[], MqttStatus]] = field(default_factory=list)
    rules: list[Callable[[], RulesStatus]] = field(default_factory=list)
    snapshots: list[TakeSnapshot] = field(default_factory=list)  # functions of flight recorders that send a snapshot
    rings: dict[str, str] = field(default_factory=dict)  # path of the ring file of each device in shared memory
    # Devices that have no ring file because imud cannot create it now
    without_ring: set[str] = field(default_factory=set)
    # Reason for each output that does not run and that imud starts again
    failed: dict[str, str] = field(default_factory=dict)
    # Names of the outputs that the configuration enables
    configured: set[str] = field(default_factory=set)

    def states(self) -> list[OutputState]:
        """Return the state of each configured output, by name. A running output has the problem of its ports."""
        problems = self.problems()
        states = []
        for name in sorted(self.configured):
            own = [problem for key, problem in problems.items() if key == name or key.startswith(f"{name} ")]
            states.append(OutputState(name, name not in self.failed, "; ".join(own)))
        return states

    def problems(self) -> dict[str, str]:
        """Return the problem of each output, or port of an output, that does not work."""
        rules = {name: words for status in self.rules for name, words in status().problems().items()}
        return (
            self.failed
            | rules
            | {
                f"{output} {port.name}": port.problem
                for output, status in self.ports.items()
                for port in status()
                if port.problem
            }
        )


class OutputOwner(Protocol):
    """Owner of outputs. `imud.daemon` implements it, and this part may not import `imud.daemon`."""

    def send_event(self, event: Event) -> None:
        """Send an event of the daemon to all outputs."""
        ...

    def tick_soon(self) -> None:
        """Tick the outputs within 0.1 s."""
        ...

    def end_with(self, error: BaseException) -> None:
        """End imud: an output of the calling program failed."""
        ...


@dataclass(frozen=True, slots=True)
class PublisherContext:
    """The parts of the daemon that outputs may use."""

    epoch: int  # Random number of this start of the daemon, 64 bits. Readers use it to recognize a restart.
    clock: PublisherClock
    devices: Devices
    outputs: OutputFacts
    latencies: Latencies  # register of the latencies that readers need
    watch_line: WatchLine  # watches a GPIO line that belongs to no device
    drive_line: DriveLine  # drives a GPIO line that belongs to no device
    owner: OutputOwner
    configuration: str = ""  # absolute path of the configuration file; empty without a file
    state_dir: Path | None = None  # directory of the state files; None: an output writes no state
    past_events: EventLog = field(default_factory=EventLog)
    kept: dict[str, Any] = field(default_factory=dict)  # data that a restarted output continues with, by name


class OutputListener(NamedTuple):
    """TCP address and port on which an output listens."""

    path: tuple[str, ...]  # key of the port, below the key of the output
    address: str  # IP address, or localhost
    port: int  # 0: any free port


def _claims_nothing(_settings: Options) -> Sequence[Claim]:
    return ()


def make_later(row: str) -> Callable[[Any, PublisherContext], Publisher]:
    """Return a function that imports and creates the publisher `module:NAME`. An output that is off needs no memory."""
    return lambda options, context: cast(Publisher, load(row)(options, context))


@dataclass(frozen=True, slots=True)
class PublisherType:
    """Row of a publisher."""

    name: str  # Top-level key in the configuration
    settings: type[Options]
    make: Callable[[Any, PublisherContext], Publisher]
    wanted: Callable[[Any], bool] = attrgetter("enabled")  # whether these options enable the publisher
    # Returns the ports that these options use. No device can use them.
    claims: Callable[[Any], Sequence[Claim]] = _claims_nothing
    # Returns path of the key and options of each GPIO line that these options use. No device can use them.
    used_lines: Callable[[Any], Iterable[tuple[tuple[str, ...], LineOptions]]] = lambda _options: ()
    # Whether the daemon exits if the first start of the publisher fails. Otherwise the daemon tries again periodically.
    required: bool = False
    # Finds keys that contradict the drivers. Returns a reason, one sentence, by the path of the key.
    check: Callable[[Any, Mapping[str, Driver]], Mapping[tuple[str, ...], str]] = lambda _options, _drivers: {}
    # Returns the values of these options that do not fit this host. It opens nothing.
    host_problems: Callable[[Any], Iterable[HostProblem]] = lambda _options: ()
    # Returns the addresses on which these options listen. No other output can use them.
    listeners: Callable[[Any], Sequence[OutputListener]] = lambda _options: ()
    interface: int = 0  # interface version for which another package was written; 0 for outputs of imud
