"""Relay of the daemon's samples, events and status to a viewer, as messages of a dialect (`imud.bridges`)."""

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
import msgspec
from foxglove.websocket import StatusLevel

from imud.attitude.conventions import Convention
from imud.bridges.channel import Diagnoses, Dialect, LiveDiagnosis, MessageChannel, MessageFrames, StampedEvent
from imud.bridges.json import status_channel
from imud.client.connection import Client, EventStream, Watch, event_of, params_of
from imud.client.feed import clock_ahead_ns, utc_offset_ns
from imud.contracts.status import Deviations, DeviceStatus
from imud.model.errors import BadArgument, ImudError, ServerError, reason_of
from imud.model.event import Event
from imud.model.sample import Sample
from imud.web.guard import is_loopback, is_own_host

ROUND_S: Final = 0.25
"""Time between two looks at events and at who looks: a tenth would be no better to a person, and costs more."""
STATUS_S: Final = 1.0
RETRY_S: Final = 1.0
"""Time between two attempts to reach the daemon."""
NORTH: Final = "ENU"
"""Navigation frame of a device whose heading has to do with north, as the status has it."""


class Viewer(Protocol):
    """What shows messages, or has clients that do."""

    @property
    def is_looked_at(self) -> bool:
        """Whether a viewer wants samples now."""
        ...

    def open(self, channel: MessageChannel[Any]) -> None:
        """Offer a channel; no-op for one whose topic is offered already."""
        ...

    def close_topic(self, topic: str) -> None:
        """Offer it no more; no-op for one that is not."""
        ...

    def send(self, channel: MessageChannel[Any], item: object, utc_ns: int) -> None:
        """Make a message of `item` for those who want it."""
        ...

    def problem(self, text: str) -> None:
        """Show why nothing comes; empty: it does."""
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
        utc_offset_ns: Callable[[int], int] = lambda now_ns: utc_offset_ns(clock_ahead_ns(now_ns)),
    ) -> None:
        """`devices` are those that are shown, none: all; each at most `rate_hz`, None: every sample.

        `utc_offset_ns` gets what the daemon's CLOCK_MONOTONIC was just now, and returns what makes UTC of it.
        `noise`, by device, is taken in place of what the daemon's configuration has.
        """
        self._path = path
        self._viewer = viewer
        self._wanted = list(devices)
        self._rate_hz = rate_hz
        self._noise = noise or {}
        self._utc_offset_of = utc_offset_ns
        self._utc_offset_ns = 0
        """As of the newest status."""
        self._dialect = dialect
        self._events = dialect.events()
        self._diagnostics = dialect.diagnostics()
        self._diagnosis = LiveDiagnosis()
        self._devices: dict[str, _ShownDevice] = {}
        self._stop = ThreadEvent()

    def run(self) -> None:
        """Relay until `stop`."""
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
        """End `run`, within a round."""
        self._stop.set()

    def _read(self, client: Client) -> None:
        """Relay until the end, or until the connection is lost, which raises."""
        events = client.events(self._wanted or None, timeout_s=ROUND_S)
        watch: Watch | None = None
        due_s = 0.0
        while not self._stop.is_set():
            if monotonic() >= due_s:
                self._show_status(client)
                due_s = monotonic() + STATUS_S
            if not self._viewer.is_looked_at:
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
        """Relay what comes in a round, each at once."""
        end_s = monotonic() + ROUND_S
        with suppress(TimeoutError):
            while monotonic() < end_s:
                sample = next(watch)
                device = self._devices.get(sample.device)
                if device is not None:  # one that was configured just now is shown with the next status
                    device.show(sample)

    def _show_event(self, event: Event) -> None:
        stamped = StampedEvent(event, event.t_ns + self._utc_offset_ns)
        self._viewer.send(self._events, stamped, stamped.utc_ns)

    def _show_diagnoses(self, diagnoses: Diagnoses) -> None:
        if diagnoses.devices:
            self._viewer.send(self._diagnostics, diagnoses, diagnoses.utc_ns)

    def _show_status(self, client: Client) -> None:
        answer = client.status()
        statuses = msgspec.convert(answer["devices"], list[DeviceStatus])
        self._utc_offset_ns = self._utc_offset_of(answer["now_ns"])
        utc_ns = answer["now_ns"] + self._utc_offset_ns
        self._viewer.problem("")
        there = {status.name: status for status in statuses if not self._wanted or status.name in self._wanted}
        for name in self._devices.keys() - there.keys():
            gone = self._devices.pop(name)
            gone.close(kept=frozenset().union(*(device.topics for device in self._devices.values())))
        for name, status in there.items():
            known = self._devices.get(name)
            noise = (status.noise or Deviations()).updated(self._noise.get(name, Deviations()))
            frames = MessageFrames(name, has_north=_has_north(status), deviations=noise)
            if known is None or known.frames != frames:
                known = self._devices[name] = _ShownDevice(self._viewer, self._dialect, frames)
            known.show_status(status, utc_ns)
        self._show_diagnoses(self._diagnosis.of(there.values(), utc_ns))
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
        """Whether channels of its samples are offered: what they are is known from the first sample."""
        return bool(self._open)

    def show(self, sample: Sample) -> None:
        """Send the messages of a sample; a channel is offered with the first sample that has something for it."""
        for channel in self._channels:
            if channel.topic not in self._open:
                if channel.encode(sample) is None:
                    continue
                self._open.add(channel.topic)
                self._viewer.open(channel)
            self._viewer.send(channel, sample, sample.utc_ns)

    def show_status(self, status: DeviceStatus, utc_ns: int) -> None:
        """Send the status."""
        self._viewer.send(self._status, (status, utc_ns), utc_ns)

    @property
    def topics(self) -> frozenset[str]:
        """Topics that are offered for it; that of transforms is one for all devices."""
        return frozenset((*self._open, self._status.topic))

    def close(self, kept: Collection[str]) -> None:
        """Offer nothing of it any more but the topics that others have as well."""
        for topic in self.topics.difference(kept):
            self._viewer.close_topic(topic)


