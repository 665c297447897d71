"""The life of one device: wait for its port, open, find, ask who it is, stream; and again when it comes back.

MISSING ──port appears──▶ SEARCHING ──samples──▶ RUNNING ──none for a while──▶ SILENT
   ▲                        │    ▲                  │                            │
   └──────── unplugged ─────┴────┼──────────────────┴────────────────────────────┤
                                 └── bytes without frames, or long silence ──────┘
"""

import asyncio
import logging
from collections.abc import Callable, Mapping
from time import monotonic_ns

from imud.clock import SampleClock
from imud.config import DeviceConfig
from imud.devices import DRIVERS
from imud.errors import CommandError, LinkError, LinkMissing, NothingHeard
from imud.event import Event, EventKind
from imud.kit.batch import Batch
from imud.kit.driver import Identity, StreamDriver
from imud.kit.link import StreamLink
from imud.kit.status import ClockStatus, DeviceState, DeviceStatus
from imud.ledger import Ledger
from imud.links import LINKS
from imud.pipeline.meters import LatencyMeter, RateMeter
from imud.pipeline.notices import Notices
from imud.pipeline.path import SamplePath
from imud.pipeline.remembered import Found, Remembered
from imud.pipeline.search import Finder, Finding
from imud.pipeline.talk import Talk
from imud.units import NS_PER_MS, NS_PER_S, uart_byte_ns

log = logging.getLogger(__name__)

RETRY_S = 0.5
"""Pause before a port that refused is opened again: short enough to be back within a second of its coming back."""
GONE_S = 0.02
"""The same after a port has gone; its coming back is waited for without polling, so this only keeps a node that is
there and cannot be opened from being tried without end."""
IDLE_FLUSH_NS = 50 * NS_PER_MS
"""A line idle for longer than any adapter's latency timer (16 ms) sends no more of the frame that is pending."""
UNHEARD_NS = 2 * NS_PER_S
"""Bytes without a single good frame for this long: the device has another rate now."""
SILENCE_NS = 1 * NS_PER_S
"""Without samples for this long, and for five periods, a device counts as silent."""
SILENT_SEARCH_NS = 15 * NS_PER_S
"""A silent line is searched anew after this: the device may have been exchanged or set to another rate."""
IDENTIFY_TRIES = 3


