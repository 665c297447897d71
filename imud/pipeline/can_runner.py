"""A device on a CAN bus: its driver is named, its frames are known by their identifiers, nothing is searched for."""

import asyncio
from collections.abc import Callable, Sequence
from time import monotonic_ns

from imud.config import DeviceConfig
from imud.devices import DRIVERS
from imud.errors import LinkError
from imud.event import Event, EventKind
from imud.kit.batch import Batch
from imud.kit.can import FRAME_BITS, CanDriver, CanFrame
from imud.kit.driver import Identity
from imud.kit.link import CanLink
from imud.kit.status import DeviceState
from imud.links import LINKS
from imud.pipeline.device import Device
from imud.pipeline.path import CanPath, SamplePath
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
    ) -> None:
        """Raises LinkError for a driver that is none for CAN."""
        super().__init__(config, device_id, publish, tell, LINKS[config.link].make_can(config.link_settings))
        driver = DRIVERS[config.driver]
        if not isinstance(driver, CanDriver):
            raise LinkError(f"{config.name}: expected a driver for CAN, got {driver.name}")
        self._driver = self._can_driver = driver
        self._options = options = config.options or driver.settings()
        self.link.filters = driver.filters(options)
        self._clock = clock = self._new_clock(driver)
        self._codec = driver.make_codec(self.ledger, options)
        self._path = self._can_path = CanPath(self._codec, *self._path_parts(clock))
        self._bus_problem = ""

    async def _wait_present(self) -> None:
        if reason := self.link.absence():
            self._down(DeviceState.MISSING, reason)
        await self.link.wait_present()

    def _start(self) -> None:
        link, path, clock = self.link, self._can_path, self._clock
        assert clock is not None
        self._bus_problem = ""
        self._set(DeviceState.SEARCHING)
        clock.restart()
        path.frame_ns = FRAME_BITS * NS_PER_S // link.bitrate if link.bitrate else 0
        path.loss.link_opened()
        path.begin(monotonic_ns())
        link.start(self._receive, self._on_news, self._on_end)

    async def _work(self) -> None:
        if self.config.identify and self.link.writable:
            driver, options = self._can_driver, self._options
            await self._identify(lambda: driver.identify(options), lambda: driver.read_settings(options), self._apply)
        await asyncio.get_running_loop().create_future()

    def _apply(self, identity: Identity) -> None:
        self._can_driver.apply_identity(self._codec, identity)

    def _receive(self, frames: Sequence[CanFrame]) -> None:
        self._can_path.on_frames(frames)

    def _on_news(self, news: str, problem: str) -> None:
        """The bus is in trouble, or out of it."""
        self._bus_problem = self._problem = problem
        self._notices.tell(monotonic_ns(), EventKind.LINK, news, problem=problem)

    def _watch_lock(self, path: SamplePath, now_ns: int) -> None:
        """No samples: bus trouble explains it, or frames of another device, or there is silence."""
        if self.state is not DeviceState.SEARCHING:
            return
        if self._bus_problem:
            self._complain(self._bus_problem)
        elif path.last_data_ns > path.begun_ns:
            self._complain(f"frames of {self._can_driver.name} come on {self._where}, but no whole sample")
        else:
            self._complain(f"nothing of {self._can_driver.name} is heard on {self._where}: is its identifier right?")

    def _down(self, state: DeviceState, problem: str) -> None:
        super()._down(state, self._bus_problem or problem if state is DeviceState.SILENT else problem)

    def _set(self, state: DeviceState, problem: str = "") -> None:
        """Trouble of the bus stays shown while samples flow, and explains their absence."""
        streaming = state in (DeviceState.RUNNING, DeviceState.SILENT)
        super()._set(state, self._bus_problem or problem if streaming else problem)

    @property
    def _rate_bit_s(self) -> int:
        return self.link.bitrate

    @property
    def _where(self) -> str:
        return f"{self.link.title} at {self.link.bitrate // 1000} kbit/s" if self.link.bitrate else self.link.title
