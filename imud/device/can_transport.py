"""Transport of a device on a CAN bus: the configuration names the driver, or a search finds the device."""

from collections.abc import Callable, Sequence
from random import Random
from typing import Any

from imud.contracts.codec import CanCodec
from imud.contracts.command import Target
from imud.contracts.driver import CanDriver, Identity, of_kind
from imud.contracts.firmware import FirmwareImage, Report
from imud.contracts.link import CanLink, CanUse, OnEnd
from imud.contracts.script import ReplyFrame, Request, RequestScript
from imud.contracts.status import DeviceState
from imud.device.can_search import EVERYTHING, CanDevice, CanFound, CanRound, CanSearch
from imud.device.search import Remembered, RememberedDevice
from imud.device.transport import (
    IDENTIFY_TRIES,
    SILENT_SEARCH_NS,
    UNHEARD_NS,
    DeviceContext,
    ReceivingTransport,
)
from imud.drivers import DRIVERS
from imud.formats.can import CanFilter, CanFrame, CyclicFrame, frame_bits
from imud.model.errors import BadArgument, CommandError, DriverFailed, LinkError
from imud.model.event import EventKind
from imud.model.options import Options, shown
from imud.model.units import NS_PER_S
from imud.sampling.path import CanPath, SamplePath


class CanBuses:
    """Devices of all CAN buses by name. Synchronization: one thread."""

    def __init__(self) -> None:
        self._members: dict[str, CanUse] = {}
        self._loads: dict[str, Callable[[], float]] = {}

    def join(
        self,
        name: str,
        bus: str,
        filters: Sequence[CanFilter],
        cyclic: Sequence[CyclicFrame],
        bits_per_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Add a device with its received frames, the cyclic frames that it needs, and its bus load."""
        self._members[name] = CanUse(bus, filters, cyclic)
        self._loads[name] = bits_per_s

    def leave(self, name: str) -> None:
        """Remove a device. Do nothing for an unknown device."""
        self._members.pop(name, None)
        self._loads.pop(name, None)

    def bits_per_s(self, name: str, bus: str) -> float:
        """Return the bus load of the other devices, bit/s without stuff bits."""
        others = [other for other, member in self._members.items() if other != name and member.bus == bus]
        return sum(self._loads[other]() for other in others)

    def claimed(self, name: str, bus: str) -> Callable[[int, bool], bool]:
        """Return a test whether another device of the bus receives an identifier."""

        def is_claimed(can_id: int, extended: bool) -> bool:
            return any(
                other != name and member.bus == bus and member.receives(can_id, extended)
                for other, member in self._members.items()
            )

        return is_claimed

    def conflict(self, name: str) -> str:
        """Return the conflict with a device that joined before, one sentence; empty if there is none.

        Two devices conflict if they receive the same frames or need the same cyclic frame. The first device continues,
        so that a reload with another device does not stop it.
        """
        mine = self._members.get(name)
        for other, member in self._members.items():
            if other == name or mine is None:
                break
            if both := mine.both_send(member):
                return f"{other} and {name} would both send {both} on {mine.bus}; configure only one of them to send it"
            if both := mine.both_receive(member):
                return (
                    f"{other} and {name} would receive the same device on {mine.bus}, which sends {both}; "
                    "change the options of one of them"
                )
        return ""


class CanTransport(ReceivingTransport):
    """Transport of the frames of one device on a CAN bus. Synchronization: the loop's thread only."""

    link: CanLink
    driver: CanDriver | None
    path: CanPath | None
    has_ticks = True

    def __init__(self, context: DeviceContext, link: CanLink, buses: CanBuses, remembered: Remembered) -> None:
        """All devices of the daemon share `buses`. Raises LinkError if the configured driver is not for CAN."""
        super().__init__(context, remembered)
        self.link = link
        self.driver = self.path = None
        self._buses = buses
        # filters of frames from other senders that can answer the outstanding request
        self._also: Sequence[CanFilter] = ()
        self._filters: Sequence[CanFilter] = ()  # filters of the device's samples and replies
        # the search round that receives the frames; None while the path receives them
        self._round: CanRound | None = None
        self._options: Options | None = None
        self._codec: CanCodec | None = None
        # number of the device that the search found; None if the configuration names the driver
        self._node: int | None = None
        self._joined = False
        self._bus_problem = ""  # present problem of the bus; empty if there is none
        self._is_wide = False  # whether the link passes all frames that the device can send
        self._conflict = ""  # present conflict of two devices with one address; empty without a conflict
        # error of the driver of another package at the start; `wait_present` raises it in the task of the device
        self._start_failure: DriverFailed | None = None
        self._damaged = 0  # counted number of frames that the adapter damaged since the link was opened
        if not self._searchable:
            driver = DRIVERS[self._config.driver]
            if not isinstance(driver, CanDriver):
                raise LinkError(f"{self._config.name}: expected a driver for CAN, got {driver.name}")
            try:
                self._set_up(driver, self._config.options or driver.settings())
            except DriverFailed as error:
                self._start_failure = error

    # --- the link ----------------------------------------------------------------------------------------------------

    async def wait_present(self) -> None:
        """Return when the bus is up. Raises LinkError if another device sends the frames of this device."""
        if self._start_failure is not None:
            raise self._start_failure
        if not self._searchable and not self._joined:
            self._join()
        self._refuse_conflict()
        if reason := self.link.absence():
            self._health.down(self._host.now_ns(), DeviceState.MISSING, reason)
        await self.link.wait_present()

    def start(self, on_end: OnEnd) -> None:
        self._bus_problem = self._conflict = ""
        self._damaged = 0
        self._search.start()
        self.link.start(self._on_frames, self._on_news, on_end)

    def stop(self) -> None:
        self._report_conflict()
        self._search.stop()
        if self._searchable:
            self._leave()
        self.link.close()

    def close(self) -> None:
        """Stop, and leave the bus. A second call does nothing."""
        self.stop()
        self._leave()

    # --- the search --------------------------------------------------------------------------------------------------

    def begin_search(self) -> CanRound | None:
        """Start a search round on all frames of the bus.

        Return None if the configuration names the driver, and set up the device instead.
        """
        if not self._searchable:
            self._begin()
            return None
        name, link, last = self._config.name, self.link, self._remembered.get(self._config.name)
        self._leave()
        if self.path is not None:
            self.path.reset()
            self.path.begin(self._host.now_ns())
        link.filters = EVERYTHING
        link.gather_ns = 0
        search = CanSearch(
            of_kind(DRIVERS.values(), CanDriver),
            self.where,
            claimed=self._buses.claimed(name, link.bus),
            remembered=(last.driver, last.node) if last and last.node is not None else None,
        )
        self._round = CanRound(search, self._context.ledger, self._host)
        self._round.start(self._on_found)
        return self._round

    def _on_found(self, found: CanFound) -> None:
        driver, node = found.device
        if driver is not self.driver or node != self._node:
            self._node = node
            self._set_up(driver, driver.node_settings(node))
        self._join()
        self._remembered.put(self._config.name, RememberedDevice(driver.name, 0, node))
        self._begin()

    def _set_up(self, driver: CanDriver, options: Options) -> None:
        """Create codec, clock and path for a device."""
        if self.path is not None:
            self.path.reset()
        context = self._context
        clock = context.new_clock(driver, self.path)
        self.driver = driver
        self._options = options
        self._filters = driver.filters(options)
        self._codec = driver.make_codec(context.ledger, options)
        self.path = CanPath(self._codec, clock, context.path_context(driver, self.link, self.scripts.on_message, {}))
        context.observer.path_made(self.path, driver.name, options)

    def _begin(self) -> None:
        """Pass the frames to the codec of the device."""
        link, path, driver = self.link, self.path, self.driver
        assert driver is not None
        assert path is not None
        self._round = None
        self._is_wide = False
        self._set_filters(wide=True)
        link.gather_ns = self._latency_ns
        path.clock.restart()
        first = driver.example_frames(Random(0))[0]
        bits = frame_bits(first.extended, len(first.data))
        path.set_frame_time(bits * NS_PER_S // link.bitrate if link.bitrate else 0)
        path.link_opened()
        path.begin(self._host.now_ns())
        self.attachments.start(path.clock)

    # --- other devices of the bus ------------------------------------------------------------------------------------

    def _join(self) -> None:
        driver, path = self.driver, self.path
        assert driver is not None
        assert path is not None
        cyclic = driver.cyclic(self._options) if self.link.writable else ()
        bits = sum(frame_bits(one.extended, len(one.data)) for one in driver.example_frames(Random(0)))
        self._buses.join(
            self._config.name, self.link.bus, self._filters, cyclic, lambda: bits * path.clock.expected_rate_hz
        )
        self._joined = True

    def _leave(self) -> None:
        if self._joined:
            self._joined = False
            self._buses.leave(self._config.name)

    def _refuse_conflict(self) -> None:
        if conflict := self._buses.conflict(self._config.name):
            raise LinkError(conflict)

    # --- requests ----------------------------------------------------------------------------------------------------

    async def ask(self) -> None:
        """Send the cyclic frames, and query identity and settings, if the configuration allows it.

        Raises LinkError if another device already sends the cyclic frames.
        """
        self._refuse_conflict()
        driver, options = self.driver, self._options
        if driver is None or not self.link.writable:
            return
        if frames := driver.cyclic(options):
            self.link.send_cyclic(frames)
        await self._identify(IDENTIFY_TRIES)

    def _identity_script(self) -> RequestScript[Identity] | None:
        return self.driver.identify(self._options) if self.driver is not None else None

    def _apply(self, identity: Identity) -> None:
        if self.driver is not None and self._codec is not None:
            self.driver.apply_identity(self._codec, identity)
            self._context.observer.codec_changed()

    def follow(self, request: Request) -> None:
        """Follow a script that has given the device another number: change the filters and create a new codec."""
        driver, options = self.driver, request.settings
        if driver is None or options == self._options:
            return
        self._leave()
        self._set_up(driver, options)
        self._join()
        self._node = None  # the next search sets it
        self._begin()
        if not self._searchable and options != (self._config.options or driver.settings()):
            message = f"the device has a new number: change {_changed(self._config.options, options)}"
            self._context.events.raise_event(self._host.now_ns(), EventKind.CONFIGURATION, message)

    def listen(self, request: Request, filters: Sequence[CanFilter]) -> None:
        """Receive frames of other senders too, while they can answer the request."""
        self._also = filters
        if self._round is None:
            self._set_filters(wide=self._is_wide)

    def _set_filters(self, *, wide: bool) -> None:
        """Receive the frames of the device. `wide`: also frames of unknown types, to name them."""
        driver, codec = self.driver, self._codec
        if driver is None or codec is None:
            return
        if wide and not self._is_wide:
            codec.unknown.clear()
        self._is_wide = wide
        passed = driver.sent_by(self._options) if wide else self._filters
        self.link.filters = (*passed, *self._also)

    async def run_script(self, make: Callable[..., Any], *arguments: Any) -> Any:
        """Run a request script. Follow the device if the script changes its number."""
        others = self._buses.bits_per_s(self._config.name, self.link.bus)
        self.target = Target(self._options, self.bit_rate, other_bits_per_s=others)
        return await self.scripts.run(make(self.target, *arguments))

    async def run_firmware(self, image: FirmwareImage, report: Report) -> None:
        """Write an image. The codec of the driver returns the replies of the boot loader."""
        last = self._remembered.get(self._config.name)
        if not self.receiving and last is not None and last.node is not None:
            found = DRIVERS.get(last.driver)
            if isinstance(found, CanDriver):  # a device in its boot loader sends nothing: no search ends
                self._search.end_with(CanFound(CanDevice(found, last.node)))
        driver, name = self.driver, self._config.name
        if driver is None or not self.receiving:
            raise CommandError(f"{name}: expected a known driver, got a running search; set `driver` of {name}")
        if driver.firmware is None:
            raise BadArgument(f"{name}: {driver.name} has no firmware update")
        await self.run_script(driver.firmware.update, image, report)

    # --- the samples -------------------------------------------------------------------------------------------------

    def set_latency(self, latency_ns: int) -> None:
        self._latency_ns = latency_ns
        self.on_busy(self.busy)

    def on_busy(self, busy: bool) -> None:
        """Hold no frames while a request waits for a reply, or during a search."""
        self.busy = busy
        self.link.gather_ns = 0 if busy or self._round is not None else self._latency_ns

    @property
    def hold_ns(self) -> int:
        return self.link.gather_ns

    def _on_frames(self, frames: Sequence[CanFrame]) -> None:
        if self._round is not None:
            self._round.on_frames(frames)
        elif self.path is not None:
            self.path.on_frames([one for one in frames if not self._is_foreign(one)] if self._is_wide else frames)
        if self._also:
            self._answer(frames)

    def _is_foreign(self, frame: CanFrame) -> bool:
        """Return whether only another configured device receives a frame."""
        at = frame.can_id, frame.extended
        is_own = any(one.matches(*at) for one in self._filters)
        return not is_own and self._buses.claimed(self._config.name, self.link.bus)(*at)

    def _answer(self, frames: Sequence[CanFrame]) -> None:
        for frame in frames:
            if any(wanted.matches(frame.can_id, frame.extended) for wanted in self._also):
                self.scripts.on_message(ReplyFrame(frame.can_id, frame.data), frame.t_rx_ns)

    def tick(self, now_ns: int) -> None:
        if self._is_wide and self._round is None and self._health.state is DeviceState.RUNNING:
            self._set_filters(wide=False)
        if self.path is not None and self._round is None:
            self._count_damaged(self.path)
        self._report_conflict()

    def _count_damaged(self, path: CanPath) -> None:
        """Count frames that arrived damaged from the adapter. Their sender is unknown: a sample may be lost."""
        framing = self.link.kernel_counters().framing
        count = framing - self._damaged
        self._damaged = framing
        for _ in range(count):
            self._context.ledger.add_unknown_gap()
        if count and path.observer is not None:
            path.observer.call("ledger", "set", self._context.ledger.snapshot())

    def _report_conflict(self) -> None:
        """Report the start and the end of a conflict of two devices with one address."""
        conflict = self._codec.problem if self._codec is not None and self._round is None else ""
        if bool(conflict) is not bool(self._conflict):
            self._conflict = conflict
            self._on_news(conflict or "all frames are from one device again", self._bus_problem)

    def _on_news(self, news: str, problem: str) -> None:
        """Report a change of the bus state, or of a conflict."""
        self._bus_problem = problem
        problems = "; ".join(filter(None, (problem, self._conflict)))
        self._health.on_link_news(self._host.now_ns(), news, problems)

    def on_no_samples(self, path: SamplePath, now_ns: int) -> None:
        """Report the received frames, and search again after a long silence."""
        health, driver = self._health, self.driver
        since_ns = health.silent_since_ns if health.state is DeviceState.SILENT else path.begun_ns
        if words := self.loader_words(path):
            health.report(words)
            return
        if self._searchable and not self.busy and now_ns - since_ns > SILENT_SEARCH_NS:
            self._search.search_again()
        if driver is None or self._round is not None or now_ns - since_ns <= UNHEARD_NS:
            return
        if not self._is_wide:
            self._set_filters(wide=True)
        if words := self.unknown_words():
            health.report(f"on {self.where}: {words}")
        elif health.state is not DeviceState.SEARCHING:
            return
        elif path.last_data_ns > path.begun_ns:
            words = self._context.events.wrong_length_words()
            what = f"; {words}" if words else ""
            health.report(f"frames of {driver.name} arrive on {self.where}, but no complete sample{what}")
        else:
            health.report(f"no frame of {driver.name} arrives on {self.where}; check its identifier")

    # --- state -------------------------------------------------------------------------------------------------------

    @property
    def where(self) -> str:
        """Name of the bus and its bit rate."""
        return f"{self.link.title} at {self.link.bitrate // 1000} kbit/s" if self.link.bitrate else self.link.title

    @property
    def bit_rate(self) -> int:
        """Bit rate of the bus, bit/s; 0 if it is unknown."""
        return self.link.bitrate

    @property
    def receiving(self) -> bool:
        return self._round is None

    @property
    def hears_replies(self) -> bool:
        """Whether a codec exists. If the driver is configured, imud can thus start the output of a silent device."""
        return self.path is not None

    @property
    def _searchable(self) -> bool:
        return self._config.driver == "auto"


def _changed(before: Options | None, after: Options) -> str:
    """Return the changed options, for example `options.node to 9 in the configuration`."""
    given = before if before is not None else type(after)()
    names = [name for name in type(after).__struct_fields__ if getattr(given, name) != getattr(after, name)]
    return ", ".join(f"options.{name} to {shown(getattr(after, name))}" for name in names) + " in the configuration"
