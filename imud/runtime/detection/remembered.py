"""Store of the last known driver and baud rate or node of each device, in one small JSON file.

A missing or damaged file costs a few hundred milliseconds of detection, nothing else, so every error here is only
reported.
"""

import logging
import queue
import threading
from pathlib import Path

import msgspec

from imud.errors import reason_of
from imud.files import read_regular, replace_file

log = logging.getLogger(__name__)

FILE_NAME = "found.json"
FILE_BYTES_MAX = 1 << 20
"""256 devices take 20 kB."""
SAVE_LIMIT_S = 1.0
"""How long the end of the daemon waits for a disk that does not answer."""


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
        self._file = folder / FILE_NAME if folder else None
        self._found = self._read()
        self._contents: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        if self._file is not None:
            self._thread = threading.Thread(target=self._save, args=(self._file,), name="remembered", daemon=True)
            self._thread.start()

    def get(self, device: str) -> RememberedDevice | None:
        """The remembered driver and rate of `device`."""
        return self._found.get(device)

    def put(self, device: str, found: RememberedDevice) -> None:
        """Remember, and have the file written if that is news."""
        if self._found.get(device) != found:
            self._found[device] = found
            if self._thread is not None:
                self._contents.put(msgspec.json.encode(self._found))

    def close(self) -> None:
        """Wait until the file is written, for at most SAVE_LIMIT_S; may be called twice."""
        if self._thread is not None:
            self._contents.put(None)
            self._thread.join(SAVE_LIMIT_S)
            self._thread = None

    def _read(self) -> dict[str, RememberedDevice]:
        if self._file is None:
            return {}
        try:
            content = read_regular(self._file, FILE_BYTES_MAX)
            return msgspec.json.decode(content, type=dict[str, RememberedDevice])
        except FileNotFoundError:
            return {}
        except (OSError, msgspec.DecodeError, UnicodeError, RecursionError) as error:
            reason = reason_of(error) if isinstance(error, OSError) else "it is not what imud wrote"
            log.warning("%s cannot be used: %s; devices are searched for from the beginning", self._file, reason)
            return {}

    def _save(self, file: Path) -> None:
        """Write the newest content whenever there is one. Runs in the thread."""
        while (content := self._contents.get()) is not None:
            ended = False
            while not ended and not self._contents.empty():
                newer = self._contents.get()
                ended, content = newer is None, newer or content
            self._write(file, content)
            if ended:
                return

    def _write(self, file: Path, content: bytes) -> None:
        try:
            replace_file(file, content)
        except OSError as error:
            log.warning(
                "%s cannot be written: %s; the next start searches again; may this user write to state_dir?",
                file, reason_of(error),
            )  # fmt: skip
