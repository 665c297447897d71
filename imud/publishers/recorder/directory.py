"""Directory of recordings: file names, and removal of the oldest files above the limit of disk space."""

import logging
import os
import re
import stat
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from itertools import count
from operator import attrgetter
from pathlib import Path
from threading import Lock
from typing import Annotated, Final, NamedTuple

import msgspec

from imud.contracts.lines import InputOptions
from imud.host.files import can_replace, read_regular, replace_file
from imud.model.host_object import Directory, OptionalDirectory
from imud.model.options import Options
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

SUFFIX: Final = ".imudrec"
SNAPSHOT: Final = "-snapshot"  # suffix of the name of a snapshot
# File names of the recorder. imud removes only these files.
NAME: Final = re.compile(r"\d{8}T\d{6}Z-(?P<run>[0-9a-f]{8})-(?P<number>\d{6,9})(?P<kind>-snapshot)?\.imudrec")
FILES_MAX: Final = 100_000  # maximum number of files that imud reads from the directory
RETRY_NS: Final = 60 * NS_PER_S  # time between two attempts on a full or failed disk, ns
# File with the runs of the daemon in their order, one line each. The wall clock of a host without RTC does not give
# this order: it can be years behind or ahead until NTP sets it.
RUNS_FILE: Final = ".runs"
RUNS_BYTES: Final = FILES_MAX * len("0123abcd\n")  # maximum size of this file, bytes
RUN: Final = re.compile("[0-9a-f]{8}")


class RecordingFile(NamedTuple):
    """Recording in the directory."""

    name: str
    size: int
    mtime_ns: int  # CLOCK_REALTIME of the last write
    run: str  # eight digits of the epoch of its daemon
    number: int
    kind: str  # SNAPSHOT, or empty


