"""RMC sentences from gpsd: the receiver's own, or those that gpsd makes for receivers with another protocol.

gpsd's JSON protocol (gpsd_json(5)): a greeting, `?WATCH={"enable":true,"nmea":true}` once, then sentences. A receiver
that is silent is no broken connection: TCP keep-alive finds a gpsd that is gone.
"""

import asyncio
import socket
from contextlib import suppress
from time import monotonic_ns
from typing import Final

import msgspec

from imud.utc.reconnecting import ReconnectingSource
from imud.utc.retry import Retry
from imud.utc.source import MakePort, RmcSettings

CONNECT_LIMIT_S: Final = 5.0
READ_BYTES: Final = 65536
KEEP_ALIVE: Final = ((socket.TCP_KEEPIDLE, 10), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))
"""Seconds of silence before the first probe, between probes, and their number: gone is noticed within 25 s."""


class GpsdSource(ReconnectingSource):
    """A client of gpsd."""

    def __init__(self, settings: RmcSettings, retry: Retry | None = None) -> None:
        super().__init__(f"gpsd at {settings.host}:{settings.tcp_port}", retry)
        self._address = settings.host, settings.tcp_port
        self._watch = _watch_request(settings.gps)

    async def _listen(self) -> None:
        try:
            async with asyncio.timeout(CONNECT_LIMIT_S):
                reader, writer = await asyncio.open_connection(*self._address)
        except (OSError, TimeoutError) as error:
            self.problem = f"{self.title} cannot be reached: {error or 'no answer'}; is gpsd running?"
            return
        try:
            _keep_alive(writer.get_extra_info("socket"))
            writer.write(self._watch)
            self.problem = f"{self.title} has no sentences yet: has its receiver a view of the sky?"
            while data := await reader.read(READ_BYTES):
                self._take(data, monotonic_ns())
            self.problem = f"{self.title} closed the connection"
        except OSError as error:
            self.problem = f"{self.title} broke the connection: {error}"
        finally:
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()


def _watch_request(device: str) -> bytes:
    watch: dict[str, object] = {"enable": True, "nmea": True}
    if device:
        watch["device"] = device
    return b"?WATCH=" + msgspec.json.encode(watch) + b";\n"


def _keep_alive(sock: socket.socket) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in KEEP_ALIVE:
        sock.setsockopt(socket.IPPROTO_TCP, option, value)


def make(settings: RmcSettings, _make_port: MakePort) -> GpsdSource:
    """The source."""
    return GpsdSource(settings)
