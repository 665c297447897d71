"""RMC sentences of GNSS receivers: from gpsd, or from a receiver on a serial port.

gpsd forwards the sentences of a receiver, or makes sentences for receivers with another protocol. Its JSON protocol
(gpsd_json(5)) is a greeting, `?WATCH={"enable":true,"nmea":true}` once, then sentences. A silent receiver is not a
broken connection. TCP keep-alive detects a missing gpsd.
"""

import asyncio
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from typing import Annotated, Any, Final, Literal, NamedTuple, Protocol

import msgspec
from msgspec import Meta

from imud.contracts.link import StreamLink
from imud.formats.nmea0183 import RMC_BYTES_MAX
from imud.host.peer_stream import READ_BYTES, TICK_S, PeerStream, open_peer_stream
from imud.model.errors import LinkError, reason_of
from imud.model.host_object import OptionalSerialPort
from imud.model.options import Options, is_host, shown
from imud.model.work_budget import WorkBudget, WorkLimits

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
    port: OptionalSerialPort = ""
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
    sentences: int  # number of sentences since the start

    @property
    def problem(self) -> str:
        """Reason why the source delivers no sentences, or too much data, one sentence; empty if it has no problem."""
        ...

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
    cpu_ns: Callable[[], int] = time.thread_time_ns  # CPU time of the event loop's thread, ns


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

    def __init__(self, title: str, context: SourceContext, retry: Retry | None) -> None:
        self.title = title
        self.sentences = 0
        self._now_ns = context.now_ns
        self._budget = WorkBudget(WorkLimits(), context.cpu_ns)
        self._fault = ""  # reason why the source delivers no sentences
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

    @property
    def problem(self) -> str:
        return self._fault or self._budget.problem(self._now_ns())

    @abstractmethod
    async def _connect_and_read(self) -> None:
        """Serve one connection until its end, and store the reason of the end in `_fault`."""

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
            self._fault = ""
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
# seconds of silence before the first probe, seconds between probes, number of probes: imud detects a loss within 25 s
KEEP_ALIVE: Final = ((socket.TCP_KEEPIDLE, 10), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))


class GpsdSource(ReconnectingSource):
    """Client of gpsd."""

    def __init__(self, options: RmcOptions, context: SourceContext, retry: Retry | None = None) -> None:
        super().__init__(f"gpsd at {options.host}:{options.tcp_port}", context, retry)
        self._address = options.host, options.tcp_port
        self._watch = _watch_request(options.gps)
        self._stream: PeerStream | None = None

    async def _connect_and_read(self) -> None:
        try:
            async with asyncio.timeout(CONNECT_LIMIT_S):
                stream = await open_peer_stream(*self._address, self.title, self._budget, self._now_ns)
        except (OSError, TimeoutError) as error:
            reason = "no answer" if isinstance(error, TimeoutError) else reason_of(error)
            self._fault = f"cannot connect to {self.title}: {reason}; is gpsd running?"
            return
        self._stream = stream
        try:
            _keep_alive(stream.get_extra_info("socket"))
            stream.write(self._watch)
            self._fault = f"{self.title} has no sentences yet: does its receiver have a view of the sky?"
            while data := await stream.read():
                self._on_data(data, self._now_ns())
            self._fault = f"{self.title} closed the connection"
        except OSError as error:
            self._fault = f"{self.title} broke the connection: {reason_of(error)}"
        finally:
            self._stream = None
            await stream.close()

    def _disconnect(self) -> None:
        if self._stream is not None:
            self._stream.abort()
            self._stream = None


class NmeaPortSource(ReconnectingSource):
    """NMEA 0183 receiver on a serial port."""

    def __init__(self, link: StreamLink, context: SourceContext, retry: Retry | None = None) -> None:
        super().__init__(f"NMEA receiver on {link.title}", context, retry)
        self._link = link
        self._ended = asyncio.Event()
        self._pause: asyncio.TimerHandle | None = None  # end of the pause of a port above its budget

    async def _connect_and_read(self) -> None:
        link = self._link
        self._ended.clear()
        self._fault = f"{self.title}: the port does not exist"
        await link.wait_present()
        try:
            link.open()
            self._fault = f"{self.title} has sent no sentence yet: is its rate {link.baud} bit/s?"
            link.start(self._on_bytes, self._on_end)
            await self._ended.wait()
        except LinkError as error:
            self._fault = str(error)
        finally:
            self._disconnect()

    def _disconnect(self) -> None:
        if self._pause is not None:
            self._pause.cancel()
            self._pause = None
        self._link.close()

    def _on_bytes(self, data: bytes, t_rx_ns: int) -> None:
        """Process a read of the port. Above the budget, discard the rest and pause the port until the next tick."""
        self._budget.start_turn(t_rx_ns)
        for start in range(0, len(data), READ_BYTES):
            if not self._budget.admit(self.title):
                self._splitter.clear()
                self._link.pause()
                self._pause = asyncio.get_running_loop().call_later(TICK_S, self._resume)
                break
            self._on_data(data[start : start + READ_BYTES], t_rx_ns)
        self._budget.end_turn()

    def _resume(self) -> None:
        self._pause = None
        self._link.resume()

    def _on_end(self, error: LinkError | None) -> None:
        self._fault = str(error) if error else f"{self.title} ended"
        self._ended.set()


def _watch_request(device: str) -> bytes:
    watch: dict[str, object] = {"enable": True, "nmea": True}
    if device:
        watch["device"] = device
    return b"?WATCH=" + msgspec.json.encode(watch) + b";\n"


def _keep_alive(sock: Any) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in KEEP_ALIVE:
        sock.setsockopt(socket.IPPROTO_TCP, option, value)


def make_gpsd(settings: RmcOptions, context: SourceContext) -> GpsdSource:
    return GpsdSource(settings, context)


def make_nmea(settings: RmcOptions, context: SourceContext) -> NmeaPortSource:
    return NmeaPortSource(context.make_port(settings.port, settings.baud), context)
