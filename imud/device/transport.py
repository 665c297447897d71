"""Transport of a device: the base class for the three kinds of link, and the search for the device.

A transport owns the link, finds the device on the link, and passes received data to the sample path of the device.
`StreamTransport` reads a serial port, `CanTransport` a CAN bus, and `PolledTransport` an SPI, I2C or RS-485 bus.
"""

import asyncio
import logging
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, repeat
from typing import Any, Protocol

import msgspec

from imud.attitude.conventions import DeviceAxes
from imud.attitude.published import PublishedAxes, published_frame
from imud.config.model import DeviceConfig
from imud.contracts.driver import Driver, Identity, StreamDriver
from imud.contracts.firmware import FirmwareImage, Report
from imud.contracts.lines import LineFactory
from imud.contracts.link import Link, OnEnd
from imud.contracts.publisher import Batch
from imud.contracts.script import Message, RequestScript
from imud.contracts.status import DeviceState, DeviceStatus, LinesStatus
from imud.device.attachments import Attachments
from imud.device.evidence import SampleWatch
from imud.device.health import DeviceEvents, Health
from imud.device.scripts import RequestPort, ScriptRunner
from imud.device.search import Remembered, SearchRound
from imud.device.settings import DeviceSettings
from imud.device.settings_plan import SettingsPort
from imud.host.clock import HostClock
from imud.model.errors import BadArgument, CommandError, DriverFailed, NothingHeard
from imud.model.event import Event, EventKind
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_S
from imud.recording.observer import PathObserver
from imud.sampling.clock import SampleClock
from imud.sampling.driver_clock import make_clock
from imud.sampling.path import PathContext, SamplePath

log = logging.getLogger(__name__)

UNHEARD_NS = 2 * NS_PER_S
"""Time with data but without a sample after which imud assumes another baud rate or another device, ns."""
SILENT_SEARCH_NS = 15 * NS_PER_S
"""Time without data after which imud searches again, because the device may be replaced or reconfigured, ns."""
IDENTIFY_TRIES = 3  # number of identity queries after a search
IDENTIFY_AGAIN_S = (5, 30, 120, 300)
"""Pauses before further identity queries of a device that did not reply, s. The last pause repeats forever."""


class DeviceOwner(Protocol):
    """Owner of devices. `imud.daemon` implements it, and this part may not import `imud.daemon`."""

    def publish(self, batch: Batch) -> None:
        """Process samples of a device."""
        ...

    def send_event(self, event: Event) -> None:
        """Process an event of a device."""
        ...

    def configured_devices(self) -> Sequence[DeviceConfig]:
        """Return all devices of the present configuration."""
        ...

    def tick_soon(self) -> None:
        """Tick the devices within 0.1 s."""
        ...


@dataclass(frozen=True, slots=True)
class DeviceContext:
    """The parts of a device that its transport uses."""

    config: DeviceConfig
    device_id: int
    owner: DeviceOwner
    host: HostClock
    lines: LineFactory
    ledger: Ledger
    events: DeviceEvents
    health: Health
    observer: PathObserver

    def published(self, axes: DeviceAxes) -> PublishedAxes:
        """Return the published axes of a device that sends `axes`."""
        config = self.config
        return published_frame(config.frame, config.convention, config.declination_deg, axes)

    def path_context(
        self, driver: Driver, link: Link, on_message: Callable[[Message, int], object], settings: Mapping[str, str]
    ) -> PathContext:
        """Return the context of a sample path for `driver`. The path passes text lines and replies to `on_message`."""

        def overruns() -> int:
            return link.kernel_counters().overrun

        return PathContext(
            self.config.name, self.device_id, self.ledger, self.owner.publish, on_message, self.events.bad_frame,
            overruns, self.host, self.published(driver.sent_axes(settings).axes), self.config.attitude,
        )  # fmt: skip

    def new_clock(self, driver: Driver, path: SamplePath | None) -> SampleClock:
        """Return a clock for `driver` that continues the clock of `path`."""
        before = path.clock if path is not None else None
        name, lines = self.config.name, self.config.lines
        return make_clock(
            name, lines, driver, before, host=self.host.steady, on_unknown_gap=self.ledger.add_unknown_gap
        )


