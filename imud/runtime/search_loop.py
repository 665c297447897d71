"""Search for the device on a link, and for its identity, repeated on request: the same for streams and CAN buses.

    begin ──round──▶ found ──▶ ask ──▶ wait until `search_again`
      ▲                │ nothing: report, reset line          │
      └────────────────┴──────────────────────────────────────┘

Where driver and rate are configured there is no round: `begin` has set up the device at once. A device that sends
nothing and answers is not searched again: `answers` asks it where it is, before its rate is left. A device that has not
answered is asked again while the loop waits, whatever else is requested meanwhile, until it answers.
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Protocol

from imud.errors import NothingHeard
from imud.host_clock import HostClock
from imud.runtime.attachments import Attachments
from imud.runtime.health import Health
from imud.runtime.identity import pauses_s
from imud.units import NS_PER_S


class BegunRound(Protocol):
    """A round in progress, on a stream or a CAN bus."""

    async def finished(self) -> None:
        """Return when a device was found. Raises NothingHeard with what was heard instead, and LinkError."""
        ...

    def cancel(self) -> None:
        """Stop searching; may be called twice."""
        ...


async def never_answers() -> bool:
    """Return False: the version for devices that cannot be asked before a search."""
    return False


class SearchLoop:
    """Loop of search rounds on one link. Synchronization: the loop's thread only."""

    def __init__(
        self,
        health: Health,
        attachments: Attachments,
        host: HostClock,
        begin: Callable[[], BegunRound | None],
        ask: Callable[[], Awaitable[None]],
        ask_again: Callable[[], Awaitable[None]],
        unanswered: Callable[[], bool],
        answers: Callable[[], Awaitable[bool]] = never_answers,
    ) -> None:
        """`begin` starts a round, or sets up the configured device and returns None; `ask` is called after each.

        `ask_again` is called after ever longer pauses for as long as `unanswered`.
        `answers` is called when another search was requested, and returns whether none is needed.
        """
        self._health = health
        self._attachments = attachments
        self._host = host
        self._begin = begin
        self._ask = ask
        self._ask_again = ask_again
        self._unanswered = unanswered
        self._answers = answers
        self._round: BegunRound | None = None
        self._again = asyncio.Event()

    @property
    def requested(self) -> bool:
        """Whether another search was requested and has not begun."""
        return self._again.is_set()

    def start(self) -> None:
        """Begin a search, in place of one in progress."""
        self.stop()
        self._again.clear()
        self._health.searching()
        self._round = self._begin()

    def search_again(self) -> None:
        """Request another search."""
        self._again.set()

    def stop(self) -> None:
        """Cancel the search; may be called twice."""
        if self._round is not None:
            self._round.cancel()
            self._round = None

    async def run(self) -> None:
        """Search and ask, again and again; the first search has begun. Ends only by an error of the link."""
        await self._attachments.reset_settled()
        while True:
            searched = self._round is not None
            await self._finish_search()
            await self._ask()
            await self._needed()
            if not searched:
                await self._report_absence()
            self.start()

    async def _needed(self) -> None:
        """Return when another search is needed; until then ask a device again that has not answered."""
        now_ns, pauses = self._host.now_ns, pauses_s()
        due_ns = now_ns() + next(pauses) * NS_PER_S
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout((due_ns - now_ns()) / NS_PER_S if self._unanswered() else None):
                    await self._again.wait()
            if self._again.is_set():
                self._again.clear()
                if not await self._answers():
                    return
            else:
                await self._ask_again()
                due_ns = now_ns() + next(pauses) * NS_PER_S

    async def _finish_search(self) -> None:
        while self._round is not None:
            try:
                await self._round.finished()
                self._round = None
            except NothingHeard as error:
                self._health.report(str(error))
                await self._report_absence()
                self.start()

    async def _report_absence(self) -> None:
        await self._attachments.device_not_found(self._host.now_ns())