def _has_north(status: DeviceStatus) -> bool:
    """Whether the navigation frame of its samples in enu-flu is ENU; while its driver is not known, as if it was."""
    if status.frame is None:
        return True
    words = status.frame.conventions.get(str(Convention.ENU_FLU))
    return words is None or words.navigation_frame == NORTH


VIEWERS: Final = ("file://", "https://app.foxglove.dev")
"""Foxglove and Lichtblick as programs, and Foxglove in the browser."""
SCHEMES: Final = ("http", "https")


class ViewerOrigins:
    """The rule of one server."""

    def __init__(self, *, names: Iterable[str] = (), origins: Iterable[str] = ()) -> None:
        """`names` are further names of this host, `origins` further sites. Raises BadArgument for what is no origin."""
        self._names: Collection[str] = {"localhost", *(name.lower() for name in names)}
        self._origins = {*VIEWERS, *(_checked(origin) for origin in origins)}

    def problem(self, host: str, origin: str) -> str:
        """Return why a request is refused; empty where it may pass. `origin` is empty where there is none."""
        if not is_own_host(host, self._names):
            return (
                f"expected an IP address or one of {', '.join(sorted(self._names))} as the host, got {host[:80]!r}; "
                "another name of this host is given with --host NAME"
            )
        if not origin or origin.lower() in self._origins or _is_of_this_machine(origin):
            return ""
        return f"pages of {origin[:80]!r} may not read; they may with --allow-origin {origin[:80]}"


def _is_of_this_machine(origin: str) -> bool:
    """Decide whether a page is served by this machine: who serves it could read without a browser."""
    parts = _parts(origin)
    return parts is not None and is_loopback(parts[1])


def _checked(origin: str) -> str:
    if _parts(origin) is None:
        raise BadArgument(f"--allow-origin: expected a site as https://viewer.example:8080, got {origin!r}")
    return origin.lower()


def _parts(origin: str) -> tuple[str, str] | None:
    """Split an origin into scheme and host name; None for what is none."""
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
"""Of a request: a browser sends about 600 bytes, and its cookies for this host."""
HEAD_S: Final = 10.0
"""Time for the request to come."""
CONNECTIONS_MAX: Final = 32
"""Viewers at a time: each has a backlog of 1024 messages in the server."""
READ_BYTES: Final = 65536
GATHER_S: Final = 0.005
"""Pause after each read of messages: the server writes each message alone, and a viewer draws every 16 ms."""
NOTES_MAX: Final = 20
"""Refusals that are printed, each once: a page may try again for ever."""


