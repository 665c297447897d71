"""Channels of messages: topics of a device, and functions that encode samples, losses, events and diagnoses.

A dialect makes the channels of a device. File writers and servers use the channels of both dialects in the same way.
They do not depend on the message format. Axes and coordinate frames follow REP-103, names of topics follow REP-145.
"""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

from imud.attitude.conventions import Convention
from imud.contracts.condition import Condition
from imud.contracts.status import Deviations, DeviceState, DeviceStatus
from imud.model.event import LEVELS, Event, EventKind
from imud.model.ledger import LOST_FIELDS
from imud.model.sample import Sample
from imud.model.units import NS_PER_S

T_contra = TypeVar("T_contra", contravariant=True)
T = TypeVar("T")

# Maximum time between two messages of a constant value (temperature), ns. A late reader then gets the value.
STEADY_NS: Final = 1_000_000_000


class MessageSchema(NamedTuple):
    """Schema of the messages of a channel, for programs that do not know the messages."""

    name: str
    encoding: str  # `jsonschema` or `ros2msg`
    data: bytes


@dataclass(frozen=True, slots=True)
class MessageChannel(Generic[T]):
    """Channel: topic, schema and encoder of its messages."""

    topic: str
    schema: MessageSchema
    message_encoding: str  # `json` or `cdr`
    encode: Callable[[T], bytes | None]  # returns a message; None if there is no message for this object
    fields: frozenset[str] = frozenset()  # names of the sample fields in the messages


class LossCounts(NamedTuple):
    """Lost samples of a device since the start of the daemon, by the causes of its ledger."""

    t_ns: int  # CLOCK_MONOTONIC of the first sample after a loss, ns
    utc_ns: int
    device: str
    samples: int  # number of samples so far
    lost_gap_device: int
    lost_crc: int
    lost_overrun: int
    lost_queue: int
    lost_unknown: int

    @property
    def counts(self) -> tuple[int, ...]:
        """Counters without the number of samples."""
        return self[4:]


class StampedEvent(NamedTuple):
    """An event with its time on CLOCK_REALTIME."""

    event: Event
    utc_ns: int

    @property
    def is_warning(self) -> bool:
        """Whether the event is a warning, as in the log."""
        return LEVELS.get(self.event.kind, logging.WARNING) >= logging.WARNING


class DiagnosisLevel(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Diagnosis(NamedTuple):
    """State of one device."""

    device: str
    level: DiagnosisLevel
    message: str
    hardware: str  # serial number, otherwise product, otherwise empty
    values: Mapping[str, str]  # Values by name. The names are the names of the status and end in units.


class Diagnoses(NamedTuple):
    """State of all devices at one time."""

    utc_ns: int
    devices: tuple[Diagnosis, ...]


class MessageFrames(NamedTuple):
    """Names of the coordinate frames of a device, and its noise.

    The body frame has the name of the device, with the suffix of REP-103 for other axes. Devices with a heading from
    north share a navigation frame. A device without a north reference has its own level frame.
    """

    device: str
    convention: Convention = Convention.ENU_FLU
    has_north: bool = True
    deviations: Deviations = Deviations()

    @property
    def body(self) -> str:
        """Coordinate frame of vectors."""
        return self.device if self.convention is Convention.ENU_FLU else f"{self.device}_frd"

    @property
    def navigation(self) -> str:
        """Reference frame of the attitude."""
        if self.has_north:
            return "enu" if self.convention is Convention.ENU_FLU else "ned"
        return f"{self.device}_level" if self.convention is Convention.ENU_FLU else f"{self.device}_level_ned"


NORTH: Final = "ENU"  # navigation frame in the status of a device with a heading relative to north


def has_north(status: DeviceStatus) -> bool:
    """Return whether the navigation frame of samples in enu-flu is ENU; True while the driver is unknown."""
    if status.frame is None:
        return True
    words = status.frame.conventions.get(str(Convention.ENU_FLU))
    return words is None or words.navigation_frame == NORTH


class ByteWriter(Protocol):
    """Destination of bytes."""

    def write(self, data: bytes) -> object: ...


class Dialect(Protocol):
    """Message format of samples, losses, events and diagnoses."""

    @property
    def profile(self) -> str:
        """Profile of an MCAP file with these messages."""
        ...

    def samples(self, frames: MessageFrames) -> Sequence[MessageChannel[Sample]]:
        """Return the channels for the samples of a device."""
        ...

    def losses(self, device: str) -> MessageChannel[LossCounts]:
        """Return the channel for the losses of a device."""
        ...

    def events(self) -> MessageChannel[StampedEvent]:
        """Return the channel for the events of all devices."""
        ...

    def diagnostics(self) -> MessageChannel[Diagnoses]:
        """Return the channel for the diagnoses of all devices."""
        ...


def covariance(sigma: float | None, *, present: bool = True) -> tuple[float, ...]:
    """Return the covariance matrix of three values with equal and independent noise, row by row.

    As in sensor_msgs/Imu and REP-145: all elements are 0 if the noise is unknown; the first element is -1 if the value
    is not present.
    """
    if not present:
        return (-1.0, *(8 * (0.0,)))
    variance = sigma * sigma if sigma is not None else 0.0
    return (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance)


class Steady:
    """Filter for a value that changes rarely: passes each change, and the value once per STEADY_NS."""

    __slots__ = ("_due_ns", "_last")

    def __init__(self) -> None:
        self._last: float | None = None
        self._due_ns = 0

    def passes(self, value: float, t_ns: int) -> bool:
        """Return whether to send this value."""
        # the last condition: a step back of the time also passes
        if value == self._last and t_ns < self._due_ns and t_ns > self._due_ns - 2 * STEADY_NS:
            return False
        self._last, self._due_ns = value, t_ns + STEADY_NS
        return True


def topic(device: str, name: str) -> str:
    """Return the topic of a device's channel. `_` replaces characters that ROS 2 does not allow in a topic."""
    plain = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in device)
    # a topic must not start with a digit
    return f"/{'_' if plain[:1].isdigit() else ''}{plain}/{name}"


