"""One round of a detection: waits for its end, keeps its time, can be given up. What it hears its subclasses take."""

import asyncio
from abc import ABC, abstractmethod
from time import monotonic_ns
from typing import Final

from imud.units import NS_PER_S

EARLY_S: Final = 0.001
"""The loop's timer may fire a little early against CLOCK_MONOTONIC; so long is waited then."""


class SearchRound(ABC):
    """Synchronization: the loop's thread only."""

    def __init__(self) -> None:
        """Needs a running loop."""
        self._now_ns = monotonic_ns
        self._timer: asyncio.TimerHandle | None = None
        self._done: asyncio.Future[None] = asyncio.get_running_loop().create_future()

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
            self._done.exception()  # nobody waits for it any more

    @abstractmethod
    def _at_time(self) -> bool:
        """The time that was waited for has come; False where the search says that it has not quite."""

    def _wait_until(self, until_ns: int) -> None:
        """Call `_at_time` then, and not at an earlier time that was asked for before."""
        if self._timer is not None:
            self._timer.cancel()
        self._call_later(max(0, until_ns - self._now_ns()) / NS_PER_S)

    def _on_time(self) -> None:
        if not self._done.done() and not self._at_time():
            self._call_later(EARLY_S)

    def _call_later(self, delay_s: float) -> None:
        self._timer = asyncio.get_running_loop().call_later(delay_s, self._on_time)
