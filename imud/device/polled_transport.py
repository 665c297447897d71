"""Transport of a polled device: it is identified and set up before it is read, and again whenever it vanished.

MISSING ──bus appears──▶ SEARCHING ──identified, set up, samples──▶ RUNNING ──same bytes for a while──▶ SILENT
   ▲                        ▲                                          │                                   │
   └──────── bus gone ──────┴──── no answer, wrong id, bad frames ─────┴───────────────────────────────────┘

Readings are decoded only between an identification and the first sign that the device is not there any more.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from imud.contracts.codec import Poll, Reading
from imud.contracts.command import Target
from imud.contracts.driver import Identity, PolledDriver, of_kind
from imud.contracts.lines import Edge, LineFactory, ReadyOptions
from imud.contracts.link import OnEnd, PolledLink
from imud.contracts.script import Message
from imud.contracts.status import DeviceState, DeviceStatus, LinesStatus, PollingStatus
from imud.device.health import DeviceEvents
from imud.device.polled_bus import BusMember, Deadlines, PolledBuses, ReadySchedule
from imud.device.transport import UNHEARD_NS, DeviceContext
from imud.drivers import DRIVERS
from imud.lines.watched_line import WatchedLine
from imud.links import LINKS
from imud.model.errors import CommandError, DeviceRefused, ImudError, LinkError, TransferError, Trouble
from imud.model.event import EventKind
from imud.model.options import Options
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock
from imud.sampling.path import PolledPath, PollTiming, ReadyEdges, SamplePath


class DataReady:
    """The data-ready line of one device, an attachment of it. Synchronization: the loop's thread only."""

    def __init__(
        self,
        device: str,
        settings: ReadyOptions,
        lines: LineFactory,
        rate_hz: float,
        notices: DeviceEvents,
        now_ns: Callable[[], int],
    ) -> None:
        """`lines` makes the line; `rate_hz` is that of the reads while no edges come."""
        self._rate_hz = rate_hz
        self._notices = notices
        self._now_ns = now_ns
        line = lines.make_input(_rising(settings), f"{device} data_ready", True)
        self._watched = WatchedLine(line, self._on_edges, self._on_level, self._report, now_ns)
        self.edges = ReadyEdges(settings, round(NS_PER_S / rate_hz))
        """The edges, for the path that dates reads by them."""
        self._member: BusMember | None = None
        self._schedule: ReadySchedule | None = None
        self._watched_fd = -1
        """The line's descriptor while the bus's thread waits for it."""
        self._reported_by_edges = True
        self._closed = False

    # --- the attachment ----------------------------------------------------------------------------------------------

    def start(self, clock: SampleClock) -> None:
        """No-op: `read` begins the reads."""

    def tick(self, now_ns: int, _newest: Sample | None) -> None:
        """Open the line if it is due, and report when edges stopped or came back."""
        if not self._closed:
            self._watched.tick(now_ns)
        by_edges = self._schedule.by_edges if self._schedule is not None else self._reported_by_edges
        if by_edges is not self._reported_by_edges:
            self._reported_by_edges = by_edges
            message = "edges are back: read at them" if by_edges else f"no edges: read at {self._rate_hz:g} Hz instead"
            self._raise_event(message, by_edges=by_edges)

    def stop(self) -> None:
        """Edges cause no more reads; may be called twice."""
        self._unwatch()
        self._member = self._schedule = None

    def close(self) -> None:
        """Release the line; may be called twice."""
        self.stop()
        self._closed = True
        self._watched.close()

    # --- reads -------------------------------------------------------------------------------------------------------

    def read(self, member: BusMember, polls: Sequence[Poll], counts: Deadlines, now_ns: int) -> None:
        """Read the device at its edges from now on; how that succeeds is counted in `counts`."""
        self._unwatch()
        self._watched.tick(now_ns)
        self.edges.restart()
        self._member = member
        self._schedule = ReadySchedule(self._rate_hz, now_ns, counts)
        self._watch()
        member.start(polls, self._schedule)

    def drain(self) -> None:
        """Process the edges that the kernel has."""
        self._watched.drain()

    # --- state -------------------------------------------------------------------------------------------------------

    @property
    def expected_rate_hz(self) -> float:
        """Reads per second as things are."""
        by_edges = self._schedule is not None and self._schedule.by_edges
        return NS_PER_S / self.edges.interval_ns if by_edges else self._rate_hz

    def add_status(self, lines: LinesStatus) -> LinesStatus:
        """Return the status of the device's lines with this one."""
        watched = self._watched
        return msgspec.structs.replace(
            lines,
            problems={**lines.problems, "data_ready": watched.problem} if watched.problem else lines.problems,
            edges={**lines.edges, "data_ready": watched.edges},
            edges_lost={**lines.edges_lost, "data_ready": watched.line.edges_lost},
        )

    def _on_edges(self, edges: Sequence[Edge]) -> None:
        self.edges.on_edges(edges)
        member, schedule = self._member, self._schedule
        if member is not None and schedule is not None:
            times_ns, interval_ns = [edge.t_ns for edge in edges], self.edges.interval_ns
            tell = member.note if schedule.has_read(times_ns[-1]) else member.command
            tell(lambda: schedule.on_edges(times_ns, interval_ns))

    def _on_level(self, active: bool | None) -> None:
        """Follow the line, which was opened, or closed (None); its level adds nothing to the edges."""
        if active is None:
            self._unwatch()
        else:
            self._watch()

    def _watch(self) -> None:
        """Have the bus's thread wait for the line, if it is open and that is possible."""
        member, schedule, fd = self._member, self._schedule, self._watched.line.fileno()
        if member is not None and schedule is not None and self._watched_fd < 0:
            now_ns = self._now_ns
            if member.watch(fd, lambda: schedule.noticed(now_ns())):
                self._watched_fd = fd

    def _unwatch(self) -> None:
        if self._watched_fd >= 0 and self._member is not None:
            self._member.unwatch(self._watched_fd)
        self._watched_fd = -1

    def _report(self, problem: str) -> None:
        self._raise_event(problem)

    def _raise_event(self, message: str, **detail: bool) -> None:
        words = f"line data_ready: {message}"
        self._notices.raise_event(self._now_ns(), EventKind.LINK, words, line="data_ready", **detail)


