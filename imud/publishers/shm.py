"""Output `shm`: one ring of slots per device, `/run/imud/shm/imud.<device>`. Readers need no system call.

The readers are `imud.client.ring` and `imud/include/imud.h`; `imud.formats.ring` describes the layout. The ring never
waits for a reader. If imud cannot create a ring, or if a ring is removed or truncated, imud creates it again as soon as
possible. The daemon and its other outputs continue in the meantime.
"""

import fcntl
import grp
import logging
import mmap
import os
import secrets
import stat
import struct
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec

from imud.contracts.publisher import Batch, PublisherContext, PublisherType
from imud.formats import kernel
from imud.formats.ring import (
    DIRECTORY,
    FIRST_WORD,
    HEADER_BYTES,
    HEARTBEAT_WORD,
    LEDGER_BLOCK_BYTES,
    LEDGER_BLOCK_OFFSET,
    LEDGER_UPDATE_WORD,
    MAGIC,
    NEWEST_WORD,
    OFFSETS,
    OPEN_FLAGS,
    STATE_CLOSED,
    STATE_HALF_WORD,
    STATE_LIVE,
    RingHeader,
    decode_header,
    default_directories,
    encode_header,
    encode_ledger_block,
    ring_path,
)
from imud.formats.slot import SEQ_INVALID, SLOT_BYTES, slot_seqs, slots_in
from imud.host.files import READ_FLAGS, can_replace, user_name
from imud.model.errors import ServerError
from imud.model.host_object import GroupName, MemoryDirectory
from imud.model.options import Options
from imud.model.units import NS_PER_MS

log = logging.getLogger(__name__)

# Maximum number of directory entries that imud checks for temporary files. Other users can create millions of entries
# in a shared directory.
LEFTOVERS_MAX: Final = 10_000

_DIRECTORY_MODE = 0o755
_OPEN_DIRECTORY = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_CREATE = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_FLOCK = struct.Struct("hhqqi0q")  # struct flock of fcntl(2): type, whence, start, length (0: to the end), pid
_TEMPORARY = ".new"


