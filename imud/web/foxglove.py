"""Server for Foxglove viewers: relays samples, events and status of the daemon in a dialect of `imud.bridges`."""

import asyncio
import secrets
import socket
from asyncio import StreamReader, StreamWriter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from email.errors import MessageError
from http.client import HTTPException, parse_headers
from io import BytesIO
from ipaddress import IPv4Network
from threading import Event as ThreadEvent
from threading import Thread
from time import monotonic, time_ns
from typing import Any, Final, Protocol
from urllib.parse import urlsplit

import foxglove
from foxglove.websocket import StatusLevel

from imud.attitude.conventions import Convention
from imud.bridges.channel import (
    Diagnoses,
    Dialect,
    LiveDiagnosis,
    MessageChannel,
    MessageFrames,
    StampedEvent,
    has_north,
)
from imud.bridges.json import status_channel
from imud.client.connection import Client, EventStream, Watch, decoded, event_of, params_of
from imud.client.feed import clock_ahead_ns, utc_offset_ns
from imud.contracts.status import Deviations, DeviceStatus
from imud.model.errors import BadArgument, ImudError, ServerError, reason_of
from imud.model.event import Event
from imud.model.sample import Sample
from imud.web.guard import is_loopback, is_own_host

ROUND_S: Final = 0.25
"""Time between two checks for events and for subscriptions of viewers, s."""
STATUS_S: Final = 1.0
RETRY_S: Final = 1.0
"""Time between two attempts to connect to the daemon, s."""


class Viewer(Protocol):
    """Receiver of messages: the server, or a recorder of a test."""

    @property
    def is_subscribed(self) -> bool:
        """Whether a client has a subscription."""
        ...

    def open(self, channel: MessageChannel[Any]) -> None:
        """Offer a channel. Do nothing if its topic is already offered."""
        ...

    def close_topic(self, topic: str) -> None:
        """Stop offering a topic. Do nothing if it is not offered."""
        ...

    def send(self, channel: MessageChannel[Any], item: object, utc_ns: int) -> None:
        """Encode `item` and send it to the subscribed clients."""
        ...

    def problem(self, text: str) -> None:
        """Show why no messages arrive; empty if they arrive."""
        ...


