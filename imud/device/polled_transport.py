"""Transport of a polled device: imud identifies the device and sets it up before it reads samples.

MISSING ──bus appears──▶ SEARCHING ──identified, set up, samples──▶ RUNNING ──same bytes for a while──▶ SILENT
   ▲                        │                                          │                                   │
   └──────── bus missing ───┴──── no reply, wrong id, bad frames ──────┴───────────────────────────────────┘

The path decodes readings only between an identification and the first sign that the device is missing.
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
from imud.device.attachments import Attachments
from imud.device.health import DeviceEvents
from imud.device.polled_bus import BusMember, PolledBuses
from imud.device.settings import DeviceSettings
from imud.device.timetable import Deadlines, ReadySchedule
from imud.device.transport import UNHEARD_NS, DeviceContext, Transport
from imud.drivers import DRIVERS
from imud.host.clock import HostClock
from imud.lines.watched_line import WatchedLine
from imud.links import LINKS
from imud.model.errors import CommandError, DeviceRefused, LinkError, TransferError, Trouble
from imud.model.event import EventKind
from imud.model.options import Options
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock
from imud.sampling.path import PolledPath, PollTiming, ReadyEdges, SamplePath

log = logging.getLogger(__name__)

RETRY_S = 0.5  # pause between two search rounds, s
TURNS_PERIOD_NS = 200 * NS_PER_MS
"""Assumed period of a device that shares a bus by turns, ns: five missing readings make the device silent."""


class DataReady:
    """Data-ready line of one device: an attachment that starts a read at each edge. Synchronization: the loop's thread
    only."""

    def __init__(
        self, device: str, settings: ReadyOptions, lines: LineFactory, rate_hz: float, events: DeviceEvents,
        host: HostClock,
    ) -> None:  # fmt: skip
        """`rate_hz` is the rate of the reads while no edge arrives."""
        self._rate_hz = rate_hz
        self._events = events
        self._host = host
        line = lines.make_input(_rising(settings), f"{device} data_ready", True)
        self._watched = WatchedLine(line, "data_ready", self, host)
        self.edges = ReadyEdges(settings, round(NS_PER_S / rate_hz))
        """Edges for the path, which time-stamps the readings with them."""
        self._member: BusMember | None = None
        self._schedule: ReadySchedule | None = None
        self._watched_fd = -1  # descriptor of the line while the thread of the bus waits for it
        self._reported_by_edges = True
        self._closed = False

    # --- the attachment ----------------------------------------------------------------------------------------------

    def start(self, clock: SampleClock) -> None:
        """Do nothing: `read` starts the reads."""

    def tick(self, now_ns: int, _newest: Sample | None) -> None:
        """Open the line if this is due. Report if edges stop or return."""
        if not self._closed:
            self._watched.tick(now_ns)
        by_edges = self._schedule.by_edges if self._schedule is not None else self._reported_by_edges
        if by_edges is not self._reported_by_edges:
            self._reported_by_edges = by_edges
            message = (
                "edges have returned: imud reads at each edge"
                if by_edges
                else f"no edges: imud reads at {self._rate_hz:g} Hz"
            )
            self._raise_event(message, by_edges=by_edges)

    def stop(self) -> None:
        self._unwatch()
        self._member = self._schedule = None

    def close(self) -> None:
        self.stop()
        self._closed = True
        self._watched.close()

    # --- reads -------------------------------------------------------------------------------------------------------

    def read(self, member: BusMember, polls: Sequence[Poll], counts: Deadlines, now_ns: int) -> None:
        """Start to read the device at its edges. `counts` counts the reads."""
        self._unwatch()
        self._watched.tick(now_ns)
        self.edges.restart()
        self._member = member
        self._schedule = ReadySchedule(self._rate_hz, now_ns, counts)
        self._watch()
        member.start(polls, self._schedule)

    def drain(self) -> None:
        """Process the edges in the buffer of the kernel."""
        self._watched.drain()

    # --- state -------------------------------------------------------------------------------------------------------

    @property
    def expected_rate_hz(self) -> float:
        """Present rate of the reads, Hz."""
        by_edges = self._schedule is not None and self._schedule.by_edges
        return NS_PER_S / self.edges.interval_ns if by_edges else self._rate_hz

    def add_status(self, lines: LinesStatus) -> LinesStatus:
        """Return the status of the lines with the status of this line."""
        watched = self._watched
        return msgspec.structs.replace(
            lines,
            problems={**lines.problems, "data_ready": watched.problem} if watched.problem else lines.problems,
            edges={**lines.edges, "data_ready": watched.edges},
            edges_lost={**lines.edges_lost, "data_ready": watched.line.edges_lost},
        )

    def on_edges(self, _key: str, edges: Sequence[Edge]) -> None:
        self.edges.on_edges(edges)
        member, schedule = self._member, self._schedule
        if member is not None and schedule is not None:
            times_ns, interval_ns = [edge.t_ns for edge in edges], self.edges.interval_ns
            # an edge that a read already covers needs no wake-up of the thread
            run = member.note if schedule.has_read(times_ns[-1]) else member.command
            run(lambda: schedule.on_edges(times_ns, interval_ns))

    def on_level(self, _key: str, active: bool | None) -> None:
        """Follow the line: imud has opened it, or closed it (None)."""
        if active is None:
            self._unwatch()
        else:
            self._watch()

    def _watch(self) -> None:
        """Let the thread of the bus wait for the line, if the line has a descriptor."""
        member, schedule, fd = self._member, self._schedule, self._watched.line.fileno()
        if member is not None and schedule is not None and self._watched_fd < 0:
            now_ns = self._host.now_ns
            if member.watch(fd, lambda: schedule.noticed(now_ns())):
                self._watched_fd = fd

    def _unwatch(self) -> None:
        if self._watched_fd >= 0 and self._member is not None:
            self._member.unwatch(self._watched_fd)
        self._watched_fd = -1

    def on_line_report(self, _key: str, message: str) -> None:
        self._raise_event(message)

    def _raise_event(self, message: str, **detail: bool) -> None:
        words = f"line data_ready: {message}"
        self._events.raise_event(self._host.now_ns(), EventKind.LINK, words, line="data_ready", **detail)


def _rising(settings: ReadyOptions) -> ReadyOptions:
    """Return settings that wait for the rising edge: the kernel reports only its direction reliably."""
    if settings.edge == "rising":
        return settings
    return msgspec.structs.replace(settings, active_low=not settings.active_low, edge="rising")


@dataclass(frozen=True, slots=True)
class IdentifiedDevice:
    """A device that replied on the bus."""

    driver: PolledDriver
    options: Options
    target: int  # address or chip select of the device
    identity: Identity


class PolledTransport(Transport):
    """Transport of one device on a polled bus. Synchronization: the loop's thread only."""

    link: PolledLink
    is_polled = has_ticks = True
    driver: PolledDriver | None
    path: PolledPath | None

    def __init__(self, context: DeviceContext, link: PolledLink, buses: PolledBuses) -> None:
        """All devices of the daemon share `buses`."""
        super().__init__(context)
        self.link = link
        self.driver = self.path = None
        self._buses = buses
        config, host, ready = context.config, context.host, None
        if config.lines is not None and config.lines.data_ready is not None:
            options = config.lines.data_ready
            ready = DataReady(config.name, options, context.lines, link.rate_hz, context.events, host)
        self._ready: DataReady | None = ready
        self._member: BusMember | None = None
        self._deadlines = Deadlines()
        self._device: IdentifiedDevice | None = None  # the device that imud read last
        # Target of the device before a script changed it. The device loses an unsaved address at a restart.
        self._former: tuple[int, ...] = ()
        self._identified = False  # whether the readings belong to the identified device
        self._gone: asyncio.Future[str] | None = None  # completes with the reason for another identification
        self._on_end: OnEnd | None = None
        self._vanished = 0
        self._lost_counted = 0

    def serve(self, attachments: Attachments, settings: DeviceSettings) -> None:
        """Set the other parts of the device, and add the data-ready line."""
        super().serve(attachments, settings)
        if self._ready is not None:
            attachments.add(self._ready)

    # --- the link ----------------------------------------------------------------------------------------------------

    def start(self, on_end: OnEnd) -> None:
        self._on_end = on_end
        self._health.searching()
        self._member = self._buses.get(self.link.bus).join(self.link, self._deadlines, self._on_readings)
        self._member.set_latency(self.hold_ns)

    async def work(self) -> None:
        member = self._member
        assert member is not None
        while True:
            await self.attachments.reset_settled()
            device = await self._find(member)
            if device is not None and await self._set_up(member, device):
                await self._read(member, device)
                continue
            await asyncio.sleep(RETRY_S)
            await self.attachments.device_not_found(self._host.now_ns())

    def stop(self) -> None:
        """Leave the bus; its thread closes the link. A second call does nothing."""
        member, self._member = self._member, None
        self._identified = False
        if member is not None:
            member.leave()

    # --- the search --------------------------------------------------------------------------------------------------

    async def _find(self, member: BusMember) -> IdentifiedDevice | None:
        """Probe all targets once; return None if no device replies."""
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
                        break  # another probe would delay the other devices of the bus
        self._health.report("; ".join(dict.fromkeys(problems)))
        return None

    async def _set_up(self, member: BusMember, device: IdentifiedDevice) -> bool:
        """Set up the device as configured; return whether this succeeded."""
        try:
            reports = await member.run(device.driver.set_up(device.options), device.target)
        except (TransferError, DeviceRefused) as error:
            member.release()
            self._health.report(f"{self.link.place(device.target)}: {error}")
            return False
        self.settings.update_identity(device.identity)
        self.settings.update(reports)
        return True

    async def _read(self, member: BusMember, device: IdentifiedDevice) -> None:
        """Read the device until it is missing. Raises LinkError if the bus is missing."""
        gone = self._gone = asyncio.get_running_loop().create_future()
        path, ready = self._begin(device), self._ready
        if ready is not None:
            ready.read(member, path.codec.polls, self._deadlines, self._host.now_ns())
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
        self._health.down(self._host.now_ns(), DeviceState.SEARCHING, why)

    def _begin(self, device: IdentifiedDevice) -> PolledPath:
        path = self.path
        if path is None or device.driver is not self.driver:
            path = self._new_path(device)
        path.clock.restart()
        self._device = device
        path.begin(self._host.now_ns())
        self._identified = True
        self.attachments.start(path.clock)
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
        self.path = PolledPath(codec, timing, clock, context.path_context(driver, self.link, _ignore_message, {}))
        context.observer.path_made(self.path, driver.name, device.options)
        return self.path

    def _candidates(self) -> list[PolledDriver]:
        named = self._config.driver != "auto"
        drivers = of_kind([DRIVERS[self._config.driver]] if named else DRIVERS.values(), PolledDriver)
        return [driver for driver in drivers if LINKS[self._config.link].fits(driver)]

    def _targets(self, driver: PolledDriver) -> Sequence[int]:
        """Return the targets to probe. The last target is first, because a script can have changed the address."""
        given = driver.targets if self.link.target is None else (self.link.target,)
        last = (self._device.target,) if self._device is not None else ()
        return tuple(dict.fromkeys((*last, *self._former, *given)))

    # --- requests ----------------------------------------------------------------------------------------------------

    async def run_script(self, make: Callable[..., Any], *arguments: Any) -> Any:
        """Run a transfer script between two reads. Follow the device if the script changes its address."""
        member, device = self._member, self._device
        if member is None or device is None:
            raise CommandError(f"{self._config.name}: the device is missing")
        options = self._config.options or device.driver.settings()
        self.target = Target(options, self.bit_rate, places=self._places(device))
        return await member.run(make(self.target, *arguments), device.target, self._follow)

    def _places(self, device: IdentifiedDevice) -> tuple[int, ...]:
        given = () if self.link.target is None else (self.link.target,)
        return tuple(dict.fromkeys((device.target, *self._former, *given)))

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
            self._context.events.raise_event(self._host.now_ns(), EventKind.CONFIGURATION, message)
        if not member.claim(target):
            place = self.link.place(target)
            message = f"the device has {place} now, which another device of this configuration has"
            self._context.events.raise_event(self._host.now_ns(), EventKind.CONFIGURATION, message)
            self._identify_again(message)

    # --- the samples -------------------------------------------------------------------------------------------------

    def set_latency(self, latency_ns: int) -> None:
        self._latency_ns = latency_ns
        if self._member is not None:
            self._member.set_latency(self.hold_ns)

    @property
    def hold_ns(self) -> int:
        """Present hold of the readings, ns; 0 if a hold contains one reading, or if each edge wakes the loop."""
        rate_hz = self.link.rate_hz
        waits = self._ready is None and rate_hz and self._latency_ns >= 2 * NS_PER_S / rate_hz
        return self._latency_ns if waits else 0

    def _on_readings(self, readings: Sequence[Reading], problem: LinkError | None) -> None:
        """Decode the readings of the bus's thread."""
        path, why = self.path, ""
        if self._ready is not None:
            self._ready.drain()  # the path needs all edges before the end of a read to assign the reading to an edge
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
        """Stop reading until imud has identified the device again."""
        self._identified = False
        if self._gone is not None and not self._gone.done():
            self._gone.set_result(why)

    def tick(self, now_ns: int) -> None:
        """Count deadlines and edges without a read as lost samples."""
        lost = self._missed
        self._context.ledger.lost_queue += lost - self._lost_counted
        self._lost_counted = lost

    def on_no_samples(self, path: SamplePath, now_ns: int) -> None:
        """Report that the device replies but has sent no new sample since its identification."""
        if self._health.state is DeviceState.SEARCHING and now_ns - path.begun_ns > UNHEARD_NS:
            self._health.report("the device replies, but its values do not change; check its reset line")

    def on_reset(self) -> None:
        """Identify the device again: a reset loses its settings."""
        self._identify_again("reset by its line")

    # --- state -------------------------------------------------------------------------------------------------------

    @property
    def where(self) -> str:
        """Name of the bus and address of the device."""
        return f"{self.link.title}, {self.link.place(self._device.target)}" if self._device else self.link.title

    @property
    def bit_rate(self) -> int:
        """Bit rate of the bus, bit/s, which all of its devices share; 0 on a bus with a clock line."""
        return self.link.bit_rate

    @property
    def receiving(self) -> bool:
        return self._identified

    @property
    def hears_replies(self) -> bool:
        """False: imud can run scripts only after the identification, and samples follow immediately."""
        return False

    def add_status(self, status: DeviceStatus) -> DeviceStatus:
        """Return `status` with the state of the reads."""
        return msgspec.structs.replace(status, polling=self._polling_status(), serial_line=self.link.serial_line())

    def add_lines(self, status: LinesStatus | None) -> LinesStatus | None:
        """Return the status of the lines with the data-ready line."""
        return self._ready.add_status(status) if self._ready is not None and status is not None else status

    @property
    def expected_rate_hz(self) -> float:
        """Present rate of the reads, Hz."""
        return self._ready.expected_rate_hz if self._ready is not None else self.link.rate_hz

    @property
    def _missed(self) -> int:
        """Number of deadlines and edges without a read."""
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
    """Ignore a message. The codec of a polled device makes none, because the device replies to transfers."""
