"""A device on a bus that is polled: identified and set up before it is read, and again whenever it vanished.

MISSING ──bus appears──▶ SEARCHING ──identified, set up, samples──▶ RUNNING ──same bytes for a while──▶ SILENT
   ▲                        ▲                                          │                                   │
   └──────── bus gone ──────┴──── no answer, wrong id, bad frames ─────┴───────────────────────────────────┘

Bytes are believed only between an identification and the first sign that the device is not there any more.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec

from imud.config import DeviceConfig
from imud.contracts.action import Action
from imud.contracts.driver import Identity, of_kind
from imud.contracts.lines import LineFactory
from imud.contracts.link import PolledLink
from imud.contracts.polling import PolledDriver, Reading
from imud.contracts.publisher import Batch
from imud.contracts.settings import Settings
from imud.contracts.status import DeviceState, DeviceStatus, PollingStatus
from imud.devices import DRIVERS
from imud.errors import CommandError, DeviceRefused, LinkError, TransferError, Trouble
from imud.event import Event
from imud.links import LINKS
from imud.runtime.device import RETRY_S, SILENCE_NS, UNHEARD_NS, Device
from imud.runtime.path import SamplePath
from imud.runtime.polled.bus import Buses, Member
from imud.runtime.polled.data_ready import DataReady
from imud.runtime.polled.path import PolledPath
from imud.runtime.polled.schedule import Deadlines
from imud.signals.gpio import GPIO_LINES
from imud.units import NS_PER_S


@dataclass(frozen=True, slots=True)
class PolledFound:
    """What was found on the bus."""

    driver: PolledDriver
    options: Settings
    target: int
    identity: Identity


class PolledRunner(Device):
    """Owns one device on a polled bus. Synchronization: the event loop's thread only."""

    link: PolledLink

    def __init__(
        self,
        config: DeviceConfig,
        device_id: int,
        publish: Callable[[Batch], None],
        tell: Callable[[Event], None],
        buses: Buses,
        lines: LineFactory = GPIO_LINES,
    ) -> None:
        super().__init__(config, device_id, publish, tell, LINKS[config.link].make_polled(config.link_settings), lines)
        self._ready: DataReady | None = None
        if config.lines is not None and config.lines.data_ready is not None:
            settings, rate_hz = config.lines.data_ready, self.link.rate_hz
            self._ready = DataReady(config.name, settings, lines, rate_hz, self._notices)
        self._buses = buses
        self._member: Member | None = None
        self._deadlines = Deadlines()
        self._found: PolledFound | None = None
        self._polled: PolledPath | None = None
        self._believed = False
        self._gone: asyncio.Future[str] | None = None
        self._vanished = 0
        self._lost_counted = 0

    async def run(self) -> None:
        """Keep the device alive until cancelled."""
        try:
            await super().run()
        finally:
            if self._ready is not None:
                self._ready.close()

    def tick(self, now_ns: int) -> None:
        """Ten times a second: as every device, and deadlines and edges without a read become lost samples."""
        if self._ready is not None:
            self._ready.tick(now_ns)
        lost = self._missed
        self.ledger.lost_queue += lost - self._lost_counted
        self._lost_counted = lost
        super().tick(now_ns)

    def close(self) -> None:
        """Leave the bus, whose thread closes the link; may be called twice."""
        member, self._member = self._member, None
        self._believed = False
        if member is not None:
            member.leave()

    def status(self) -> DeviceStatus:
        """Everything there is to say of the device now."""
        status = super().status()
        return msgspec.structs.replace(
            status,
            expected_rate_hz=self._ready.expected_rate_hz if self._ready is not None else self.link.rate_hz,
            polling=self._polling_status(),
            serial_line=self.link.serial_line(),
            lines=self._ready.told(status.lines) if self._ready is not None and status.lines else status.lines,
        )

    # --- the bus's life ----------------------------------------------------------------------------------------------

    def _start(self) -> None:
        self._set(DeviceState.SEARCHING)
        bus = self._buses.get(self.link.bus)
        self._member = bus.join(self.link, self._deadlines, self._take)

    async def _work(self) -> None:
        """Find, set up, read; and again. Ends only with the bus."""
        member = self._member
        assert member is not None
        while True:
            if self._reset is not None:
                await self._reset.settled()
            found = await self._find(member)
            if found is not None and await self._set_up(member, found):
                await self._read(member, found)
                continue
            await asyncio.sleep(RETRY_S)
            if self._reset is not None:
                await self._reset.not_found(self._buses.now_ns())

    async def _find(self, member: Member) -> PolledFound | None:
        """One round of search; None when nothing is there."""
        problems: list[str] = []
        for driver in self._candidates():
            options = self.config.options or driver.settings()
            for target in self._targets(driver):
                place = self.link.place(target)
                if not member.claim(target):
                    problems.append(f"{place}: another device of this configuration")
                    continue
                try:
                    return PolledFound(driver, options, target, await member.talk(driver.probe(options), target))
                except (TransferError, DeviceRefused) as error:
                    member.release()
                    problems.append(f"{place}: {error}")
                    if isinstance(error, TransferError) and error.trouble is Trouble.STUCK:
                        break  # another try would hold up the other devices of the bus
        self._complain("; ".join(dict.fromkeys(problems)))
        return None

    async def _set_up(self, member: Member, found: PolledFound) -> bool:
        """Make the device what the configuration says; False when that failed."""
        try:
            settings = await member.talk(found.driver.set_up(found.options), found.target)
        except (TransferError, DeviceRefused) as error:
            member.release()
            self._complain(f"{self.link.place(found.target)}: {error}")
            return False
        self._learn(found.identity, settings)
        return True

    async def _read(self, member: Member, found: PolledFound) -> None:
        """Read until the device is gone. Raises LinkError when its bus is."""
        gone = self._gone = asyncio.get_running_loop().create_future()
        path = self._begin(found)
        if self._ready is not None:
            self._ready.start(member, path.codec.polls, self._deadlines, self._buses.now_ns())
        else:
            member.start(path.codec.polls)
        try:
            why = await gone
        finally:
            self._believed = False
            if self._ready is not None:
                self._ready.rest()
            member.rest()
            member.release()
        self._vanished += 1
        self._down(DeviceState.SEARCHING, why)

    def _begin(self, found: PolledFound) -> PolledPath:
        path = self._polled
        if path is None or self._clock is None or found.driver is not self._driver:
            self._driver = found.driver
            self._clock = self._new_clock(found.driver)
            codec = found.driver.make_codec(self.ledger, found.options)
            period_ns, update_ns = self._period_ns, found.driver.update_ns(found.options)
            path = PolledPath(codec, period_ns, update_ns, self._buses.now_ns, *self._path_parts(self._clock))
            path.edges = self._ready.edges if self._ready is not None else None
            self._path = self._polled = path
        self._clock.restart()
        self._found = found
        path.begin(self._buses.now_ns())
        self._believed = True
        return path

    def _candidates(self) -> list[PolledDriver]:
        named = self.config.driver != "auto"
        drivers = of_kind([DRIVERS[self.config.driver]] if named else DRIVERS.values(), PolledDriver)
        return [driver for driver in drivers if LINKS[self.config.link].fits(driver)]

    def _targets(self, driver: PolledDriver) -> Sequence[int]:
        """Where to look, beginning where it was."""
        if self.link.target is not None:
            return (self.link.target,)
        last = (self._found.target,) if self._found is not None else ()
        return tuple(dict.fromkeys((*last, *driver.targets)))

    async def _do(self, action: Action, params: Settings) -> object:
        """Run an action of the driver between two reads."""
        member, found = self._member, self._found
        if member is None or found is None:
            raise CommandError(f"{self.config.name} is not there")
        return await member.talk(action.script(self._target, params), found.target)

    # --- the flow ----------------------------------------------------------------------------------------------------

    def _take(self, readings: Sequence[Reading], problem: LinkError | None) -> None:
        """What the bus's thread hands over."""
        path = self._polled
        if self._ready is not None:
            self._ready.watched.drain()  # which edge a read belongs to is told by all that came before its end
        why = ""
        if path is not None and self._believed:
            why = path.on_readings(readings)
        elif path is not None:
            for reading in readings:
                path.disbelieve(reading)
        if why or problem is not None:
            self._believed = False
        if problem is not None:
            self._on_end(problem)
        elif why:
            self._leave_it(why)

    def _on_reset(self) -> None:
        self._believed = False
        self._leave_it("reset by its line")

    def _leave_it(self, why: str) -> None:
        """Read no more before it is identified again."""
        if self._gone is not None and not self._gone.done():
            self._gone.set_result(why)

    def _watch_flow(self, path: SamplePath, now_ns: int) -> None:
        if self._believed:
            super()._watch_flow(path, now_ns)

    def _watch_lock(self, path: SamplePath, now_ns: int) -> None:
        if self.state is DeviceState.SEARCHING and now_ns - path.begun_ns > UNHEARD_NS:
            self._complain("the device answers, but no value of it is new: is it held in reset?")

    def _silence_limit_ns(self) -> int:
        return max(SILENCE_NS, 5 * self._period_ns)

    @property
    def _missed(self) -> int:
        """Deadlines and data-ready edges for which nothing was read."""
        return self._deadlines.missed + (self._ready.edges.missed if self._ready is not None else 0)

    @property
    def _period_ns(self) -> int:
        """Time between two reads; the longest that is no silence where the link has no rate."""
        return round(NS_PER_S / self.link.rate_hz) if self.link.rate_hz else SILENCE_NS // 5

    @property
    def _where(self) -> str:
        return f"{self.link.title}, {self.link.place(self._found.target)}" if self._found else self.link.title

    def _polling_status(self) -> PollingStatus:
        path, deadlines = self._polled, self._deadlines
        return PollingStatus(
            polls=deadlines.polls,
            late=deadlines.late,
            missed=self._missed,
            stale=path.codec.stale if path else 0,
            failed=path.failed if path else 0,
            vanished=self._vanished,
            late_mean_ns=deadlines.sum_late_ns // deadlines.polls if deadlines.polls else 0,
            late_worst_ns=deadlines.worst_ns,
            late_sum_ns=deadlines.sum_late_ns,
        )