class DeviceRunner:
    """Owns one configured device. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        config: DeviceConfig,
        device_id: int,
        publish: Callable[[Batch], None],
        tell: Callable[[Event], None],
        remembered: Remembered,
    ) -> None:
        self.config = config
        self.device_id = device_id
        self.ledger = Ledger()
        self.state = DeviceState.MISSING
        self._problem = ""
        self._publish = publish
        self._notices = Notices(config.name, self.ledger, tell)
        self._remembered = remembered
        self.link: StreamLink = LINKS[config.link].make(config.link_settings)
        self._talk = Talk(self.ledger, self.link.write)
        self._driver: StreamDriver | None = None
        self._clock: SampleClock | None = None
        self._path: SamplePath | None = None
        self._take: Callable[[bytes, int], None] = self._ignore
        self._finder: Finder | None = None
        self._identity = Identity()
        self._settings: Mapping[str, str] = {}
        self._rate = RateMeter()
        self._connects = 0
        self._silent_since_ns = 0
        self._search_again = asyncio.Event()
        self._ended: asyncio.Future[LinkError | None] | None = None

    async def run(self) -> None:
        """Keep the device alive until cancelled, or until a replay ends."""
        while True:
            try:
                await self.link.wait_present()
                await self._live()
                self._set(DeviceState.FINISHED)
                return
            except LinkMissing as error:
                self._down(DeviceState.MISSING, str(error))
                await asyncio.sleep(GONE_S)
            except LinkError as error:
                self._down(DeviceState.FAILED, str(error))
                await asyncio.sleep(RETRY_S)

    def tick(self, now_ns: int) -> None:
        """Ten times a second: states, idle line, events that gathered."""
        self._rate.mark(now_ns, self.ledger.samples)
        path = self._path
        if path is None:
            return
        if now_ns - path.last_data_ns > IDLE_FLUSH_NS:
            path.flush(now_ns)
        self._watch_flow(path, now_ns)
        self._notices.tick(now_ns, path.newest.sync if path.newest else None)

    def close(self) -> None:
        """Release the link; may be called twice."""
        self.link.close()
        self._take = self._ignore

    # --- the link's life -----------------------------------------------------------------------------------------

    async def _live(self) -> None:
        """From open to the end of the link; returns at the regular end of a replay. Raises LinkError."""
        self.link.open()
        self._connects += 1
        self._problem = ""
        ended = self._ended = asyncio.get_running_loop().create_future()
        self.link.start(self._receive, self._on_end)
        self._seek()
        working = asyncio.create_task(self._work(), name=f"{self.config.name} work")
        try:
            await asyncio.wait({working, ended}, return_when=asyncio.FIRST_COMPLETED)
            if not ended.done():
                await working  # it ends before its link only by an error
            elif error := ended.result():
                raise error
        finally:
            working.cancel()
            await asyncio.gather(working, return_exceptions=True)
            self._end_search()
            self.close()
            if self._path is not None:
                self._path.codec.reset()

    def _end_search(self) -> None:
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
                    self._seek()
            if self._may_ask:
                await self._identify()
            await self._search_again.wait()
            self._seek()

    def _seek(self) -> None:
        """Begin a search, or take what comes at once where driver and rate are given."""
        self._search_again.clear()
        self.state = DeviceState.SEARCHING
        config, link = self.config, self.link
        if not self._searchable:
            self._begin(Finding(DRIVERS[config.driver], ()))
            return
        last = self._remembered.get(config.name)
        self._finder = Finder(config, link, self.ledger, last, self._begin, may_ask=self._may_ask)
        self._take = self._finder.take
        self._finder.start()

    def _begin(self, finding: Finding) -> None:
        """Set up codec and clock for what was found, and give them what was heard during the search."""
        driver, link = finding.driver, self.link
        if self._path is None or self._clock is None or driver is not self._driver:
            self._driver = driver
            self._clock = self._new_clock(driver)
            codec = driver.make_codec(self.ledger, self.config.options or driver.settings())
            self._path = SamplePath(
                self.config.name, self.device_id, codec, self._clock, self.ledger,
                self._publish, self._talk.on_text, self._notices.bad_frame, self._overruns,
            )  # fmt: skip
        else:
            self._clock.restart()
        self._clock.link_changed(byte_ns=uart_byte_ns(link.baud), hold_ns=link.hold_ns)
        self._path.loss.link_opened()
        self._path.begin(monotonic_ns())
        if self._searchable:
            self._remembered.put(self.config.name, Found(driver.name, link.baud))
        self._take = self._path.on_data
        for data, t_rx_ns in finding.chunks:
            self._path.on_data(data, t_rx_ns)

    @property
    def _searchable(self) -> bool:
        return self.link.auto_baud or self.config.driver == "auto"

    @property
    def _may_ask(self) -> bool:
        return self.config.identify and self.link.writable

    def _new_clock(self, driver: StreamDriver) -> SampleClock:
        clock = SampleClock(
            self.config.name,
            tick_ns=driver.tick_ns,
            tick_modulus=driver.tick_modulus,
            byte_ns=uart_byte_ns(self.link.baud),
            hold_ns=self.link.hold_ns,
        )
        if self._clock is not None:
            clock.follow(self._clock)
        return clock

    # --- who it is -----------------------------------------------------------------------------------------------

    async def _identify(self) -> None:
        """Ask who it is and how it is set; a device that does not answer still streams."""
        driver, path = self._driver, self._path
        if driver is None or path is None:
            return
        for attempt in range(1, IDENTIFY_TRIES + 1):
            try:
                identity = await self._talk.hold(driver.identify())
                driver.apply_identity(path.codec, identity)
                self._learn(identity, await self._talk.hold(driver.read_settings()))
                return
            except CommandError as error:
                log.info("%s: %s (try %d of %d)", self.config.name, error, attempt, IDENTIFY_TRIES)

    def _learn(self, identity: Identity, settings: Mapping[str, str]) -> None:
        """Compare with what was known: a device that comes back may be another one, or set otherwise."""
        now_ns = monotonic_ns()
        before = self._identity
        if before.serial_number and identity.serial_number != before.serial_number:
            message = f"another device: serial number {identity.serial_number}, was {before.serial_number}"
            self._notices.tell(now_ns, EventKind.CONFIGURATION, message, serial_number=identity.serial_number)
        changed = {k: v for k, v in settings.items() if self._settings.get(k, v) != v}
        if changed:
            words = ", ".join(f"{name} is {value}, was {self._settings[name]}" for name, value in changed.items())
            self._notices.tell(now_ns, EventKind.CONFIGURATION, f"settings of the device changed: {words}", **changed)
        self._identity, self._settings = identity, settings

    # --- the flow ------------------------------------------------------------------------------------------------

    def _receive(self, data: bytes, t_rx_ns: int) -> None:
        self._take(data, t_rx_ns)

    def _ignore(self, data: bytes, t_rx_ns: int) -> None:
        """Between two uses of the port nothing is expected; count it all the same."""
        self.ledger.bytes_in += len(data)
        self.ledger.bytes_skipped += len(data)

    def _on_end(self, error: LinkError | None) -> None:
        if self._ended is not None and not self._ended.done():
            self._ended.set_result(error)

    def _watch_flow(self, path: SamplePath, now_ns: int) -> None:
        quiet_ns = now_ns - path.last_sample_ns
        if (self.state is DeviceState.SEARCHING and path.fresh) or (
            self.state is DeviceState.SILENT and quiet_ns < SILENCE_NS
        ):
            self._up(now_ns, path)
        elif self.state is DeviceState.RUNNING and quiet_ns > self._silence_limit_ns():
            self._silent_since_ns = now_ns
            self._down(DeviceState.SILENT, f"no sample for {quiet_ns / NS_PER_S:.1f} s, though the link is there")
        elif self._take == path.on_data and quiet_ns > UNHEARD_NS:
            self._watch_lock(path, now_ns)

    def _watch_lock(self, path: SamplePath, now_ns: int) -> None:
        """No samples for a while: say what is heard, and search anew where that can help."""
        unheard = path.last_data_ns - max(path.last_sample_ns, path.begun_ns) > UNHEARD_NS
        if unheard:
            self._complain(f"bytes come on {self._where()}, but no valid frame: wrong baud rate or device?")
        elif self.state is DeviceState.SEARCHING:
            self._complain(f"nothing is heard on {self._where()}: is it powered, are TX and RX swapped?")
        silent_long = self.state is DeviceState.SILENT and now_ns - self._silent_since_ns > SILENT_SEARCH_NS
        if self._searchable and (unheard or silent_long):
            self._search_again.set()

    def _silence_limit_ns(self) -> int:
        expected_hz = self._clock.expected_rate_hz if self._clock is not None else 0.0
        return max(SILENCE_NS, int(5 * NS_PER_S / expected_hz) if expected_hz else 0)

    def _up(self, now_ns: int, path: SamplePath) -> None:
        self._set(DeviceState.RUNNING)
        driver = self._driver.name if self._driver else ""
        self._notices.tell(now_ns, EventKind.UP, f"{driver} on {self._where()}", driver=driver, baud=self.link.baud)

    def _down(self, state: DeviceState, problem: str) -> None:
        was_up = self.state in (DeviceState.RUNNING, DeviceState.SILENT)
        changed = state is not self.state or problem != self._problem
        self._set(state, problem)
        if was_up:
            self._notices.tell(monotonic_ns(), EventKind.DOWN, problem, state=str(state))
        elif changed:
            log.warning("%s: %s", self.config.name, problem)

    def _complain(self, problem: str) -> None:
        if problem != self._problem:
            log.warning("%s: %s", self.config.name, problem)
        self._problem = problem

    def _set(self, state: DeviceState, problem: str = "") -> None:
        self.state, self._problem = state, problem

    def _overruns(self) -> int:
        return self.link.kernel_counters().overrun

    def _where(self) -> str:
        return f"{self.link.title} at {self.link.baud} baud" if self.link.baud else self.link.title

    # --- what it looks like from outside ---------------------------------------------------------------------------

    def status(self) -> DeviceStatus:
        """Everything there is to say of the device now."""
        path, clock = self._path, self._clock
        newest = path.newest if path else None
        latency = path.latency if path else LatencyMeter()
        driver = self._driver
        return DeviceStatus(
            name=self.config.name,
            device_id=self.device_id,
            driver=driver.name if driver else self.config.driver,
            euler_convention=driver.euler_convention if driver else "",
            navigation_frame=driver.navigation_frame if driver else "",
            link=self._where(),
            state=self.state,
            problem=self._problem,
            identity=identity_words(self._identity),
            settings=dict(self._settings),
            rate_hz=self._rate.rate_hz(),
            expected_rate_hz=clock.expected_rate_hz if clock else 0.0,
            newest_seq=newest.seq if newest else 0,
            clock=clock.status() if clock else ClockStatus(),
            ledger=self.ledger.snapshot(),
            kernel=self.link.kernel_counters(),
            latency_buckets=tuple(latency.buckets),
            latency_sum_ns=latency.sum_ns,
            temperature_c=newest.temperature_c if newest else None,
            status_bits=newest.status if newest else None,
            connects=self._connects,
        )


def identity_words(identity: Identity) -> dict[str, str]:
    """An identity as the flat mapping of `DeviceStatus`, empty members left out."""
    words = {
        "product": identity.product,
        "serial_number": identity.serial_number,
        "firmware": identity.firmware,
        **(identity.details or {}),
    }
    return {name: value for name, value in words.items() if value}