def diagnosis_name(device: str) -> str:
    """Return the name of a device's diagnosis: node and task, as in diagnostic_updater."""
    return f"imud: {device}"


PERIOD_NS: Final = NS_PER_S  # time between two diagnoses in a file, ns, as in diagnostic_updater
LOSS_SHOWN_NS: Final = 10 * NS_PER_S  # duration of the warning after a loss, ns
# Time without samples after which a recorded device is stale, s. Viewers also wait 5 s for diagnoses.
STALE_S: Final = 5

CONDITION_LEVEL: Final = {
    Condition.OK: DiagnosisLevel.OK,
    Condition.DEGRADED: DiagnosisLevel.WARN,
    Condition.ATTENTION: DiagnosisLevel.WARN,
    Condition.MISSING: DiagnosisLevel.ERROR,
}
# Levels of the states in the events of a recording
LEVEL_OF: Final = {
    DeviceState.RUNNING: DiagnosisLevel.OK,
    DeviceState.FINISHED: DiagnosisLevel.OK,
    DeviceState.SEARCHING: DiagnosisLevel.WARN,
    DeviceState.MISSING: DiagnosisLevel.ERROR,
    DeviceState.FAILED: DiagnosisLevel.ERROR,
    DeviceState.SILENT: DiagnosisLevel.STALE,
}


class LiveDiagnosis:
    """Diagnoses of the devices of a running daemon. Synchronization: one thread."""

    def __init__(self) -> None:
        self._newest: dict[str, Diagnosis] = {}

    def of(self, statuses: Iterable[DeviceStatus], utc_ns: int) -> Diagnoses:
        """Return the diagnoses for the status of all devices."""
        self._newest = {status.name: self._one(status, utc_ns) for status in statuses}
        return Diagnoses(utc_ns, tuple(self._newest.values()))

    def stale(self, reason: str, utc_ns: int) -> Diagnoses:
        """Return the newest diagnoses with the level STALE. `reason`: why the state is unknown now."""
        stale = (one._replace(level=DiagnosisLevel.STALE, message=reason) for one in self._newest.values())
        return Diagnoses(utc_ns, tuple(stale))

    def _one(self, status: DeviceStatus, utc_ns: int) -> Diagnosis:
        known = status.condition
        level = CONDITION_LEVEL[known.condition] if known is not None else LEVEL_OF[status.state]
        hardware = status.identity.get("serial_number") or status.identity.get("product", "")
        return Diagnosis(status.name, level, str(known or status.state), hardware, _values(status))


class RecordedDiagnosis:
    """Diagnoses of the devices of a recording. Synchronization: one thread.

    Each device counts seconds with the times of its own samples, because the times of replayed devices are unrelated.
    """

    def __init__(self) -> None:
        self._devices: dict[str, _RecordedDevice] = {}

    def samples(self, device: str, samples: Sequence[Sample]) -> list[Diagnoses]:
        """Process samples of a device. Return the diagnoses at the end of each second.

        The result does not depend on the division of the samples into batches.
        """
        recorded_device = self._device(device)
        diagnoses = []
        for sample in samples:
            recorded_device.sample(sample)
            if recorded_device.is_due:
                for other_device in self._devices.values():
                    other_device.pass_second()
                diagnoses.append(self._all(sample.utc_ns))
        return diagnoses

    def losses(self, losses: LossCounts) -> None:
        """Process the losses of a device."""
        self._device(losses.device).losses(losses)

    def event(self, stamped: StampedEvent) -> Diagnoses | None:
        """Process an event. Return the diagnoses if the event changes the state of a device."""
        event = stamped.event
        if event.kind not in (EventKind.UP, EventKind.DOWN) or not event.device:
            return None
        self._device(event.device).change(event)
        return self._all(stamped.utc_ns)

    def _device(self, name: str) -> "_RecordedDevice":
        return self._devices.setdefault(name, _RecordedDevice(name))

    def _all(self, utc_ns: int) -> Diagnoses:
        return Diagnoses(utc_ns, tuple(device.diagnosis() for device in self._devices.values()))


