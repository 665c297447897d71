"""Transport of bytes (UART, replay): finds the device and its baud rate, queries its identity, and receives samples."""

import asyncio
import logging
from collections.abc import Callable
from typing import Any, Final, Protocol

from imud.contracts.codec import message_of
from imud.contracts.command import Target
from imud.contracts.driver import Identity, StreamDriver
from imud.contracts.firmware import BootLoaderCodec, FirmwareImage, Report
from imud.contracts.link import OnEnd, StreamLink
from imud.contracts.script import Request, RequestScript
from imud.contracts.setting import declared_values
from imud.contracts.status import DeviceState
from imud.device.latency import MOST_NS
from imud.device.scripts import RequestPort, ScriptRunner
from imud.device.search import Remembered, RememberedDevice
from imud.device.stream_search import StreamFound, StreamRound
from imud.device.transport import (
    IDENTIFY_TRIES,
    SILENT_SEARCH_NS,
    UNHEARD_NS,
    DeviceContext,
    ReceivingTransport,
)
from imud.drivers import DRIVERS
from imud.host.clock import HostClock
from imud.host.event_loop import Alarm
from imud.model.errors import BadArgument, CommandError, DriverFailed
from imud.model.event import EventKind
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns
from imud.sampling.path import SamplePath, StreamPath

log = logging.getLogger(__name__)

GRID_NS: Final = NS_PER_MS  # grid of the end of a hold, ns. One iteration of the loop then serves many devices.
FIRST_NS: Final = 5 * NS_PER_MS
"""Maximum first hold, ns. imud does not know the data rate yet. Each hold is at most twice as long as the last."""
WATCH_NS: Final = MOST_NS
"""Time between two frames that imud reads on arrival, ns: the longest latency. Each such read is another wake-up.
Behind an adapter with a latency timer, imud reads one frame per hold on arrival, because the time stamp error would
grow by half otherwise."""
PERIODS_LEAST: Final = 2  # minimum number of samples in a hold. With fewer samples a hold saves no wake-up.


class StreamHold:
    """Receiver that holds the bytes of a link before the path processes them. Synchronization: the loop's thread only.

    The bytes wait in the kernel: `link.pause` stops the reads, and `link.take` reads all bytes at the end of the hold.
    """

    def __init__(self, link: StreamLink, path: StreamPath, port: RequestPort, host: HostClock) -> None:
        self.latency_ns = 0  # maximum hold, ns; set by the transport
        self.hold_ns = 0  # present hold, ns
        self._link = link
        self._path = path
        self._port = port
        self._now_ns = host.now_ns
        self._alarm = Alarm(self)
        self._paused_ns = 0  # CLOCK_MONOTONIC of the start of the hold
        self._least_ns = 0  # minimum hold, ns, from the newest frame that was read on arrival
        self._watch_ns = 0  # CLOCK_MONOTONIC of the next frame that is read on arrival
        # maximum hold in which the bytes fit into the kernel buffer, from the number of bytes of the last hold, ns
        self._most_ns = FIRST_NS

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Process bytes that the link read on arrival."""
        path = self._path
        self._least_ns = PERIODS_LEAST * path.period_ns
        hold_ns = min(self.latency_ns, self._most_ns)
        if hold_ns < self._least_ns or path.clock.utc_reference is not None or self._port.busy:
            hold_ns = 0
        self.hold_ns = hold_ns
        if not hold_ns:
            path.on_data(data, t_rx_ns)
        elif not path.gather(data, t_rx_ns):
            return
        elif not path.held_by_fit:
            self.hold_ns = 0
            path.publish_gathered()
        else:
            self._link.pause()
            self._watch_ns = t_rx_ns if self._link.hold_ns else t_rx_ns + WATCH_NS
            self._begin_hold(t_rx_ns, hold_ns)

    def release(self) -> None:
        """Read and publish the held bytes now. Do nothing without held bytes."""
        self._watch_ns = 0  # publishing can call this method: no new hold follows
        if self._alarm.due_s is not None:
            self._alarm.cancel()
            self.on_alarm()

    def _begin_hold(self, now_ns: int, hold_ns: int) -> None:
        self._paused_ns = now_ns
        wait_ns = hold_ns - (now_ns + hold_ns) % GRID_NS
        self._alarm.set(wait_ns / NS_PER_S)

    def on_alarm(self) -> None:
        """End the hold: read and publish the held bytes. Start the next hold, or read on arrival."""
        link, path, now = self._link, self._path, self._now_ns
        data = link.take()
        now_ns = now()
        waited_ns = now_ns - self._paused_ns
        most_ns = 2 * self._most_ns
        if data:
            path.gather(data, now_ns, waited_ns)
            full_ns = link.waiting_bytes * waited_ns // len(data)
            if full_ns < most_ns:  # noqa: PLR1730 - a call of min() costs 700 instructions
                most_ns = full_ns
        self._most_ns = 1 if most_ns < 1 else MOST_NS if most_ns > MOST_NS else most_ns
        by_fit = path.publish_gathered()
        hold_ns = self.latency_ns if self.latency_ns < self._most_ns else self._most_ns
        if data and by_fit and hold_ns >= self._least_ns and now_ns + hold_ns <= self._watch_ns:
            self.hold_ns = hold_ns
            self._begin_hold(now_ns, hold_ns)
        else:
            link.resume()


class DataReceiver(Protocol):
    """Receiver of the bytes of a link."""

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Process bytes; `t_rx_ns` is CLOCK_MONOTONIC right after the read."""
        ...


