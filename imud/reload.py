"""Reads the configuration file again when SIGHUP asks for it, without keeping the event loop waiting.

    request ──▶ thread: read, check ──▶ event loop: apply, a device at a time

Reading and checking 256 devices take 50 ms: a thread does it, which lets the event loop run after every piece of less
than a millisecond (both need Python's global lock). The thread starts with the daemon, so that a reload needs no
resource that may have run out by then. Requests that come during a reload lead to one more, of the file as it is then.
"""

import asyncio
import logging
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, Protocol

from imud import config as configuration
from imud.config import Config
from imud.errors import ConfigError
from imud.log import printable
from imud.notify import notify

log = logging.getLogger(__name__)

PAUSE_S: Final = 100e-6
"""Long enough for the kernel to wake the loop's thread, which takes some ten microseconds."""


class Reconfigurable(Protocol):
    """What follows a configuration that was read again."""

    async def change_to(self, new: Config) -> None:
        """Apply `new`, and let the event loop run after every device."""
        ...

    def refuse(self, error: ConfigError) -> None:
        """Note that the file cannot be used: everything stays as it is."""
        ...


class Reloader:
    """Reads `file` on request and applies it to `target`. Synchronization: the event loop's thread only."""

    def __init__(self, file: Path, target: Reconfigurable, now_ns: Callable[[], int]) -> None:
        """`now_ns` reads CLOCK_MONOTONIC."""
        self._file = file
        self._target = target
        self._now_ns = now_ns
        self._jobs: queue.SimpleQueue[asyncio.Future[Config] | None] = queue.SimpleQueue()
        self._again = False
        self._task: asyncio.Task[None] | None = None
        threading.Thread(target=self._serve, name="configuration", daemon=True).start()

    def request(self, done: Callable[[asyncio.Task[None]], None]) -> None:
        """Reload now, or once more after the reload that is under way. `done` is called with the task at its end."""
        if self._task is not None and not self._task.done():
            self._again = True
            return
        self._task = asyncio.create_task(self._reload(), name="reload")
        self._task.add_done_callback(done)

    async def close(self) -> None:
        """End the thread and a reload that is under way; may be called twice."""
        self._jobs.put(None)
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _reload(self) -> None:
        again = True
        while again:
            self._again = False
            notify(f"RELOADING=1\nMONOTONIC_USEC={self._now_ns() // 1000}")
            try:
                new = await self._read()
            except ConfigError as error:
                self._target.refuse(error)
            else:
                await self._target.change_to(new)
            notify("READY=1")
            again = self._again

    async def _read(self) -> Config:
        """Have the thread read the file. Raises ConfigError."""
        answer: asyncio.Future[Config] = asyncio.get_running_loop().create_future()
        self._jobs.put(answer)
        return await answer

    def _serve(self) -> None:
        """Read the file for each future of the queue. Runs in the thread."""
        while (answer := self._jobs.get()) is not None:
            config, error = self._load()
            with suppress(RuntimeError):  # the loop has ended meanwhile
                answer.get_loop().call_soon_threadsafe(_give, answer, config, error)

    def _load(self) -> tuple[Config | None, ConfigError | None]:
        try:
            return configuration.load(self._file, pause=lambda: time.sleep(PAUSE_S)), None
        except ConfigError as error:
            return None, error
        except Exception as error:  # an internal error in reading a new configuration does not end what runs
            log.exception("the configuration cannot be read because of an internal error")
            return None, ConfigError(f"{self._file}: {type(error).__name__}: {printable(str(error))}")


def _give(answer: "asyncio.Future[Config]", config: Config | None, error: ConfigError | None) -> None:
    if answer.done():  # cancelled
        return
    if config is not None:
        answer.set_result(config)
    else:
        answer.set_exception(error or ConfigError("not read"))