class Transport(SettingsPort):
    """Transport of one device. Synchronization: the loop's thread only.

    Order of calls: `serve` once; then `wait_present`, `link.open`, `start`, `work` until it or the link ends, `stop`,
    and again from `wait_present`; `close` at the end.
    """

    link: Link
    settings: DeviceSettings
    is_polled = False  # whether imud requests each sample
    has_ticks = False  # whether `tick` has work while samples arrive
    busy = False  # whether a request script is running; always False for a polled device: scripts and reads alternate

    def __init__(self, context: DeviceContext) -> None:
        self.samples = SampleWatch(self)
        self._context = context
        self._config = context.config
        self._health = context.health
        self._host = context.host
        self._latency_ns = 0
        self._loader = 0, ""  # CLOCK_MONOTONIC and text of the newest interrupted firmware update
        self.axes_problem = ""  # reason for which the axes of the device are uncertain
        self._compared: tuple[SamplePath, DeviceAxes] | None = None  # path, and the sent axes that it publishes

    def serve(self, attachments: Attachments, settings: DeviceSettings) -> None:
        """Set the other parts of the device, before the first use of the link."""
        self.attachments = attachments
        self.settings = settings

    # --- the link ----------------------------------------------------------------------------------------------------

    async def wait_present(self) -> None:
        """Return when imud can open the link. Raises LinkError if imud must not open it."""
        self._health.missing(self._host.now_ns(), self.link.absence())
        await self.link.wait_present()

    @abstractmethod
    def start(self, on_end: OnEnd) -> None:
        """Start reading the open link. `on_end` is called once if the link ends. Raises LinkError."""

    @abstractmethod
    async def work(self) -> None:
        """Find the device and query its identity, repeatedly. Ends with the link, or by an error."""

    @abstractmethod
    def stop(self) -> None:
        """Stop all work and close the link. A second call does nothing."""

    def close(self) -> None:
        """Stop, and release all resources that devices share. A second call does nothing."""
        self.stop()

    def forget_driver(self) -> None:
        """Forget the driver, because its code has failed."""
        self.driver = self.path = None

    # --- requests ----------------------------------------------------------------------------------------------------

    def write(self, data: bytes) -> None:
        """Send bytes to the device. Raises LinkError."""
        self.link.write(data)

    def use_axes(self, settings: Mapping[str, str]) -> None:
        """Publish samples in the axes that the readable device settings select. Report unknown axes once."""
        driver, path = self.driver, self.path
        if driver is None or path is None:
            return
        sent, before = driver.sent_axes(settings), self.axes_problem
        if self._compared != (path, sent.axes):
            self._compared = path, sent.axes
            if (frame := self._context.published(sent.axes)) != path.frame:
                path.set_frame(frame)
        self.axes_problem = sent.problem
        if sent.problem and sent.problem != before:
            self._context.events.raise_event(self._host.now_ns(), EventKind.CONFIGURATION, sent.problem)

    async def run_firmware(self, image: FirmwareImage, report: Report) -> None:
        """Write an image to the device with its driver. Raises CommandError and LinkError."""
        raise BadArgument(f"{self._config.name}: expected a device on a UART or on CANopen for a firmware update")

    def in_boot_loader(self, words: str) -> None:
        """Report `words` in place of a search until the next sample arrives: the device is in its boot loader."""
        self._loader = self._host.now_ns(), words

    def loader_words(self, path: SamplePath) -> str:
        """Return the text of `in_boot_loader`; empty after a sample of the device."""
        since_ns, words = self._loader
        return words if path.last_sample_ns <= since_ns else ""

    @property
    def is_in_boot_loader(self) -> bool:
        """Whether the device is in its boot loader after a firmware update, as far as imud knows."""
        return bool(self._loader[1] if self.path is None else self.loader_words(self.path))

    # --- the samples -------------------------------------------------------------------------------------------------

    @abstractmethod
    def set_latency(self, latency_ns: int) -> None:
        """Set the maximum hold of a sample, ns; 0: no hold."""

    @abstractmethod
    def on_no_samples(self, path: SamplePath, now_ns: int) -> None:
        """Report the received data, or search again. Called after UNHEARD_NS without a sample."""

    def tick(self, now_ns: int) -> None:
        """Do periodic work before the device checks its samples."""

    def on_reset(self) -> None:  # a stream or CAN device sends again without a request
        """Prepare for a reset of the device by its line."""

    # --- state -------------------------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def bit_rate(self) -> int:
        """Bit rate of the link, bit/s; 0 if the link has no bit rate."""

    @property
    @abstractmethod
    def receiving(self) -> bool:
        """Whether received data goes to the sample path; False during a search."""

    @property
    @abstractmethod
    def hears_replies(self) -> bool:
        """Whether the codec can receive replies before the first sample."""

    @property
    @abstractmethod
    def hold_ns(self) -> int:
        """Present hold of the samples, ns."""

    @property
    def is_free(self) -> bool:
        """Whether other parts may send bytes to the device: no script runs, and no search changes the rate."""
        return self.receiving and not self.busy

    @property
    def accepts_scripts(self) -> bool:
        """Whether the device can reply to a script: samples arrive, or the codec receives replies before them."""
        health = self._health
        return health.streaming or (health.state is DeviceState.SEARCHING and self.hears_replies)

    def require_replies(self) -> None:
        self._context.owner.tick_soon()  # a command watches the samples
        if not self.accepts_scripts:
            problem = self._health.problem or "it cannot reply to commands now"
            raise CommandError(f"{self._config.name} is {self._health.state}: {problem}")

    @property
    def can_be_asked(self) -> bool:
        """Whether imud can run a script on the device now."""
        return self.link.writable and self.accepts_scripts and not self.busy

    def add_status(self, status: DeviceStatus) -> DeviceStatus:
        """Return `status` with the fields of this kind of transport."""
        return msgspec.structs.replace(status, unused=self._unused_words())

    def add_lines(self, status: LinesStatus | None) -> LinesStatus | None:
        """Return `status` with the lines of this kind of transport."""
        return status

    @property
    def expected_rate_hz(self) -> float:
        """Sample rate that the device must have, Hz; 0 if it is not known."""
        return self.path.clock.expected_rate_hz if self.path is not None else 0.0

    def unknown_words(self) -> str:
        """Describe the received frames of unknown types; empty without such frames."""
        driver, path = self.driver, self.path
        if driver is None or path is None or not path.unknown:
            return ""
        return driver.unknown_words(path.unknown, self._config.name)

    def _unused_words(self) -> str:
        """Describe the received frames that imud cannot decode; empty without such frames."""
        driver, path = self.driver, self.path
        words = self._context.events.wrong_length_words()
        # unknown frames on a CAN bus can be from other devices
        if isinstance(driver, StreamDriver) and path is not None and path.unknown:
            words = driver.unknown_types(path.unknown)
        return words