class _LossWarning:
    """Warning that samples were lost within LOSS_SHOWN_NS."""

    def __init__(self) -> None:
        self._lost: int | None = None  # None: losses before the first call cause no warning
        self._until_ns = 0

    def is_on(self, counts: Sequence[int], now_ns: int) -> bool:
        lost = sum(counts)
        # a restarted ledger has fewer losses
        if self._lost is not None and lost > self._lost:
            self._until_ns = now_ns + LOSS_SHOWN_NS
        self._lost = lost
        return now_ns < self._until_ns


class _RecordedDevice:
    """State of a device of a recording."""

    def __init__(self, name: str) -> None:
        self.name = name
        # Level and reason after the event DOWN; None while the device is up
        self._gone: tuple[DiagnosisLevel, str] | None = None
        self._newest: Sample | None = None
        self._begin: Sample | None = None  # newest sample at the start of the current second
        self._count = 0  # number of samples in the current second
        self._rate_hz: float | None = None
        self._idle_s = 0  # number of seconds of the recording without a sample
        self._counts = dict.fromkeys(LOST_FIELDS, 0)
        self._warning = _LossWarning()
        self._losing = False

    def sample(self, newest: Sample) -> None:
        self._newest = newest
        self._count += 1
        self._losing = self._warning.is_on(list(self._counts.values()), newest.t_ns)

    def losses(self, losses: LossCounts) -> None:
        self._counts = dict(zip(LOST_FIELDS, losses.counts, strict=True))
        self._losing = self._warning.is_on(losses.counts, losses.t_ns)

    def change(self, event: Event) -> None:
        """Process the event UP or DOWN."""
        state = str(event.detail.get("state", event.kind))
        level = LEVEL_OF[DeviceState(state)] if state in list(DeviceState) else DiagnosisLevel.ERROR
        self._gone = (level, f"{state}: {event.message}") if event.kind == EventKind.DOWN else None
        self._idle_s = 0

    @property
    def is_due(self) -> bool:
        """Whether the sample times moved by one second or stepped back."""
        newest, begin = self._newest, self._begin
        return newest is not None and (begin is None or not 0 <= newest.t_ns - begin.t_ns < PERIOD_NS)

    def pass_second(self) -> None:
        """Start the next second."""
        newest, begin = self._newest, self._begin
        self._idle_s = 0 if self._count else self._idle_s + 1
        if newest is not None and begin is not None and newest.t_ns > begin.t_ns:
            self._rate_hz = self._count * NS_PER_S / (newest.t_ns - begin.t_ns)
        elif self._idle_s:
            self._rate_hz = 0.0
        self._begin, self._count = newest, 0

    def diagnosis(self) -> Diagnosis:
        level, message = self._judged()
        return Diagnosis(self.name, level, message, "", self._values())

    def _judged(self) -> tuple[DiagnosisLevel, str]:
        if self._gone is not None:
            return self._gone
        if self._idle_s >= STALE_S:
            return DiagnosisLevel.STALE, f"no sample for {self._idle_s} s"
        if self._newest is None:
            return DiagnosisLevel.OK, "no sample yet"
        return (DiagnosisLevel.WARN, f"running; {_LOSING}") if self._losing else (DiagnosisLevel.OK, "running")

    def _values(self) -> dict[str, str]:
        values = {name: str(count) for name, count in self._counts.items()}
        if self._newest is not None:
            newest = self._newest
            values |= {"samples": str(newest.seq), "sync": str(newest.sync), "t_err_ns": str(newest.t_err_ns)}
        if self._rate_hz is not None:
            values["rate_hz"] = _number(self._rate_hz)
        return values


_LOSING: Final = f"samples were lost within the last {LOSS_SHOWN_NS // NS_PER_S} s"


def _values(status: DeviceStatus) -> dict[str, str]:
    clock = status.clock
    numbers = {
        "rate_hz": status.rate_hz, "expected_rate_hz": status.expected_rate_hz,
        "samples": status.ledger.get("samples", 0), **{name: status.ledger.get(name, 0) for name in LOST_FIELDS},
        "t_err_ns": clock.t_err_ns, "skew_ppm": clock.skew_ppm, "residual_ns": clock.residual_ns,
        "reference_error_ns": clock.reference_error_ns, "resets": clock.resets, "connects": status.connects,
        "frames_bad_crc": status.ledger.get("frames_bad_crc", 0),
    }  # fmt: skip
    words = {"state": str(status.state), "driver": status.driver, "link": status.link, "sync": str(clock.sync)}
    values = words | {name: _number(value) for name, value in numbers.items()}
    if status.status_words:
        values["status"] = ", ".join(status.status_words)
    if status.condition is not None and status.condition.steps:
        values["next"] = status.condition.steps
    return values


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.6g}"