class Relay:
    """Relay from the daemon at `path`. Synchronization: `run` in one thread, `stop` in any."""

    def __init__(
        self,
        path: str,
        viewer: Viewer,
        dialect: Dialect,
        *,
        devices: Sequence[str] = (),
        rate_hz: float | None = None,
        noise: Mapping[str, Deviations] | None = None,
    ) -> None:
        """Relay `devices` (empty: all) with at most `rate_hz` samples per second (None: every sample).

        `noise` replaces the noise in the daemon's configuration, by device.
        """
        self._path = path
        self._viewer = viewer
        self._wanted = list(devices)
        self._rate_hz = rate_hz
        self._noise = noise or {}
        self._utc_offset_ns = 0  # UTC minus CLOCK_MONOTONIC at the newest status
        self._dialect = dialect
        self._events = dialect.events()
        self._diagnostics = dialect.diagnostics()
        self._diagnosis = LiveDiagnosis()
        self._devices: dict[str, _ShownDevice] = {}
        self._stop = ThreadEvent()

    def run(self) -> None:
        """Relay until `stop`. Connect again if the connection is lost."""
        self._viewer.open(self._events)
        self._viewer.open(self._diagnostics)
        while not self._stop.is_set():
            try:
                with Client(self._path) as client:
                    self._read(client)
            except (ImudError, TimeoutError) as error:
                self._viewer.problem(str(error))
                self._show_diagnoses(self._diagnosis.stale(str(error), time_ns()))
                self._stop.wait(RETRY_S)

    def stop(self) -> None:
        """End `run` within ROUND_S."""
        self._stop.set()

    def _read(self, client: Client) -> None:
        """Relay until `stop`. Raises ImudError if the connection is lost."""
        events = client.events(self._wanted or None, timeout_s=ROUND_S)
        watch: Watch | None = None
        due_s = 0.0
        while not self._stop.is_set():
            if monotonic() >= due_s:
                self._show_status(client)
                due_s = monotonic() + STATUS_S
            if not self._viewer.is_subscribed:
                if watch is not None:
                    client.unwatch()
                    watch = None
                with suppress(TimeoutError):
                    self._show_event(next(events))
            elif watch is None:
                watch = client.watch(
                    self._wanted or None, rate_hz=self._rate_hz, timeout_s=ROUND_S, convention=Convention.ENU_FLU
                )
            else:
                self._show_samples(watch)
            while isinstance(message := client.kept_message(EventStream.NAMES), dict):
                self._show_event(event_of(params_of(message)))

    def _show_samples(self, watch: Watch) -> None:
        """Relay the samples that arrive in ROUND_S."""
        end_s = monotonic() + ROUND_S
        with suppress(TimeoutError):
            while monotonic() < end_s:
                sample = next(watch)
                device = self._devices.get(sample.device)
                if device is not None:  # imud shows a new device after the next status
                    device.show(sample)

    def _show_event(self, event: Event) -> None:
        stamped = StampedEvent(event, event.t_ns + self._utc_offset_ns)
        self._viewer.send(self._events, stamped, stamped.utc_ns)

    def _show_diagnoses(self, diagnoses: Diagnoses) -> None:
        if diagnoses.devices:
            self._viewer.send(self._diagnostics, diagnoses, diagnoses.utc_ns)

    def _show_status(self, client: Client) -> None:
        reply = client.status()
        statuses = decoded(reply["devices"], list[DeviceStatus])
        self._utc_offset_ns = utc_offset_ns(clock_ahead_ns(reply["now_ns"]))
        utc_ns = reply["now_ns"] + self._utc_offset_ns
        self._viewer.problem("")
        shown = {status.name: status for status in statuses if not self._wanted or status.name in self._wanted}
        for name in self._devices.keys() - shown.keys():
            gone = self._devices.pop(name)
            gone.close(kept=frozenset().union(*(device.topics for device in self._devices.values())))
        for name, status in shown.items():
            known = self._devices.get(name)
            noise = (status.noise or Deviations()).updated(self._noise.get(name, Deviations()))
            frames = MessageFrames(name, has_north=has_north(status), deviations=noise)
            if known is None or known.frames != frames:
                known = self._devices[name] = _ShownDevice(self._viewer, self._dialect, frames)
            known.show_status(status, utc_ns)
        self._show_diagnoses(self._diagnosis.of(shown.values(), utc_ns))
        unknown = [name for name, device in self._devices.items() if not device.is_offered]
        for sample in client.poll(unknown, convention=Convention.ENU_FLU) if unknown else ():
            self._devices[sample.device].show(sample)


class _ShownDevice:
    """The channels of one device."""

    def __init__(self, viewer: Viewer, dialect: Dialect, frames: MessageFrames) -> None:
        self.frames = frames
        self._viewer = viewer
        self._status = status_channel(frames.device)
        self._channels = dialect.samples(frames)
        self._open: set[str] = set()
        viewer.open(self._status)

    @property
    def is_offered(self) -> bool:
        """Whether channels of samples are offered. The first sample determines these channels."""
        return bool(self._open)

    def show(self, sample: Sample) -> None:
        """Send the messages of a sample. Offer a channel with its first message."""
        for channel in self._channels:
            if channel.topic not in self._open:
                if channel.encode(sample) is None:
                    continue
                self._open.add(channel.topic)
                self._viewer.open(channel)
            self._viewer.send(channel, sample, sample.utc_ns)

    def show_status(self, status: DeviceStatus, utc_ns: int) -> None:
        self._viewer.send(self._status, (status, utc_ns), utc_ns)

    @property
    def topics(self) -> frozenset[str]:
        """Offered topics of the device. All devices share the topic of transforms."""
        return frozenset((*self._open, self._status.topic))

    def close(self, kept: Collection[str]) -> None:
        """Stop offering the topics of the device, except topics of other devices (`kept`)."""
        for topic in self.topics.difference(kept):
            self._viewer.close_topic(topic)


