"""Small file in the state directory: read once, written whole by a thread, so that a busy disk makes no sample wait."""

import logging
import queue
import threading
from pathlib import Path
from typing import TypeVar

import msgspec

from imud.errors import reason_of
from imud.files import read_regular, replace_file

log = logging.getLogger(__name__)

FILE_BYTES_MAX = 1 << 20
"""256 devices take some 20 kB."""
SAVE_LIMIT_S = 1.0
"""How long the end of the daemon waits for a disk that does not answer."""

T = TypeVar("T")


class StateFile:
    """A JSON file. Every error is reported, and costs the content only. Synchronization: the event loop's thread."""

    def __init__(self, file: Path | None, thread: str, without: str) -> None:
        """None as `file` reads and writes nothing; `without` says in messages what the next start does without it."""
        self._file = file
        self._without = without
        self._contents: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        if file is not None:
            self._thread = threading.Thread(target=self._save, args=(file,), name=thread, daemon=True)
            self._thread.start()

    def read(self, content_type: type[dict[str, T]]) -> dict[str, T]:
        """Return the content; empty where there is none that can be used."""
        if self._file is None:
            return {}
        try:
            return msgspec.json.decode(read_regular(self._file, FILE_BYTES_MAX), type=content_type)
        except FileNotFoundError:
            return {}
        except (OSError, msgspec.DecodeError, UnicodeError, RecursionError) as error:
            reason = reason_of(error) if isinstance(error, OSError) else "it is not what imud wrote"
            log.warning("%s cannot be used: %s; %s", self._file, reason, self._without)
            return {}

    def write(self, content: object) -> None:
        """Have the content written soon; of several that wait only the newest is."""
        if self._thread is not None:
            self._contents.put(msgspec.json.encode(content))

    def close(self) -> None:
        """Wait until the file is written, for at most SAVE_LIMIT_S; may be called twice."""
        if self._thread is not None:
            self._contents.put(None)
            self._thread.join(SAVE_LIMIT_S)
            self._thread = None

    def _save(self, file: Path) -> None:
        """Write the newest content whenever there is one. Runs in the thread."""
        while (content := self._contents.get()) is not None:
            ended = False
            while not ended and not self._contents.empty():
                newer = self._contents.get()
                ended, content = newer is None, newer or content
            try:
                file.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
                replace_file(file, content)
            except OSError as error:
                log.warning(
                    "%s cannot be written: %s; after the next start %s; may this user write to state_dir?",
                    file, reason_of(error), self._without,
                )  # fmt: skip
            if ended:
                return
