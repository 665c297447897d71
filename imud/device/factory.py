"""Factory of devices from their configuration, each with the transport that its link and driver need.

What the devices of a daemon share (time, buses, remembered devices, GPIO lines) is kept here.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from imud.config.devices import owner_of
from imud.config.model import DeviceConfig
from imud.contracts.driver import CanDriver
from imud.contracts.lines import LineFactory
from imud.contracts.link import CanLink, PolledLink, StreamLink
from imud.contracts.publisher import Batch
from imud.device.can_transport import CanBuses, CanTransport
from imud.device.device import Device, MakeTransport
from imud.device.flash import SettingsFiles
from imud.device.polled_bus import PolledBuses
from imud.device.polled_transport import DataReady, PolledTransport
from imud.device.search import Remembered
from imud.device.stream_transport import StreamTransport
from imud.device.transport import DeviceContext
from imud.drivers import DRIVERS
from imud.host.clock import HostClock
from imud.host.threads import BusThread, StartWatchingWorker
from imud.lines.gpio import GPIO_LINES
from imud.links import LINKS
from imud.model.event import Event


class DeviceFactory:
    """Factory of the devices of one daemon. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        publish: Callable[[Batch], None],
        send_event: Callable[[Event], None],
        host: HostClock,
        *,
        state_dir: Path | None = None,
        lines: LineFactory = GPIO_LINES,
        start_worker: StartWatchingWorker = BusThread,
        configured: Callable[[], Sequence[DeviceConfig]] = lambda: (),
    ) -> None:
        """Found devices are remembered in `state_dir` (None: not beyond this run); `lines` makes the GPIO lines, and
        `start_worker` starts what serves a polled bus; `configured` are all devices of the present configuration."""
        self._configured = configured
        self.remembered = Remembered(state_dir)
        """Last known driver and rate of each device."""
        self._publish = publish
        self._send_event = send_event
        self._host = host
        self._lines = lines
        self._files = SettingsFiles(state_dir, lambda: host.now_ns() + host.utc_offset_ns())
        self._polled_buses = PolledBuses(host.now_ns, start_worker)
        self._can_buses = CanBuses()

    def make(self, config: DeviceConfig, device_id: int) -> Device:
        """Make a device; `run` starts it. Raises LinkError for a driver that its link cannot have."""
        row = LINKS[config.link]
        make: MakeTransport
        if row.polled:
            make = self.on_polled(row.make_polled(config.link_settings))
        elif row.frames_only or isinstance(DRIVERS.get(config.driver), CanDriver):
            make = self.on_can(row.make_can(config.link_settings))
        else:
            make = self.on_stream(row.make(config.link_settings))
        return self.make_on(config, device_id, make)

    def make_on(self, config: DeviceConfig, device_id: int, make_transport: MakeTransport) -> Device:
        """Make a device on a transport of the caller's (`on_stream`, `on_can`, `on_polled`)."""
        return Device(
            config,
            device_id,
            make_transport,
            self._publish,
            self._send_event,
            self._host,
            self._lines,
            self._files,
            lambda: owner_of(config, self._configured(), LINKS),
        )

    def close(self) -> None:
        """Stop what serves the polled buses, and have what was found written; may be called twice."""
        self._polled_buses.end()
        self.remembered.close()
        self._files.close()

    def on_stream(self, link: StreamLink) -> MakeTransport:
        """Return a maker of transports on a link of bytes, for `make_on`."""
        return lambda context: StreamTransport(context, link, self.remembered)

    def on_can(self, link: CanLink) -> MakeTransport:
        """Return a maker of transports on a CAN bus, for `make_on`."""
        return lambda context: CanTransport(context, link, self._can_buses, self.remembered)

    def on_polled(self, link: PolledLink) -> MakeTransport:
        """Return a maker of transports on a bus that is polled, for `make_on`."""

        def make(context: DeviceContext) -> PolledTransport:
            config, ready = context.config, None
            if config.lines is not None and config.lines.data_ready is not None:
                ready = DataReady(
                    config.name, config.lines.data_ready, self._lines, link.rate_hz, context.notices, self._host.now_ns
                )
                context.attachments.add(ready)
            return PolledTransport(context, link, self._polled_buses, ready)

        return make
