"""Transport of bytes (UART, replay): finds the device and its rate, asks for its identity, and streams."""

import asyncio
import logging
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, Protocol

from imud.contracts.command import Target
from imud.contracts.driver import Identity, StreamDriver
from imud.contracts.link import OnEnd, StreamLink
from imud.contracts.setting import declared_values
from imud.contracts.status import DeviceState, DeviceStatus
from imud.device.latency import MOST_NS
from imud.device.scripts import Exchange
from imud.device.search import Remembered, RememberedDevice
from imud.device.settings import IDENTIFY_TRIES
from imud.device.stream_search import StreamFound, StreamRound
from imud.device.transport import SILENT_SEARCH_NS, UNHEARD_NS, DeviceContext, SearchLoop
from imud.drivers import DRIVERS
from imud.model.errors import CommandError, LinkError
from imud.model.event import EventKind
from imud.model.ledger import Ledger
from imud.model.sample import Sync
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns
from imud.sampling.path import SamplePath, StreamPath

GRID_NS: Final = NS_PER_MS
"""Rounds end at whole ms, so that many devices are served in one turn of the loop."""
FIRST_NS: Final = 5 * NS_PER_MS
"""The first round is so long at most, before it is seen how much gathers; each next one at most twice as long."""
WATCH_NS: Final = MOST_NS
"""Time from one message that is read as it comes to the next: as with the longest latency. Each is a wake-up more.
Behind an adapter with a latency timer it is each round: there the error of stamps would grow by half."""
PERIODS_LEAST: Final = 2
"""With fewer samples in a round nothing is saved."""


class StreamHold:
    """Receiver of a link's bytes in place of the path. Synchronization: the event loop's thread only."""

    def __init__(
        self, link: StreamLink, path: StreamPath, is_busy: Callable[[], bool], now_ns: Callable[[], int]
    ) -> None:
        """`is_busy` says whether a request of the device is unanswered."""
        self.latency_ns = 0
        """How long samples may wait; set by the owner."""
        self.hold_ns = 0
        """How long they wait at present."""
        self._link = link
        self._path = path
        self._is_busy = is_busy
        self._now_ns = now_ns
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._paused_ns = self._watch_ns = 0
        """When bytes began to gather, and when one is to be read as it comes again."""
        self._most_ns = FIRST_NS
        """Time in which no more gathers than may wait, by what gathered last."""

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Process bytes that were read as they came."""
        path = self._path
        self.hold_ns = hold_ns = self._allowed_ns()
        if not hold_ns:
            path.on_data(data, t_rx_ns)
        elif not path.gather(data, t_rx_ns):
            return
        elif path.gathered[-1].sync is not Sync.REGRESSION:
            self.hold_ns = 0
            path.publish_gathered()
        else:
            self._link.pause()
            self._watch_ns = t_rx_ns if self._link.hold_ns else t_rx_ns + WATCH_NS
            self._begin_round(t_rx_ns, hold_ns)

    def release(self) -> None:
        """Read and publish what waits now; the next samples may wait again. No-op while nothing waits."""
        self._watch_ns = 0  # publishing may have led here: no round follows
        if self._timer is not None:
            self._timer.cancel()
            self._end_round()

    def _allowed_ns(self) -> int:
        """How long samples may wait now."""
        latency_ns, path = min(self.latency_ns, self._most_ns), self._path
        if latency_ns < PERIODS_LEAST * path.period_ns or path.clock.utc_reference is not None or self._is_busy():
            return 0
        return latency_ns

    def _begin_round(self, now_ns: int, hold_ns: int) -> None:
        """Let bytes gather in the kernel from now on."""
        self._paused_ns = now_ns
        wait_ns = hold_ns - (now_ns + hold_ns) % GRID_NS
        self._timer = self._loop.call_later(wait_ns / NS_PER_S, self._end_round)

    def _end_round(self) -> None:
        self._timer = None
        link, path = self._link, self._path
        data = link.take()
        now_ns = self._now_ns()
        waited_ns = now_ns - self._paused_ns
        most_ns = 2 * self._most_ns
        if data:
            path.gather(data, now_ns, waited_ns)
            most_ns = min(most_ns, link.waiting_bytes * waited_ns // len(data))
        self._most_ns = min(max(most_ns, 1), MOST_NS)
        by_fit = bool(path.gathered) and path.gathered[-1].sync is Sync.REGRESSION
        path.publish_gathered()
        hold_ns = self._allowed_ns()
        if data and by_fit and hold_ns and now_ns + hold_ns <= self._watch_ns:
            self.hold_ns = hold_ns
            self._begin_round(now_ns, hold_ns)
        else:
            link.resume()


log = logging.getLogger(__name__)


class DataReceiver(Protocol):
    """Receiver of the bytes of a link."""

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Process bytes as read, with CLOCK_MONOTONIC right after the read."""
        ...