class ReceivingTransport(Transport, RequestPort):
    """Transport of a device that sends samples without a request, on a serial port or a CAN bus."""

    def __init__(self, context: DeviceContext, remembered: Remembered) -> None:
        super().__init__(context)
        self.scripts = ScriptRunner(self, context.ledger, context.host)
        self._search = SearchLoop(self, context)
        self._remembered = remembered
        self._asked_ns = 0  # CLOCK_MONOTONIC of the newest identity query; 0 before the first query

    # --- parts of each kind ------------------------------------------------------------------------------------------

    @abstractmethod
    def begin_search(self) -> SearchRound[Any] | None:
        """Start a search round. Return None if the configuration names the device, and set up the device instead."""

    @abstractmethod
    async def ask(self) -> None:
        """Query identity and settings after a search, if the configuration allows it. Raises LinkError."""

    async def still_answers(self) -> bool:
        """Return whether the search that was requested is not needed, because the device replies."""
        return False

    @abstractmethod
    def _identity_script(self) -> RequestScript[Identity] | None:
        """Return the script that queries the identity; None before imud has found the device."""

    @abstractmethod
    def _apply(self, identity: Identity) -> None:
        """Adapt the codec to the identity of the device."""

    # --- common code -------------------------------------------------------------------------------------------------

    async def work(self) -> None:
        await self._search.run()

    def on_change(self) -> None:
        if self.path is not None:
            self.path.clock.expect_rate()

    async def ask_once(self) -> None:
        """Query identity and settings once."""
        await self._identify(1)

    async def read_identity(self) -> None:
        script = self._identity_script()
        if script is not None:
            identity = await self.scripts.run(script)
            self._apply(identity)
            self.settings.update_identity(identity)

    async def _identify(self, tries: int) -> bool:
        """Query identity and settings. Return whether the device replied to all queries."""
        settings = self.settings
        if self.driver is None or not self.may_ask:
            return False
        self._asked_ns = self._host.now_ns()
        settings.answered = False
        for attempt in range(1, tries + 1):
            try:
                await self.read_identity()
                await settings.read()
                settings.answered = True
                return True
            except DriverFailed:  # each try would fail
                raise
            except CommandError as error:
                log.info("%s: %s (try %d of %d)", self._config.name, error, attempt, tries)
        return False

    @property
    def unanswered(self) -> bool:
        """Whether imud must query the identity again."""
        return self.may_ask and not self.settings.answered

    @property
    def may_ask(self) -> bool:
        return self._config.identify and self.link.writable


