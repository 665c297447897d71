"""A round of a search on an open link: passes received data on, sets rates, sends queries, keeps the deadlines.

A search without I/O (`detection.stream`, `detection.can`) determines each step; here it is carried out.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Final, Generic, Protocol, TypeVar

from imud.config import DeviceConfig
from imud.contracts.driver import StreamDriver, of_kind
from imud.contracts.link import StreamLink
from imud.devices import DRIVERS
from imud.errors import LinkError, NothingHeard
from imud.formats.can import CanFilter, CanFrame
from imud.ledger import Ledger
from imud.runtime.detection.can import CanFound, CanSearch
from imud.runtime.detection.remembered import RememberedDevice
from imud.runtime.detection.steps import GaveUp, Listen
from imud.runtime.detection.stream import Search, StreamFound
from imud.units import NS_PER_S

EARLY_S: Final = 0.001
"""Extra wait when the loop's timer fires a little early against CLOCK_MONOTONIC."""
EVERYTHING: Final = (CanFilter(0, 0, False), CanFilter(0, 0, True))
"""Filters that pass every data frame."""

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


class StreamRound(SearchRound[StreamFound]):
    """A round on a link of bytes."""

    def __init__(
        self,
        config: DeviceConfig,
        link: StreamLink,
        ledger: Ledger,
        last: RememberedDevice | None,
        on_found: Callable[[StreamFound], None],
        now_ns: Callable[[], int],
        *,
        may_ask: bool,
    ) -> None:
        """The bytes of what was found are taken out of the ledger again, for the device's own codec to count."""
        named = config.driver != "auto"
        self._search = Search(
            of_kind([DRIVERS[config.driver]] if named else DRIVERS.values(), StreamDriver),
            bauds=() if link.auto_baud else (link.baud,),
            remembered=(last.driver, last.baud) if last else None,
            may_ask=may_ask,
            hold_ns=link.hold_ns,
            options=config.options if named else None,
        )
        super().__init__(self._search, ledger, on_found, now_ns)
        self._link = link

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Pass on bytes from the link; they count as skipped until a device is found in them."""
        self._count(len(data))
        if not self._done.done():
            self._follow(self._search.on_data(data, t_rx_ns))

    def _found(self, found: StreamFound) -> None:
        self._count(-sum(len(data) for data, _ in found.chunks))
        super()._found(found)

    def _listen(self, step: Listen) -> Listen | StreamFound | GaveUp | None:
        if step.baud != self._link.baud:
            try:
                self._link.set_baud(step.baud)
            except LinkError as error:
                return self._search.refused(str(error), self._now_ns())
        if step.send:
            try:
                self._link.write(step.send)
            except LinkError as error:
                self._done.set_exception(error)
        return None


class CanRound(SearchRound[CanFound]):
    """A round on a CAN bus."""

    def __init__(
        self, search: CanSearch, ledger: Ledger, on_found: Callable[[CanFound], None], now_ns: Callable[[], int]
    ) -> None:
        super().__init__(search, ledger, on_found, now_ns)
        self._search = search

    def on_frames(self, frames: Sequence[CanFrame]) -> None:
        """Pass on frames from the link, all of the bus; they count as skipped."""
        self._count(sum(len(frame.data) for frame in frames))
        if not self._done.done():
            self._follow(self._search.on_frames(frames))

    def _listen(self, step: Listen) -> None:
        """Filters pass everything already."""