VIEWERS: Final = ("file://", "https://app.foxglove.dev")
"""Origins of the desktop programs Foxglove and Lichtblick, and of Foxglove in the browser."""
SCHEMES: Final = ("http", "https")


class ViewerOrigins:
    """Accepted hosts and origins of one server."""

    # Host: an IP address, `localhost` or a configured name. No other site can serve a page under these names, so a name
    # that resolves to this host (DNS rebinding) is useless.
    # Origin: the site of the page that opens the WebSocket. Browsers send it, and pages cannot change it. A program
    # sends none, or `file://` if it consists of web pages (Electron). The gate refuses `null`, the origin of sandboxed
    # pages of any site.

    def __init__(self, *, names: Iterable[str] = (), origins: Iterable[str] = ()) -> None:
        """Accept additional `names` of this host and additional `origins`. Raises BadArgument for an invalid origin."""
        self._names: Collection[str] = {"localhost", *(name.lower() for name in names)}
        self._origins = {*VIEWERS, *(_checked(origin) for origin in origins)}

    def problem(self, host: str, origin: str) -> str:
        """Return the reason to refuse a request; empty to accept it. `origin` is empty without the header Origin."""
        if not is_own_host(host, self._names):
            return (
                f"expected an IP address or one of {', '.join(sorted(self._names))} as the host, got {host[:80]!r}; "
                "add another name of this host with --host NAME"
            )
        if not origin or origin.lower() in self._origins or _is_local(origin):
            return ""
        return f"pages of {origin[:80]!r} may not read; allow them with --allow-origin {origin[:80]}"


def _is_local(origin: str) -> bool:
    """Return whether this host serves the page. A program on this host could read without a browser."""
    parts = _parts(origin)
    return parts is not None and is_loopback(parts[1])


def _checked(origin: str) -> str:
    if _parts(origin) is None:
        raise BadArgument(f"--allow-origin: expected a site as https://viewer.example:8080, got {origin!r}")
    return origin.lower()


def _parts(origin: str) -> tuple[str, str] | None:
    """Return scheme and host name of an origin; None if it is invalid."""
    origin = origin.lower()
    try:
        parts = urlsplit(origin)
        place = f"{parts.scheme}://{parts.netloc}"
        _ = parts.port
    except ValueError:
        return None
    is_origin = parts.scheme in SCHEMES and bool(parts.hostname) and "@" not in parts.netloc
    return (parts.scheme, parts.hostname or "") if is_origin and place == origin else None


HEAD_BYTES_MAX: Final = 16384
"""Maximum size of a request head, bytes. A browser sends about 600 bytes and its cookies for this host."""
HEAD_S: Final = 10.0
"""Time limit for the request head, s."""
CONNECTIONS_MAX: Final = 32
"""Maximum number of viewers. The server has a queue of 1024 messages for each."""
WAITING_MAX: Final = 64
"""Maximum number of connections without a complete request head. A new connection then closes the oldest of them."""
READ_BYTES: Final = 65536
VIEWER_BYTES: Final = 4096
"""Maximum size of one read from a viewer, bytes. A viewer only sends its subscriptions, a few kB after its start."""
VIEWER_PAUSE_S: Final = 0.05
"""Pause after each read from a viewer, s: at most 80 kB/s of each viewer reach the server of foxglove-sdk."""
GATHER_S: Final = 0.005
"""Pause after each read of messages, s. The server writes each message separately. A viewer draws every 16 ms."""
NOTES_MAX: Final = 20
"""Maximum number of printed refusals. The gate prints each text once, because a page may try again forever."""


