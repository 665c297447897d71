"""Transport of bytes (UART, replay): finds the device and its rate, asks for its identity, and streams."""

import asyncio
import logging
from collections.abc import Callable
from typing import Any, Protocol

from imud.contracts.action import Target
from imud.contracts.driver import Identity, StreamDriver
from imud.contracts.link import OnEnd, StreamLink
from imud.contracts.status import DeviceState, DeviceStatus
from imud.devices import DRIVERS
from imud.errors import CommandError
from imud.event import EventKind
from imud.ledger import Ledger
from imud.runtime.detection import StreamFound
from imud.runtime.detection.remembered import Remembered, RememberedDevice
from imud.runtime.detection.rounds import StreamRound
from imud.runtime.exchange import Exchange
from imud.runtime.path import SamplePath, StreamPath
from imud.runtime.search_loop import SearchLoop
from imud.runtime.transport import SILENT_SEARCH_NS, UNHEARD_NS, DeviceContext
from imud.units import NS_PER_S, uart_byte_ns

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
        self._exchange = Exchange(context.ledger, link.write, self._now_ns, self._change_rate)
        self._search = SearchLoop(context.health, context.attachments, context.host, self._begin_search, self._ask)
        self._discard = _Discard(context.ledger)
        self._receiver: DataReceiver = self._discard
        self._fixed_baud = 0 if link.auto_baud else link.baud
        self._samples_before = 0
        """Samples made before the link was opened."""

    # --- the link's life ---------------------------------------------------------------------------------------------

    async def wait_present(self) -> None:
        """Return when the port is there."""
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
        path.loss.link_opened()
        path.begin(self._now_ns())
        self._remember()
        self._context.attachments.start(path.clock)
        self._receiver = path
        for data, t_rx_ns in found.chunks:
            path.on_data(data, t_rx_ns)

    def _new_path(self, driver: StreamDriver) -> StreamPath:
        context = self._context
        clock = context.new_clock(driver, self.path)
        codec = driver.make_codec(self._ledger, self._config.options or driver.settings())
        path_context = context.path_context(self.link, self._exchange.on_message)
        self.driver = driver
        self.path = StreamPath(codec, clock, path_context, context.attachments.drain_edges, self._exchange)
        return self.path

    def _remember(self) -> None:
        if self._searchable and self.driver is not None:
            self._remembered.put(self._config.name, RememberedDevice(self.driver.name, self.link.baud))

    # --- asking ------------------------------------------------------------------------------------------------------

    async def _ask(self) -> None:
        """Ask for identity and settings, and start the streaming of a silent device, where asking is allowed."""
        driver = self.driver
        if self._may_ask and driver is not None:
            await self._context.identity.ask(self._exchange, driver.identify, driver.read_settings, self._apply)
            await self._wake(driver)

    async def _wake(self, driver: StreamDriver) -> None:
        """Until its first sample since the link was opened: make a device stream that answers and sends none.

        One that has streamed is left alone when it falls silent: that may have been commanded.
        """
        reported = False
        while driver.wake is not None:
            await asyncio.sleep(UNHEARD_NS / NS_PER_S)
            if self._ledger.samples != self._samples_before or self._search.requested:
                return
            try:
                acknowledged = await self._exchange.run(driver.wake())
            except CommandError as error:
                log.debug("%s: not woken: %s", self._config.name, error)
                continue
            if not reported:
                reported = True
                message = "it answered and sent no samples: commanded to stream, which is not saved"
                self._context.notices.raise_event(
                    self._now_ns(), EventKind.CONFIGURATION, message, acknowledged=acknowledged
                )

    def _apply(self, identity: Identity) -> None:
        if self.driver is not None and self.path is not None:
            self.driver.apply_identity(self.path.codec, identity)

    def _change_rate(self, baud: int) -> None:
        """Follow a script that has changed the device's rate: port, clock and remembered rate."""
        if baud == self.link.baud:
            return
        self.link.set_baud(baud)
        if self.path is not None:
            self.path.clock.link_changed(byte_ns=uart_byte_ns(baud), hold_ns=self.link.hold_ns)
        self._remember()

    async def run_script(self, make: Callable[[Target], Any]) -> Any:
        """Run a request script; one that changes the device's rate is followed."""
        options = self._config.options or (self.driver.settings() if self.driver is not None else None)
        return await self._exchange.run(make(Target(options, self.bit_rate, self._fixed_baud)))

    # --- the flow ----------------------------------------------------------------------------------------------------

    def _on_data(self, data: bytes, t_rx_ns: int) -> None:
        self._receiver.on_data(data, t_rx_ns)

    def tick(self, now_ns: int) -> None:
        """No-op: bytes come by themselves."""

    def on_no_samples(self, path: SamplePath, now_ns: int) -> None:
        """Report the received bytes, and search anew where that can help."""
        health = self._health
        unheard = path.last_data_ns - max(path.last_sample_ns, path.begun_ns) > UNHEARD_NS
        if unheard:
            health.report(f"bytes come on {self.where}, but no valid frame: wrong baud rate or device?")
        elif health.state is DeviceState.SEARCHING:
            health.report(f"nothing is heard on {self.where}: is it powered, are TX and RX swapped?")
            if self._context.attachments.can_reset and path.last_data_ns <= path.begun_ns:
                self._search.search_again()
        silent_long = health.state is DeviceState.SILENT and now_ns - health.silent_since_ns > SILENT_SEARCH_NS
        if self._searchable and (unheard or silent_long):
            self._search.search_again()

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
        return self._receiver is self.path

    @property
    def hears_replies(self) -> bool:
        """Whether replies are heard before samples: while rate and driver are uncertain, they are not."""
        return False

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
    def _may_ask(self) -> bool:
        return self._config.identify and self.link.writable


class _Discard:
    """Receiver of unexpected bytes between two uses of the port, which are counted all the same."""

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger

    def on_data(self, data: bytes, _t_rx_ns: int) -> None:
        self._ledger.bytes_in += len(data)
        self._ledger.bytes_skipped += len(data)
