"""A device that sends bytes (UART, replay): finds out what it is and at which rate, asks who it is, and streams."""

import asyncio
import logging
from collections.abc import Callable
from time import monotonic_ns

from imud.config import DeviceConfig
from imud.contracts.driver import Identity, StreamDriver
from imud.contracts.lines import LineFactory
from imud.contracts.link import StreamLink
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceState
from imud.devices import DRIVERS
from imud.errors import CommandError, NothingHeard
from imud.event import Event, EventKind
from imud.links import LINKS
from imud.runtime.detection.remembered import Remembered, RememberedDevice
from imud.runtime.detection.stream_round import Finder, Finding
from imud.runtime.device import UNHEARD_NS, Device
from imud.runtime.path import SamplePath, StreamPath
from imud.signals.gpio import GPIO_LINES
from imud.units import NS_PER_S, uart_byte_ns

log = logging.getLogger(__name__)

SILENT_SEARCH_NS = 15 * NS_PER_S
"""A silent line is searched anew after this: the device may have been exchanged or set to another rate."""


class DeviceRunner(Device):
    """Owns one device on a link of bytes. Synchronization: the event loop's thread only."""

    link: StreamLink

    def __init__(
        self,
        config: DeviceConfig,
        device_id: int,
        publish: Callable[[Batch], None],
        tell: Callable[[Event], None],
        remembered: Remembered,
        lines: LineFactory = GPIO_LINES,
    ) -> None:
        super().__init__(config, device_id, publish, tell, LINKS[config.link].make(config.link_settings), lines)
        self._remembered = remembered
        self._take: Callable[[bytes, int], None] = self._ignore
        self._finder: Finder | None = None
        self._search_again = asyncio.Event()
        self._samples_before = 0
        """Samples made before the link was opened."""

    def close(self) -> None:
        """Release the link; may be called twice."""
        super().close()
        self._take = self._ignore

    def _start(self) -> None:
        self._samples_before = self.ledger.samples
        self.link.start(self._receive, self._on_end)
        self._seek()

    def _end_work(self) -> None:
        if self._finder is not None:
            self._finder.cancel()
            self._finder = None

    async def _work(self) -> None:
        """Find, ask, and find again when told so; ends only with the link."""
        while True:
            while self._finder is not None:
                try:
                    await self._finder.finished()
                    self._finder = None
                except NothingHeard as error:
                    self._complain(str(error))
                    await self._not_found()
                    self._seek()
            if self._may_ask and isinstance(self._driver, StreamDriver):
                await self._identify(self._driver.identify, self._driver.read_settings, self._apply)
                await self._wake(self._driver)
            await self._search_again.wait()
            if not self._searchable:
                await self._not_found()
            self._seek()

    async def _not_found(self) -> None:
        """Nothing is heard of it: its reset line may help."""
        if self._reset is not None:
            await self._reset.not_found(monotonic_ns())

    async def _wake(self, driver: StreamDriver) -> None:
        """Until its first sample since the link was opened: make a device stream that answers and sends none.

        One that has streamed is left alone when it falls silent: it may have been told to.
        """
        told = False
        while driver.wake is not None:
            await asyncio.sleep(UNHEARD_NS / NS_PER_S)
            if self.ledger.samples != self._samples_before or self._search_again.is_set():
                return
            try:
                acknowledged = await self._exchange.run(driver.wake())
            except CommandError as error:
                log.debug("%s: not woken: %s", self.config.name, error)
                continue
            if not told:
                told = True
                message = "it answered and sent no samples: told to stream, which is not saved"
                self._notices.tell(monotonic_ns(), EventKind.CONFIGURATION, message, acknowledged=acknowledged)

    def _seek(self) -> None:
        """Begin a search, or take what comes at once where driver and rate are given."""
        self._search_again.clear()
        self.state = DeviceState.SEARCHING
        config, link = self.config, self.link
        if not self._searchable:
            driver = DRIVERS[config.driver]
            assert isinstance(driver, StreamDriver)
            self._begin(Finding(driver, ()))
            return
        last = self._remembered.get(config.name)
        self._finder = Finder(config, link, self.ledger, last, self._begin, may_ask=self._may_ask)
        self._take = self._finder.take
        self._finder.start()

    def _begin(self, finding: Finding) -> None:
        """Set up codec and clock for what was found, and give them what was heard during the search."""
        driver, link = finding.driver, self.link
        path = self._path
        if not isinstance(path, StreamPath) or self._clock is None or driver is not self._driver:
            self._driver = driver
            self._clock = self._new_clock(driver)
            codec = driver.make_codec(self.ledger, self.config.options or driver.settings())
            path = StreamPath(codec, *self._path_parts(self._clock))
        else:
            self._clock.restart()
        self._clock.link_changed(byte_ns=uart_byte_ns(link.baud), hold_ns=link.hold_ns)
        path.loss.link_opened()
        path.begin(monotonic_ns())
        if self._searchable:
            self._remembered.put(self.config.name, RememberedDevice(driver.name, link.baud))
        self._path = path
        if self._utc is not None:
            self._utc.start(self._clock)
        if self._wires is not None:
            self._wires.start(self._clock)
            path.drain = self._wires.drain
        self._take = path.on_data
        for data, t_rx_ns in finding.chunks:
            path.on_data(data, t_rx_ns)

    @property
    def _searchable(self) -> bool:
        return self.link.auto_baud or self.config.driver == "auto"

    @property
    def _may_ask(self) -> bool:
        return self.config.identify and self.link.writable

    @property
    def _rate_bit_s(self) -> int:
        return self.link.baud

    @property
    def _where(self) -> str:
        return f"{self.link.title} at {self.link.baud} baud" if self.link.baud else self.link.title

    @property
    def _listening(self) -> bool:
        return isinstance(self._path, StreamPath) and self._take == self._path.on_data

    def _apply(self, identity: Identity) -> None:
        if isinstance(self._driver, StreamDriver) and isinstance(self._path, StreamPath):
            self._driver.apply_identity(self._path.codec, identity)

    def _change_rate(self, baud: int) -> None:
        """A conversation has set the device to another rate: the port, its clock and the memory follow."""
        if baud == self.link.baud:
            return
        self.link.set_baud(baud)
        if self._clock is not None:
            self._clock.link_changed(byte_ns=uart_byte_ns(baud), hold_ns=self.link.hold_ns)
        if self._searchable and self._driver is not None:
            self._remembered.put(self.config.name, RememberedDevice(self._driver.name, baud))

    def _receive(self, data: bytes, t_rx_ns: int) -> None:
        self._take(data, t_rx_ns)

    def _ignore(self, data: bytes, t_rx_ns: int) -> None:
        """Between two uses of the port nothing is expected; count it all the same."""
        self.ledger.bytes_in += len(data)
        self.ledger.bytes_skipped += len(data)

    def _watch_lock(self, path: SamplePath, now_ns: int) -> None:
        """No samples for a while: say what is heard, and search anew where that can help."""
        unheard = path.last_data_ns - max(path.last_sample_ns, path.begun_ns) > UNHEARD_NS
        if unheard:
            self._complain(f"bytes come on {self._where}, but no valid frame: wrong baud rate or device?")
        elif self.state is DeviceState.SEARCHING:
            self._complain(f"nothing is heard on {self._where}: is it powered, are TX and RX swapped?")
            if self._reset is not None and path.last_data_ns <= path.begun_ns:
                self._search_again.set()
        silent_long = self.state is DeviceState.SILENT and now_ns - self._silent_since_ns > SILENT_SEARCH_NS
        if self._searchable and (unheard or silent_long):
            self._search_again.set()
