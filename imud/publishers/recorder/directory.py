"""Directory of recordings: file names, and removal of the oldest files above the limit of disk space."""

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
SNAPSHOT: Final = "-snapshot"  # suffix of the name of a snapshot
# File names of the recorder. imud removes only these files.
NAME: Final = re.compile(r"\d{8}T\d{6}Z-[0-9a-f]{8}-\d{6}(-snapshot)?\.imudrec")
FILES_MAX: Final = 100_000  # maximum number of files that imud reads from the directory
RETRY_NS: Final = 60 * NS_PER_S  # time between two attempts on a full or failed disk, ns


class RecordingFile(NamedTuple):
    """Recording in the directory."""

    name: str
    size: int


class RecordingDirectory:
    """Directory of recordings. Synchronization: any thread."""

    def __init__(self, path: Path, keep_bytes: int) -> None:
        self.path = path
        self.removed = 0  # number of files removed since the start
        self.in_use: set[str] = set()  # names of open files, which imud does not remove
        # Size of the files that are not open, from the last measurement and the files added after it
        self.kept_bytes = 0
        self._keep_bytes = keep_bytes
        self._lock = Lock()

    def make(self) -> None:
        """Create the directory if it does not exist. Raises OSError."""
        self.path.mkdir(mode=0o750, parents=True, exist_ok=True)

    def measure(self) -> None:
        """Measure the size of the files. Raises OSError."""
        with self._lock:
            self._note(self.files())

    def add(self, size: int) -> None:
        """Add the size of a closed file."""
        with self._lock:
            self.kept_bytes += size

    def new_file(self, utc_ns: int, epoch: int, number: int, kind: str = "") -> Path:
        """Return the path of the next file. Names sort by time; the files of one run of the daemon share the epoch.
        `kind` is SNAPSHOT for a snapshot. Snapshots have their own numbers."""
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
        """Remove the oldest closed files, so that `reserve_bytes` fit. Return their names. Raises OSError."""
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
    """Keep the data of the last minutes. An alert or `imud record --snapshot` saves it."""
    minutes: Annotated[float, msgspec.Meta(ge=0.1, le=1440)] = 5.0
    """Time before an alert, min."""
    after_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 30.0
    """Time after an alert, s."""
    memory_mb: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 64.0
    """Maximum size of the kept data, MB (10⁶ bytes). imud keeps fewer minutes if they need more."""
    directory: str = ""
    """Directory of the kept data, for example on a tmpfs; empty: main memory. After a kill, imud saves the data of this
    directory at the next start."""
    acceleration_m_s2: Annotated[float, msgspec.Meta(gt=0, le=1_000_000)] | None = None
    """Acceleration that causes an alert, m/s², including gravity; null: no alert."""
    device_lost: bool = True
    """Cause an alert if a running device becomes missing or silent."""
    line: InputOptions | None = None
    """GPIO line that causes an alert when it becomes active; null: no line."""
    per_hour: Annotated[int, msgspec.Meta(ge=1, le=3600)] = 6
    """Maximum number of snapshots by alerts per hour."""


class RecorderOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the recorder."""

    enabled: bool = False
    """Record continuously."""
    directory: Annotated[str, msgspec.Meta(min_length=1)] = "/var/lib/imud/recordings"
    """Directory of the recordings. imud creates it."""
    devices: list[str] | None = None
    """Names of the recorded devices; null: all devices."""
    keep_gb: Annotated[float, msgspec.Meta(gt=0, le=1_000_000)] = 10.0
    """Maximum size of all files, including snapshots, GB (10⁹ bytes). imud removes the oldest files."""
    file_mb: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 100.0
    """Size at which imud starts a new file, MB (10⁶ bytes)."""
    file_minutes: Annotated[float, msgspec.Meta(ge=1, le=10_080)] = 60.0
    """Time after which imud starts a new file, min."""
    flight: FlightOptions = FlightOptions()
    """Options of the flight recorder."""

    def __post_init__(self) -> None:
        """Raise ValueError if the limit has no room for two files or for a snapshot."""
        if self.keep_gb * 1000 < 2 * self.file_mb:
            raise ValueError(
                f"keep_gb: expected room for two files of file_mb ({self.file_mb:g}), {self.file_mb / 500:g} or more, "
                f"got {self.keep_gb:g}"
            )
        room_mb = (2 * self.file_mb if self.enabled else 0) + self.flight.memory_mb
        if self.flight.enabled and self.keep_gb * 1000 < room_mb:
            raise ValueError(
                f"keep_gb: expected room for a snapshot of flight.memory_mb ({self.flight.memory_mb:g}) and the "
                f"files, {room_mb / 1000:g} or more, got {self.keep_gb:g}"
            )

    @property
    def keep_bytes(self) -> int:
        return round(self.keep_gb * 1000 * MEGABYTE)
