"""A blocking client of the daemon's UNIX socket.

with Client() as imud:
    print(imud.hello.version, [device["name"] for device in imud.devices()])
    for sample in imud.watch(rate_hz=100):
        print(sample.t_ns, sample.accel_m_s2)
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
from typing import Any, Final, Self, TypeVar

import msgspec

from imud.formats.jsonrpc import (
    FRAME_HEADER,
    FRAME_MAX_BYTES,
    PROTOCOL,
    RpcError,
    default_path,
    encode_request,
    line_of,
    parse_object,
)
from imud.formats.slot import SLOT_BYTES, SLOT_FIELDS, decode_slot
from imud.model.bucket import Bucket
from imud.model.errors import LinkDenied, LinkError, LinkMissing, ServerError, reason_of
from imud.model.event import Event, PastEvents, kind_of
from imud.model.options import wrong_values
from imud.model.sample import Sample

RECV_BYTES: Final = 65536
FDS_MAX: Final = 4
INBOX_MAX: Final = 65536
"""Maximum number of messages kept for an iterator while the client waits for another message."""
_DEVICE_ID_OFFSET: Final = next(field.offset for field in SLOT_FIELDS if field.name == "device_id")

T = TypeVar("T")
Message = dict[str, Any] | bytes
"""A JSON object, or complete slots."""


class DeviceNumber(msgspec.Struct, frozen=True):
    """Parameters of `device`."""

    device: str
    device_id: int


class DroppedSamples(msgspec.Struct, frozen=True):
    """Parameters of `dropped`, or members of a sample with drops."""

    device: str
    dropped: int


class ReceivedEvent(msgspec.Struct, frozen=True):
    """Parameters of `event`."""

    t_ns: int
    device: str
    kind: str  # kind of the event. A daemon of another version may send an unknown kind.
    message: str
    detail: dict[str, Any] = {}  # msgspec copies a mutable default


class Watch:
    """Iterator over samples, from `Client.watch`. It ends when the client calls `watch` or `unwatch`.

    Raises TimeoutError if no sample arrives within the `timeout_s` of `Client.watch`, LinkMissing if the connection is
    lost, and ServerError if it cannot decode a message.
    """

    NAMES: Final = frozenset(("sample", "dropped", "device"))  # methods of the notifications that the iterator reads

    def __init__(self, client: "Client", devices: Mapping[str, int], timeout_s: float | None) -> None:
        self.device_ids: dict[str, int] = dict(devices)  # number of each device in slots
        # number of samples per device that the daemon dropped because this client read too slowly
        self.dropped: dict[str, int] = {}
        # function that the iterator calls with device and number before the first sample after a drop; None: no call
        self.on_dropped: Callable[[str, int], None] | None = None
        self._ended = False
        self._names = {number: name for name, number in self.device_ids.items()}
        self._client = client
        self._timeout_s = timeout_s
        self._ready: deque[Sample] = deque()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Sample:
        while not self._ready:
            message = self._client.kept_message(self.NAMES)
            if message is None and self._ended:
                raise StopIteration
            self._handle(self._client.next_message(self.NAMES, self._timeout_s) if message is None else message)
        return self._ready.popleft()

    def end(self) -> None:
        """Stop the iteration after the samples that the client has received."""
        self._ended = True

    def _handle(self, message: Message) -> None:
        if isinstance(message, bytes):
            for start in range(0, len(message), SLOT_BYTES):
                self._ready.append(self._decode(message[start : start + SLOT_BYTES]))
            return
        params = params_of(message)
        if message["method"] == "device":
            known = decoded(params, DeviceNumber, "device")
            self.device_ids[known.device] = known.device_id
            self._names[known.device_id] = known.device
            return
        if params.get("dropped"):
            lost = decoded(params, DroppedSamples, "dropped")
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
            raise ServerError(f"expected a slot of a known device number ({self._names}), got {number}")
        try:
            return decode_slot(slot, name)
        except ValueError as error:
            raise ServerError(str(error)) from error


class EventStream:
    """Endless iterator over events, from `Client.events`. It raises the same errors as `Watch`."""

    NAMES: Final = frozenset(("event",))  # methods of the notifications that the iterator reads

    def __init__(self, client: "Client", timeout_s: float | None) -> None:
        self._client = client
        self._timeout_s = timeout_s

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Event:
        message = self._client.next_message(self.NAMES, self._timeout_s)
        assert isinstance(message, dict)
        return event_of(params_of(message))


def sample_of(params: Mapping[str, Any]) -> Sample:
    """Return the sample in a JSON notification; null becomes NaN. Raises ServerError."""
    values = {name: _with_nan(value) for name, value in params.items()}
    try:
        return msgspec.convert(values, Sample)
    except msgspec.ValidationError as error:
        wrong = "; ".join(map(str, wrong_values(Sample, values, "member")))
        raise ServerError(f"cannot decode a sample: {wrong}") from error


def event_of(params: Mapping[str, Any]) -> Event:
    """Return the event in a JSON notification. An unknown kind stays a string. Raises ServerError."""
    received = decoded(params, ReceivedEvent, "event")
    return Event(received.t_ns, received.device, kind_of(received.kind), received.message, received.detail)


def params_of(message: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a notification. Raises ServerError."""
    params = message.get("params", {})
    if not isinstance(params, dict):
        raise ServerError(f"cannot decode the notification {message.get('method')!r:.80}: expected an object as params")
    return params


