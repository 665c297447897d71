"""A blocking client of the daemon's UNIX socket.

    with Client() as imud:
        print(imud.hello.version, [device["name"] for device in imud.devices()])
        for sample in imud.watch(rate_hz=100):
            print(sample.t_ns, sample.accel_m_s2)

A lost connection raises LinkMissing; to connect again, make another Client. Synchronization: one thread at a time.
"""

import errno
import os
import socket
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from math import isfinite
from time import monotonic
from types import TracebackType
from typing import Any, Final, Protocol, Self, TypeVar

import msgspec

from imud.formats.jsonrpc import (
    DEFAULT_PATH,
    FRAME_HEADER,
    FRAME_MAX_BYTES,
    PROTOCOL,
    RpcError,
    encode_request,
    line_of,
    parse_object,
)
from imud.formats.slot import SLOT_BYTES, SLOT_FIELDS, decode_slot
from imud.model.errors import LinkDenied, LinkError, LinkMissing, ServerError, reason_of
from imud.model.event import Event, kind_of
from imud.model.options import wrong_values
from imud.model.sample import Sample

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


RECV_BYTES: Final = 65536
FDS_MAX: Final = 4
INBOX_MAX: Final = 65536
"""Messages kept for an iterator while another one, or a question, waits for something else."""

Message = dict[str, Any] | bytes
"""A JSON object, or whole slots."""


class Hello(msgspec.Struct, frozen=True):
    """The daemon's greeting."""

    protocol: int
    version: str
    """Version of the daemon."""
    epoch: int
    """Random number of this start of the daemon."""
    rights: tuple[str, ...]
    """`read`, `control`."""


class WatchAnswer(msgspec.Struct, frozen=True):
    """The answer to `watch`, as far as the client needs it."""

    devices: dict[str, int]
    """Device → its number in slots."""
    convention: str | None = None


class PollAnswer(msgspec.Struct, frozen=True):
    """The answer to `poll`."""

    samples: list[dict[str, Any]]
    convention: str | None = None


class StopAnswer(msgspec.Struct, frozen=True):
    """The answer to `record.stop`."""

    records_dropped: int


class SnapshotAnswer(msgspec.Struct, frozen=True):
    """The answer to `record.snapshot`."""

    seconds: float