class SearchLoop:
    """Loop of search rounds on one link. Synchronization: the loop's thread only."""

    def __init__(self, transport: ReceivingTransport, context: DeviceContext) -> None:
        self._transport = transport
        self._health = context.health
        self._host = context.host
        self._round: SearchRound[Any] | None = None
        self._again = asyncio.Event()

    @property
    def requested(self) -> bool:
        """Whether another search was requested and has not started."""
        return self._again.is_set()

    def start(self) -> None:
        """Start a search. Cancel a search that is running."""
        self.stop()
        self._again.clear()
        self._health.searching()
        self._round = self._transport.begin_search()

    def end_with(self, found: Any) -> None:
        """End a running search with a device that imud knows from another source."""
        if self._round is not None:
            self._round.end_with(found)

    def search_again(self) -> None:
        """Request another search."""
        self._again.set()

    def stop(self) -> None:
        """Cancel the search. A second call does nothing."""
        if self._round is not None:
            self._round.cancel()
            self._round = None

    async def run(self) -> None:
        """Search and query, repeatedly; the first search has started. Ends only by an error of the link."""
        await self._transport.attachments.reset_settled()
        while True:
            searched = self._round is not None
            await self._finish_search()
            await self._transport.ask()
            await self._needed()
            if not searched:
                await self._report_absence()
            self.start()

    async def _needed(self) -> None:
        """Return when another search is needed. Until then query a device again that has not replied."""
        now_ns, pauses = self._host.now_ns, _pauses_s()
        due_ns = now_ns() + next(pauses) * NS_PER_S
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout((due_ns - now_ns()) / NS_PER_S if self._transport.unanswered else None):
                    await self._again.wait()
            if self._again.is_set():
                self._again.clear()
                if not await self._transport.still_answers():
                    return
            else:
                await self._transport.ask_once()
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
        await self._transport.attachments.device_not_found(self._host.now_ns())


def _pauses_s() -> Iterator[int]:
    """Return the pauses before further identity queries, without end.

    Requests and replies can be lost right after a plug, on a busy host, or before a line is wired. A device without a
    wired RX costs one useless request in five minutes.
    """
    return chain(IDENTIFY_AGAIN_S, repeat(IDENTIFY_AGAIN_S[-1]))
