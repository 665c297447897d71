"""RMC sentences of GNSS receivers: from gpsd, or from a receiver on a serial port.

gpsd forwards the sentences of a receiver, or makes sentences for receivers with another protocol. Its JSON protocol
(gpsd_json(5)) is a greeting, `?WATCH={"enable":true,"nmea":true}` once, then sentences. A silent receiver is not a
broken connection. TCP keep-alive detects a missing gpsd.
"""

import asyncio
import socket
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Annotated, Final, Literal, NamedTuple, Protocol

import msgspec
from msgspec import Meta

from imud.contracts.link import StreamLink
from imud.formats.nmea0183 import RMC_BYTES_MAX
from imud.host.network import resolve
from imud.model.errors import LinkError, reason_of
from imud.model.options import Options, is_host, shown

# called with one RMC sentence including its line end, and with CLOCK_MONOTONIC right after its arrival, ns
OnSentence = Callable[[bytes, int], None]
# makes a closed serial link from a path and a rate in bit/s
MakePort = Callable[[str, int], StreamLink]


class RmcOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the source of a device's RMC sentences."""

    source: Literal["gpsd", "nmea", "system"]
    """`gpsd`: a GNSS receiver that gpsd owns. `nmea`: a receiver on a serial port. `system`: the system clock while it
    is synchronized."""
    rate_hz: Annotated[int, Meta(ge=1, le=10)] = 1
    """Maximum number of sentences per second for the device."""
    host: Annotated[str, Meta(min_length=1, max_length=253)] = "127.0.0.1"
    """Host of gpsd."""
    tcp_port: Annotated[int, Meta(ge=1, le=65535)] = 2947
    """TCP port of gpsd."""
    gps: Annotated[str, Meta(max_length=256)] = ""
    """Path of the receiver in gpsd, if gpsd has several receivers. Empty for all receivers."""
    port: str = ""
    """Path of the receiver's serial port, for `nmea`."""
    baud: Annotated[int, Meta(ge=4800, le=921_600)] = 9600
    """Baud rate of this port, bit/s."""
    error_ms: Annotated[float, Meta(gt=0, le=60)] = 50.0
    """Maximum one-sigma error of the system clock for the source `system`, ms."""

    def __post_init__(self) -> None:
        if not is_host(self.host):
            raise ValueError(f"host: expected an IP address or a host name, got {shown(self.host)}")
        if self.source == "nmea" and not self.port:
            raise ValueError("expected the key port for source nmea, the path of the receiver's port, got none")


class RmcSource(Protocol):
    """Source of sentences, valid or not. It recovers from failures. Synchronization: the event loop's thread only."""

    title: str  # Name of the source for the user. Example: `gpsd at 127.0.0.1:2947`.
    problem: str  # reason why the source delivers no sentences, one sentence; empty if it delivers sentences
    sentences: int  # number of sentences since the start

    def start(self, on_sentence: OnSentence) -> None:
        """Start to deliver sentences. Needs a running event loop."""
        ...

    def close(self) -> None:
        """Stop the delivery, and release the port or connection. A second call does nothing."""
        ...


class SourceContext(NamedTuple):
    make_port: MakePort
    now_ns: Callable[[], int]  # CLOCK_MONOTONIC, ns
    utc_offset_ns: Callable[[], int]  # CLOCK_REALTIME minus CLOCK_MONOTONIC, ns


# Makes a source. `imud.utc.RMC_SOURCES` contains one for each value of `RmcOptions.source`.
MakeSource = Callable[[RmcOptions, SourceContext], RmcSource]

# Maximum length of a line, bytes. gpsd writes JSON of some kilobytes. Longer lines are skipped and not buffered.
LINE_BYTES_MAX: Final = 16384
FIRST_PAUSE_S: Final = 0.5
LONGEST_PAUSE_S: Final = 30.0


class SentenceSplitter:
    """Finder of RMC sentences between other data. It buffers at most LINE_BYTES_MAX. Synchronization: one thread."""

    def __init__(self) -> None:
        self._tail = b""
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes]:
        """Add bytes. Return the complete sentences with CR LF. Their checksums are not verified."""
        *lines, tail = (self._tail + data).split(b"\n")
        if lines and self._skipping:
            lines, self._skipping = lines[1:], False
        if len(tail) > LINE_BYTES_MAX:
            tail, self._skipping = b"", True
        self._tail = b"" if self._skipping else tail
        return [sentence for line in lines if len(line) <= LINE_BYTES_MAX and (sentence := _rmc_in(line))]

    def clear(self) -> None:
        self._tail, self._skipping = b"", False


class Retry:
    """Pauses between attempts. Each pause is twice as long as the previous pause, until a success."""

    def __init__(self, sleep: Callable[[float], Awaitable[None]] = asyncio.sleep) -> None:
        self._sleep = sleep
        self._pause_s = FIRST_PAUSE_S

    async def pause(self) -> None:
        """Sleep for the next pause, at most LONGEST_PAUSE_S."""
        pause_s, self._pause_s = self._pause_s, min(self._pause_s * 2, LONGEST_PAUSE_S)
        await self._sleep(pause_s)

    def reset(self) -> None:
        """Make the next pause short after a success."""
        self._pause_s = FIRST_PAUSE_S