class Client:
    """A connection to the daemon at `path`, by default where `default_path` says.

    Raises LinkMissing (no daemon there), LinkDenied (no permission), ServerError (answers that are not the protocol's),
    TimeoutError where an answer takes longer than `timeout_s`. RpcError, a ServerError, is what the daemon refused.
    """

    def __init__(self, path: str | os.PathLike[str] | None = None, *, timeout_s: float = 5.0) -> None:
        self.path = default_path() if path is None else os.fspath(path)
        self.timeout_s = timeout_s
        self._buffer = bytearray()
        self.given_up = 0
        """Messages discarded because no iterator read them while `INBOX_MAX` others waited."""
        self._inbox: deque[Message] = deque()
        self._watch: Watch | None = None
        self._fds: list[int] = []
        self._framed = False
        self._id = 0
        self._sock = _connect(self.path, timeout_s)
        with ExitStack() as undo:
            undo.callback(self.close)
            self.hello = self._greet()
            undo.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._sock.close()
        while self._fds:
            os.close(self._fds.pop())

    def fileno(self) -> int:
        """The descriptor, to wait on with others."""
        return self._sock.fileno()

    # --- questions --------------------------------------------------------------------------------------------------

    def devices(self) -> list[dict[str, Any]]:
        """Request the list of devices, one mapping each."""
        return self._answer("devices", list[dict[str, Any]])

    def status(self) -> dict[str, Any]:
        """Request the full status: `now_ns`, `devices`, `socket`."""
        return self._answer("status", dict[str, Any])

    def schema(self) -> dict[str, Any]:
        """Descriptions of the members of samples: `fields`, `devices`, `slot`."""
        return self._answer("schema", dict[str, Any])

    def poll(self, devices: Iterable[str] | None = None, convention: str | None = None) -> list[Sample]:
        """Request the newest sample of each device that has one; `convention` as for `watch`."""
        reply = self._answer("poll", PollAnswer, devices=_listed(devices), convention=convention)
        _check_convention(reply.convention, convention)
        return [sample_of(params) for params in reply.samples]

    def call(self, method: str, **params: object) -> Any:
        """Call a method by its name; parameters that are None are left out. Returns the result as JSON values."""
        self._id += 1
        chosen = {name: value for name, value in params.items() if value is not None}
        self._send(line_of(encode_request(method, chosen, self._id)))
        deadline_s = monotonic() + self.timeout_s
        while True:
            message = self._receive(deadline_s, method)
            if isinstance(message, bytes) or "id" not in message or "method" in message:
                self._keep(message)
            elif message["id"] in (self._id, None):  # another id is of a call that timed out
                if "error" in message:
                    raise rpc_error(message["error"])
                return message.get("result")

    # --- streams ----------------------------------------------------------------------------------------------------

    def watch(
        self,
        devices: Iterable[str] | None = None,
        fields: Iterable[str] | None = None,
        rate_hz: float | None = None,
        encoding: str = "binary",
        timeout_s: float | None = None,
        convention: str | None = None,
        latency_ms: float | None = None,
    ) -> Watch:
        """Subscribe to samples; an endless iterator that replaces an earlier one. None asks for all.

        `fields` names the values that are wanted of JSON samples, the others are None then; binary ones are complete
        always. `convention` is `enu-flu` or `ned-frd`, None for what the configuration says; ServerError where the
        daemon does not know it. Samples come up to `latency_ms` late, several at once, which costs less CPU on both
        sides; 0 is at once, None a period of `rate_hz`, at most 20 ms, and at once without a rate. Waiting longer than
        `timeout_s` for a sample raises TimeoutError.
        """
        wanted = None if fields is None else sorted({*fields, "t_err_ns", "sync", "t_rx_ns", "utc_ns"})
        reply = self._answer(
            "watch", WatchAnswer, devices=_listed(devices), fields=wanted, rate_hz=_finite(rate_hz), encoding=encoding,
            convention=convention, latency_ms=_finite(latency_ms),
        )  # fmt: skip
        if encoding == "binary":
            self._framed = True
        _check_convention(reply.convention, convention)
        self._end_watch()
        while self.kept_message(Watch.NAMES) is not None:
            pass  # of the earlier one
        self._watch = Watch(self, reply.devices, timeout_s)
        return self._watch

    def unwatch(self) -> None:
        """End the subscription. The iterator still returns the samples received meanwhile, then ends."""
        self.call("unwatch")
        self._end_watch()

    def events(self, devices: Iterable[str] | None = None, timeout_s: float | None = None) -> EventStream:
        """Subscribe to events; an endless iterator. Waiting longer than `timeout_s` for one raises TimeoutError."""
        self.call("events", devices=_listed(devices))
        return EventStream(self, timeout_s)

    def notify(self, device: str, latency_ms: float | None = None) -> int:
        """A descriptor that is readable after each batch of samples of `device`, for `Ring.wait`; the caller closes it.

        A batch is written up to `latency_ms` late; None and 0: each sample at once. How many bytes are in it means
        nothing: read them all. It ends with the connection, and when `notify` is asked for the same device again, which
        gives a new one.
        """
        self.call("notify", device=device, latency_ms=_finite(latency_ms))
        return self._descriptor("notify")

    # --- recordings -------------------------------------------------------------------------------------------------

    def record(self, devices: Iterable[str] | None = None) -> int:
        """A descriptor from which a recording is read, to end of file; the caller closes it.

        None records all devices. It needs the permission to control. What is not read in time is missing in the
        recording, which says so.
        """
        self.call("record.start", devices=_listed(devices))
        return self._descriptor("record.start")

    def stop_recording(self) -> int:
        """End the recording of this connection; what waits still comes. Return how many records were not read."""
        return self._answer("record.stop", StopAnswer).records_dropped

    def snapshot(self) -> tuple[int, float]:
        """A descriptor from which the last minutes are read, as with `record`, and how long they are, s.

        RpcError where the configuration has no flight recorder.
        """
        seconds = self._answer("record.snapshot", SnapshotAnswer).seconds
        return self._descriptor("record.snapshot"), seconds

    def kept_message(self, names: frozenset[str]) -> Message | None:
        """Return the oldest such message among those kept while waiting for another; None for none."""
        for index, message in enumerate(self._inbox):
            if _is_one_of(message, names):
                del self._inbox[index]
                return message
        return None

    def next_message(self, names: frozenset[str], timeout_s: float | None) -> Message:
        """Receive the next message: slots, or a notification whose method is among `names`; others are kept."""
        kept = self.kept_message(names)
        if kept is not None:
            return kept
        deadline_s = None if timeout_s is None else monotonic() + timeout_s
        while not _is_one_of(message := self._receive(deadline_s, " or ".join(sorted(names))), names):
            self._keep(message)
        return message

    def _answer(self, method: str, kind: type[T], **params: object) -> T:
        """Call a method whose answer is of this form. Raises ServerError for one that is not."""
        result = self.call(method, **params)
        try:
            return msgspec.convert(result, kind)
        except msgspec.ValidationError as error:
            raise ServerError(f"{self.path}: the answer to {method} is not understood: {reason_of(error)}") from error

    # --- messages ---------------------------------------------------------------------------------------------------

    def _greet(self) -> Hello:
        message = self._receive(monotonic() + self.timeout_s, "hello")
        if isinstance(message, dict) and "error" in message:
            error = rpc_error(message["error"])
            raise LinkDenied(f"{self.path}: the daemon refuses: {error}") from error
        if isinstance(message, bytes) or message.get("method") != "hello":
            raise ServerError(f"{self.path}: expected the daemon's hello, got {message!r:.200}")
        try:
            hello = msgspec.convert(message.get("params"), Hello)
        except msgspec.ValidationError as error:
            raise ServerError(f"{self.path}: expected the greeting of an imud daemon, got another one") from error
        if hello.protocol != PROTOCOL:
            raise ServerError(f"{self.path}: the daemon speaks protocol {hello.protocol}, this client {PROTOCOL}")
        return hello

    def _descriptor(self, method: str) -> int:
        """The descriptor that came with an answer. Raises ServerError for none."""
        if not self._fds:
            raise ServerError(f"the daemon's answer to {method} came without a descriptor")
        return self._fds.pop()

    def _keep(self, message: Message) -> None:
        """Keep a message for another iterator; without one that reads, only the newest are kept."""
        self._inbox.append(message)
        if len(self._inbox) > INBOX_MAX:
            self._inbox.popleft()
            self.given_up += 1

    def _end_watch(self) -> None:
        if self._watch is not None:
            self._watch.end()
            self._watch = None

    def _send(self, data: bytes) -> None:
        try:
            self._sock.settimeout(self.timeout_s)
            self._sock.sendall(data)
        except TimeoutError:
            raise TimeoutError(f"{self.path}: the daemon read nothing for {self.timeout_s} s") from None
        except OSError as error:
            raise _lost(self.path, error) from error

    def _receive(self, deadline_s: float | None, what: str) -> Message:
        """Receive the next message in order of arrival."""
        while (message := self._parse()) is None:
            left_s = None if deadline_s is None else deadline_s - monotonic()
            if left_s is not None and left_s <= 0:
                raise TimeoutError(f"{self.path}: waited in vain for {what}")
            try:
                self._sock.settimeout(left_s)
                data, fds, _flags, _address = socket.recv_fds(self._sock, RECV_BYTES, FDS_MAX)
            except TimeoutError:
                raise TimeoutError(f"{self.path}: waited in vain for {what}") from None
            except OSError as error:
                raise _lost(self.path, error) from error
            self._fds.extend(fds)
            if not data:
                raise LinkMissing(f"{self.path}: the daemon closed the connection")
            self._buffer += data
        return message

    def _parse(self) -> Message | None:
        """Remove a whole message from the buffer and return it; None while there is none."""
        buffer = self._buffer
        if not self._framed:
            end = buffer.find(b"\n")
            if end < 0:
                return None
            line = bytes(buffer[:end])
            del buffer[: end + 1]
            return self._object(line)
        if len(buffer) < FRAME_HEADER.size:
            return None
        (length,) = FRAME_HEADER.unpack_from(buffer)
        if length > FRAME_MAX_BYTES:
            raise ServerError(f"{self.path}: a frame of {length} bytes; the boundary between frames is lost")
        end = FRAME_HEADER.size + length
        if len(buffer) < end:
            return None
        body = bytes(buffer[FRAME_HEADER.size : end])
        del buffer[:end]
        return self._object(body) if length % SLOT_BYTES else body

    def _object(self, body: bytes) -> dict[str, Any]:
        try:
            message = parse_object(body)
        except RpcError as error:
            raise ServerError(f"{self.path}: expected a JSON object, {error}: {body[:80]!r}") from error
        if not isinstance(message.get("method", ""), str):
            raise ServerError(f"{self.path}: expected a method that is text, got {body[:80]!r}")
        return message


