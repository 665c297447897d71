"""A socket server in a thread of its own, so that a blocking client can be tested against the real thing."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from imud.publishers.socket.publisher import SocketServer
from tests.support.socket_rig import LIMIT_S, serving

T = TypeVar("T")


class Daemon:
    """Runs callables in the server's loop and waits for them."""

    def __init__(self, server: SocketServer, loop: asyncio.AbstractEventLoop) -> None:
        self.server = server
        self.path = server.hub.path
        self._loop = loop

    def do(self, work: Callable[[SocketServer], T]) -> T:
        """`work(server)` in the loop's thread; its result."""

        async def run() -> T:
            return work(self.server)

        return asyncio.run_coroutine_threadsafe(run(), self._loop).result(LIMIT_S)


@contextmanager
def daemon(directory: Path) -> Iterator[Daemon]:
    """A served socket until the end of the block."""
    ready = threading.Event()
    found: list[Daemon] = []
    stops: list[asyncio.Event] = []

    async def main() -> None:
        async with serving(directory) as server:
            stop = asyncio.Event()
            stops.append(stop)
            found.append(Daemon(server, asyncio.get_running_loop()))
            ready.set()
            await stop.wait()

    thread = threading.Thread(target=asyncio.run, args=(main(),))
    thread.start()
    try:
        assert ready.wait(LIMIT_S)
        yield found[0]
    finally:
        found[0]._loop.call_soon_threadsafe(stops[0].set)
        thread.join(LIMIT_S)
        assert not thread.is_alive()
