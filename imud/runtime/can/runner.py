"""A device on a CAN bus: its driver is named, or found by listening to the bus; its frames are those of its filters."""

import asyncio
from collections.abc import Callable, Sequence
from random import Random
from time import monotonic_ns
from typing import Any

from imud.config import DeviceConfig
from imud.contracts.action import Target
from imud.contracts.can import CanCodec, CanDriver
from imud.contracts.driver import Identity, of_kind
from imud.contracts.link import CanLink
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceState
from imud.devices import DRIVERS
from imud.errors import LinkError, NothingHeard
from imud.event import Event, EventKind
from imud.formats.can import CanFrame, frame_bits
from imud.links import LINKS
from imud.runtime.can.buses import CanBuses
from imud.runtime.detection import CanDevice, CanSearch
from imud.runtime.detection.can_round import EVERYTHING, CanFinder
from imud.runtime.detection.remembered import Remembered, RememberedDevice
from imud.runtime.device import UNHEARD_NS, Device
from imud.runtime.path import CanPath, SamplePath
from imud.runtime.stream.runner import SILENT_SEARCH_NS
from imud.units import NS_PER_S


class CanRunner(Device):
    """Owns one device on a CAN bus, through a link of its own. Synchronization: the event loop's thread only."""

    link: CanLink

    def __init__(
        self,
        config: DeviceConfig,
        device_id: int,
        publish: Callable[[Batch], None],
        tell: Callable[[Event], None],
        buses: CanBuses | None = None,
        remembered: Remembered | None = None,
    ) -> None:
        """`buses` is what the devices of a daemon share. Raises LinkError for a driver that is none for CAN."""
        super().__init__(config, device_id, publish, tell, LINKS[config.link].make_can(config.link_settings))
        self._buses = buses or CanBuses()
        self._remembered = remembered or Remembered(None)
        self._can_driver: CanDriver | None = None
        self._options: Any = None
        self._codec: CanCodec | None = None
        self._can_path: CanPath | None = None
        self._node: int | None = None
        """The device that was found, as its driver numbers them; None for a driver that is named."""
        self._finder: CanFinder | None = None
        self._search_again = asyncio.Event()
        self._bus_problem = ""
        if not self._searchable:
            driver = DRIVERS[config.driver]
            if not isinstance(driver, CanDriver):
                raise LinkError(f"{config.name}: expected a driver for CAN, got {driver.name}")
            self._set_up(driver, config.options or driver.settings())

    async def run(self) -> None:
        """Keep the device alive until cancelled, or until a replay ends."""
        if not self._searchable:
            self._join()
        try:
            await super().run()
        finally:
            self._buses.leave(self.config.name)

    async def _wait_present(self) -> None:
        self._refuse_rivalry()
        if reason := self.link.absence():
            self._down(DeviceState.MISSING, reason)
        await self.link.wait_present()

    def _start(self) -> None:
        self._bus_problem = ""
        self._set(DeviceState.SEARCHING)
        if self._searchable:
            self._seek()
        else:
            self._begin()
        self.link.start(self._receive, self._on_news, self._on_end)

    def _end_work(self) -> None:
        self._end_search()
        if self._searchable:
            self._buses.leave(self.config.name)

    async def _work(self) -> None:
        """Find, ask, and find again when told so; ends only with the link."""
        while True:
            while (finder := self._finder) is not None:
                try:
                    await finder.finished()
                    self._finder = None
                except NothingHeard as error:
                    self._complain(self._bus_problem or str(error))
                    self._seek()
            self._send_cyclic()
            if self.config.identify and self.link.writable:
                await self._ask()
            await self._search_again.wait()
            self._seek()

    async def _ask(self) -> None:
        driver, options = self._can_driver, self._options
        if driver is not None:
            await self._identify(lambda: driver.identify(options), lambda: driver.read_settings(options), self._apply)

    # --- finding the device ------------------------------------------------------------------------------------------

    def _seek(self) -> None:
        """Listen to the whole bus, until a single device that nobody else has is heard."""
        self._search_again.clear()
        self._end_search()
        self.state = DeviceState.SEARCHING
        name, link, last = self.config.name, self.link, self._remembered.get(self.config.name)
        self._buses.leave(name)
        if self._can_path is not None:
            self._can_path.reset()
            self._can_path.begin(monotonic_ns())
        link.filters = EVERYTHING
        search = CanSearch(
            of_kind(DRIVERS.values(), CanDriver),
            self._where,
            claimed=self._buses.claimed(name, link.bus),
            remembered=(last.driver, last.node) if last and last.node is not None else None,
        )
        self._finder = CanFinder(search, self.ledger, self._found)
        self._finder.start()

    def _found(self, device: CanDevice) -> None:
        """Go on with the device that was found."""
        driver, node = device
        if driver is not self._can_driver or node != self._node:
            self._node = node
            self._set_up(driver, driver.node_settings(node))
        self._join()
        self._remembered.put(self.config.name, RememberedDevice(driver.name, 0, node))
        self._finder = None
        self._begin()

    def _end_search(self) -> None:
        finder, self._finder = self._finder, None
        if finder is not None:
            finder.cancel()

    # --- the device's own codec --------------------------------------------------------------------------------------

    def _set_up(self, driver: CanDriver, options: Any) -> None:
        """Make codec, clock and path for a device."""
        if self._can_path is not None:
            self._can_path.reset()
        self._driver = self._can_driver = driver
        self._options = options
        self._clock = clock = self._new_clock(driver)
        self._codec = driver.make_codec(self.ledger, options)
        self._path = self._can_path = CanPath(self._codec, *self._path_parts(clock))

    def _begin(self) -> None:
        """What comes from now on is fresh, and goes to the device's codec."""
        link, path, clock, driver = self.link, self._can_path, self._clock, self._can_driver
        assert clock is not None
        assert driver is not None
        assert path is not None
        link.filters = driver.filters(self._options)
        clock.restart()
        first = driver.example_frames(Random(0))[0]
        path.frame_ns = frame_bits(first.extended, len(first.data)) * NS_PER_S // link.bitrate if link.bitrate else 0
        path.loss.link_opened()
        path.begin(monotonic_ns())

    def _join(self) -> None:
        driver, options = self._can_driver, self._options
        assert driver is not None
        cyclic = driver.cyclic(options) if self.link.writable else ()
        self._buses.join(self.config.name, self.link.bus, driver.filters(options), cyclic)

    def _refuse_rivalry(self) -> None:
        if rivalry := self._buses.rivalry(self.config.name):
            raise LinkError(rivalry)

    def _send_cyclic(self) -> None:
        """Have the link send what the device needs. Raises LinkError where another device sends it already."""
        self._refuse_rivalry()
        driver = self._can_driver
        if driver is not None and self.link.writable and (frames := driver.cyclic(self._options)):
            self.link.send_cyclic(frames)

    def _apply(self, identity: Identity) -> None:
        if self._can_driver is not None and self._codec is not None:
            self._can_driver.apply_identity(self._codec, identity)

    # --- the flow ----------------------------------------------------------------------------------------------------

    def _receive(self, frames: Sequence[CanFrame]) -> None:
        if self._finder is not None:
            self._finder.take(frames)
        elif self._can_path is not None:
            self._can_path.on_frames(frames)

    def _on_news(self, news: str, problem: str) -> None:
        """The bus is in trouble, or out of it."""
        self._bus_problem = self._problem = problem
        self._notices.tell(monotonic_ns(), EventKind.LINK, news, problem=problem)

    def _watch_lock(self, path: SamplePath, now_ns: int) -> None:
        """No samples: bus trouble explains it, or frames of another device, or there is silence."""
        since_ns = self._silent_since_ns if self.state is DeviceState.SILENT else path.begun_ns
        if self._searchable and now_ns - since_ns > SILENT_SEARCH_NS:
            self._search_again.set()
        driver = self._can_driver
        if self.state is not DeviceState.SEARCHING or driver is None or now_ns - path.begun_ns <= UNHEARD_NS:
            return
        if self._bus_problem:
            self._complain(self._bus_problem)
        elif path.last_data_ns > path.begun_ns:
            self._complain(f"frames of {driver.name} come on {self._where}, but no whole sample")
        else:
            self._complain(f"nothing of {driver.name} is heard on {self._where}: is its identifier right?")

    def _down(self, state: DeviceState, problem: str) -> None:
        super()._down(state, self._bus_problem or problem if state is DeviceState.SILENT else problem)

    def _set(self, state: DeviceState, problem: str = "") -> None:
        """Trouble of the bus stays shown while samples flow, and explains their absence."""
        streaming = state in (DeviceState.RUNNING, DeviceState.SILENT)
        super()._set(state, self._bus_problem or problem if streaming else problem)

    @property
    def _hears_replies(self) -> bool:
        """A device whose driver is named is heard from the first moment: one that sends nothing can be told to."""
        return super()._hears_replies or (self.state is DeviceState.SEARCHING and self._can_path is not None)

    @property
    def _target(self) -> Target:
        """The device that is heard: one that was found has a number that the configuration does not name."""
        return Target(self._options, self._rate_bit_s)

    @property
    def _searchable(self) -> bool:
        return self.config.driver == "auto"

    @property
    def _listening(self) -> bool:
        return self._finder is None

    @property
    def _rate_bit_s(self) -> int:
        return self.link.bitrate

    @property
    def _where(self) -> str:
        return f"{self.link.title} at {self.link.bitrate // 1000} kbit/s" if self.link.bitrate else self.link.title
