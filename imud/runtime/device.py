"""The life of one device, whatever its link: open, stream, notice silence and end, and again when it comes back.

MISSING ──port appears──▶ SEARCHING ──samples──▶ RUNNING ──none for a while──▶ SILENT
   ▲                        │    ▲                  │                            │
   └──────── unplugged ─────┴────┼──────────────────┴────────────────────────────┤
                                 └── bytes without frames, or long silence ──────┘
"""

import asyncio
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from time import monotonic_ns
from typing import Any

from imud.clock import SampleClock
from imud.config import DeviceConfig
from imud.contracts.action import Action, Actions, Target
from imud.contracts.driver import Driver, Identity
from imud.contracts.lines import LineFactory
from imud.contracts.link import Link
from imud.contracts.publisher import Batch
from imud.contracts.session import RequestScript
from imud.contracts.settings import Settings
from imud.contracts.status import ClockStatus, DeviceState, DeviceStatus
from imud.errors import BadArgument, CommandError, LinkError, LinkMissing
from imud.event import Event, EventKind
from imud.ledger import Ledger
from imud.runtime.exchange import Exchange
from imud.runtime.known_identity import KnownIdentity, identity_words
from imud.runtime.meters import LatencyMeter, RateMeter
from imud.runtime.notices import Notices
from imud.runtime.path import SamplePath
from imud.runtime.utc_keeper import DevicePort, make_keeper
from imud.signals.gpio import GPIO_LINES
from imud.signals.line_actions import LineActions
from imud.signals.reset import make_reset
from imud.signals.sync_signals import SyncSignals
from imud.units import NS_PER_MS, NS_PER_S
from imud.utc.system_clock import realtime_offset_ns

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
IDENTIFY_TRIES = 3