class ReconnectingSource(ABC):
    """Source that connects again after each end of its stream. Synchronization: the event loop's thread only."""

    def __init__(self, title: str, retry: Retry | None) -> None:
        self.title = title
        self.problem = ""
        self.sentences = 0
        self._retry = retry or Retry()
        self._splitter = SentenceSplitter()
        self._on_sentence: OnSentence = _ignore
        self._task: asyncio.Task[None] | None = None

    def start(self, on_sentence: OnSentence) -> None:
        self._on_sentence = on_sentence
        self._task = asyncio.get_running_loop().create_task(self._run(), name=self.title)

    def close(self) -> None:
        self._on_sentence = _ignore
        self._disconnect()
        if self._task is not None:
            self._task.cancel()
            self._task = None

    @abstractmethod
    async def _connect_and_read(self) -> None:
        """Serve one connection until its end, and store the reason of the end in `problem`."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Close the connection, if any. A second call does nothing."""

    async def _run(self) -> None:
        while True:
            self._splitter.clear()
            await self._connect_and_read()
            await self._retry.pause()

    def _on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Add bytes of the stream. `t_rx_ns` is CLOCK_MONOTONIC right after the read."""
        for sentence in self._splitter.feed(data):
            self.problem = ""
            self.sentences += 1
            self._retry.reset()
            self._on_sentence(sentence, t_rx_ns)


def _rmc_in(line: bytes) -> bytes | None:
    """Return the RMC sentence at the end of a line. Lost bytes may have joined it to an earlier sentence."""
    begin = line.rfind(b"$")
    sentence = line[begin:].rstrip(b"\r")
    if begin < 0 or sentence[3:7] != b"RMC," or len(sentence) > RMC_BYTES_MAX - 2:
        return None
    return sentence + b"\r\n"


def _ignore(_sentence: bytes, _t_rx_ns: int) -> None:
    """Ignore the sentence, before `start` and after `close`."""


CONNECT_LIMIT_S: Final = 5.0
READ_BYTES: Final = 65536
# seconds of silence before the first probe, seconds between probes, number of probes: imud detects a loss within 25 s
KEEP_ALIVE: Final = ((socket.TCP_KEEPIDLE, 10), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))


class GpsdSource(ReconnectingSource):
    """Client of gpsd."""

    def __init__(self, settings: RmcOptions, now_ns: Callable[[], int], retry: Retry | None = None) -> None:
        super().__init__(f"gpsd at {settings.host}:{settings.tcp_port}", retry)
        self._now_ns = now_ns
        self._address = settings.host, settings.tcp_port
        self._watch = _watch_request(settings.gps)
        self._writer: asyncio.StreamWriter | None = None

    async def _connect_and_read(self) -> None:
        try:
            async with asyncio.timeout(CONNECT_LIMIT_S):
                reader, writer = await _connect(*self._address)
        except (OSError, TimeoutError) as error:
            reason = "no answer" if isinstance(error, TimeoutError) else reason_of(error)
            self.problem = f"cannot connect to {self.title}: {reason}; is gpsd running?"
            return
        self._writer = writer
        try:
            _keep_alive(writer.get_extra_info("socket"))
            writer.write(self._watch)
            self.problem = f"{self.title} has no sentences yet: does its receiver have a view of the sky?"
            while data := await reader.read(READ_BYTES):
                self._on_data(data, self._now_ns())
            self.problem = f"{self.title} closed the connection"
        except OSError as error:
            self.problem = f"{self.title} broke the connection: {reason_of(error)}"
        finally:
            self._disconnect()
            with suppress(OSError):
                await writer.wait_closed()

    def _disconnect(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None


class NmeaPortSource(ReconnectingSource):
    """NMEA 0183 receiver on a serial port."""

    def __init__(self, link: StreamLink, retry: Retry | None = None) -> None:
        super().__init__(f"NMEA receiver on {link.title}", retry)
        self._link = link
        self._ended = asyncio.Event()

    async def _connect_and_read(self) -> None:
        link = self._link
        self._ended.clear()
        self.problem = f"{self.title}: the port does not exist"
        await link.wait_present()
        try:
            link.open()
            self.problem = f"{self.title} has sent no sentence yet: is its rate {link.baud} bit/s?"
            link.start(self._on_data, self._on_end)
            await self._ended.wait()
        except LinkError as error:
            self.problem = str(error)
        finally:
            link.close()

    def _disconnect(self) -> None:
        self._link.close()

    def _on_end(self, error: LinkError | None) -> None:
        self.problem = str(error) if error else f"{self.title} ended"
        self._ended.set()


async def _connect(host: str, port: int) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Connect to the first address of a host that accepts the connection. Raises OSError."""
    *others, last = await resolve(host, port)
    for address in others:
        with suppress(OSError):
            return await asyncio.open_connection(address, port)
    return await asyncio.open_connection(last, port)


def _watch_request(device: str) -> bytes:
    watch: dict[str, object] = {"enable": True, "nmea": True}
    if device:
        watch["device"] = device
    return b"?WATCH=" + msgspec.json.encode(watch) + b";\n"


def _keep_alive(sock: socket.socket) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in KEEP_ALIVE:
        sock.setsockopt(socket.IPPROTO_TCP, option, value)


def make_gpsd(settings: RmcOptions, context: SourceContext) -> GpsdSource:
    return GpsdSource(settings, context.now_ns)


def make_nmea(settings: RmcOptions, context: SourceContext) -> NmeaPortSource:
    return NmeaPortSource(context.make_port(settings.port, settings.baud))