class ViewerGate:
    """Checks connections and forwards them to a server, in a thread of its own. Call `close` in the creating thread.

    viewer ──▶ gate: Host, Origin ──▶ server of foxglove-sdk, on a random address of 127.0.0.0/8
    """

    # The server of foxglove-sdk accepts every connection, and any page in a browser of this host can open a WebSocket
    # to it. The gate checks the head of the first request, and then forwards bytes without a check.

    def __init__(
        self, host: str, port: int, server: tuple[str, int], origins: ViewerOrigins, *, note: Callable[[str], None]
    ) -> None:
        """Listen on `host` and `port` (0: any free port), and forward to the address and port `server`.

        The gate's thread calls `note` with each new refusal. Raises ServerError if it cannot listen.
        """
        self._server = server
        self._origins = origins
        self._note = note
        self._noted: set[str] = set()
        self._viewers = 0  # number of connections with an accepted head
        # connections without a complete request head, oldest first
        self._waiting: dict[asyncio.Task[None], StreamWriter] = {}
        self._connections: set[asyncio.Task[None]] = set()
        self._socket = _listening(host, port)
        self.port: Final = int(self._socket.getsockname()[1])
        self._loop = asyncio.new_event_loop()
        self._stopped = asyncio.Event()
        self._ready = ThreadEvent()
        self._thread = Thread(target=self._run, name="foxglove-gate", daemon=True)
        self._thread.start()
        self._ready.wait()

    def close(self) -> None:
        """Close all connections. A second call does nothing."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stopped.set)
        self._thread.join()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())  # the runner cancels the remaining connections

    async def _serve(self) -> None:
        listening = await asyncio.start_server(self._accept, sock=self._socket, limit=HEAD_BYTES_MAX)
        self._ready.set()
        await self._stopped.wait()
        listening.close()

    def _accept(self, reader: StreamReader, writer: StreamWriter) -> None:
        if len(self._waiting) >= WAITING_MAX:
            oldest = next(iter(self._waiting))
            self._waiting.pop(oldest).transport.abort()
        task = self._loop.create_task(self._take(reader, writer))
        self._connections.add(task)
        self._waiting[task] = writer
        task.add_done_callback(lambda _: self._waiting.pop(task, None))
        task.add_done_callback(self._connections.discard)
        task.add_done_callback(lambda _: writer.close())  # also if the gate closes before the task starts

    async def _take(self, reader: StreamReader, writer: StreamWriter) -> None:
        try:
            async with asyncio.timeout(HEAD_S):
                head = await reader.readuntil(b"\r\n\r\n")
            status, problem = self._judge(head)
            task = asyncio.current_task()
            assert task is not None
            if problem:
                writer.write(_refusal(status, problem))
                await writer.drain()
            else:
                self._waiting.pop(task, None)
                self._viewers += 1
                try:
                    await self._join(head, reader, writer)
                finally:
                    self._viewers -= 1
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the client has left, or it is not a viewer

    def _judge(self, head: bytes) -> tuple[str, str]:
        """Return HTTP status and reason of a refusal. The reason is empty if the gate accepts the request."""
        if self._viewers >= CONNECTIONS_MAX:
            return "503 Service Unavailable", f"{CONNECTIONS_MAX} viewers are connected, the maximum; close one"
        request, _, rest = head.partition(b"\r\n")
        try:
            headers = parse_headers(BytesIO(rest))
        except (HTTPException, MessageError):
            return "400 Bad Request", "expected a WebSocket request"
        hosts, origins = headers.get_all("Host", []), headers.get_all("Origin", [])
        if headers.defects or len(hosts) != 1 or len(origins) > 1 or not request.endswith(b" HTTP/1.1"):
            return "400 Bad Request", "expected a WebSocket request"
        if headers.get("Upgrade", "").lower() != "websocket":
            return "426 Upgrade Required", "expected a WebSocket request; open ws:// and this address in a viewer"
        problem = self._origins.problem(hosts[0].strip(), origins[0].strip() if origins else "")
        if problem and problem not in self._noted and len(self._noted) < NOTES_MAX:
            self._noted.add(problem)
            self._note(f"refused a connection: {problem}")
        return "403 Forbidden", problem

    async def _join(self, head: bytes, reader: StreamReader, writer: StreamWriter) -> None:
        """Forward bytes in both directions until one end closes."""
        server_reader, server_writer = await asyncio.open_connection(*self._server, limit=READ_BYTES)
        server_writer.write(head)
        copies = (
            asyncio.create_task(_forward(reader, server_writer, VIEWER_BYTES, VIEWER_PAUSE_S)),
            asyncio.create_task(_forward(server_reader, writer, READ_BYTES, GATHER_S)),
        )
        try:
            await asyncio.wait(copies, return_when=asyncio.FIRST_COMPLETED)
        finally:
            server_writer.close()  # before `gather`, which may be cancelled
            for copy in copies:
                copy.cancel()
            await asyncio.gather(*copies, return_exceptions=True)


async def _forward(reader: StreamReader, writer: StreamWriter, size_bytes: int, pause_s: float) -> None:
    """Forward at most `size_bytes` in each `pause_s`. The kernel stops a faster sender."""
    with suppress(OSError):
        while data := await reader.read(size_bytes):
            writer.write(data)
            await writer.drain()
            await asyncio.sleep(pause_s)


def _listening(host: str, port: int) -> socket.socket:
    """Return a listening socket. Raises ServerError."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family)
    except OSError as error:
        raise ServerError(
            f"cannot listen on {host} port {port}: {reason_of(error)}; is another `imud foxglove` running? (ss -ltnp)"
        ) from error


