"""Firmware updates that erased a device and did not end, by name of the device, over all runs of imud."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from imud.host.clock import HostClock
from imud.host.files import StateFile
from imud.model.units import NS_PER_S

FILE_NAME: Final = "updates.json"
UPDATES_MAX: Final = 256  # maximum number of records: a daemon has at most 256 devices


class PendingUpdates:
    """Start of each update that did not end. Synchronization: the loop's thread only."""

    def __init__(self, folder: Path | None, host: HostClock) -> None:
        """`folder` contains the file; None: imud forgets the updates at its end."""
        self._file = StateFile(
            folder / FILE_NAME if folder else None, "updates", "imud does not name an interrupted firmware update"
        )
        self._starts_s = self._file.read(dict[str, int])
        self._host = host

    def start_of(self, device: str) -> str:
        """Return the UTC of the start of the incomplete update; empty if there is none."""
        start_s = self._starts_s.get(device)
        return f"{datetime.fromtimestamp(start_s, UTC):%Y-%m-%d %H:%M:%S} UTC" if start_s is not None else ""

    def add(self, device: str) -> None:
        """Store that an update of `device` starts to erase it."""
        self._starts_s.pop(device, None)
        self._starts_s[device] = self._host.utc_ns() // NS_PER_S
        while len(self._starts_s) > UPDATES_MAX:
            del self._starts_s[next(iter(self._starts_s))]
        self._file.write(self._starts_s)

    def remove(self, device: str) -> None:
        """Store that `device` runs its application. Do nothing without a record."""
        if self._starts_s.pop(device, None) is not None:
            self._file.write(self._starts_s)

    def close(self) -> None:
        """Wait for the end of the last write, for a limited time. A second call does nothing."""
        self._file.close()
