"""TCP connection to a server that imud does not trust, within a work budget.

A server that sends without a pause keeps its connection readable in each turn of the event loop. Its data then delay
the samples of the devices. `PeerStream.read` therefore returns small pieces, one in each turn, and charges the CPU time
from one read to the next. Above the budget, it stops reading until the next tick: the kernel then stops the server
(flow control of TCP), and its connection costs no time.
"""

import asyncio
import ssl
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

from imud.host.network import resolve
from imud.model.work_budget import WorkBudget

# Maximum number of bytes of one read. The budget is checked between two reads only. 2048 bytes of the most expensive
# input, 28 valid sentences with leaping times, cost 1.7 ms on a slow host.
READ_BYTES: Final = 2048
TICK_S: Final = 0.1  # pause of a server above its budget, s
CLOSE_S: Final = 1.0  # maximum time to send the last bytes of a connection, s. The end of the daemon waits for it.


class PeerStream:
    """Connection to a server. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        peer: str,
        budget: WorkBudget,
        now_ns: Callable[[], int],
    ) -> None:
        """`peer` is the name of the server in `budget`, for the user."""
        self._reader = reader
        self._writer = writer
        self._peer = peer
        self._budget = budget
        self._now_ns = now_ns

    async def read(self) -> bytes:
        """Return the next bytes of the server, at most READ_BYTES; empty at the end of the connection. Raises OSError.

        The caller processes the bytes without `await`, and calls `read` or `end_turn` afterwards.
        """
        self.end_turn()
        await asyncio.sleep(0)  # other work of the event loop, although more bytes wait
        data = await self._reader.read(READ_BYTES)
        while data:
            self._budget.start_turn(self._now_ns())
            if self._budget.admit(self._peer):
                break
            await asyncio.sleep(TICK_S)
        return data

    def end_turn(self) -> None:
        """Charge the work since the last read. Call this method if other work follows."""
        self._budget.end_turn()

    def write(self, data: bytes) -> None:
        """Queue bytes for the server."""
        self._writer.write(data)

    async def drain(self) -> None:
        """Wait until the server has room for more bytes. Raises OSError."""
        await self._writer.drain()

    def get_extra_info(self, name: str) -> Any:
        """Return a property of the connection, as `asyncio.BaseTransport.get_extra_info`."""
        return self._writer.get_extra_info(name)

    def abort(self) -> None:
        """Close the connection immediately. A second call does nothing."""
        # a transport that has sent its last bytes after `close` has no event loop any longer, and `abort` fails
        with suppress(AttributeError):
            self._writer.transport.abort()

    async def close(self) -> None:
        """Send the queued bytes for at most CLOSE_S, and close the connection."""
        self.end_turn()
        self._writer.close()
        try:
            async with asyncio.timeout(CLOSE_S):
                await self._writer.wait_closed()
        except OSError:  # also TimeoutError
            pass
        finally:
            self.abort()


async def open_peer_stream(
    host: str,
    port: int,
    peer: str,
    budget: WorkBudget,
    now_ns: Callable[[], int],
    context: ssl.SSLContext | None = None,
) -> PeerStream:
    """Connect to the first address of a host that accepts the connection; with TLS if there is a `context`. Raises
    OSError. The caller limits the time."""
    *other_addresses, last_address = await resolve(host, port)
    for address in other_addresses:
        with suppress(ConnectionError, TimeoutError):
            return await _open(address, host, port, peer, budget, now_ns, context)
    return await _open(last_address, host, port, peer, budget, now_ns, context)


async def _open(
    address: str,
    host: str,
    port: int,
    peer: str,
    budget: WorkBudget,
    now_ns: Callable[[], int],
    context: ssl.SSLContext | None,
) -> PeerStream:
    if context is None:
        reader, writer = await asyncio.open_connection(address, port, limit=READ_BYTES)
    else:
        reader, writer = await asyncio.open_connection(
            address, port, limit=READ_BYTES, ssl=context, server_hostname=host, ssl_shutdown_timeout=CLOSE_S
        )
    return PeerStream(reader, writer, peer, budget, now_ns)
