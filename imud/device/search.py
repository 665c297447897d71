"""A round of a search on an open link: passes received data on, sets rates, sends queries, keeps the deadlines.

A search without I/O (`detection.stream`, `detection.can`) determines each step; here it is carried out.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Generic, Protocol, TypeVar

import msgspec

from imud.host.files import StateFile
from imud.model.errors import NothingHeard
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_S

FILE_NAME = "found.json"


class RememberedDevice(msgspec.Struct, frozen=True):
    """Driver and rate at which a device was last heard."""

    driver: str
    baud: int
    """0 on a CAN bus, whose rate is the system's."""
    node: int | None = None
    """On a CAN bus: which device of the driver's kind."""


class Remembered:
    """The last good driver and baud rate by device name. Synchronization: the event loop's thread only.

    The file is written by a thread: a disk that is busy makes no sample wait. Only the newest content is written.
    """

    def __init__(self, folder: Path | None) -> None:
        """With None as `folder` nothing is read or written."""
        without = "devices are searched for from the beginning"
        self._file = StateFile(folder / FILE_NAME if folder else None, "remembered", without)
        self._found = self._file.read(dict[str, RememberedDevice])

    def get(self, device: str) -> RememberedDevice | None:
        """The remembered driver and rate of `device`."""
        return self._found.get(device)

    def put(self, device: str, found: RememberedDevice) -> None:
        """Remember, and have the file written if that is news."""
        if self._found.get(device) != found:
            self._found[device] = found
            self._file.write(self._found)

    def close(self) -> None:
        """Wait until the file is written, for a limited time; may be called twice."""
        self._file.close()


@dataclass(frozen=True, slots=True)
class Listen:
    """Pass on received data, call `on_time` at `until_ns`. On a line of bytes first set the rate and send `send`."""

    until_ns: int
    baud: int = 0
    """Rate in bit/s; 0 on a CAN bus, whose rate is the system's."""
    send: bytes = b""


@dataclass(frozen=True, slots=True)
class GaveUp:
    """End of a round that found no device, or several."""

    summary: str
    """Observations and advice, for people."""
    wasted_bytes: int = 0
    """Bytes heard on a line of bytes: the ledger's `bytes_skipped`."""


EARLY_S: Final = 0.001
"""Extra wait when the loop's timer fires a little early against CLOCK_MONOTONIC."""

F = TypeVar("F")
F_co = TypeVar("F_co", covariant=True)


class TimedSearch(Protocol[F_co]):
    """Timing of a search; all times are CLOCK_MONOTONIC in ns."""

    def start(self, now_ns: int) -> Listen | F_co | GaveUp:
        """Return the first step."""
        ...

    def on_time(self, now_ns: int) -> Listen | F_co | GaveUp | None:
        """Return the next step when the time of the last `Listen` has come; None when it has not."""
        ...


class SearchRound(ABC, Generic[F]):
    """Execution of the steps of one search. Synchronization: the loop's thread only."""

    def __init__(
        self, search: TimedSearch[F], ledger: Ledger, on_found: Callable[[F], None], now_ns: Callable[[], int]
    ) -> None:
        """`on_found` is called inside the callback that completed the round, so that what comes next already goes to
        the device's own codec. `ledger` counts what is heard as skipped. Needs a running loop."""
        self._steps = search
        self._on_found = on_found
        self._ledger = ledger
        self._now_ns = now_ns
        self._timer: asyncio.TimerHandle | None = None
        self._done: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def start(self) -> None:
        """Begin; data received from now on is to be given to the round."""
        self._follow(self._steps.start(self._now_ns()))

    async def finished(self) -> None:
        """Return when a device was found. Raises NothingHeard with what was heard instead, and LinkError."""
        try:
            await self._done
        finally:
            self.cancel()

    def cancel(self) -> None:
        """Stop searching; may be called twice."""
        if self._timer is not None:
            self._timer.cancel()
        if not self._done.done():
            self._done.cancel()
        elif not self._done.cancelled():
            self._done.exception()  # retrieved, so that asyncio does not log it

    @abstractmethod
    def _listen(self, step: Listen) -> Listen | F | GaveUp | None:
        """Carry out `step`; return the next step if that failed."""

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
        """Call `_on_time` at that time; replaces an earlier request."""
        if self._timer is not None:
            self._timer.cancel()
        self._call_later(max(0, until_ns - self._now_ns()) / NS_PER_S)

    def _on_time(self) -> None:
        if self._done.done():
            return
        step = self._steps.on_time(self._now_ns())
        if step is None:
            self._call_later(EARLY_S)
        else:
            self._follow(step)

    def _call_later(self, delay_s: float) -> None:
        self._timer = asyncio.get_running_loop().call_later(delay_s, self._on_time)