class ViewerGate:
    """The gate in front of a server, in a thread of its own. Synchronization: `close` in the thread that made it."""

    def __init__(
        self, host: str, port: int, server: tuple[str, int], origins: ViewerOrigins, *, note: Callable[[str], None]
    ) -> None:
        """Listen on `host` and `port` (0: a free one) for the server at the address and port `server`.

        `note` is called in another thread with each refusal for the first time. Raises ServerError.
        """
        self._server = server
        self._origins = origins
        self._note = note
        self._noted: set[str] = set()
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
        """End all connections; may be called twice."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stopped.set)
        self._thread.join()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())  # the runner cancels the connections that are left

    async def _serve(self) -> None:
        listening = await asyncio.start_server(self._accept, sock=self._socket, limit=HEAD_BYTES_MAX)
        self._ready.set()
        await self._stopped.wait()
        listening.close()

    def _accept(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Serve a connection; its writer is closed even where the gate ends before the task has begun."""
        task = self._loop.create_task(self._take(reader, writer))
        self._connections.add(task)
        task.add_done_callback(self._connections.discard)
        task.add_done_callback(lambda _: writer.close())

    async def _take(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Serve a connection to its end."""
        try:
            async with asyncio.timeout(HEAD_S):
                head = await reader.readuntil(b"\r\n\r\n")
            status, problem = self._judge(head)
            if problem:
                writer.write(_refusal(status, problem))
                await writer.drain()
            else:
                await self._join(head, reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # it went away, or it is no viewer

    def _judge(self, head: bytes) -> tuple[str, str]:
        """Return the HTTP status and the words of a refusal; empty words where the request may pass."""
        if len(self._connections) > CONNECTIONS_MAX:
            return "503 Service Unavailable", f"{CONNECTIONS_MAX} viewers are connected, which is the most"
        request, _, rest = head.partition(b"\r\n")
        try:
            headers = parse_headers(BytesIO(rest))
        except (HTTPException, MessageError):
            return "400 Bad Request", "expected a request of a WebSocket"
        hosts, origins = headers.get_all("Host", []), headers.get_all("Origin", [])
        if headers.defects or len(hosts) != 1 or len(origins) > 1 or not request.endswith(b" HTTP/1.1"):
            return "400 Bad Request", "expected a request of a WebSocket"
        if headers.get("Upgrade", "").lower() != "websocket":
            return "426 Upgrade Required", "expected a WebSocket: open ws:// and this address in a viewer"
        problem = self._origins.problem(hosts[0].strip(), origins[0].strip() if origins else "")
        if problem and problem not in self._noted and len(self._noted) < NOTES_MAX:
            self._noted.add(problem)
            self._note(f"refused a connection: {problem}")
        return "403 Forbidden", problem

    async def _join(self, head: bytes, reader: StreamReader, writer: StreamWriter) -> None:
        """Pass bytes on in both directions until one end closes."""
        server_reader, server_writer = await asyncio.open_connection(*self._server, limit=READ_BYTES)
        server_writer.write(head)
        ways = (
            asyncio.create_task(_pass_on(reader, server_writer, 0.0)),
            asyncio.create_task(_pass_on(server_reader, writer, GATHER_S)),
        )
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            server_writer.close()  # before the wait: the end of the gate may cancel that
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)


async def _pass_on(reader: StreamReader, writer: StreamWriter, pause_s: float) -> None:
    with suppress(OSError):
        while data := await reader.read(READ_BYTES):
            writer.write(data)
            await writer.drain()
            await asyncio.sleep(pause_s)


def _listening(host: str, port: int) -> socket.socket:
    """Open the socket. Raises ServerError naming what to look at."""
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
"""Of the status message that says why nothing comes."""
LOOPBACK: Final = IPv4Network("127.0.0.0/8")


class FoxgloveServer:
    """A server, which is a `Viewer`. Synchronization: one thread; the library has its own."""

    def __init__(self, host: str, port: int, origins: ViewerOrigins, *, note: Callable[[str], None]) -> None:
        """`note` says a problem for people, once each, also in the gate's thread.

        Raises ServerError where the address cannot be had.
        """
        self._note = note
        self._problem = ""
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        behind = hidden_address()
        try:
            self._server = foxglove.start_server(name="imud", host=behind, port=0, context=self._context)
        except RuntimeError as error:  # what foxglove-sdk makes of every error of the operating system
            raise ServerError(f"foxglove-sdk cannot listen on {behind}, behind imud's own port: {error}") from error
        try:
            self._gate = ViewerGate(host, port, (behind, self._server.port), origins, note=note)
        except ServerError:
            self._server.stop()
            raise
        self.url: Final = f"ws://{f'[{host}]' if ':' in host else host}:{self._gate.port}"

    @property
    def is_looked_at(self) -> bool:
        """Whether a client has subscribed to anything."""
        return any(channel.has_sinks() for channel in self._channels.values())

    def open(self, channel: MessageChannel[Any]) -> None:
        """Offer a channel; no-op for one whose topic is offered already."""
        if channel.topic not in self._channels:
            name, encoding, data = channel.schema
            self._channels[channel.topic] = foxglove.Channel(
                channel.topic,
                schema=foxglove.Schema(name=name, encoding=encoding, data=data),
                message_encoding=channel.message_encoding,
                context=self._context,
            )

    def close_topic(self, topic: str) -> None:
        """Offer it no more; no-op for one that is not."""
        channel = self._channels.pop(topic, None)
        if channel is not None:
            channel.close()

    def send(self, channel: MessageChannel[Any], item: object, utc_ns: int) -> None:
        """Make a message of `item` if a client wants it, and send it."""
        offered = self._channels[channel.topic]
        if offered.has_sinks():
            data = channel.encode(item)
            if data is not None:
                offered.log(data, log_time=max(utc_ns, 0))

    def problem(self, text: str) -> None:
        """Show clients and the terminal why nothing comes; empty: it does."""
        if text == self._problem:
            return
        self._problem = text
        if text:
            self._note(text)
            self._server.publish_status(text, StatusLevel.Error, STATUS_ID)
        else:
            self._note("samples come again")
            self._server.remove_status([STATUS_ID])

    def close(self) -> None:
        """End the server; may be called twice."""
        self._gate.close()
        self._server.stop()


def hidden_address() -> str:
    """Choose one of 16 million addresses of this machine: with its port, no page finds the server by trying."""
    return str(LOOPBACK[1 + secrets.randbelow(LOOPBACK.num_addresses - 2)])