def _rising(settings: ReadyOptions) -> ReadyOptions:
    """Return settings whose rising edge is the wanted one: of that alone the kernel reports the direction reliably."""
    if settings.edge == "rising":
        return settings
    return msgspec.structs.replace(settings, active_low=not settings.active_low, edge="rising")


log = logging.getLogger(__name__)

RETRY_S = 0.5
"""Pause between two rounds of search."""
TURNS_PERIOD_NS = 200 * NS_PER_MS
"""Time between two reads of a device that is read in turns with others: five of them are no silence."""


@dataclass(frozen=True, slots=True)
class IdentifiedDevice:
    """A device that answered on the bus."""

    driver: PolledDriver
    options: Options
    target: int
    identity: Identity


class PolledTransport:
    """Transport of one device on a polled bus. Synchronization: the event loop's thread only."""

    def __init__(self, context: DeviceContext, link: PolledLink, buses: PolledBuses, ready: DataReady | None) -> None:
        """`buses` is what the devices of a daemon share; `ready` is the device's data-ready line, if it has one."""
        self.link = link
        self.driver: PolledDriver | None = None
        self.path: PolledPath | None = None
        self._config = context.config
        self._context = context
        self._health = context.health
        self._now_ns = context.host.now_ns
        self._buses = buses
        self._ready = ready
        self._member: BusMember | None = None
        self._deadlines = Deadlines()
        self._device: IdentifiedDevice | None = None
        """The device that was read last."""
        self._former: tuple[int, ...] = ()
        """Target of the device before a script moved it: an unsaved address is lost when the device restarts."""
        self._identified = False
        """Whether what is read is that of the identified device."""
        self._gone: asyncio.Future[str] | None = None
        """Completes with why the device must be identified again."""
        self._on_end: OnEnd | None = None
        self._vanished = 0
        self._lost_counted = 0
        self._latency_ns = 0

    # --- the bus's life ----------------------------------------------------------------------------------------------

    async def wait_present(self) -> None:
        """Return when the bus is there."""
        self._health.missing(self._now_ns(), self.link.absence())
        await self.link.wait_present()

    def start(self, on_end: OnEnd) -> None:
        """Join the bus."""
        self._on_end = on_end
        self._health.searching()
        self._member = self._buses.get(self.link.bus).join(self.link, self._deadlines, self._on_readings)
        self._member.set_latency(self.hold_ns)

    async def work(self) -> None:
        """Find, set up and read the device, repeatedly. Ends only with the bus."""
        member, attachments = self._member, self._context.attachments
        assert member is not None
        while True:
            await attachments.reset_settled()
            device = await self._find(member)
            if device is not None and await self._set_up(member, device):
                await self._read(member, device)
                continue
            await asyncio.sleep(RETRY_S)
            await attachments.device_not_found(self._now_ns())

    def stop(self) -> None:
        """Leave the bus, whose thread closes the link; may be called twice."""
        member, self._member = self._member, None
        self._identified = False
        if member is not None:
            member.leave()

    def close(self) -> None:
        """Stop; may be called twice."""
        self.stop()

    # --- the search --------------------------------------------------------------------------------------------------

    async def _find(self, member: BusMember) -> IdentifiedDevice | None:
        """Try all places once; return None when no device is there."""
        problems: list[str] = []
        for driver in self._candidates():
            options = self._config.options or driver.settings()
            for target in self._targets(driver):
                place = self.link.place(target)
                if not member.claim(target):
                    problems.append(f"{place}: another device of this configuration")
                    continue
                try:
                    return IdentifiedDevice(driver, options, target, await member.run(driver.probe(options), target))
                except (TransferError, DeviceRefused) as error:
                    member.release()
                    problems.append(f"{place}: {error}")
                    if isinstance(error, TransferError) and error.trouble is Trouble.STUCK:
                        break  # another try would hold up the other devices of the bus
        self._health.report("; ".join(dict.fromkeys(problems)))
        return None

    async def _set_up(self, member: BusMember, device: IdentifiedDevice) -> bool:
        """Set the device up as configured; return False when that failed."""
        try:
            settings = await member.run(device.driver.set_up(device.options), device.target)
        except (TransferError, DeviceRefused) as error:
            member.release()
            self._health.report(f"{self.link.place(device.target)}: {error}")
            return False
        self._context.identity.update(device.identity, settings)
        return True

    async def _read(self, member: BusMember, device: IdentifiedDevice) -> None:
        """Read until the device is gone. Raises LinkError when its bus is gone."""
        gone = self._gone = asyncio.get_running_loop().create_future()
        path, ready = self._begin(device), self._ready
        if ready is not None:
            ready.read(member, path.codec.polls, self._deadlines, self._now_ns())
        else:
            member.start(path.codec.polls)
        try:
            why = await gone
        finally:
            self._identified = False
            if ready is not None:
                ready.stop()
            member.stop()
            member.release()
        self._vanished += 1
        self._health.down(self._now_ns(), DeviceState.SEARCHING, why)

    def _begin(self, device: IdentifiedDevice) -> PolledPath:
        path = self.path
        if path is None or device.driver is not self.driver:
            path = self._new_path(device)
        path.clock.restart()
        self._device = device
        path.begin(self._now_ns())
        self._identified = True
        self._context.attachments.start(path.clock)
        return path

    def _new_path(self, device: IdentifiedDevice) -> PolledPath:
        context, driver, rate_hz = self._context, device.driver, self.link.rate_hz
        clock = context.new_clock(driver, self.path)
        codec = driver.make_codec(context.ledger, device.options)
        timing = PollTiming(
            round(NS_PER_S / rate_hz) if rate_hz else TURNS_PERIOD_NS,
            driver.update_ns(device.options),
            self._ready.edges if self._ready is not None else None,
        )
        self.driver = driver
        self.path = PolledPath(codec, timing, clock, context.path_context(driver, self.link, _ignore_message))
        context.tap.path_made(self.path, driver.name, device.options)
        return self.path

    def _candidates(self) -> list[PolledDriver]:
        named = self._config.driver != "auto"
        drivers = of_kind([DRIVERS[self._config.driver]] if named else DRIVERS.values(), PolledDriver)
        return [driver for driver in drivers if LINKS[self._config.link].fits(driver)]

    def _targets(self, driver: PolledDriver) -> Sequence[int]:
        """Return where to look, beginning where the device was: a script may have moved it from the given place."""
        given = driver.targets if self.link.target is None else (self.link.target,)
        last = (self._device.target,) if self._device is not None else ()
        return tuple(dict.fromkeys((*last, *self._former, *given)))

    async def run_script(self, make: Callable[[Target], Any]) -> Any:
        """Run a transfer script between two reads; one that changes the device's address is followed."""
        member, device = self._member, self._device
        if member is None or device is None:
            raise CommandError(f"{self._config.name} is not there")
        options = self._config.options or device.driver.settings()
        script = make(Target(options, self.bit_rate, places=self._places(device)))
        return await member.run(script, device.target, self._follow)

    def _places(self, device: IdentifiedDevice) -> tuple[int, ...]:
        given = () if self.link.target is None else (self.link.target,)
        return tuple(dict.fromkeys((device.target, *self._former, *given)))

    async def read_back(self) -> None:
        """Set the device up again as configured, and keep the settings that it reads back.

        One that does not answer is left as it is: it is set up when it returns."""
        member, device = self._member, self._device
        if member is None or device is None or not self._identified:
            return
        try:
            settings = await member.run(device.driver.set_up(device.options), device.target)
        except ImudError as error:
            log.info("%s: settings not read back: %s", self._config.name, error)
            return
        self._context.identity.update(device.identity, settings)

    def _follow(self, target: int) -> None:
        """Follow a script that has given the device another address."""
        member, device = self._member, self._device
        if member is None or device is None or target == device.target:
            return
        self._device, self._former = replace(device, target=target), (device.target,)
        member.release()
        fixed = self.link.target
        if fixed is not None and target != fixed:
            place = self.link.place(target)
            message = f"the device has {place} now: change {self.link.place(fixed)} in the configuration"
            self._context.notices.raise_event(self._now_ns(), EventKind.CONFIGURATION, message)
        if not member.claim(target):
            place = self.link.place(target)
            message = f"the device has {place} now, which another device of this configuration has"
            self._context.notices.raise_event(self._now_ns(), EventKind.CONFIGURATION, message)
            self._identify_again(message)

    # --- the flow ----------------------------------------------------------------------------------------------------

    def set_latency(self, latency_ns: int) -> None:
        """Let readings wait so long; polls keep their deadlines."""
        self._latency_ns = latency_ns
        if self._member is not None:
            self._member.set_latency(self.hold_ns)

    @property
    def hold_ns(self) -> int:
        """How long readings wait, ns: not where fewer than two would, nor where each edge wakes the loop anyhow."""
        rate_hz = self.link.rate_hz
        waits = self._ready is None and rate_hz and self._latency_ns >= 2 * NS_PER_S / rate_hz
        return self._latency_ns if waits else 0

    def _on_readings(self, readings: Sequence[Reading], problem: LinkError | None) -> None:
        """Decode the readings of the bus's thread."""
        path, why = self.path, ""
        if self._ready is not None:
            self._ready.drain()  # all edges before the end of a read are needed to say which of them it belongs to
        if path is not None and self._identified:
            why = path.on_readings(readings)
        elif path is not None:
            for reading in readings:
                path.skip(reading)
        if why or problem is not None:
            self._identified = False
        if problem is not None and self._on_end is not None:
            self._on_end(problem)
        elif why:
            self._identify_again(why)

    def _identify_again(self, why: str) -> None:
        """Stop reading until the device is identified again."""
        self._identified = False
        if self._gone is not None and not self._gone.done():
            self._gone.set_result(why)

    def tick(self, _now_ns: int) -> None:
        """Count deadlines and edges without a read as lost samples."""
        lost = self._missed
        self._context.ledger.lost_queue += lost - self._lost_counted
        self._lost_counted = lost

    def on_no_samples(self, path: SamplePath, now_ns: int) -> None:
        """Report that the device answers, where no sample came since the beginning."""
        if self._health.state is DeviceState.SEARCHING and now_ns - path.begun_ns > UNHEARD_NS:
            self._health.report("the device answers, but no value of it is new: is it held in reset?")

    def on_reset(self) -> None:
        """Identify the device again: its settings are lost."""
        self._identify_again("reset by its line")

    # --- state -------------------------------------------------------------------------------------------------------

    @property
    def where(self) -> str:
        """The bus and the place of the device on it, for people."""
        return f"{self.link.title}, {self.link.place(self._device.target)}" if self._device else self.link.title

    @property
    def bit_rate(self) -> int:
        """Rate of the line in bit/s, the same for all of its devices; 0 on a bus with a clock."""
        return self.link.bit_rate

    @property
    def receiving(self) -> bool:
        """Whether what is read is decoded."""
        return self._identified

    @property
    def hears_replies(self) -> bool:
        """Whether there is a device to talk to before the first sample: before it is identified, there is not."""
        return False

    @property
    def busy(self) -> bool:
        """False: scripts and reads take turns."""
        return False

    def add_status(self, status: DeviceStatus) -> DeviceStatus:
        """Return the status with how reading goes."""
        ready, lines = self._ready, status.lines
        return msgspec.structs.replace(
            status,
            expected_rate_hz=ready.expected_rate_hz if ready is not None else self.link.rate_hz,
            polling=self._polling_status(),
            serial_line=self.link.serial_line(),
            lines=ready.add_status(lines) if ready is not None and lines is not None else lines,
        )

    @property
    def _missed(self) -> int:
        """Deadlines and data-ready edges for which nothing was read."""
        return self._deadlines.missed + (self._ready.edges.missed if self._ready is not None else 0)

    def _polling_status(self) -> PollingStatus:
        path, deadlines = self.path, self._deadlines
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


def _ignore_message(_message: Message, _t_rx_ns: int) -> None:
    """Ignore messages: polled codecs make none, their devices answer to transfers."""