def decoded(value: object, kind: type[T], name: str = "status") -> T:
    """Return the reply to the method `name`, or a part of it, as `kind`. Raises ServerError."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise ServerError(
            f"cannot decode {name!r} of the daemon: {reason_of(error)}; if imud was updated, restart the daemon"
        ) from error


def _with_nan(value: object) -> object:
    if value is None:
        return float("nan")
    if isinstance(value, list):
        return [float("nan") if item is None else item for item in value]
    return value


class Hello(msgspec.Struct, frozen=True):
    """Greeting of the daemon."""

    protocol: int  # version of the socket protocol
    version: str  # version of imud
    epoch: int  # random number of this start of the daemon
    rights: tuple[str, ...]  # permissions of this client: `read`, `control`


class WatchReply(msgspec.Struct, frozen=True):
    """Reply to `watch`, without the members that the client does not use."""

    devices: dict[str, int]
    convention: str | None = None


class PollReply(msgspec.Struct, frozen=True):
    """Reply to `poll`."""

    samples: list[dict[str, Any]]
    convention: str | None = None


class StopReply(msgspec.Struct, frozen=True):
    """Reply to `record.stop`."""

    records_dropped: int


class SnapshotReply(msgspec.Struct, frozen=True):
    """Reply to `record.snapshot`."""

    seconds: float


class Client:
    """A connection to the daemon at `path`; None for `default_path()`. The end of a `with` block closes it.

    Every method raises LinkMissing (no daemon at the path, or connection lost), LinkDenied (no permission), RpcError
    (the daemon refuses the request), ServerError (invalid reply), or TimeoutError (no reply within `timeout_s`). After
    LinkMissing, make another Client. Synchronization: one thread at a time.
    """

    def __init__(self, path: str | os.PathLike[str] | None = None, *, timeout_s: float = 5.0) -> None:
        self.path: str = default_path() if path is None else os.fspath(path)  # path of the socket
        self.timeout_s: float = timeout_s  # maximum time of a request, s
        self._buffer = bytearray()
        # number of messages that the client discarded because no iterator read them; it keeps the 65,536 newest
        self.discarded: int = 0
        self._inbox: deque[Message] = deque()
        self._watch: Watch | None = None
        self._fds: list[int] = []
        self._framed = False
        self._id = 0
        self._binary_ids: set[int] = set()  # requests whose reply starts binary frames, also if the reply is late
        self._sock = _connect(self.path, timeout_s)
        with ExitStack() as undo:
            undo.callback(self.close)
            self.hello: Hello = self._greet()  # greeting of the daemon
            undo.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect. A second call does nothing."""
        self._sock.close()
        while self._fds:
            os.close(self._fds.pop())

    def fileno(self) -> int:
        """Return the descriptor of the socket, for select or poll."""
        return self._sock.fileno()

    # --- requests ---------------------------------------------------------------------------------------------------

    def devices(self) -> list[dict[str, Any]]:
        """Return name, driver, link, state, identity, rate and ring file of each device (docs/socket.md)."""
        return self._request("devices", list[dict[str, Any]])

    def status(self) -> dict[str, Any]:
        """Return the complete status (docs/socket.md): `now_ns` (CLOCK_MONOTONIC), `devices`, `socket`."""
        return self._request("status", dict[str, Any])

    def schema(self) -> dict[str, Any]:
        """Return the descriptions of the members of samples: `fields`, `devices`, `slot`."""
        return self._request("schema", dict[str, Any])

    def poll(self, devices: Iterable[str] | None = None, convention: str | None = None) -> list[Sample]:
        """Return the newest sample of each device, without devices that have no sample. `convention` as for `watch`."""
        reply = self._request("poll", PollReply, devices=_listed(devices), convention=convention)
        _check_convention(reply.convention, convention)
        return [sample_of(params) for params in reply.samples]

    def call(self, method: str, **params: object) -> Any:
        """Call a method of the socket (docs/socket.md) and return its result as JSON values. Leave out the parameters
        that are None."""
        self._id += 1
        while self._fds:  # descriptors of late replies
            os.close(self._fds.pop())
        chosen = {name: value for name, value in params.items() if value is not None}
        if method == "watch" and chosen.get("encoding") == "binary":
            self._binary_ids.add(self._id)
        self._send(line_of(encode_request(method, chosen, self._id)))
        deadline_s = monotonic() + self.timeout_s
        while True:
            message = self._receive(deadline_s, method)
            if isinstance(message, bytes) or "id" not in message or "method" in message:
                self._keep(message)
            elif message["id"] in (self._id, None):  # other ids: late replies after a timeout
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
        """Return an endless iterator over samples. It replaces the previous iterator.

        - `devices`: names of the devices, None for all devices.
        - `rate_hz`: maximum number of samples per second and device, None for every sample.
        - `encoding`: `binary` or `json`. Binary samples cost less CPU time.
        - `fields`: members of JSON samples, None for all. Other members are None. Binary samples are complete.
        - `convention`: `enu-flu`, `ned-frd`, or None for the convention of the configuration. ServerError if the daemon
          does not know it.
        - `latency_ms`: maximum hold of a sample. A hold costs less CPU time on both sides. 0 for no hold, None for a
          period of `rate_hz`, at most 20 ms; no hold without a rate.
        - `timeout_s`: the iterator raises TimeoutError if no sample arrives in this time.
        """
        wanted = None if fields is None else sorted({*fields, "t_err_ns", "sync", "t_rx_ns", "utc_ns"})
        try:
            reply = self._request(
                "watch", WatchReply, devices=_listed(devices), fields=wanted, rate_hz=_finite(rate_hz),
                encoding=encoding, convention=convention, latency_ms=_finite(latency_ms),
            )  # fmt: skip
        except TimeoutError:
            self._end_watch()  # the daemon may already send the samples of the new subscription
            raise
        _check_convention(reply.convention, convention)
        self._end_watch()
        while self.kept_message(Watch.NAMES) is not None:
            pass  # samples of the previous iterator
        self._watch = Watch(self, reply.devices, timeout_s)
        return self._watch

    def unwatch(self) -> None:
        """End the subscription. The iterator returns the samples received so far, then ends."""
        self.call("unwatch")
        self._end_watch()

    def events(self, devices: Iterable[str] | None = None, timeout_s: float | None = None) -> EventStream:
        """Return an endless iterator over events. It raises TimeoutError if no event arrives in `timeout_s`."""
        self.call("events", devices=_listed(devices))
        return EventStream(self, timeout_s)

    def past_events(
        self, since_ns: int, devices: Iterable[str] | None = None, *, limit: int | None = None
    ) -> PastEvents:
        """Return the stored events since `since_ns` (CLOCK_MONOTONIC of the daemon), at most 1000, the oldest first.

        The method ends a subscription of `events` on this connection.
        """
        reply = self.call("events", devices=_listed(devices), enable=False, since_ns=since_ns, limit=limit)
        return decoded(reply, PastEvents, "events")

    def history(self, devices: Iterable[str], **params: int | str | None) -> dict[str, list[Bucket]]:
        """Return minimum and maximum of the samples of the last hour by device. `params` are the other parameters of
        the method (docs/socket.md): `from_ns`, `to_ns`, `points` (number of intervals), `convention`."""
        reply = self.call("history", devices=_listed(devices), **params)
        _check_convention(reply.get("convention"), params.get("convention"))
        return decoded(reply["devices"], dict[str, list[Bucket]], "history")

    def notify(self, device: str, latency_ms: float | None = None) -> int:
        """Return a descriptor for `Ring.wait`, readable after each batch of samples of `device`. The caller closes it.

        `latency_ms` is the maximum hold of a sample; None for 0. Read all bytes: their number has no meaning. The
        descriptor ends with the connection, or when `notify` makes another one for this device.
        """
        self.call("notify", device=device, latency_ms=_finite(latency_ms))
        return self.descriptor("notify")

    # --- recordings -------------------------------------------------------------------------------------------------

    def record(self, devices: Iterable[str] | None = None) -> int:
        """Start a recording of `devices`, None for all. Return the descriptor to read it from. The caller closes it.

        The user needs the right to control. If the caller reads too slowly, imud drops records, and marks the loss in
        the recording.
        """
        self.call("record.start", devices=_listed(devices))
        return self.descriptor("record.start")

    def stop_recording(self) -> int:
        """Stop the recording. imud still sends its queue, then end of file. Return the number of dropped records."""
        return self._request("record.stop", StopReply).records_dropped

    def snapshot(self) -> tuple[int, float]:
        """Return a descriptor to read the flight recorder's content from, as `record`, and its duration, s.

        Raises RpcError if the configuration has no flight recorder.
        """
        seconds = self._request("record.snapshot", SnapshotReply).seconds
        return self.descriptor("record.snapshot"), seconds

    # --- messages ---------------------------------------------------------------------------------------------------

    def kept_message(self, names: frozenset[str]) -> Message | None:
        """Remove and return the oldest kept message with a method in `names`; None if there is no such message."""
        for index, message in enumerate(self._inbox):
            if _is_one_of(message, names):
                del self._inbox[index]
                return message
        return None

    def next_message(self, names: frozenset[str], timeout_s: float | None) -> Message:
        """Return the next message with a method in `names`: a JSON object, or the bytes of slots (`sample`). Keep other
        messages. Raises TimeoutError if no such message arrives in `timeout_s`."""
        kept = self.kept_message(names)
        if kept is not None:
            return kept
        deadline_s = None if timeout_s is None else monotonic() + timeout_s
        while not _is_one_of(message := self._receive(deadline_s, " or ".join(sorted(names))), names):
            self._keep(message)
        return message

    def _request(self, method: str, kind: type[T], **params: object) -> T:
        """Call a method and return its result as `kind`. Raises ServerError if the result has another form."""
        return decoded(self.call(method, **params), kind, method)

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
            raise ServerError(f"{self.path}: cannot decode the greeting; is this the socket of imud?") from error
        if hello.protocol != PROTOCOL:
            raise ServerError(f"{self.path}: expected protocol {PROTOCOL}, got {hello.protocol}; update imud")
        return hello

    def descriptor(self, method: str) -> int:
        """Return the descriptor in the reply of `call(method)`; the caller closes it. Raises ServerError if it is
        absent."""
        if not self._fds:
            raise ServerError(f"expected a descriptor in the reply to {method}, got a reply without it")
        return self._fds.pop()

    def _keep(self, message: Message) -> None:
        """Keep a message for another iterator; at most the INBOX_MAX newest messages."""
        self._inbox.append(message)
        if len(self._inbox) > INBOX_MAX:
            self._inbox.popleft()
            self.discarded += 1

    def _end_watch(self) -> None:
        if self._watch is not None:
            self._watch.end()
            self._watch = None

    def _send(self, data: bytes) -> None:
        try:
            self._sock.settimeout(self.timeout_s)
            self._sock.sendall(data)
        except TimeoutError:
            self.close()  # the daemon may have a part of the request, so it cannot decode another one
            raise TimeoutError(
                f"{self.path}: the daemon did not read the request for {self.timeout_s} s; the connection is closed"
            ) from None
        except OSError as error:
            raise _lost(self.path, error) from error

    def _receive(self, deadline_s: float | None, name: str) -> Message:
        """Return the next message in order of arrival. `name` is the expected message, for the error."""
        while (message := self._parse()) is None:
            left_s = None if deadline_s is None else deadline_s - monotonic()
            if left_s is not None and left_s <= 0:
                raise TimeoutError(f"{self.path}: no {name} within the time limit")
            try:
                self._sock.settimeout(left_s)
                data, fds, _flags, _address = socket.recv_fds(self._sock, RECV_BYTES, FDS_MAX)
            except TimeoutError:
                raise TimeoutError(f"{self.path}: no {name} within the time limit") from None
            except OSError as error:
                raise _lost(self.path, error) from error
            self._fds.extend(fds)
            if not data:
                raise LinkMissing(f"{self.path}: the daemon closed the connection")
            self._buffer += data
        return message

    def _parse(self) -> Message | None:
        """Remove and return a complete message from the buffer; None if there is none."""
        buffer = self._buffer
        if not self._framed:
            end = buffer.find(b"\n")
            if end < 0:
                return None
            line = bytes(buffer[:end])
            del buffer[: end + 1]
            message = self._object(line)
            number = message.get("id")
            self._framed = "result" in message and isinstance(number, int) and number in self._binary_ids
            return message
        if len(buffer) < FRAME_HEADER.size:
            return None
        (length,) = FRAME_HEADER.unpack_from(buffer)
        if length > FRAME_MAX_BYTES:
            raise ServerError(f"{self.path}: expected a frame of at most {FRAME_MAX_BYTES} bytes, got {length} bytes")
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
            raise ServerError(f"{self.path}: expected a string as method, got {body[:80]!r}")
        return message


def rpc_error(error: object) -> RpcError:
    """Return the exception for the member `error` of a reply."""
    if isinstance(error, dict):
        data = error.get("data")
        message = str(error.get("message", "without a message"))
        return RpcError(error.get("code", 0), message, data=data if isinstance(data, dict) else None)
    return RpcError(0, f"cannot decode the error {error!r}")


def _is_one_of(message: Message, names: frozenset[str]) -> bool:
    return "sample" in names if isinstance(message, bytes) else message.get("method") in names


def _check_convention(given: object, convention: object) -> None:
    """Raise ServerError if the daemon ignored the convention."""
    if convention is not None and given != convention:
        raise ServerError(f"the daemon does not know the convention {convention}; update the daemon")


def _listed(names: Iterable[str] | None) -> list[str] | None:
    if isinstance(names, str):
        raise TypeError(f"expected a list of names, got the string {names!r}")
    return None if names is None else list(names)


def _finite(value: float | None) -> float | None:
    """Return `value`. Raise ValueError if it is NaN or infinite: JSON would send null, which is the default."""
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