class StreamTransport:
    """Transport of the bytes of one device. Synchronization: the event loop's thread only."""

    def __init__(self, context: DeviceContext, link: StreamLink, remembered: Remembered) -> None:
        self.link = link
        self.driver: StreamDriver | None = None
        self.path: StreamPath | None = None
        self._config = context.config
        self._context = context
        self._health = context.health
        self._ledger = context.ledger
        self._now_ns = context.host.now_ns
        self._remembered = remembered
        self._exchange = Exchange(
            context.ledger, self._send, self._now_ns, self._change_rate, on_busy=lambda _busy: self._release()
        )
        self._search = SearchLoop(
            *(context.health, context.attachments, context.host),
            begin=self._begin_search,
            ask=self._ask,
            ask_again=self._ask_once,
            unanswered=lambda: self._may_ask and not context.identity.answered,
            answers=self._still_answers,
        )
        self._discard = _Discard(context.ledger)
        self._receiver: DataReceiver = self._discard
        self._latency_ns = 0
        self._hold: StreamHold | None = None
        """What has samples wait; None while they must not."""
        self._fixed_baud = 0 if link.auto_baud else link.baud
        self._asked_ns = 0
        """CLOCK_MONOTONIC when identity and settings were asked for last."""
        self._samples_before = 0
        """Samples made before the link was opened."""

    # --- the link's life ---------------------------------------------------------------------------------------------

    async def wait_present(self) -> None:
        """Return when the port is there."""
        self._health.missing(self._now_ns(), self.link.absence())
        await self.link.wait_present()

    def start(self, on_end: OnEnd) -> None:
        """Deliver bytes from now on, and begin the search."""
        self._samples_before = self._ledger.samples
        self.link.start(self._on_data, on_end)
        self._search.start()

    async def work(self) -> None:
        """Find the device and ask for its identity, as often as needed; ends only with the link."""
        await self._search.run()

    def stop(self) -> None:
        """End the search and close the link; may be called twice."""
        self._search.stop()
        self._release()
        self.link.close()
        self._receiver = self._discard

    def close(self) -> None:
        """Stop; may be called twice."""
        self.stop()

    # --- the search --------------------------------------------------------------------------------------------------

    def _begin_search(self) -> StreamRound | None:
        """Start a round, or begin at once where driver and rate are given."""
        config, link = self._config, self.link
        if not self._searchable:
            driver = DRIVERS[config.driver]
            assert isinstance(driver, StreamDriver)
            self._begin(StreamFound(driver, link.baud))
            return None
        self._release()
        last = self._remembered.get(config.name)
        searching = StreamRound(config, link, self._ledger, last, self._begin, self._now_ns, may_ask=self._may_ask)
        self._receiver = searching
        searching.start()
        return searching

    def _begin(self, found: StreamFound) -> None:
        """Set up codec and clock for what was found, and feed them what was heard during the search."""
        link, path = self.link, self.path
        if path is None or found.driver is not self.driver:
            path = self._new_path(found.driver)
        else:
            path.clock.restart()
        path.clock.link_changed(byte_ns=uart_byte_ns(link.baud), hold_ns=link.hold_ns)
        path.link_opened()
        path.begin(self._now_ns())
        self._remember()
        self._context.attachments.start(path.clock)
        self._receiver = path
        for data, t_rx_ns in found.chunks:
            path.on_data(data, t_rx_ns)
        self._receive()

    def _new_path(self, driver: StreamDriver) -> StreamPath:
        context = self._context
        clock = context.new_clock(driver, self.path)
        options = self._config.options or driver.settings()
        codec = driver.make_codec(self._ledger, options)
        path_context = context.path_context(driver, self.link, self._exchange.on_message)
        self.driver = driver
        self.path = StreamPath(codec, clock, path_context, context.attachments.drain_edges, self._exchange)
        context.tap.path_made(self.path, driver.name, options)
        return self.path

    def _remember(self) -> None:
        if self._searchable and self.driver is not None:
            self._remembered.put(self._config.name, RememberedDevice(self.driver.name, self.link.baud))

    # --- asking ------------------------------------------------------------------------------------------------------

    async def _ask(self) -> None:
        """Ask for identity and settings, and start the streaming of a silent device, where asking is allowed."""
        driver = self.driver
        if self._may_ask and driver is not None:
            await self._identify(IDENTIFY_TRIES)
            await self._wake(driver)

    async def _ask_once(self) -> None:
        await self._identify(1)

    async def _identify(self, tries: int) -> bool:
        """Ask for identity and settings; return whether the device answered."""
        driver = self.driver
        if not self._may_ask or driver is None:
            return False
        self._asked_ns = self._now_ns()
        return await self._context.identity.ask(
            self._exchange, driver.identify, driver.read_settings, self._apply, tries
        )

    async def read_back(self) -> None:
        """Ask for identity and settings again."""
        with suppress(LinkError):  # whoever waits for the link's end learns of it
            await self._identify(1)

    async def _still_answers(self) -> bool:
        """Ask a silent device where it was heard last; return whether no search is needed.

        Where driver and rate are configured a search finds nothing else: it is only for the reset line.
        """
        path, samples = self.path, self._ledger.samples
        if path is None or (self._searchable and self._is_unheard(path)):
            return False
        waits = self._now_ns() - self._silent_since_ns(path) < SILENT_SEARCH_NS
        if await self._identify(1) and self.driver is not None:
            await self._wake(self.driver)
            return True
        if self._ledger.samples != samples:
            return True
        searching = self._health.state is DeviceState.SEARCHING
        return not ((self._searchable and not waits) or (self._resettable and searching))

    async def _wake(self, driver: StreamDriver) -> None:
        """Until its first sample since the link was opened: make a device stream that answers and sends none.

        One that has streamed is left alone when it falls silent: that may have been commanded. So is one that is meant
        to be silent by its own settings, as its driver finds, or by the declared ones.
        """
        reported = False
        meant = declared_values(self._config.declared).get("output_enabled") is False
        while driver.wake is not None and not meant:
            await asyncio.sleep(UNHEARD_NS / NS_PER_S)
            if self._ledger.samples != self._samples_before or self._search.requested:
                return
            try:
                acknowledged = await self._exchange.run(driver.wake())
            except CommandError as error:
                log.debug("%s: not woken: %s", self._config.name, error)
                continue
            if acknowledged is None:
                return
            if not reported:
                reported = True
                message = "it answered and sent no samples: commanded to stream, which is not saved"
                self._context.notices.raise_event(
                    self._now_ns(), EventKind.CONFIGURATION, message, acknowledged=acknowledged
                )

    def _apply(self, identity: Identity) -> None:
        if self.driver is not None and self.path is not None:
            self.driver.apply_identity(self.path.codec, identity)
            self._context.tap.codec_changed()

    def _send(self, data: bytes) -> None:
        """Send a request at the rate of the device. Raises CommandError while a search sets other rates, LinkError."""
        self._require_device()
        self.link.write(data)

    def _require_device(self) -> None:
        if not self.receiving:
            raise CommandError(f"{self._config.name} is searched for at all baud rates now: try again in some seconds")

    def _change_rate(self, baud: int) -> None:
        """Follow a script that has changed the device's rate: port, clock and remembered rate."""
        self._require_device()
        if baud == self.link.baud:
            return
        self.link.set_baud(baud)
        if self.path is not None:
            self.path.clock.link_changed(byte_ns=uart_byte_ns(baud), hold_ns=self.link.hold_ns)
        self._remember()

    async def run_script(self, make: Callable[[Target], Any]) -> Any:
        """Run a request script; one that changes the device's rate is followed."""
        self._require_device()
        options = self._config.options or (self.driver.settings() if self.driver is not None else None)
        return await self._exchange.run(make(Target(options, self.bit_rate, self._fixed_baud)))

    # --- the flow ----------------------------------------------------------------------------------------------------

    def set_latency(self, latency_ns: int) -> None:
        """Let samples wait so long."""
        latency_ns = latency_ns if self.link.waiting_bytes else 0
        if latency_ns == self._latency_ns:
            return  # another consumer asks for it
        self._latency_ns = latency_ns
        if self.receiving:
            self._receive()

    @property
    def hold_ns(self) -> int:
        """How long samples wait at present, ns."""
        return self._hold.hold_ns if self._hold is not None else 0

    def _receive(self) -> None:
        """Have bytes from now on received by the path: at once, or after a wait."""
        path, latency_ns = self.path, self._latency_ns
        assert path is not None
        self._release()
        self._receiver, self._hold = path, None
        if latency_ns:
            self._receiver = self._hold = StreamHold(self.link, path, lambda: self._exchange.busy, self._now_ns)
            self._hold.latency_ns = latency_ns

    def _release(self) -> None:
        """Have all that waits processed now."""
        if self._hold is not None:
            self._hold.release()

    def _on_data(self, data: bytes, t_rx_ns: int) -> None:
        self._receiver.on_data(data, t_rx_ns)

    def tick(self, now_ns: int) -> None:
        """No-op: bytes come by themselves."""

    def on_no_samples(self, path: SamplePath, now_ns: int) -> None:
        """Report what is received or answered instead, and search anew where that can help."""
        health = self._health
        unheard = self._is_unheard(path)
        if unheard:
            problem = f"bytes come on {self.where}, but no valid frame: wrong baud rate or device?"
            self._report_silence(problem, now_ns, ended=health.state is DeviceState.RUNNING)
        elif self._has_answered(path):
            self._report_silence(self._words_of_silence(), now_ns, ended=health.state is DeviceState.SEARCHING)
        elif health.state is DeviceState.SEARCHING:
            health.report(f"nothing is heard on {self.where}: is it powered, are TX and RX swapped?")
            if self._resettable and path.last_data_ns <= path.begun_ns:
                self._search.search_again()
        if not self.busy and ((unheard and self._searchable) or self._is_overdue(path, now_ns)):
            self._search.search_again()

    def _is_overdue(self, path: SamplePath, now_ns: int) -> bool:
        """Whether it is time to ask a silent device, or to search for it: when it falls silent, and later again."""
        if not (self._searchable or self._may_ask):
            return False
        just_silent = self._health.state is DeviceState.SILENT and self._asked_ns < self._health.silent_since_ns
        if just_silent and self._may_ask and not self._has_answered(path):
            return True
        return now_ns - max(self._silent_since_ns(path), self._asked_ns) > SILENT_SEARCH_NS

    def _silent_since_ns(self, path: SamplePath) -> int:
        """CLOCK_MONOTONIC since when neither samples nor answers came."""
        return max(self._health.silent_since_ns, self._exchange.answered_ns, path.begun_ns)

    def _report_silence(self, problem: str, now_ns: int, *, ended: bool) -> None:
        """Show why no samples come; `ended`: the state ends with it."""
        if ended:
            self._health.down(now_ns, DeviceState.SILENT, problem)
        else:
            self._health.report(problem)

    def _is_unheard(self, path: SamplePath) -> bool:
        """Whether bytes come that are neither samples nor answers."""
        understood_ns = max(path.last_sample_ns, path.begun_ns, self._exchange.answered_ns)
        return path.last_data_ns - understood_ns > UNHEARD_NS

    def _has_answered(self, path: SamplePath) -> bool:
        """Whether the device has answered a request since its last sample, or since it was found."""
        return self._exchange.answered_ns >= max(path.begun_ns, path.last_sample_ns) > 0

    def _words_of_silence(self) -> str:
        """Describe a device that answers and sends no samples."""
        driver, identity = self.driver, self._context.identity.identity
        assert driver is not None
        firmware = f"firmware {identity.firmware}" if identity.firmware else ""
        names = ", ".join(filter(None, (identity.product, firmware)))
        why = driver.why_silent(self._context.identity.settings)
        hint = "; the action wake makes it send" if "wake" in driver.actions else ""
        return f"it answers{f' ({names})' if names else ''} and sends no samples: {why}{hint}"

    def on_reset(self) -> None:
        """No-op: the device streams again by itself."""

    # --- state -------------------------------------------------------------------------------------------------------

    @property
    def where(self) -> str:
        """The port and its rate, for people."""
        return f"{self.link.title} at {self.link.baud} baud" if self.link.baud else self.link.title

    @property
    def bit_rate(self) -> int:
        """Rate of the port in bit/s; 0 where it has none."""
        return self.link.baud

    @property
    def receiving(self) -> bool:
        """Whether bytes go to the device's codec."""
        return self._receiver is self.path or self._receiver is self._hold

    @property
    def hears_replies(self) -> bool:
        """Whether replies are heard before samples: once it has answered; before, rate and driver are uncertain."""
        return self.path is not None and self.receiving and self._has_answered(self.path)

    @property
    def busy(self) -> bool:
        """Whether a request script is running."""
        return self._exchange.busy

    def add_status(self, status: DeviceStatus) -> DeviceStatus:
        """Return the status as it is."""
        return status

    @property
    def _searchable(self) -> bool:
        return self.link.auto_baud or self._config.driver == "auto"

    @property
    def _resettable(self) -> bool:
        return self._context.attachments.can_reset

    @property
    def _may_ask(self) -> bool:
        return self._config.identify and self.link.writable


class _Discard:
    """Receiver of unexpected bytes between two uses of the port, which are counted all the same."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger

    def on_data(self, data: bytes, _t_rx_ns: int) -> None:
        self._ledger.bytes_in += len(data)
        self._ledger.bytes_skipped += len(data)