class RecordingDirectory:
    """Directory of recordings. Synchronization: any thread."""

    def __init__(self, path: Path, keep_bytes: int, *, own_only: bool = False) -> None:
        """`own_only`: ignore the files of other users."""
        self.path = path
        self._owners = {0, os.geteuid()} if own_only else None
        self.removed = 0  # number of files removed since the start
        self.in_use: set[str] = set()  # names of open files, which imud does not remove
        # Size of the files that are not open, from the last measurement and the files added after it
        self.kept_bytes = 0
        self._keep_bytes = keep_bytes
        self._lock = Lock()
        self._run = ""  # run of this daemon
        self._is_noted = True  # whether RUNS_FILE contains this run
        self._runs: dict[str, int] = {}  # known runs, with their places in the order
        self._made: dict[str, int] = {}  # files of this daemon, with their places in the order
        self._next_place = count(1)

    def make(self) -> None:
        """Create the directory if it does not exist. Raises OSError."""
        self.path.mkdir(mode=0o750, parents=True, exist_ok=True)

    def problem(self) -> str:
        """Return why other users can replace the files; empty if they cannot, or if the directory is missing."""
        above = {*self.path.parents, *(real := self.path.resolve()).parents, self.path}
        try:
            found = [(level, level.lstat()) for level in sorted(above)]
            problems = [can_replace(real.stat(), real, "its files")]
        except OSError:
            return ""
        for level, status in found:
            # the group of root or of this process may write above the directory
            others = stat.S_IWOTH if status.st_gid in (0, os.getegid()) else stat.S_IWOTH | stat.S_IWGRP
            is_open = stat.S_ISDIR(status.st_mode) and status.st_mode & others
            if is_open or status.st_uid not in (0, os.geteuid()):  # also the owner of a symbolic link
                problems.append(can_replace(status, level, "its files"))
        return next(filter(None, problems), "")

    def begin_run(self, epoch: int, kind: str = "") -> int:
        """Add the run of this daemon after all known runs of the directory. Return the number of its next file of this
        kind: after a reload, the directory contains files of this run. Raises OSError."""
        with self._lock:
            self._run, files = _run_of(epoch), self.files()
            self._note_run(files)
        return max((file.number + 1 for file in files if (file.run, file.kind) == (self._run, kind)), default=0)

    def note_run(self) -> None:
        """Add the run of this daemon to RUNS_FILE if the last attempt failed."""
        if not self._is_noted:
            with self._lock, suppress(OSError):
                self._note_run(self.files())

    def measure(self) -> None:
        """Measure the size of the files. Raises OSError."""
        with self._lock:
            self._note(self.files())

    def add(self, size: int) -> None:
        """Add the size of a closed file."""
        with self._lock:
            self.kept_bytes += size

    def new_file(self, utc_ns: int, epoch: int, number: int, kind: str = "") -> Path:
        """Return the path of the next file. The files of one run of the daemon share the epoch. `kind` is SNAPSHOT for
        a snapshot. Snapshots have their own numbers."""
        begun = datetime.fromtimestamp(utc_ns // NS_PER_S, UTC).strftime("%Y%m%dT%H%M%SZ")
        name = f"{begun}-{_run_of(epoch)}-{number:06d}{kind}{SUFFIX}"
        self._made[name] = next(self._next_place)
        return self.path / name

    def files(self) -> list[RecordingFile]:
        """Return the recordings in the directory, oldest first. Raises OSError."""
        runs, found = dict[str, list[RecordingFile]](), 0
        with os.scandir(self.path) as entries:
            for entry in entries:
                name = NAME.fullmatch(entry.name)
                if name is not None and entry.is_file(follow_symlinks=False):
                    with suppress(FileNotFoundError):
                        status, run = entry.stat(follow_symlinks=False), name["run"]
                        if self._owners is not None and status.st_uid not in self._owners:
                            continue
                        file = RecordingFile(
                            entry.name, status.st_size, status.st_mtime_ns, run, int(name["number"]), name["kind"] or ""
                        )
                        runs.setdefault(run, []).append(file)
                        found += 1
                if found >= FILES_MAX:
                    break
        # imud does not know the place of a run before the first line of RUNS_FILE
        order = sorted(runs, key=lambda run: (self._runs.get(run, -1), max(file.mtime_ns for file in runs[run]), run))
        return [file for run in order for file in self._in_order(runs[run])]

    def make_room(self, reserve_bytes: int) -> Sequence[str]:
        """Remove the oldest closed files, so that `reserve_bytes` fit. Return and log their names. Raises OSError."""
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
                    self._made.pop(file.name, None)
                    removed.append(file.name)
                    log.info(
                        "removed the oldest recording %s (%.1f MB) to stay below %g GB",
                        self.path / file.name, file.size / 1e6, self._keep_bytes / 1e9,
                    )  # fmt: skip
            self.removed += len(removed)
            if self._run:
                self._note_run(files)
        return removed

    def _note(self, files: Sequence[RecordingFile]) -> None:
        self.kept_bytes = sum(file.size for file in files if file.name not in self.in_use)

    def _in_order(self, files: Sequence[RecordingFile]) -> list[RecordingFile]:
        """Return the files of one run, oldest first. The numbers give the order of the files of one kind. The time of
        the last write is only the order of recordings and snapshots, because the wall clock can step."""
        by_number = {kind: iter(sorted(files, key=attrgetter("number"))) for kind in ("", SNAPSHOT)}
        by_time = sorted(files, key=lambda file: (self._made.get(file.name, 0), file.mtime_ns, file.number))
        return [next(other for other in by_number[file.kind] if other.kind == file.kind) for file in by_time]

    def _note_run(self, files: Sequence[RecordingFile]) -> None:
        """Read RUNS_FILE. If it lacks the run of this daemon, add the run and remove the runs without files."""
        path = self.path / RUNS_FILE
        try:
            known = RUN.findall(read_regular(path, RUNS_BYTES).decode("ascii", "replace"))
        except OSError:
            known = []
        self._is_noted = self._run in known
        if not self._is_noted:
            present = {file.run for file in files}
            known = [*(run for run in known if run in present), self._run]
            with suppress(OSError):  # a full disk: the next call tries again
                replace_file(path, "".join(f"{run}\n" for run in known).encode())
                self._is_noted = True
        self._runs = {run: place for place, run in enumerate(known)}


def _run_of(epoch: int) -> str:
    return f"{epoch & 0xFFFF_FFFF:08x}"


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
    directory: OptionalDirectory = ""
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
    directory: Directory = "/var/lib/imud/recordings"
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
        """Raise ValueError if the limit has no room for two files or for a snapshot, or if both recorders share a
        directory: the flight recorder removes the files of its directory."""
        if self.keep_gb * 1000 < 2 * self.file_mb:
            raise ValueError(
                f"keep_gb: expected room for two files of file_mb ({self.file_mb:g}), {self.file_mb / 500:g} or more, "
                f"got {self.keep_gb:g}"
            )
        if self.flight.directory and os.path.realpath(self.flight.directory) == os.path.realpath(self.directory):
            raise ValueError(f"flight: expected another directory than {self.directory}, got the same")
        room_mb = (2 * self.file_mb if self.enabled else 0) + self.flight.memory_mb
        if self.flight.enabled and self.keep_gb * 1000 < room_mb:
            raise ValueError(
                f"keep_gb: expected room for a snapshot of flight.memory_mb ({self.flight.memory_mb:g}) and the "
                f"files, {room_mb / 1000:g} or more, got {self.keep_gb:g}"
            )

    @property
    def keep_bytes(self) -> int:
        return round(self.keep_gb * 1000 * MEGABYTE)