class Device(ABC):
    """Owns one configured device and its link. Synchronization: the event loop's thread only."""

    link: Link

    def __init__(
        self,
        config: DeviceConfig,
        device_id: int,
        publish: Callable[[Batch], None],
        tell: Callable[[Event], None],
        link: Link,
        lines: LineFactory = GPIO_LINES,
    ) -> None:
        self.config = config
        self.device_id = device_id
        self.ledger = Ledger()
        self.state = DeviceState.MISSING
        self._problem = ""
        self._publish = publish
        self._notices = Notices(config.name, self.ledger, tell)
        self.link = link
        self._exchange = Exchange(self.ledger, link.write, self._change_rate)
        port = DevicePort(link.write, lambda: self._rate_bit_s, lambda: self._exchange.busy)
        self._utc = make_keeper(config, port, monotonic_ns, realtime_offset_ns)
        self._wires: SyncSignals | None = None
        if config.lines is not None:
            on_pulses = self._utc.on_pulses if self._utc is not None else None
            self._wires = SyncSignals(
                config.name, config.lines, lines, self._notices.tell, monotonic_ns, on_pulses=on_pulses
            )
        self._reset = make_reset(config.name, config.lines, lines, self._notices.tell, monotonic_ns, self._on_reset)
        self._by_lines = LineActions(self._reset, self._wires)
        self._driver: Driver | None = None
        self._clock: SampleClock | None = None
        self._path: SamplePath | None = None
        self._known = KnownIdentity(self._notices)
        self._rate = RateMeter()
        self._connects = 0
        self._silent_since_ns = 0
        self._ended: asyncio.Future[LinkError | None] | None = None

    async def run(self) -> None:
        """Keep the device alive until cancelled, or until a replay ends."""
        try:
            if self._reset is not None:
                self._reset.tick(monotonic_ns(), None)
            await self._live_again_and_again()
            self._set(DeviceState.FINISHED)
        finally:
            if self._wires is not None:
                self._wires.close()
            if self._reset is not None:
                self._reset.close()
            if self._utc is not None:
                self._utc.close()

    def tick(self, now_ns: int) -> None:
        """Ten times a second: states, idle line, events that gathered."""
        self._rate.mark(now_ns, self.ledger.samples)
        if self._wires is not None:
            self._wires.tick(now_ns, self._path.newest if self._path is not None else None)
        if self._reset is not None:
            self._reset.tick(now_ns, None)
        if self._utc is not None:
            self._utc.tick(now_ns, None)
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

    # --- what the kinds of links do in their own way -----------------------------------------------------------------

    @abstractmethod
    def _start(self) -> None:
        """The link is open: start it, and set up what takes what it delivers. Raises LinkError."""

    @abstractmethod
    async def _work(self) -> None:
        """What is to be done while the link lives; ends only with it, or by an error."""

    @abstractmethod
    def _watch_lock(self, path: SamplePath, now_ns: int) -> None:
        """No samples for UNHEARD_NS: say what is heard, and do what can help."""

    @property
    @abstractmethod
    def _where(self) -> str:
        """The link and how it is set, for people."""

    @property
    def _rate_bit_s(self) -> int:
        """Rate of the link in bit/s; 0 where it has none."""
        return 0

    @property
    def _listening(self) -> bool:
        """Whether what comes goes to the device's own codec."""
        return True

    def _change_rate(self, baud: int) -> None:
        """A conversation wants the link to go on at another rate."""
        raise LinkError(f"{self.link.title} has no baud rate to set to {baud}")

    def _end_work(self) -> None:
        """The link ends."""
        return

    def _on_reset(self) -> None:
        """The reset line is about to be pulsed."""
        return

    async def _wait_present(self) -> None:
        await self.link.wait_present()

    # --- the link's life -----------------------------------------------------------------------------------------

    async def _live_again_and_again(self) -> None:
        """Live with the link, and again when it is back; returns at the regular end of a replay."""
        while True:
            try:
                await self._wait_present()
                await self._live()
                return
            except LinkMissing as error:
                self._down(DeviceState.MISSING, str(error))
                await asyncio.sleep(GONE_S)
            except LinkError as error:
                self._down(DeviceState.FAILED, str(error))
                await asyncio.sleep(RETRY_S)

    async def _live(self) -> None:
        """From open to the end of the link; returns at the regular end of a replay. Raises LinkError."""
        self.link.open()
        self._connects += 1
        self._problem = ""
        ended = self._ended = asyncio.get_running_loop().create_future()
        self._start()
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
            self._end_work()
            self.close()
            if self._wires is not None:
                self._wires.stop()
            if self._utc is not None:
                self._utc.stop()
            if self._path is not None:
                self._path.reset()

    def _new_clock(self, driver: Driver, *, byte_ns: int = 0, hold_ns: int = 0) -> SampleClock:
        lines = self.config.lines
        clock = SampleClock(
            self.config.name,
            tick_ns=driver.tick_ns,
            tick_modulus=driver.tick_modulus,
            byte_ns=byte_ns,
            hold_ns=hold_ns,
            bits=driver.time_bits,
            sout=lines.sout.timing if lines is not None and lines.sout is not None else None,
            sin=lines.sin.timing if lines is not None and lines.sin is not None else None,
        )
        if self._clock is not None:
            clock.continue_from(self._clock)
        return clock

    def _path_parts(self, clock: SampleClock) -> tuple[object, ...]:
        """What every `SamplePath` of the device is made of, in its order."""
        return (
            self.config.name, self.device_id, clock, self.ledger,
            self._publish, self._exchange.on_message, self._notices.bad_frame, self._overruns,
        )  # fmt: skip

    # --- who it is -----------------------------------------------------------------------------------------------

    async def _identify(
        self,
        identify: Callable[[], RequestScript[Identity]],
        read_settings: Callable[[], RequestScript[Mapping[str, str]]],
        apply: Callable[[Identity], None],
    ) -> None:
        """Ask who it is and how it is set; a device that does not answer still streams."""
        for attempt in range(1, IDENTIFY_TRIES + 1):
            try:
                identity = await self._exchange.run(identify())
                apply(identity)
                self._learn(identity, await self._exchange.run(read_settings()))
                return
            except CommandError as error:
                log.info("%s: %s (try %d of %d)", self.config.name, error, attempt, IDENTIFY_TRIES)

    def _learn(self, identity: Identity, settings: Mapping[str, str]) -> None:
        self._known.learn(monotonic_ns(), identity, settings)
        if self._wires is not None:
            read = self._driver.alarm_ranges if self._driver is not None else None
            self._wires.set_alarm_ranges(read(settings) if read is not None else None)

    # --- what it can be told -----------------------------------------------------------------------------------------

    @property
    def actions(self) -> Actions:
        """What it can be told to do, by name; while its driver is not known, by its lines only."""
        return {**(self._driver.actions if self._driver is not None else {}), **self._by_lines.rows}

    async def act(self, name: str, arguments: Mapping[str, Any]) -> object:
        """Have it do something, and return the answer. Raises CommandError, TransferError, DeviceRefused, LinkError."""
        action = self.actions.get(name)
        if action is None:
            known = ", ".join(self.actions) or "none" + " while no device is found" * (self._driver is None)
            raise BadArgument(f"{self.config.name}: no action {name[:64]!r}; there are: {known}")
        if name in self._by_lines.rows:
            return await self._by_lines.run(name, arguments)
        if not self._hears_replies:
            raise CommandError(
                f"{self.config.name} is {self.state}: {self._problem or 'it cannot be told anything now'}"
            )
        params = action.arguments(arguments)
        if self._wires is not None:
            self._wires.set_alarm_ranges(None)  # what was read back need not hold any more
        return await self._do(action, params)

    @property
    def _hears_replies(self) -> bool:
        """Whether what it says now goes to its codec."""
        return self.state in (DeviceState.RUNNING, DeviceState.SILENT)

    async def _do(self, action: Action, params: Settings) -> object:
        """Run an action of the driver."""
        return await self._exchange.run(action.script(self._target, params))

    @property
    def _target(self) -> Target:
        """The device as actions see it."""
        options = self.config.options or (self._driver.settings() if self._driver is not None else None)
        return Target(options, self._rate_bit_s)

    # --- the flow ------------------------------------------------------------------------------------------------

    def _on_end(self, error: LinkError | None) -> None:
        if self._ended is not None and not self._ended.done():
            self._ended.set_result(error)

    def _watch_flow(self, path: SamplePath, now_ns: int) -> None:
        quiet_ns = now_ns - max(path.last_sample_ns, path.begun_ns)
        if (self.state is DeviceState.SEARCHING and path.fresh) or (
            self.state is DeviceState.SILENT and quiet_ns < SILENCE_NS
        ):
            self._up(now_ns, path)
        elif self.state is DeviceState.RUNNING and quiet_ns > self._silence_limit_ns():
            self._silent_since_ns = now_ns
            self._down(DeviceState.SILENT, f"no sample for {quiet_ns / NS_PER_S:.1f} s, though the link is there")
        elif self._listening and quiet_ns > UNHEARD_NS:
            self._watch_lock(path, now_ns)

    def _silence_limit_ns(self) -> int:
        expected_hz = self._clock.expected_rate_hz if self._clock is not None else 0.0
        return max(SILENCE_NS, int(5 * NS_PER_S / expected_hz) if expected_hz else 0)

    def _up(self, now_ns: int, path: SamplePath) -> None:
        self._set(DeviceState.RUNNING)
        if self._reset is not None:
            self._reset.found()
        driver = self._driver.name if self._driver else ""
        self._notices.tell(now_ns, EventKind.UP, f"{driver} on {self._where}", driver=driver, baud=self._rate_bit_s)

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
            link=self._where,
            state=self.state,
            problem=self._problem,
            identity=identity_words(self._known.identity),
            settings=dict(self._known.settings),
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
            lines=self._wires.status(self._reset) if self._wires is not None else None,
            utc=self._utc.status() if self._utc is not None else None,
        )
