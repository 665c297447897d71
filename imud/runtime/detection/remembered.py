"""Table of the last known driver and baud rate or node of each device, in one small JSON file.

A missing or damaged file costs a few hundred milliseconds of detection, nothing else, so every error here is only
reported.
"""

from pathlib import Path

import msgspec

from imud.runtime.state_file import StateFile

FILE_NAME = "found.json"


class RememberedDevice(msgspec.Struct, frozen=True):
    """Driver and rate at which a device was last heard."""

    driver: str
    baud: int
    """0 on a CAN bus, whose rate is the system's."""
    node: int | None = None
    """On a CAN bus: which device of the driver's kind."""


class Remembered:
    """The last good driver and baud rate by device name. Synchronization: the event loop's thread only.

    The file is written by a thread: a disk that is busy makes no sample wait. Only the newest content is written.
    """

    def __init__(self, folder: Path | None) -> None:
        """With None as `folder` nothing is read or written."""
        without = "devices are searched for from the beginning"
        self._file = StateFile(folder / FILE_NAME if folder else None, "remembered", without)
        self._found = self._file.read(dict[str, RememberedDevice])

    def get(self, device: str) -> RememberedDevice | None:
        """The remembered driver and rate of `device`."""
        return self._found.get(device)

    def put(self, device: str, found: RememberedDevice) -> None:
        """Remember, and have the file written if that is news."""
        if self._found.get(device) != found:
            self._found[device] = found
            self._file.write(self._found)

    def close(self) -> None:
        """Wait until the file is written, for a limited time; may be called twice."""
        self._file.close()
