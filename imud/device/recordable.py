"""Devices and host clocks of a daemon as the source of recorders."""

from collections.abc import Mapping, Sequence

from imud.contracts.publisher import PutRecord
from imud.device.device import Device
from imud.host.clock import HostClock
from imud.recording.observer import ClockObserver


class RecordableDevices:
    """Devices and host clocks of a daemon for recorders. Synchronization: the event loop's thread only."""

    def __init__(self, devices: Mapping[str, Device], host: HostClock) -> None:
        """`devices` contains the present devices at each call."""
        self._devices = devices
        self._clocks = ClockObserver(host)

    def names(self) -> Sequence[str]:
        """Return the names of the present devices."""
        return list(self._devices)

    def begin_host(self, put: PutRecord) -> None:
        """Send the state of the host's clocks to `put`, then each reading. A second call sends the state again."""
        self._clocks.begin(put)

    def begin(self, device: str, put: PutRecord) -> None:
        """Send the description of a device to `put`, then each input. Do nothing if the device does not exist.

        A second call sends the description again.
        """
        found = self._devices.get(device)
        if found is not None:
            found.record(put)

    def check(self, device: str, put: PutRecord) -> None:
        """Send the newest sample and the ledger of a device to `put`. Do nothing if the device does not exist."""
        found = self._devices.get(device)
        if found is not None:
            found.observer.check(put)

    def end(self, put: PutRecord) -> None:
        """Send no more records of the devices and of the host to `put`."""
        for device in self._devices.values():
            device.observer.end(put)
        self._clocks.end(put)
