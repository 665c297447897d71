"""Contract of the transport that connects a device to its link.

A transport is a stream of bytes, a CAN bus, or a bus that is polled. It owns the link, finds the device behind it, and
feeds received data to the device's sample path.
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from imud.attitude.published import published_frame
from imud.config.model import DeviceConfig
from imud.contracts.command import Target
from imud.contracts.driver import Driver
from imud.contracts.link import Link, OnEnd
from imud.contracts.publisher import Batch
from imud.contracts.script import Message
from imud.contracts.status import DeviceStatus
from imud.device.attachments import Attachments
from imud.device.health import DeviceEvents, Health
from imud.device.settings import KnownIdentity, pauses_s
from imud.host.clock import HostClock
from imud.model.errors import NothingHeard
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_S
from imud.recording.observer import PathObserver
from imud.sampling.clock import SampleClock
from imud.sampling.path import PathContext, SamplePath, make_clock

UNHEARD_NS = 2 * NS_PER_S
"""Data without a single good sample for this long: the device has another rate now, or is another one."""
SILENT_SEARCH_NS = 15 * NS_PER_S
"""A silent link is searched anew after this: the device may have been exchanged or set to another rate."""


@dataclass(frozen=True, slots=True)
class DeviceContext:
    """The parts of a device that its transport works with."""

    config: DeviceConfig
    device_id: int
    host: HostClock
    ledger: Ledger
    notices: DeviceEvents
    health: Health
    identity: KnownIdentity
    attachments: Attachments
    publish: Callable[[Batch], None]
    tap: PathObserver
    """Where a recording hears what goes into the path; the transport says when it makes another one."""

    def path_context(self, driver: Driver, link: Link, on_message: Callable[[Message, int], None]) -> PathContext:
        """Return what the sample path of what `driver` decodes needs; messages of the device go to `on_message`."""
        config = self.config

        def overruns() -> int:
            return link.kernel_counters().overrun

        return PathContext(
            config.name, self.device_id, self.ledger, self.publish, on_message, self.notices.bad_frame, overruns,
            self.host, published_frame(config.frame, config.convention, config.declination_deg, driver.axes),
        )  # fmt: skip

    def new_clock(self, driver: Driver, path: SamplePath | None) -> SampleClock:
        """Return a clock for what `driver` decodes, which continues that of the path before."""
        before = path.clock if path is not None else None
        name, lines = self.config.name, self.config.lines
        return make_clock(
            name, lines, driver, before, host=self.host.steady, on_unknown_gap=self.ledger.add_unknown_gap
        )


class Transport(Protocol):
    """Transport of one device's data from its link to its sample path. Synchronization: the loop's thread only.

    Order of calls: `wait_present`, `link.open`, `start`, then `work` until it or the link ends, `stop`; then again from
    the beginning, and `close` at the end of all.
    """

    @property
    def link(self) -> Link:
        """The link it owns."""
        ...

    @property
    def driver(self) -> Driver | None:
        """Driver of the device; None until it is known."""
        ...

    @property
    def path(self) -> SamplePath | None:
        """Sample path of the device; None until its driver is known."""
        ...

    @property
    def where(self) -> str:
        """The link and its settings, for people."""
        ...

    @property
    def bit_rate(self) -> int:
        """Rate of the link in bit/s; 0 where it has none."""
        ...

    @property
    def receiving(self) -> bool:
        """Whether received data goes to the sample path; False while the device is searched for."""
        ...

    @property
    def hears_replies(self) -> bool:
        """Whether replies reach the device's codec even before its first sample."""
        ...

    @property
    def busy(self) -> bool:
        """Whether a request script is running."""
        ...

    @property
    def hold_ns(self) -> int:
        """How long data of the device waits at present to be processed together, ns."""
        ...

    def set_latency(self, latency_ns: int) -> None:
        """Let samples wait so long from now on, ns; 0: not at all."""
        ...

    async def wait_present(self) -> None:
        """Return when the link can be opened. Raises LinkError where it must not be."""
        ...

    def start(self, on_end: OnEnd) -> None:
        """Deliver from now on; the link is open. `on_end` is called once when it ends by itself. Raises LinkError."""
        ...

    async def work(self) -> None:
        """Find the device and ask for its identity, as often as needed. Ends only with the link, or by an error."""
        ...

    def tick(self, now_ns: int) -> None:
        """Ten times a second, before the flow of samples is looked at."""
        ...

    def on_no_samples(self, path: SamplePath, now_ns: int) -> None:
        """Report received data instead, and try what can help: no sample came for UNHEARD_NS."""
        ...

    def on_reset(self) -> None:
        """Prepare for a reset of the device by its line."""
        ...

    async def run_script(self, make: Callable[[Target], Any]) -> Any:
        """Run the script that `make` makes for the device, and return its result.

        Raises what the script and its making raise: CommandError, TransferError, DeviceRefused, and LinkError.
        """
        ...

    async def read_back(self) -> None:
        """Ask for identity and settings again, after something was changed; a device that does not answer is left."""
        ...

    def add_status(self, status: DeviceStatus) -> DeviceStatus:
        """Return the status with the fields of this kind of transport."""
        ...

    def stop(self) -> None:
        """Stop all work and close the link; may be called twice."""
        ...

    def close(self) -> None:
        """Stop, and release what is shared with other devices; may be called twice."""
        ...


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
