"""Store of the last known driver and baud rate or node of each device, in one small JSON file.

A missing or damaged file costs a few hundred milliseconds of detection, nothing else, so every error here is only
reported.
"""

import logging
import os
from pathlib import Path

import msgspec

log = logging.getLogger(__name__)

FILE_NAME = "found.json"
FILE_BYTES_MAX = 1 << 20


class RememberedDevice(msgspec.Struct, frozen=True):
    """Driver and rate at which a device was last heard."""

    driver: str
    baud: int
    """0 on a CAN bus, whose rate is the system's."""
    node: int | None = None
    """On a CAN bus: which device of the driver's kind."""


class Remembered:
    """The last good driver and baud rate by device name."""

    def __init__(self, folder: Path | None) -> None:
        self._file = folder / FILE_NAME if folder else None
        self._found = self._read()

    def get(self, device: str) -> RememberedDevice | None:
        """The remembered driver and rate of `device`."""
        return self._found.get(device)

    def put(self, device: str, found: RememberedDevice) -> None:
        """Remember, and write the file if anything changed."""
        if self._found.get(device) != found:
            self._found[device] = found
            self._write()

    def _read(self) -> dict[str, RememberedDevice]:
        if self._file is None:
            return {}
        try:
            with self._file.open("rb") as file:
                return msgspec.json.decode(file.read(FILE_BYTES_MAX), type=dict[str, RememberedDevice])
        except FileNotFoundError:
            return {}
        except (OSError, msgspec.DecodeError) as error:
            log.warning("%s cannot be used (%s): devices are searched for from the beginning", self._file, error)
            return {}

    def _write(self) -> None:
        if self._file is None:
            return
        temporary = self._file.with_suffix(".new")
        try:
            temporary.write_bytes(msgspec.json.encode(self._found))
            os.replace(temporary, self._file)
        except OSError as error:
            log.warning("%s cannot be written (%s): the next start searches again", self._file, error)