class RingDirectory:
    """Open directory of rings. Synchronization: one thread."""

    def __init__(self, path: str) -> None:
        """Open `path`. Remove the temporary files of a daemon that died while it created a ring. Raises ServerError if
        the directory is missing, if other users can replace its files, or if this user cannot create files."""
        self.path = path
        self._fd = _open(path)
        try:
            self._status = _checked(self._fd, path)
        except BaseException:  # close the descriptor after any error
            os.close(self._fd)
            raise
        self._remove_leftovers()

    @property
    def current(self) -> bool:
        """Return whether `path` still names this directory. False after it was removed, renamed or mounted over."""
        return kernel.is_at(os.fsencode(self.path), self._status.st_dev, self._status.st_ino)

    def names(self, name: str, file: os.stat_result) -> bool:
        """Return whether the directory entry `name` is the file `file`."""
        try:
            found = os.lstat(name, dir_fd=self._fd)
        except OSError:
            return False
        return os.path.samestat(found, file)

    def refuse_second_writer(self, name: str) -> None:
        """Raise ServerError if another daemon of this user or of root writes the ring `name`. `make` replaces any other
        file with this name."""
        try:
            found = os.stat(name, dir_fd=self._fd, follow_symlinks=False)
        except OSError:
            return
        if not _credible(found):
            return
        try:
            descriptor = os.open(name, OPEN_FLAGS, dir_fd=self._fd)
        except OSError:
            return
        try:
            if _credible(os.fstat(descriptor)) and _is_locked(descriptor):
                path = os.path.join(self.path, name)
                raise ServerError(f"{path}: another imud writes this ring, {_process(descriptor)}: stop it first")
        finally:
            os.close(descriptor)

    def keep_foreign_file(self, name: str) -> None:
        """Rename a file of this user or of root that has the name of a ring and is not a ring: imud replaces the name,
        and the content stays."""
        try:
            status = os.stat(name, dir_fd=self._fd, follow_symlinks=False)
            if not _credible(status) or not status.st_size:
                return
            descriptor = os.open(name, READ_FLAGS | os.O_NOFOLLOW, dir_fd=self._fd)
        except OSError:
            return
        try:
            start = os.pread(descriptor, len(MAGIC), 0)
        finally:
            os.close(descriptor)
        if start == MAGIC:
            return

        new_name = f".{name}.{secrets.token_hex(8)}.foreign"
        with suppress(OSError):
            os.rename(name, new_name, src_dir_fd=self._fd, dst_dir_fd=self._fd)
            path = os.path.join(self.path, name)
            log.warning("shm: %s is not a ring of imud; renamed it to %s in the same directory", path, new_name)

    def make(self, name: str, size_bytes: int, head: bytes, mode: int, group_id: int | None) -> int:
        """Create the file `name` with `head` and zeros. Return its locked descriptor.

        The file appears complete and locked. It replaces a file with the same name, and gets the group, if this user
        has the permission. Raises ServerError.
        """
        temporary = f".{name}.{secrets.token_hex(8)}{_TEMPORARY}"
        path = os.path.join(self.path, name)
        try:
            descriptor = os.open(temporary, _CREATE, 0o600, dir_fd=self._fd)
        except OSError as error:
            raise ServerError(
                f"cannot create {path}: {error.strerror}; check the permissions of {self.path}"
            ) from error
        try:
            _lock(descriptor)
            # otherwise a write to a page without memory would raise SIGBUS
            os.posix_fallocate(descriptor, 0, size_bytes)
            os.pwrite(descriptor, head, 0)
            if group_id is not None:
                # fails if the user is not in the group; the caller checks the group of the file
                with suppress(PermissionError):
                    os.fchown(descriptor, -1, group_id)
            os.fchmod(descriptor, mode)
            self._rename(temporary, name)
        except OSError as error:
            os.close(descriptor)
            with suppress(OSError):
                os.unlink(temporary, dir_fd=self._fd)
            raise ServerError(
                f"cannot create {path} with {size_bytes} bytes: {error.strerror}; check the file (ls -ld {path}) and "
                f"the free space (df {self.path}), or reduce shm.slots"
            ) from error
        return descriptor

    def remove(self, name: str, file: os.stat_result) -> None:
        """Remove `name` if it is `file` and if this user has the permission."""
        if self.names(name, file):
            with suppress(OSError):
                os.unlink(name, dir_fd=self._fd)

    def close(self) -> None:
        """Close the descriptor. A second call does nothing."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _rename(self, temporary: str, name: str) -> None:
        try:
            os.rename(temporary, name, src_dir_fd=self._fd, dst_dir_fd=self._fd)
        except IsADirectoryError:
            os.rmdir(name, dir_fd=self._fd)
            os.rename(temporary, name, src_dir_fd=self._fd, dst_dir_fd=self._fd)

    def _remove_leftovers(self) -> None:
        with os.scandir(self._fd) as entries:
            seen = [entry.name for entry in islice(entries, LEFTOVERS_MAX)]
        for name in seen:
            if name.startswith(".imud.") and name.endswith(_TEMPORARY):
                with suppress(OSError):  # the file of another user cannot be removed
                    self._remove_leftover(name)

    def _remove_leftover(self, name: str) -> None:
        if not _credible(os.stat(name, dir_fd=self._fd, follow_symlinks=False)):
            return
        descriptor = os.open(name, OPEN_FLAGS, dir_fd=self._fd)
        try:
            if not _is_locked(descriptor):
                os.unlink(name, dir_fd=self._fd)
        finally:
            os.close(descriptor)


def open_directory(configured: str, environment: Mapping[str, str]) -> RingDirectory:
    """Open the configured directory. If the default directory cannot be used, open the directory of the user. This
    function creates missing default directories, and a configured directory in an existing one. Raises ServerError."""
    if configured != DIRECTORY:
        return _made(configured, parents=False)
    first, *others = default_directories(environment)
    try:
        return _made(first)
    except ServerError as error:
        for other in others:
            directory = _made(other)
            log.warning("shm: %s; using %s", error, other)
            return directory
        raise ServerError(f"{error}; or set XDG_RUNTIME_DIR") from None


def directory_problem(configured: str, environment: Mapping[str, str]) -> str:
    """Return why this user cannot create rings; empty if it can. Create nothing."""
    is_default = configured == DIRECTORY
    paths = default_directories(environment) if is_default else [configured]
    for path in paths:
        level = Path(path)
        # imud creates the default directories, and a configured directory in an existing one
        while not os.path.exists(level) and (is_default or level == Path(path)):
            level = level.parent
        if os.path.isdir(level) and os.access(level, os.W_OK | os.X_OK, effective_ids=True):
            return ""
    hint = "set shm.directory, or XDG_RUNTIME_DIR" if is_default else "create its parent, or set shm.directory"
    return f"user {user_name()} cannot create shared memory in {' or '.join(paths)}; {hint}"


def _made(path: str, *, parents: bool = True) -> RingDirectory:
    for level in (Path(path).parent, Path(path))[not parents :]:
        with suppress(OSError):  # it exists, or opening it reports the problem
            level.mkdir(_DIRECTORY_MODE)
            level.chmod(_DIRECTORY_MODE)  # the umask may have removed permissions
    return RingDirectory(path)


def _open(path: str) -> int:
    try:
        return os.open(path, _OPEN_DIRECTORY)
    except PermissionError:
        raise ServerError(
            f"user {user_name()} cannot open {path}: permission denied; check its permissions (ls -ld {path})"
        ) from None
    except OSError as error:
        reason = "a symbolic link" if os.path.islink(path) else error.strerror
        hint = "create it, or set shm.directory"
        raise ServerError(f"{path}: expected a directory for shared memory ({reason}); {hint}") from error


def _checked(descriptor: int, path: str) -> os.stat_result:
    """Return the status of the directory. Raises ServerError if other users can replace its files."""
    status = os.fstat(descriptor)
    if problem := can_replace(status, path, "the rings"):
        raise ServerError(f"{problem}; set shm.directory")
    if not os.access(".", os.W_OK | os.X_OK, dir_fd=descriptor):
        raise ServerError(f"user {user_name()} cannot create files in {path}; check its permissions (ls -ld {path})")
    return status


def _credible(status: os.stat_result) -> bool:
    """Return whether a daemon of this user or of root can have created the file."""
    return stat.S_ISREG(status.st_mode) and status.st_uid in (0, os.geteuid())


def _lock(descriptor: int) -> None:
    fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0))


def _is_locked(descriptor: int) -> bool:
    """Return whether a process has a write lock on the file. The process must have opened it for writing."""
    asked = _FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, 0, 0, 0)
    answer = fcntl.fcntl(descriptor, fcntl.F_OFD_GETLK, asked)
    assert isinstance(answer, bytes)
    return bool(_FLOCK.unpack(answer)[0] == fcntl.F_WRLCK)


def _process(descriptor: int) -> str:
    try:
        return f"process {decode_header(os.pread(descriptor, HEADER_BYTES, 0), '').pid}"
    except ServerError:
        return "of another version"


_INVALID = struct.pack("<Q", SEQ_INVALID)
_SEQ = struct.Struct("<Q")
_PAYLOAD = slice(8, SLOT_BYTES)
_LEDGER_PAYLOAD = slice(LEDGER_BLOCK_OFFSET + 8, LEDGER_BLOCK_OFFSET + LEDGER_BLOCK_BYTES)


class ShmRing:
    """Ring file of one device. Synchronization: one thread."""

    def __init__(self, directory: RingDirectory, header: RingHeader, mode: int, group_id: int | None) -> None:
        """Create the complete file in `directory`. Raises ServerError."""
        self._directory = directory
        path = ring_path(directory.path, header.device)
        self._path, self._name = os.fsencode(path), path.name
        self._size_bytes = HEADER_BYTES + header.slot_count * SLOT_BYTES
        self._fd = directory.make(self._name, self._size_bytes, encode_header(header), mode, group_id)
        self._status = os.fstat(self._fd)
        self._inode = self._status.st_dev, self._status.st_ino
        self.group_given = self._status.st_gid == group_id  # True if the file has the requested group
        self._memory = self._mapped()
        with memoryview(self._memory) as view:
            self._words, self._halves = view.cast("Q"), view.cast("I")
        self._mask = header.slot_count - 1
        self._newest, self._update = header.newest_seq, 0
        # `Ring` of the kernel in C; None without the kernel. Its `write` returns False if the file was truncated.
        open_ring = getattr(kernel.present.module, "open_ring", None)
        self._ring: Any = open_ring and open_ring(self._memory, self._mask, self._newest, self._fd)
        self.write: Callable[[bytes], bool] = self._ring.write if self._ring else self.write_in_python
        self._known: tuple[str, tuple[int, ...]] | None = None  # last ledger, without the kernel
        # minimum size of the file for a write; larger than any file after the file was truncated
        self._least_bytes = self._size_bytes

    @property
    def newest(self) -> int:
        """Return the sequence number of the newest sample; 0 before the first."""
        return self._newest if self._ring is None else int(self._ring.newest)

    def write_in_python(self, packed: bytes) -> bool:
        """Write slots that are back to back, oldest first. Do nothing if the file was truncated. Return True."""
        if not self._is_whole():
            self._newest = slot_seqs(packed)[1]
        elif len(packed) == SLOT_BYTES:
            self._write_one(packed)
        elif not self._write_run(packed):
            for (slot,) in slots_in(packed):
                self._write_one(slot)
        return True

    def _write_one(self, slot: bytes) -> None:
        (seq,) = _SEQ.unpack_from(slot)
        words, at = self._words, HEADER_BYTES + (seq & self._mask) * SLOT_BYTES
        word = at >> 3
        words[word] = SEQ_INVALID
        self._memory[at + 8 : at + SLOT_BYTES] = slot[_PAYLOAD]
        words[word] = words[NEWEST_WORD] = seq  # Python assigns from left to right
        if seq != self._newest + 1:  # the ring does not contain the samples between: readers must not wait for them
            words[FIRST_WORD] = seq
        self._newest = seq

    def _write_run(self, packed: bytes) -> bool:
        """Write consecutive slots. All slots are invalid from before the first payload until after the last payload.
        Return False without a write if a number is missing, or if the run reaches the end of the ring."""
        first, last = slot_seqs(packed)
        count, begin = len(packed) // SLOT_BYTES, first & self._mask
        if first != self._newest + 1 or last != self._newest + count or begin + count > self._mask + 1:
            return False
        at = HEADER_BYTES + begin * SLOT_BYTES
        words, numbers = self._words, slice(at >> 3, (at + count * SLOT_BYTES) >> 3, SLOT_BYTES >> 3)
        words[numbers] = invalid = memoryview(_INVALID * count).cast("Q")
        payload = bytearray(packed)
        with memoryview(payload).cast("Q") as view:
            view[:: SLOT_BYTES >> 3] = invalid
        self._memory[at + 8 : at + count * SLOT_BYTES] = memoryview(payload)[8:]
        with memoryview(packed).cast("Q") as view:
            words[numbers] = view[:: SLOT_BYTES >> 3]
        self._newest = words[NEWEST_WORD] = last
        return True

    def beat(self, now_ns: int) -> bool:
        """Write the heartbeat. Return False if the file was truncated."""
        if self._ring and self._ring.beat(now_ns):
            return True
        if is_whole := self._is_whole():
            self._words[HEARTBEAT_WORD] = now_ns
        return is_whole

    def set_ledger(self, driver: str, counters: tuple[int, ...]) -> None:
        """Write the driver, and the ledger as counters in the order of LEDGER_FIELDS, if they changed."""
        if self._ring and self._ring.show(driver, counters):
            return
        if self._known == (driver, counters) or not self._is_whole():
            return
        self._known = (driver, counters)
        self._update += 1
        block = encode_ledger_block(self._update, driver, counters)
        self._words[LEDGER_UPDATE_WORD] = SEQ_INVALID
        self._memory[_LEDGER_PAYLOAD] = block[8:]
        self._words[LEDGER_UPDATE_WORD] = self._update

    def is_at_path(self) -> bool:
        """Return whether readers find the file at its path."""
        return kernel.is_at(self._path, *self._inode)

    def is_named(self, directory: RingDirectory) -> bool:
        """Return whether the file has its name in `directory`."""
        return directory.names(self._name, self._status)

    def close(self) -> None:
        """Mark the ring as closed and remove its file."""
        if self._is_whole():
            self._halves[STATE_HALF_WORD] = STATE_CLOSED
        self._directory.remove(self._name, self._status)
        self._ring, self.write = None, self.write_in_python
        for view in (self._words, self._halves):
            view.release()
        self._memory.close()
        os.close(self._fd)

    def _mapped(self) -> mmap.mmap:
        try:
            return mmap.mmap(self._fd, self._size_bytes)
        except OSError as error:
            self._directory.remove(self._name, self._status)
            os.close(self._fd)
            raise ServerError(f"cannot map {self._size_bytes} bytes of {self._name}: {error.strerror}") from error

    def _is_whole(self) -> bool:
        whole = os.lseek(self._fd, 0, os.SEEK_END) >= self._least_bytes
        if not whole:
            self._restore_size()
        return whole

    def _restore_size(self) -> None:
        """Restore the size of a truncated file and mark it as closed, without the mapping. Readers can have the file
        mapped. imud does not write to it after that."""
        self._newest, self._ring, self.write = self.newest, None, self.write_in_python
        self._least_bytes = sys.maxsize
        with suppress(OSError):
            os.ftruncate(self._fd, self._size_bytes)
            os.pwrite(self._fd, struct.pack("<I", STATE_CLOSED), OFFSETS["state"])


ASKER: Final = "shared memory"  # name of this output in latency requests
# Minimum time between two checks of the files, and between two ledgers, ns: each second tick in a quiet state
CHECK_NS: Final = 950_000_000
OTHERS_WRITE: Final = 0o022
SLOTS_MIN, SLOTS_MAX = 64, 1 << 20  # limits of `slots`: a ring of 64 slots has 20 kB, a ring of 2²⁰ slots 320 MB


class ShmOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of shared memory."""

    enabled: bool = True
    """Write rings."""
    directory: MemoryDirectory = DIRECTORY
    """Directory of the ring files. If the default is not usable, imud uses $XDG_RUNTIME_DIR/imud/shm."""
    slots: Annotated[int, msgspec.Meta(ge=SLOTS_MIN, le=SLOTS_MAX)] = 4096
    """Number of samples in a ring, a power of two: 4096 are four seconds at 1 kHz and 1.3 MB per device."""
    latency_ms: Annotated[float, msgspec.Meta(ge=0, le=50)] = 5.0
    """Maximum hold of samples, ms; 0: imud writes each sample immediately (docs/latency.md)."""
    group: GroupName = "imud"
    """Group with read access, if it exists and imud may use it."""
    mode: Annotated[int, msgspec.Meta(ge=0, le=0o777)] = 0o640
    """File mode: permissions of owner, group and others. Only the owner may have write permission."""

    def __post_init__(self) -> None:
        """Raise ValueError if a value is invalid."""
        if self.slots & (self.slots - 1):
            below = 1 << self.slots.bit_length() - 1
            raise ValueError(f"slots: expected a power of two, got {self.slots}; try {below} or {2 * below}")
        if not self.directory.startswith("/"):
            raise ValueError(f"directory: expected an absolute path, got {self.directory!r}")
        if self.mode & OTHERS_WRITE:
            raise ValueError(f"mode: expected no write permission for group and others, got {self.mode:#o}; try 0o640")


