"""The directory of recordings: names of files, and the oldest removed so that all of them keep within a budget."""

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Final, NamedTuple

from imud.units import NS_PER_S

SUFFIX: Final = ".imudrec"
SNAPSHOT: Final = "-snapshot"
"""Ends the name of a snapshot, before the suffix."""
NAME: Final = re.compile(r"\d{8}T\d{6}Z-[0-9a-f]{8}-\d{6}(-snapshot)?\.imudrec")
"""Files that the recorder makes, and only such are ever removed."""
FILES_MAX: Final = 100_000
"""Files looked at in one directory."""
RETRY_NS: Final = 60 * NS_PER_S
"""A directory that was full or failed is tried again after so long."""


class RecordingFile(NamedTuple):
    """A file of the directory."""

    name: str
    size: int


class RecordingDirectory:
    """The directory. Synchronization: any thread."""

    def __init__(self, path: Path, keep_bytes: int) -> None:
        self.path = path
        self.removed = 0
        """Files removed for the budget since the start."""
        self.in_use: set[str] = set()
        """Names of files that are written at present, which are not removed."""
        self.kept_bytes = 0
        """Size of the files that are not in use, as of the last look, and of those that were added since."""
        self._keep_bytes = keep_bytes
        self._lock = Lock()

    def make(self) -> None:
        """Make the directory where it is missing. Raises OSError."""
        self.path.mkdir(mode=0o750, parents=True, exist_ok=True)

    def measure(self) -> None:
        """Look how much the files take. Raises OSError."""
        with self._lock:
            self._note(self.files())

    def add(self, size: int) -> None:
        """Count a file that was written."""
        with self._lock:
            self.kept_bytes += size

    def new_file(self, utc_ns: int, epoch: int, number: int, kind: str = "") -> Path:
        """Return the path of the next file: names sort by time, those of one run of the daemon go together.

        `kind` is SNAPSHOT for one, which are counted by themselves.
        """
        begun = datetime.fromtimestamp(utc_ns // NS_PER_S, UTC).strftime("%Y%m%dT%H%M%SZ")
        return self.path / f"{begun}-{epoch & 0xFFFF_FFFF:08x}-{number:06d}{kind}{SUFFIX}"

    def files(self) -> list[RecordingFile]:
        """Return the recordings in the directory, oldest first. Raises OSError."""
        found = []
        with os.scandir(self.path) as entries:
            for entry in entries:
                if NAME.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                    with suppress(FileNotFoundError):
                        found.append(RecordingFile(entry.name, entry.stat(follow_symlinks=False).st_size))
                if len(found) >= FILES_MAX:
                    break
        return sorted(found)

    def make_room(self, reserve_bytes: int) -> Sequence[str]:
        """Remove the oldest files that are not in use, until the rest and `reserve_bytes` more are within the budget.

        Returns their names. Raises OSError.
        """
        with self._lock:
            files = self.files()
            total, removed = sum(file.size for file in files), list[str]()
            self._note(files)
            for file in files:
                if total + reserve_bytes <= self._keep_bytes:
                    break
                if file.name not in self.in_use:
                    (self.path / file.name).unlink(missing_ok=True)
                    total -= file.size
                    self.kept_bytes -= file.size
                    removed.append(file.name)
            self.removed += len(removed)
        return removed

    def _note(self, files: Sequence[RecordingFile]) -> None:
        self.kept_bytes = sum(file.size for file in files if file.name not in self.in_use)
