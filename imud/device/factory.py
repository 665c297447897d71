"""Factory of devices: each device with the transport that its link and driver need.

The factory owns the resources that all devices of a daemon share: clock, buses, GPIO lines and state files.
"""

from pathlib import Path

from imud.config.model import DeviceConfig
from imud.contracts.driver import CanDriver
from imud.contracts.lines import LineFactory
from imud.contracts.link import CanLink, PolledLink, StreamLink
from imud.device.can_transport import CanBuses, CanTransport
from imud.device.device import Device, MakeTransport, SharedParts
from imud.device.flash import SettingsFiles
from imud.device.polled_bus import PolledBuses
from imud.device.polled_transport import PolledTransport
from imud.device.search import Remembered
from imud.device.stream_transport import StreamTransport
from imud.device.transport import DeviceOwner
from imud.drivers import DRIVERS
from imud.host.clock import HostClock
from imud.host.threads import BusThread, StartWatchingWorker
from imud.lines.gpio import GPIO_LINES
from imud.links import LINKS


class DeviceFactory:
    """Factory of the devices of one daemon. Synchronization: the loop's thread only."""

    def __init__(
        self,
        owner: DeviceOwner,
        host: HostClock,
        *,
        state_dir: Path | None = None,
        lines: LineFactory = GPIO_LINES,
        start_worker: StartWatchingWorker = BusThread,
    ) -> None:
        """`owner` receives samples and events. `state_dir` contains the state files; with None imud writes none.
        `start_worker` starts the thread of a polled bus."""
        self.remembered = Remembered(state_dir)
        self._shared = SharedParts(owner, host, lines, SettingsFiles(state_dir, host))
        self._polled_buses = PolledBuses(host, start_worker)
        self._can_buses = CanBuses()

    def make(self, config: DeviceConfig, device_id: int) -> Device:
        """Return a device; `run` starts it. Raises LinkError if the driver does not fit the link."""
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
        """Return a device with another transport (`on_stream`, `on_can`, `on_polled`)."""
        return Device(config, device_id, self._shared, make_transport)

    def close(self) -> None:
        """Stop the threads of the polled buses and write the state files. A second call does nothing."""
        self._polled_buses.end()
        self.remembered.close()
        self._shared.files.close()

    def on_stream(self, link: StreamLink) -> MakeTransport:
        """Return a function that creates a transport on a serial port, for `make_on`."""
        return lambda context: StreamTransport(context, link, self.remembered)

    def on_can(self, link: CanLink) -> MakeTransport:
        """Return a function that creates a transport on a CAN bus, for `make_on`."""
        return lambda context: CanTransport(context, link, self._can_buses, self.remembered)

    def on_polled(self, link: PolledLink) -> MakeTransport:
        """Return a function that creates a transport on a polled bus, for `make_on`."""
        return lambda context: PolledTransport(context, link, self._polled_buses)
