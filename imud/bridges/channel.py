"""Channels of messages: what is said of a device, by topic, and how a sample becomes the bytes of a message.

A dialect makes the channels of a device; whoever writes a file or serves a viewer takes channels of either dialect and
needs to know nothing of their messages. Axes and frames are those of REP-103, and of REP-145 for names of topics.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Generic, NamedTuple, Protocol, TypeVar

from imud.contracts.sensors.deviations import Deviations
from imud.event import LEVELS, Event
from imud.frames.conventions import Convention
from imud.sample import Sample

T_contra = TypeVar("T_contra", contravariant=True)
T = TypeVar("T")

STEADY_NS: Final = 1_000_000_000
"""A value that changes rarely (temperature) is said again after this time, so that a reader who comes later has it."""


class MessageSchema(NamedTuple):
    """What describes the messages of a channel to programs that do not know them."""

    name: str
    encoding: str
    """`jsonschema` or `ros2msg`."""
    data: bytes


@dataclass(frozen=True, slots=True)
class MessageChannel(Generic[T]):
    """A channel: where its messages go, what they look like, and what makes them."""

    topic: str
    schema: MessageSchema
    message_encoding: str
    """`json` or `cdr`."""
    encode: Callable[[T], bytes | None]
    """Makes the message; None where there is nothing to say of this one."""
    fields: frozenset[str] = frozenset()
    """Fields of a sample that it says something of."""


class LossCounts(NamedTuple):
    """Losses of a device since its daemon's start, by cause, as its ledger has them."""

    t_ns: int
    """CLOCK_MONOTONIC: of the first sample after a loss."""
    utc_ns: int
    device: str
    samples: int
    """Samples so far."""
    lost_gap_device: int
    lost_crc: int
    lost_overrun: int
    lost_queue: int
    lost_unknown: int

    @property
    def counts(self) -> tuple[int, ...]:
        """What a loss changes."""
        return self[4:]


class StampedEvent(NamedTuple):
    """An event with its time on CLOCK_REALTIME."""

    event: Event
    utc_ns: int

    @property
    def is_warning(self) -> bool:
        """Whether a viewer shows it as a warning, as the log does."""
        return LEVELS.get(self.event.kind, logging.WARNING) >= logging.WARNING


class DiagnosisLevel(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Diagnosis(NamedTuple):
    """How one device is."""

    device: str
    level: DiagnosisLevel
    message: str
    hardware: str
    """Its serial number; where that is not known its product, else empty."""
    values: Mapping[str, str]
    """Names end in units, as those of the status."""


class Diagnoses(NamedTuple):
    """How all devices are, at one moment."""

    utc_ns: int
    devices: tuple[Diagnosis, ...]


class MessageFrames(NamedTuple):
    """Names of the frames of a device, and of what is known of its noise.

    Bodies have the name of their device; with axes other than REP-103's the suffix that it wants. Devices whose heading
    has to do with north share a navigation frame; one whose heading has not has a level frame of its own.
    """

    device: str
    convention: Convention = Convention.ENU_FLU
    has_north: bool = True
    deviations: Deviations = Deviations()

    @property
    def body(self) -> str:
        """Frame of vectors."""
        return self.device if self.convention is Convention.ENU_FLU else f"{self.device}_frd"

    @property
    def navigation(self) -> str:
        """Frame that the attitude turns into."""
        if self.has_north:
            return "enu" if self.convention is Convention.ENU_FLU else "ned"
        return f"{self.device}_level" if self.convention is Convention.ENU_FLU else f"{self.device}_level_ned"


class ByteWriter(Protocol):
    """Where bytes go."""

    def write(self, data: bytes) -> object:
        """Append them."""
        ...


class Dialect(Protocol):
    """A way to say samples, losses, events and diagnoses."""

    @property
    def profile(self) -> str:
        """Profile of an MCAP file of these messages."""
        ...

    def samples(self, frames: MessageFrames) -> Sequence[MessageChannel[Sample]]:
        """Channels of the samples of a device."""
        ...

    def losses(self, device: str) -> MessageChannel[LossCounts]:
        """Channel of the losses of a device."""
        ...

    def events(self) -> MessageChannel[StampedEvent]:
        """Channel of the events of all devices."""
        ...

    def diagnostics(self) -> MessageChannel[Diagnoses]:
        """Channel of how all devices are."""
        ...


def covariance(sigma: float | None, *, present: bool = True) -> tuple[float, ...]:
    """Return a covariance matrix, row by row, of three values with the same independent noise.

    As sensor_msgs/Imu and REP-145 have it: all zeros where it is not known, -1 as first element where the value itself
    is missing.
    """
    if not present:
        return (-1.0, *(8 * (0.0,)))
    variance = sigma * sigma if sigma is not None else 0.0
    return (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance)


class Steady:
    """Filter of a value that changes rarely: lets it pass when it changes, and once in STEADY_NS."""

    __slots__ = ("_due_ns", "_last")

    def __init__(self) -> None:
        self._last: float | None = None
        self._due_ns = 0

    def passes(self, value: float, t_ns: int) -> bool:
        """Whether this value is to be said."""
        if value == self._last and t_ns < self._due_ns and t_ns > self._due_ns - 2 * STEADY_NS:
            return False
        self._last, self._due_ns = value, t_ns + STEADY_NS
        return True


def topic(device: str, name: str) -> str:
    """Return the topic of a device's channel; what a name may have and a topic of ROS 2 may not becomes `_`."""
    plain = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in device)
    return f"/{'_' if plain[:1].isdigit() else ''}{plain}/{name}"


def diagnosis_name(device: str) -> str:
    """Return the name of a device's diagnosis: node and task, as diagnostic_updater makes it."""
    return f"imud: {device}"
