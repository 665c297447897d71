"""Runs a detection on a CAN bus (`imud.detect`, without I/O) on an open link: hands on frames, keeps its time."""

import asyncio
from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import Final

from imud.detect import CanDevice, CanFound, CanListen, CanSearch, CanStep
from imud.errors import NothingHeard
from imud.kit.can import CanFilter, CanFrame
from imud.ledger import Ledger
from imud.units import NS_PER_S

EVERYTHING: Final = (CanFilter(0, 0, False), CanFilter(0, 0, True))
"""Filters that pass every data frame."""
EARLY_S: Final = 0.001
"""The loop's timer may fire a little early against CLOCK_MONOTONIC; so long is waited then."""


class CanFinder:
    """One round. `on_found` is called inside the callback that completed it. Synchronization: the loop's thread."""

    def __init__(
        self,
        search: CanSearch,
        ledger: Ledger,
        on_found: Callable[[CanDevice], None],
        now_ns: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._search = search
        self._ledger = ledger
        self._on_found = on_found
        self._now_ns = now_ns
        self._timer: asyncio.TimerHandle | None = None
        self._done: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def start(self) -> None:
        """Begin; from now on frames go to `take`."""
        self._follow(self._search.start(self._now_ns()))

    async def finished(self) -> None:
        """Return when a device was found. Raises NothingHeard with what was heard instead."""
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
            self._done.exception()  # nobody waits for it any more

    def take(self, frames: Sequence[CanFrame]) -> None:
        """Frames from the link, all of the bus; they count as skipped."""
        size = sum(len(frame.data) for frame in frames)
        self._ledger.bytes_in += size
        self._ledger.bytes_skipped += size
        if not self._done.done():
            self._follow(self._search.on_frames(frames))

    def _on_time(self) -> None:
        if self._done.done():
            return
        step = self._search.on_time(self._now_ns())
        if step is None:
            self._timer = asyncio.get_running_loop().call_later(EARLY_S, self._on_time)
        else:
            self._follow(step)

    def _follow(self, step: CanStep | None) -> None:
        if isinstance(step, CanListen):
            delay_s = max(0, step.until_ns - self._now_ns()) / NS_PER_S
            self._timer = asyncio.get_running_loop().call_later(delay_s, self._on_time)
        elif isinstance(step, CanFound):
            self._done.set_result(None)
            self._on_found(step.device)
        elif step is not None:
            self._done.set_exception(NothingHeard(step.summary))