class StreamTransport(ReceivingTransport):
    """Transport of the bytes of one device. Synchronization: the loop's thread only."""

    link: StreamLink
    driver: StreamDriver | None
    path: StreamPath | None

    def __init__(self, context: DeviceContext, link: StreamLink, remembered: Remembered) -> None:
        super().__init__(context, remembered)
        self.link = link
        self.driver = self.path = None
        self._ledger = context.ledger
        self._discard = _Discard(context.ledger)
        self._receiver: DataReceiver = self._discard
        # holds the samples; `_discard` if the path receives each read on arrival
        self._hold: StreamHold | _Discard = self._discard
        self._fixed_baud = 0 if link.auto_baud else link.baud
        self._samples_before = 0  # number of samples before the link was opened
        self._started = False  # whether a script has started the output of a device that replied and sent no samples
        self._ignored = 0  # number of valid frames without samples at the last check
        self._ignored_ns = -UNHEARD_NS  # CLOCK_MONOTONIC of the last change of this number

    # --- the link ----------------------------------------------------------------------------------------------------

    def start(self, on_end: OnEnd) -> None:
        self._samples_before, self._started = self._ledger.samples, False
        self.link.start(self._receiver.on_data, on_end)
        self._search.start()

    def stop(self) -> None:
        self._search.stop()
        self._hold.release()
        self.link.close()
        self._receiver = self._discard

    # --- the search --------------------------------------------------------------------------------------------------

    def begin_search(self) -> StreamRound | None:
        """Start a search round. Return None if driver and baud rate are configured, and set up the device instead."""
        config, link = self._config, self.link
        if not self._searchable:
            driver = DRIVERS[config.driver]
            assert isinstance(driver, StreamDriver)
            self._begin(StreamFound(driver, link.baud))
            return None
        self._hold.release()
        last = self._remembered.get(config.name)
        searching = StreamRound(config, link, self._ledger, last, self._host)
        self._pass_to(searching)
        searching.start(self._begin)
        return searching

    def _begin(self, found: StreamFound) -> None:
        """Set up codec and clock for the device, and pass the bytes of the search to them."""
        link, path = self.link, self.path
        if path is None or found.driver is not self.driver:
            path = self._new_path(found.driver)
        else:
            path.clock.restart()
        path.clock.link_changed(byte_ns=uart_byte_ns(link.baud), hold_ns=link.hold_ns)
        path.link_opened()
        path.begin(self._host.now_ns())
        self._remember()
        self.attachments.start(path.clock)
        self._pass_to(path)
        for data, t_rx_ns in found.chunks:
            path.on_data(data, t_rx_ns)
        self._receive()

    def _new_path(self, driver: StreamDriver) -> StreamPath:
        context = self._context
        clock = context.new_clock(driver, self.path)
        options = self._config.options or driver.settings()
        codec = driver.make_codec(self._ledger, options)
        path_context = context.path_context(driver, self.link, self.scripts.on_message, self.settings.shown)
        self.driver = driver
        self.path = StreamPath(codec, clock, path_context, self.attachments.drain_edges, self.scripts)
        context.observer.path_made(self.path, driver.name, options)
        return self.path

    def _remember(self) -> None:
        if self._searchable and self.driver is not None:
            self._remembered.put(self._config.name, RememberedDevice(self.driver.name, self.link.baud))

    # --- requests ----------------------------------------------------------------------------------------------------

    async def ask(self) -> None:
        """Query identity and settings, and start the output of a silent device, if the configuration allows it."""
        driver = self.driver
        if self.may_ask and driver is not None:
            await self._identify(IDENTIFY_TRIES)
            await self._wake(driver)

    def _identity_script(self) -> RequestScript[Identity] | None:
        return self.driver.identify() if self.driver is not None else None

    async def still_answers(self) -> bool:
        """Query a silent device at its last baud rate; return whether no search is needed.

        If driver and baud rate are configured, a search cannot find another device. It only uses the reset line.
        """
        path, samples = self.path, self._ledger.samples
        if path is None or (self._searchable and self._is_unheard(path)):
            return False
        waits = self._host.now_ns() - self._silent_since_ns(path) < SILENT_SEARCH_NS
        if await self._identify(1) and self.driver is not None:
            await self._wake(self.driver)
            return True
        if self._ledger.samples != samples:
            return True
        searching = self._health.state is DeviceState.SEARCHING
        return not ((self._searchable and not waits) or (self.attachments.can_reset and searching))

    async def _wake(self, driver: StreamDriver) -> None:
        """Start the output of a device that replies but has sent no sample since the link was opened.

        Do nothing if the device has sent samples: a command may have stopped it. Do nothing if the device settings or
        the declared settings switch the output off.
        """
        reported = False
        is_off = declared_values(self._config.declared).get("output_enabled") is False
        while driver.wake is not None and not is_off:
            await asyncio.sleep(UNHEARD_NS / NS_PER_S)
            samples_arrived = self._ledger.samples != self._samples_before
            if samples_arrived or self._search.requested or self._hears_unknown(self._host.now_ns()):
                if samples_arrived and self._started and not reported:
                    self._report_started()
                return
            try:
                acknowledged = await self.scripts.run(driver.wake())
            except DriverFailed:
                raise
            except CommandError as error:
                log.debug("%s: not woken: %s", self._config.name, error)
                continue
            if acknowledged is None:
                return
            if not reported:
                reported = True
                self._report_started(acknowledged=acknowledged)

    def _report_started(self, **detail: bool) -> None:
        self._started = False
        message = "it replied but sent no samples: imud started its output and did not save this"
        self._context.events.raise_event(self._host.now_ns(), EventKind.CONFIGURATION, message, **detail)

    def _apply(self, identity: Identity) -> None:
        if self.driver is not None and self.path is not None:
            self.driver.apply_identity(self.path.codec, identity)
            self._context.observer.codec_changed()

    def write(self, data: bytes) -> None:
        """Send a request at the baud rate of the device. Raises CommandError during a search, and LinkError."""
        self._require_device()
        if isinstance(self._receiver, LoaderReceiver):
            self._receiver.flush()
        self.link.write(data)
        driver = self.driver
        if driver is not None and data == driver.output_on and self._ledger.samples == self._samples_before:
            self._started = self._started or self.hears_replies

    def _require_device(self) -> None:
        if not (self.receiving or isinstance(self._receiver, LoaderReceiver)):
            raise CommandError(
                f"{self._config.name}: cannot run a command during the search; try again in some seconds"
            )

    def change_rate(self, request: Request) -> None:
        """Follow a script that has changed the baud rate of the device."""
        self._require_device()
        if request.baud == self.link.baud:
            return
        self.link.set_baud(request.baud)
        if self.path is not None:
            self.path.clock.link_changed(byte_ns=uart_byte_ns(request.baud), hold_ns=self.link.hold_ns)
        self._remember()

    def on_busy(self, busy: bool) -> None:
        """Release held samples when a script starts or ends: the reply must not wait."""
        self.busy = busy
        self._hold.release()

    async def run_script(self, make: Callable[..., Any], *arguments: Any) -> Any:
        """Run a request script. Follow the device if the script changes the baud rate."""
        self._require_device()
        options = self._config.options or (self.driver.settings() if self.driver is not None else None)
        self.target = Target(options, self.link.baud, self._fixed_baud)
        return await self.scripts.run(make(self.target, *arguments))

    async def run_firmware(self, image: FirmwareImage, report: Report) -> None:
        """Write an image. The codec of the boot loader receives the bytes until the end."""
        if not self.receiving and (last := self._remembered.get(self._config.name)) is not None:
            driver, baud = DRIVERS.get(last.driver), last.baud
            if isinstance(driver, StreamDriver) and baud:  # a device in its boot loader sends nothing: no search ends
                self.link.set_baud(baud)
                self._search.end_with(StreamFound(driver, baud))
        driver = self.driver
        if driver is None or not self.receiving:
            name = self._config.name
            raise CommandError(
                f"{name}: expected a known driver and baud rate, got a search; set `driver` and `baud` of {name}"
            )
        if driver.firmware is None or driver.firmware.make_codec is None:
            raise BadArgument(f"{self._config.name}: {driver.name} has no firmware update")
        self._hold.release()
        self._hold = self._discard
        receiver = LoaderReceiver(driver.firmware.make_codec(self._ledger), self.scripts)
        self._pass_to(receiver)
        try:
            await self.run_script(driver.firmware.update, image, report)
        finally:
            receiver.close()
            if self._receiver is receiver:
                self._begin(StreamFound(driver, self.link.baud))

    # --- the samples -------------------------------------------------------------------------------------------------

    def set_latency(self, latency_ns: int) -> None:
        latency_ns = latency_ns if self.link.waiting_bytes else 0
        if latency_ns == self._latency_ns:
            return  # another client requested the same latency
        self._latency_ns = latency_ns
        if self.receiving:
            self._receive()

    @property
    def hold_ns(self) -> int:
        return self._hold.hold_ns

    def _receive(self) -> None:
        """Pass the bytes to the path, on arrival or after a hold."""
        path, latency_ns = self.path, self._latency_ns
        assert path is not None
        self._hold.release()
        self._hold = self._discard
        if latency_ns:
            self._hold = StreamHold(self.link, path, self, self._host)
            self._hold.latency_ns = latency_ns
        self._pass_to(self._hold if latency_ns else path)

    def _pass_to(self, receiver: DataReceiver) -> None:
        """Pass the following bytes of the link to `receiver`, without a function call in between."""
        self._receiver = receiver
        self.link.deliver_to(receiver.on_data)

    def on_no_samples(self, path: SamplePath, now_ns: int) -> None:
        """Report the received bytes or replies, and search again if a search can find the device."""
        health = self._health
        if words := self.loader_words(path):
            health.report(words)
            return
        if self._hears_unknown(now_ns):
            problem = f"on {self.where}: {self.unknown_words()}"
            self._report_silence(problem, now_ns, ended=health.state is not DeviceState.SILENT)
            return  # the baud rate and the driver are right: no search can find samples
        unheard = self._is_unheard(path)
        if unheard:
            problem = f"bytes arrive on {self.where}, but no valid frame; check the baud rate and the driver"
            self._report_silence(problem, now_ns, ended=health.state is DeviceState.RUNNING)
        elif self._has_answered(path):
            self._report_silence(self._words_of_silence(), now_ns, ended=health.state is DeviceState.SEARCHING)
        elif health.state is DeviceState.SEARCHING:
            health.report(
                f"no byte arrives on {self.where}; check the power supply of the device and the wires TX and RX"
            )
            if self.attachments.can_reset and path.last_data_ns <= path.begun_ns:
                self._search.search_again()
        if not self.busy and ((unheard and self._searchable) or self._is_overdue(path, now_ns)):
            self._search.search_again()

    def _hears_unknown(self, now_ns: int) -> bool:
        """Return whether valid frames of an unknown type arrive."""
        ignored = self._ledger.frames_ignored
        if ignored != self._ignored:
            self._ignored, self._ignored_ns = ignored, now_ns
        return now_ns - self._ignored_ns <= UNHEARD_NS

    def _is_overdue(self, path: SamplePath, now_ns: int) -> bool:
        """Return whether imud must query a silent device or search for it: once when it becomes silent, then later."""
        if not (self._searchable or self.may_ask):
            return False
        just_silent = self._health.state is DeviceState.SILENT and self._asked_ns < self._health.silent_since_ns
        if just_silent and self.may_ask and not self._has_answered(path):
            return True
        return now_ns - max(self._silent_since_ns(path), self._asked_ns) > SILENT_SEARCH_NS

    def _silent_since_ns(self, path: SamplePath) -> int:
        """Return CLOCK_MONOTONIC of the last sample or reply."""
        return max(self._health.silent_since_ns, self.scripts.answered_ns, path.begun_ns)

    def _report_silence(self, problem: str, now_ns: int, *, ended: bool) -> None:
        """Report why no sample arrives. With `ended`, the device state becomes SILENT."""
        if ended:
            self._health.down(now_ns, DeviceState.SILENT, problem)
        else:
            self._health.report(problem)

    def _is_unheard(self, path: SamplePath) -> bool:
        """Return whether bytes arrive that are neither samples nor replies."""
        understood_ns = max(path.last_sample_ns, path.begun_ns, self.scripts.answered_ns)
        return path.last_data_ns - understood_ns > UNHEARD_NS

    def _has_answered(self, path: SamplePath) -> bool:
        """Return whether the device has replied after its last sample, or after imud found it."""
        return self.scripts.answered_ns >= max(path.begun_ns, path.last_sample_ns) > 0

    def _words_of_silence(self) -> str:
        """Describe a device that replies and sends no samples."""
        driver, identity = self.driver, self.settings.identity
        assert driver is not None
        firmware = f"firmware {identity.firmware}" if identity.firmware else ""
        names = ", ".join(filter(None, (identity.product, firmware)))
        why = driver.why_silent(self.settings.values)
        hint = "; the command wake starts its output" if "wake" in driver.verbs else ""
        return f"it replies{f' ({names})' if names else ''} but sends no samples: {why}{hint}"

    # --- state -------------------------------------------------------------------------------------------------------

    @property
    def where(self) -> str:
        """Name of the port and its baud rate."""
        return f"{self.link.title} at {self.link.baud} baud" if self.link.baud else self.link.title

    @property
    def bit_rate(self) -> int:
        return self.link.baud

    @property
    def receiving(self) -> bool:
        return isinstance(self._receiver, StreamPath | StreamHold)

    @property
    def hears_replies(self) -> bool:
        """Whether the device has replied. Before a reply, driver and baud rate are uncertain."""
        return self.path is not None and self.receiving and self._has_answered(self.path)

    @property
    def _searchable(self) -> bool:
        return self.link.auto_baud or self._config.driver == "auto"


class LoaderReceiver:
    """Receiver that passes the replies of a boot loader to the script runner."""

    def __init__(self, codec: BootLoaderCodec, scripts: ScriptRunner) -> None:
        self._codec = codec
        self._scripts = scripts

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        for event in self._codec.feed(data):
            if (message := message_of(event)) is not None:
                self._scripts.on_message(message, t_rx_ns)

    def flush(self) -> None:
        """Discard an incomplete reply before the next request."""
        self._codec.flush()

    def close(self) -> None:
        self._codec.reset()


class _Discard:
    """Receiver that only counts bytes, while no search and no path use the port. It holds no samples."""

    hold_ns = 0

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger

    def on_data(self, data: bytes, _t_rx_ns: int) -> None:
        self._ledger.bytes_in += len(data)
        self._ledger.bytes_skipped += len(data)

    def release(self) -> None:
        """Do nothing."""
