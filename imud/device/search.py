"""Execution of a search round on an open link: received data, rates, queries and deadlines.

A search without I/O determines each step (`stream_search.Search`, `can_search.CanSearch`). A round executes the steps.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Generic, TypeVar

import msgspec

from imud.host.clock import HostClock
from imud.host.files import StateFile
from imud.model.errors import NothingHeard
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_S

FILE_NAME = "found.json"


class RememberedDevice(msgspec.Struct, frozen=True):
    """Driver and rate of a device at the last successful search."""

    driver: str
    baud: int  # baud rate; 0 on a CAN bus
    node: int | None = None  # number of the device on a CAN bus


class Remembered:
    """The results of successful searches by device name, in a file. Synchronization: the loop's thread only.

    A thread writes the file, so that a slow disk delays no sample. The thread writes only the newest content.
    """

    def __init__(self, folder: Path | None) -> None:
        """`folder` contains the file; None: imud keeps the results in memory."""
        without = "imud searches for all devices again"
        self._file = StateFile(folder / FILE_NAME if folder else None, "remembered", without)
        self._found = self._file.read(dict[str, RememberedDevice])

    def get(self, device: str) -> RememberedDevice | None:
        """Return the result for `device`; None if no search was successful."""
        return self._found.get(device)

    def put(self, device: str, found: RememberedDevice) -> None:
        """Store a result. Write the file if the result is new."""
        if self._found.get(device) != found:
            self._found[device] = found
            self._file.write(self._found)

    def close(self) -> None:
        """Wait for the end of the last write, for a limited time. A second call does nothing."""
        self._file.close()


@dataclass(frozen=True, slots=True)
class Listen:
    """Step: receive data until `until_ns`. On a serial port, first set the baud rate and send `send`."""

    until_ns: int
    baud: int = 0  # baud rate; 0 on a CAN bus, because the kernel sets its bit rate
    send: bytes = b""


@dataclass(frozen=True, slots=True)
class GaveUp:
    """End of a round that found no device, or several devices."""

    summary: str  # observations and advice for the user
    wasted_bytes: int = 0  # number of received bytes on a serial port: the ledger counts them as `bytes_skipped`


EARLY_S: Final = 0.001  # additional wait if the timer of the loop fires before the deadline, s

F = TypeVar("F")


class SearchRound(ABC, Generic[F]):
    """Execution of the steps of one search. Synchronization: the loop's thread only."""

    def __init__(self, ledger: Ledger, host: HostClock) -> None:
        """`ledger` counts the received bytes as skipped. Needs a running loop."""
        self._on_found: Callable[[F], None] = _ignore
        self._ledger = ledger
        self._host = host
        self._timer: asyncio.TimerHandle | None = None
        self._done: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def start(self, on_found: Callable[[F], None]) -> None:
        """Start the round. From now on the owner passes received data to the round.

        The round calls `on_found` in the callback of the last data, so that the codec of the device receives the data
        that follow.
        """
        self._on_found = on_found
        self._follow(self._first(self._host.now_ns()))

    async def finished(self) -> None:
        """Return when the round has found a device. Raises NothingHeard with a summary, or LinkError."""
        try:
            await self._done
        finally:
            self.cancel()

    def cancel(self) -> None:
        """Stop the search. A second call does nothing."""
        if self._timer is not None:
            self._timer.cancel()
        if not self._done.done():
            self._done.cancel()
        elif not self._done.cancelled():
            self._done.exception()  # retrieved, so that asyncio does not log it

    def end_with(self, found: F) -> None:
        """End the search with a device that imud knows from another source. Do nothing if the search has ended."""
        if not self._done.done():
            self._follow(found)

    @abstractmethod
    def _first(self, now_ns: int) -> Listen | F | GaveUp:
        """Return the first step. `now_ns` is CLOCK_MONOTONIC."""

    @abstractmethod
    def _due(self, now_ns: int) -> Listen | F | GaveUp | None:
        """Return the next step, or None before `until_ns` of the last `Listen`."""

    @abstractmethod
    def _listen(self, step: Listen) -> Listen | F | GaveUp | None:
        """Execute `step`. Return the next step if `step` failed."""

    def _found(self, found: F) -> None:
        self._on_found(found)

    def _count(self, size: int) -> None:
        self._ledger.bytes_in += size
        self._ledger.bytes_skipped += size

    def _follow(self, step: Listen | F | GaveUp | None) -> None:
        while isinstance(step, Listen):
            until_ns = step.until_ns
            step = self._listen(step)
            if step is None and not self._done.done():
                self._wait_until(until_ns)
        if isinstance(step, GaveUp):
            self._done.set_exception(NothingHeard(step.summary))
        elif step is not None:
            self._done.set_result(None)
            self._found(step)

    def _wait_until(self, until_ns: int) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._call_later(max(0, until_ns - self._host.now_ns()) / NS_PER_S)

    def _on_time(self) -> None:
        if self._done.done():
            return
        step = self._due(self._host.now_ns())
        if step is None:
            self._call_later(EARLY_S)
        else:
            self._follow(step)

    def _call_later(self, delay_s: float) -> None:
        self._timer = asyncio.get_running_loop().call_later(delay_s, self._on_time)


def _ignore(_found: object) -> None:
    """Ignore the result: `start` sets the receiver."""
