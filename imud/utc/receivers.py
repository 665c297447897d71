"""RMC sentences of GNSS receivers: through gpsd, or from a receiver on a serial port of its own.

gpsd passes on a receiver's own sentences, or makes them for receivers with another protocol. Its JSON protocol
(gpsd_json(5)) is: a greeting, `?WATCH={"enable":true,"nmea":true}` once, then sentences. A silent receiver is no broken
connection; TCP keep-alive detects a gpsd that is gone.
"""

import asyncio
import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import msgspec

from imud.contracts.link import StreamLink
from imud.errors import LinkError, reason_of
from imud.utc.sentence_stream import ReconnectingSource, Retry
from imud.utc.source import RmcSettings, SourceContext

CONNECT_LIMIT_S: Final = 5.0
READ_BYTES: Final = 65536
KEEP_ALIVE: Final = ((socket.TCP_KEEPIDLE, 10), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))
"""Seconds of silence before the first probe, between probes, and their number: a loss is noticed within 25 s."""


class GpsdSource(ReconnectingSource):
    """A client of gpsd."""

    def __init__(self, settings: RmcSettings, now_ns: Callable[[], int], retry: Retry | None = None) -> None:
        """`now_ns` is CLOCK_MONOTONIC."""
        super().__init__(f"gpsd at {settings.host}:{settings.tcp_port}", retry)
        self._now_ns = now_ns
        self._address = settings.host, settings.tcp_port
        self._watch = _watch_request(settings.gps)
        self._writer: asyncio.StreamWriter | None = None

    async def _connect_and_read(self) -> None:
        try:
            async with asyncio.timeout(CONNECT_LIMIT_S):
                reader, writer = await asyncio.open_connection(*self._address)
        except (OSError, TimeoutError) as error:
            reason = "no answer" if isinstance(error, TimeoutError) else reason_of(error)
            self.problem = f"{self.title} cannot be reached: {reason}; is gpsd running?"
            return
        self._writer = writer
        try:
            _keep_alive(writer.get_extra_info("socket"))
            writer.write(self._watch)
            self.problem = f"{self.title} has no sentences yet: has its receiver a view of the sky?"
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
    """A receiver on a serial port, with NMEA 0183."""

    def __init__(self, link: StreamLink, retry: Retry | None = None) -> None:
        super().__init__(f"NMEA receiver on {link.title}", retry)
        self._link = link
        self._ended = asyncio.Event()

    async def _connect_and_read(self) -> None:
        link = self._link
        self._ended.clear()
        self.problem = f"{self.title}: the port is not there"
        await link.wait_present()
        try:
            link.open()
            self.problem = f"{self.title} sent no sentence yet: is its rate {link.baud} bit/s?"
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


def _watch_request(device: str) -> bytes:
    watch: dict[str, object] = {"enable": True, "nmea": True}
    if device:
        watch["device"] = device
    return b"?WATCH=" + msgspec.json.encode(watch) + b";\n"


def _keep_alive(sock: socket.socket) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in KEEP_ALIVE:
        sock.setsockopt(socket.IPPROTO_TCP, option, value)


def make_gpsd(settings: RmcSettings, context: SourceContext) -> GpsdSource:
    """Make the source `gpsd`."""
    return GpsdSource(settings, context.now_ns)


def make_nmea(settings: RmcSettings, context: SourceContext) -> NmeaPortSource:
    """Make the source `nmea`."""
    return NmeaPortSource(context.make_port(settings.port, settings.baud))