def _refusal(status: str, problem: str) -> bytes:
    words = f"imud foxglove: {problem}\n".encode()
    head = f"HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {len(words)}\r\n"
    return f"{head}Connection: close\r\n\r\n".encode() + words


STATUS_ID: Final = "daemon"
"""Id of the status message with the reason for missing messages."""
LOOPBACK: Final = IPv4Network("127.0.0.0/8")


class FoxgloveServer:
    """A `Viewer` that serves Foxglove clients. Synchronization: one thread; the library has its own threads."""

    def __init__(self, host: str, port: int, origins: ViewerOrigins, *, note: Callable[[str], None]) -> None:
        """Listen. `note` prints a problem; the gate's thread calls it too. Raises ServerError if it cannot listen."""
        self._note = note
        self._problem = ""
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        behind = hidden_address()
        try:
            self._server = foxglove.start_server(name="imud", host=behind, port=0, context=self._context)
        except RuntimeError as error:  # foxglove-sdk raises it for every error of the operating system
            raise ServerError(f"foxglove-sdk cannot listen on the internal address {behind}: {error}") from error
        try:
            self._gate = ViewerGate(host, port, (behind, self._server.port), origins, note=note)
        except ServerError:
            self._server.stop()
            raise
        self.url: Final = f"ws://{f'[{host}]' if ':' in host else host}:{self._gate.port}"

    @property
    def is_subscribed(self) -> bool:
        return any(channel.has_sinks() for channel in self._channels.values())

    def open(self, channel: MessageChannel[Any]) -> None:
        if channel.topic not in self._channels:
            name, encoding, data = channel.schema
            self._channels[channel.topic] = foxglove.Channel(
                channel.topic,
                schema=foxglove.Schema(name=name, encoding=encoding, data=data),
                message_encoding=channel.message_encoding,
                context=self._context,
            )

    def close_topic(self, topic: str) -> None:
        channel = self._channels.pop(topic, None)
        if channel is not None:
            channel.close()

    def send(self, channel: MessageChannel[Any], item: object, utc_ns: int) -> None:
        offered = self._channels[channel.topic]
        if offered.has_sinks():
            data = channel.encode(item)
            if data is not None:
                offered.log(data, log_time=max(utc_ns, 0))

    def problem(self, text: str) -> None:
        # to the clients and to the terminal
        if text == self._problem:
            return
        self._problem = text
        if text:
            self._note(text)
            self._server.publish_status(text, StatusLevel.Error, STATUS_ID)
        else:
            self._note("connected to the daemon again")
            self._server.remove_status([STATUS_ID])

    def close(self) -> None:
        """Stop the server. A second call does nothing."""
        self._gate.close()
        self._server.stop()


def hidden_address() -> str:
    """Return a random loopback address."""
    # one of 16 million: a page cannot find the server behind the gate by trying
    return str(LOOPBACK[1 + secrets.randbelow(LOOPBACK.num_addresses - 2)])