@dataclass(slots=True)
class _Place:
    """Device of the configuration, and the cause of a missing ring."""

    device_id: int
    newest: int = 0  # sequence number of the newest sample while there was no ring
    problem: str = ""


class ShmPublisher:
    """Output that writes the samples of each device into a ring. Synchronization: the event loop's thread only."""

    def __init__(self, settings: ShmOptions, context: PublisherContext) -> None:
        self._settings = settings
        self._context = context
        self._directory: RingDirectory | None = None
        self._places: dict[str, _Place] = {}
        self._rings: dict[str, ShmRing] = {}
        self._group_id: int | None = None
        self._started = False
        self._directory_problem = ""
        self._check_ns = 0  # CLOCK_MONOTONIC of the next check of the files

    def start(self) -> None:
        """Open the directory and find the group. Raises ServerError if imud cannot create files in the directory."""
        if sys.byteorder != "little":
            raise ServerError("shared memory needs a little-endian host; set `shm: {enabled: false}`")
        self._opened_directory()
        self._group_id = self._find_group()
        self._started = True
        self._context.latencies.ask(ASKER, round(self._settings.latency_ms * NS_PER_MS))

    def add_device(self, name: str, device_id: int) -> None:
        """Create the ring of a device. If that fails, log the cause and try again later. Raises ServerError if another
        daemon writes the ring, or if the directory cannot be used."""
        self.remove_device(name)
        try:
            directory = self._opened_directory()
            file_name = ring_path(directory.path, name).name
            directory.refuse_second_writer(file_name)
            directory.keep_foreign_file(file_name)
        except ServerError:
            if not self._started:  # the daemon will not start: close all rings
                self.close()
            raise
        self._places[name] = _Place(device_id)
        self._make(name, directory, self._context.clock.now_ns())

    def remove_device(self, name: str) -> None:
        """Close the ring of a device and remove its file. Do nothing if there is no ring."""
        self._places.pop(name, None)
        ring = self._rings.pop(name, None)
        self._context.outputs.rings.pop(name, None)
        self._context.outputs.without_ring.discard(name)
        if ring is not None:
            ring.close()

    event: Final = None  # rings contain only samples

    def publish(self, batch: Batch) -> None:
        """Write samples over the oldest samples of the ring."""
        ring = self._rings.get(batch.device)
        if ring is not None:
            write, packed = ring.write, batch.packed
            if not write(packed):
                ring.write_in_python(packed)
        elif batch.device in self._places:
            self._places[batch.device].newest = batch.seqs[1]

    def tick(self, now_ns: int) -> None:
        """Write heartbeats. Once per second, create missing or truncated rings again, and write ledgers."""
        if now_ns < self._check_ns:
            for ring in self._rings.values():
                ring.beat(now_ns)
            return
        self._check_ns = now_ns + CHECK_NS
        for name in self._places:
            found = self._rings.get(name)
            if found is None or not (found.beat(now_ns) and found.is_at_path()):
                self._replace(name, self._current_directory(), now_ns)
        self._show_ledgers()

    def close(self) -> None:
        """Write the final ledgers and close all rings. A second call does nothing."""
        self._context.latencies.release(ASKER)
        self._show_ledgers()
        for ring in self._rings.values():
            ring.beat(self._context.clock.now_ns())
        for name in list(self._places):
            self.remove_device(name)
        if self._directory is not None:
            self._directory.close()
            self._directory = None

    def _show_ledgers(self) -> None:
        for name, driver, ledger in self._context.devices.ledgers():
            ring = self._rings.get(name)
            if ring is not None:
                ring.set_ledger(driver, ledger)

    def _opened_directory(self) -> RingDirectory:
        if self._directory is None:
            self._directory = open_directory(self._settings.directory, os.environ)
        return self._directory

    def _current_directory(self) -> RingDirectory:
        """Return the directory that the path names now. If it cannot be used, return the previous one."""
        directory = self._opened_directory()
        if directory.current:
            return directory
        try:
            self._directory = open_directory(self._settings.directory, os.environ)
        except ServerError as error:
            if str(error) != self._directory_problem:
                log.error("shm: %s; trying again", error)
            self._directory_problem = str(error)
            return directory
        self._directory_problem = ""
        directory.close()
        return self._directory

    def _replace(self, name: str, directory: RingDirectory, now_ns: int) -> None:
        """Replace a missing or truncated ring, or create the ring that could not be created before."""
        old = self._rings.get(name)
        if old is None or not old.is_named(directory):
            try:
                file_name = ring_path(directory.path, name).name
                directory.refuse_second_writer(file_name)
                directory.keep_foreign_file(file_name)
            except ServerError as error:
                self._put_off(name, error)
                return
        if self._make(name, directory, now_ns):
            log.warning("shm: the ring file of %s was missing or truncated; created it again", name)
            if old is not None:
                old.close()

    def _make(self, name: str, directory: RingDirectory, now_ns: int) -> bool:
        """Create the ring of a device. It continues with the sequence numbers of the previous ring."""
        context, settings, place, old = self._context, self._settings, self._places[name], self._rings.get(name)
        newest = place.newest if old is None else old.newest
        header = RingHeader(
            context.epoch, os.getpid(), STATE_LIVE, name, place.device_id, settings.slots, newest, newest + 1, now_ns
        )  # fmt: skip
        try:
            ring = self._rings[name] = ShmRing(directory, header, settings.mode, self._group_id)
        except ServerError as error:
            self._put_off(name, error)
            return False
        place.problem = ""
        context.outputs.rings[name] = str(ring_path(directory.path, name))
        context.outputs.without_ring.discard(name)
        if self._group_id is not None and not ring.group_given:
            self._warn_of_group(f"does not contain user {os.geteuid()}, so imud cannot give it files")
        return True

    def _put_off(self, name: str, error: ServerError) -> None:
        place = self._places[name]
        if str(error) != place.problem:
            log.error("shm: no ring for %s: %s; trying again every second", name, error)
        place.problem = str(error)
        self._context.outputs.without_ring.add(name)

    def _find_group(self) -> int | None:
        try:
            return grp.getgrnam(self._settings.group).gr_gid
        except KeyError:
            self._warn_of_group("does not exist")
            return None

    def _warn_of_group(self, why: str) -> None:
        """Log once why the group cannot read the ring."""
        self._group_id = None
        log.warning("shm: group %s %s; its members cannot read shared memory", self._settings.group, why)


PUBLISHER = PublisherType("shm", ShmOptions, ShmPublisher, required=True)
