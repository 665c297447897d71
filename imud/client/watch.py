"""Iterators of the client over samples and events."""

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol, Self, TypeVar

import msgspec

from imud.contracts.settings import wrong_values
from imud.errors import ServerError, reason_of
from imud.event import Event, kind_of
from imud.formats.slot import SLOT_BYTES, SLOT_FIELDS, decode_slot
from imud.sample import Sample

_DEVICE_ID_OFFSET: Final = next(field.offset for field in SLOT_FIELDS if field.name == "device_id")


T = TypeVar("T")


class DeviceNumber(msgspec.Struct, frozen=True):
    """The number of a device in slots."""

    device: str
    device_id: int


class DroppedSamples(msgspec.Struct, frozen=True):
    """How many samples of a device were dropped."""

    device: str
    dropped: int


class ReceivedEvent(msgspec.Struct, frozen=True):
    """An event as it came."""

    t_ns: int
    device: str
    kind: str
    """Of an older or newer daemon it may be one that this client does not know."""
    message: str
    detail: dict[str, Any] = {}  # msgspec copies a mutable default


class Source(Protocol):
    """Receiver of messages for the iterators."""

    def kept_message(self, names: frozenset[str]) -> dict[str, Any] | bytes | None:
        """A message that came before, or None."""
        ...

    def next_message(self, names: frozenset[str], timeout_s: float | None) -> dict[str, Any] | bytes:
        """The next message: slots, or a notification with one of these methods."""
        ...


class Watch:
    """Iterator over samples; ends when the client subscribes anew or unsubscribes.

    `on_dropped`, where it is set, is called with device and number before the first sample after the loss.
    """

    NAMES: Final = frozenset(("sample", "dropped", "device"))

    def __init__(self, source: Source, devices: Mapping[str, int], timeout_s: float | None) -> None:
        self.device_ids = dict(devices)
        """Device → its number in slots."""
        self.dropped: dict[str, int] = {}
        """Samples per device that the daemon dropped because this client read too slowly."""
        self.on_dropped: Callable[[str, int], None] | None = None
        self._ended = False
        self._names = {number: name for name, number in self.device_ids.items()}
        self._source = source
        self._timeout_s = timeout_s
        self._ready: deque[Sample] = deque()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Sample:
        while not self._ready:
            message = self._source.kept_message(self.NAMES)
            if message is None and self._ended:
                raise StopIteration
            self._handle(self._source.next_message(self.NAMES, self._timeout_s) if message is None else message)
        return self._ready.popleft()

    def end(self) -> None:
        """Stop the iteration after the samples that came already."""
        self._ended = True

    def _handle(self, message: dict[str, Any] | bytes) -> None:
        if isinstance(message, bytes):
            for start in range(0, len(message), SLOT_BYTES):
                self._ready.append(self._decode(message[start : start + SLOT_BYTES]))
            return
        params = params_of(message)
        if message["method"] == "device":
            known = _understood(params, DeviceNumber, "the number of a device")
            self.device_ids[known.device] = known.device_id
            self._names[known.device_id] = known.device
            return
        if params.get("dropped"):
            lost = _understood(params, DroppedSamples, "a number of dropped samples")
            self._note_dropped(lost.device, lost.dropped)
        params.pop("dropped", None)
        if message["method"] == "sample":
            self._ready.append(sample_of(params))

    def _note_dropped(self, device: str, count: int) -> None:
        self.dropped[device] = self.dropped.get(device, 0) + count
        if self.on_dropped is not None:
            self.on_dropped(device, count)

    def _decode(self, slot: bytes) -> Sample:
        number = int.from_bytes(slot[_DEVICE_ID_OFFSET : _DEVICE_ID_OFFSET + 2], "little")
        name = self._names.get(number)
        if name is None:
            raise ServerError(f"a slot of device number {number}; known are {self._names}")
        try:
            return decode_slot(slot, name)
        except ValueError as error:
            raise ServerError(str(error)) from error


class EventStream:
    """Endless iterator over events."""

    NAMES: Final = frozenset(("event",))

    def __init__(self, source: Source, timeout_s: float | None) -> None:
        self._source = source
        self._timeout_s = timeout_s

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Event:
        message = self._source.next_message(self.NAMES, self._timeout_s)
        assert isinstance(message, dict)
        return event_of(params_of(message))


def sample_of(params: Mapping[str, Any]) -> Sample:
    """The sample in a JSON notification; null is NaN. Raises ServerError."""
    values = {name: _with_nan(value) for name, value in params.items()}
    try:
        return msgspec.convert(values, Sample)
    except msgspec.ValidationError as error:
        wrong = "; ".join(map(str, wrong_values(Sample, values, "member")))
        raise ServerError(f"a sample that is not understood: {wrong}") from error


def event_of(params: Mapping[str, Any]) -> Event:
    """Decode the event in a JSON notification. An unknown kind stays a plain string. Raises ServerError."""
    received = _understood(params, ReceivedEvent, "an event")
    return Event(received.t_ns, received.device, kind_of(received.kind), received.message, received.detail)


def params_of(message: Mapping[str, Any]) -> dict[str, Any]:
    """The members of a notification. Raises ServerError."""
    params = message.get("params", {})
    if not isinstance(params, dict):
        raise ServerError(f"a notification {message.get('method')!r:.80} whose members are not understood")
    return params


def _understood(params: Mapping[str, Any], kind: type[T], what: str) -> T:
    """The members of a notification in this form; `what` is for the message. Raises ServerError."""
    try:
        return msgspec.convert(params, kind)
    except msgspec.ValidationError as error:
        raise ServerError(f"{what} that is not understood: {reason_of(error)}") from error


def _with_nan(value: object) -> object:
    if value is None:
        return float("nan")
    if isinstance(value, list):
        return [float("nan") if item is None else item for item in value]
    return value
