"""The directory of recordings: names of files, and the oldest removed so that all of them keep within a budget."""

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Annotated, Final, NamedTuple

import msgspec

from imud.contracts.lines import InputOptions
from imud.model.options import Options
from imud.model.units import NS_PER_S

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


MEGABYTE: Final = 1_000_000


class FlightOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the flight recorder."""

    enabled: bool = False
    """Whether imud keeps the last minutes, to be saved by an alert or by `imud record --snapshot`."""
    minutes: Annotated[float, msgspec.Meta(ge=0.1, le=1440)] = 5.0
    """Time before an alert that is kept, min."""
    after_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 30.0
    """Time after an alert that is saved with it, s."""
    memory_mb: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 64.0
    """Room for what is kept, MB (10⁶ bytes): where `minutes` need more, less of them is kept."""
    directory: str = ""
    """Where it is kept: empty for the main memory, or a directory that imud makes, for example on a tmpfs; what a
    killed imud left there is saved at the next start."""
    acceleration_m_s2: Annotated[float, msgspec.Meta(gt=0, le=1_000_000)] | None = None
    """An acceleration above which a sample is an alert, m/s², gravity included; null for none."""
    device_lost: bool = True
    """Whether it is an alert that a device that was running is gone or silent."""
    line: InputOptions | None = None
    """A GPIO line whose becoming active is an alert, with the keys `line`, `chip`, `active_low` and `bias` as those of
    a device; null for none."""
    per_hour: Annotated[int, msgspec.Meta(ge=1, le=3600)] = 6
    """At most so many snapshots are saved by alerts within an hour."""


class RecorderOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the recorder."""

    enabled: bool = False
    """Whether imud records always, to files that follow one another."""
    directory: Annotated[str, msgspec.Meta(min_length=1)] = "/var/lib/imud/recordings"
    """Where the files are; imud makes it where it is missing."""
    devices: list[str] | None = None
    """Names of the devices that are recorded; null for all."""
    keep_gb: Annotated[float, msgspec.Meta(gt=0, le=1_000_000)] = 10.0
    """Room for all files together, snapshots included, GB (10⁹ bytes): the oldest are removed before it is exceeded."""
    file_mb: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 100.0
    """A new file begins at this size, MB (10⁶ bytes), …"""
    file_minutes: Annotated[float, msgspec.Meta(ge=1, le=10_080)] = 60.0
    """… or after this time, whichever comes first."""
    flight: FlightOptions = FlightOptions()
    """The flight recorder: the last minutes, saved when something happens."""

    def __post_init__(self) -> None:
        """Raise ValueError for a budget with room for less than two files, or for a snapshot."""
        if self.keep_gb * 1000 < 2 * self.file_mb:
            raise ValueError(
                f"keep_gb: expected room for two files of file_mb ({self.file_mb:g}), {self.file_mb / 500:g} or more, "
                f"got {self.keep_gb:g}"
            )
        room_mb = (2 * self.file_mb if self.enabled else 0) + self.flight.memory_mb
        if self.flight.enabled and self.keep_gb * 1000 < room_mb:
            raise ValueError(
                f"keep_gb: expected room for a snapshot of flight.memory_mb ({self.flight.memory_mb:g}) beside the "
                f"files, {room_mb / 1000:g} or more, got {self.keep_gb:g}"
            )

    @property
    def keep_bytes(self) -> int:
        """`keep_gb` in bytes."""
        return round(self.keep_gb * 1000 * MEGABYTE)