def default_path() -> str:
    """The socket's path: the environment variable IMUD_SOCKET; where that is not set or empty, /run/imud/imud.sock."""
    return os.environ.get("IMUD_SOCKET") or DEFAULT_PATH


def rpc_error(error: object) -> RpcError:
    """The exception for the `error` member of a reply."""
    if isinstance(error, dict):
        return RpcError(error.get("code", 0), str(error.get("message", "without a message")))
    return RpcError(0, f"an error that is not understood: {error!r}")


def _is_one_of(message: Message, names: frozenset[str]) -> bool:
    return "sample" in names if isinstance(message, bytes) else message.get("method") in names


def _check_convention(given: str | None, convention: str | None) -> None:
    """Raise ServerError where the daemon ignored the convention."""
    if convention is not None and given != convention:
        raise ServerError(f"the daemon gives no samples as {convention}: it is older than this client")


def _listed(names: Iterable[str] | None) -> list[str] | None:
    if isinstance(names, str):
        raise TypeError(f"expected a list of names, got the string {names!r}")
    return None if names is None else list(names)


def _finite(value: float | None) -> float | None:
    """Raise ValueError for what JSON does not have, and would arrive as null: as if nothing was asked for."""
    if value is not None and not isfinite(value):
        raise ValueError(f"expected a finite number, got {value}")
    return value


def _connect(path: str, timeout_s: float) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    sock.settimeout(timeout_s)
    try:
        sock.connect(path)
    except OSError as error:
        sock.close()
        raise _unreachable(path, error) from error
    return sock


def _unreachable(path: str, error: OSError) -> LinkError:
    if error.errno in (errno.ENOENT, errno.ECONNREFUSED):
        return LinkMissing(f"no daemon at {path}: is imud running? (systemctl status imud, or imud run)")
    if error.errno in (errno.EACCES, errno.EPERM):
        return LinkDenied(f"no permission for {path}: is this user in group imud? (adduser USER imud, log in again)")
    return LinkError(f"cannot connect to {path}: {reason_of(error)}")


def _lost(path: str, error: OSError) -> LinkMissing:
    return LinkMissing(f"{path}: the connection to the daemon is lost: {reason_of(error)}")
