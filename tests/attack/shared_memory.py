"""Operations of a user without rights in a directory of rings, as fast as possible, until the process is stopped.

`attack` runs in its own process, which it changes to the hostile user. In `/run/imud/shm`, the kernel refuses every
operation. In a sticky directory such as /dev/shm, the user can make names, and lock and map readable files. The daemon
must keep working.
"""

import errno
import fcntl
import mmap
import os
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Final

from imud.formats.ring import HEADER_BYTES, STATE_LIVE, RingHeader, encode_header
from imud.formats.slot import SLOT_BYTES

DEVICES: Final = ("a", "bow", "demo", "imu", "imu0", "stern")
"""Names of possible devices. The attack also uses the names of the existing rings."""
SLOTS: Final = 64
HELD_MAX: Final = 64
"""Maximum number of descriptors that the attacker keeps open, with their locks."""
FILLER_BYTES: Final = 1 << 20  # size of a filler file
FILLERS: Final = 8


class Attacker:
    """A user with at most read permission. It counts its operations and expects errors."""

    def __init__(self, directory: Path, seed: int = 1) -> None:
        self.acts = 0
        self._directory = directory
        self._random = Random(seed)
        self._held: list[int] = []
        self._kinds: tuple[Callable[[Path], None], ...] = (
            self._fifo, self._link, self._folder, self._node, self._forge, self._lock, self._cut, self._remove,
            self._rename, self._rights, self._write, self._fill, self._watch,
        )  # fmt: skip

    def act(self) -> None:
        kind, path = self._random.choice(self._kinds), self._target()
        self.acts += 1
        with suppress(OSError, ValueError):
            kind(path)

    def clean(self) -> None:
        for descriptor in self._held:
            os.close(descriptor)
        self._held.clear()
        for path in self._directory.iterdir():
            if path.lstat().st_uid == os.geteuid():
                path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()

    def _target(self) -> Path:
        there: list[str] = []
        with suppress(OSError):
            there = [name for name in os.listdir(self._directory) if name.startswith(("imud.", ".imud."))]
        names = [f"imud.{device}" for device in DEVICES]
        names += [f".{name}.new" for name in names] + there
        return self._directory / self._random.choice(names)

    def _hold(self, descriptor: int) -> None:
        self._held.append(descriptor)
        if len(self._held) > HELD_MAX:
            os.close(self._held.pop(0))

    def _fifo(self, path: Path) -> None:
        os.mkfifo(path)

    def _link(self, path: Path) -> None:
        path.symlink_to(self._random.choice(["/etc/passwd", "/dev/zero", "/nowhere", str(path), "/proc/self/mem"]))

    def _folder(self, path: Path) -> None:
        path.mkdir()

    def _node(self, path: Path) -> None:
        os.mknod(path, stat.S_IFSOCK | 0o666)

    def _forge(self, path: Path) -> None:
        pid = self._random.choice([1, os.getpid(), os.getppid()])
        header = RingHeader(5, pid, STATE_LIVE, path.name[5:][:63], 0, SLOTS, (1 << 64) - 2, 1, (1 << 63) - 1)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        self._hold(descriptor)
        os.write(descriptor, encode_header(header))
        os.truncate(descriptor, HEADER_BYTES + self._random.choice([0, 1, SLOTS, 1 << 20]) * SLOT_BYTES)
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def _lock(self, path: Path) -> None:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        self._hold(descriptor)
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        fcntl.lockf(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)

    def _cut(self, path: Path) -> None:
        os.truncate(path, self._random.choice([0, 1, HEADER_BYTES]))

    def _remove(self, path: Path) -> None:
        path.rmdir() if path.is_dir() else path.unlink()

    def _rename(self, path: Path) -> None:
        path.rename(self._directory / f"imud.{self._random.choice(DEVICES)}")

    def _rights(self, path: Path) -> None:
        path.chmod(self._random.choice([0, 0o666, 0o777]))
        self._directory.chmod(0o777)

    def _write(self, path: Path) -> None:
        descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._hold(descriptor)
        os.pwrite(descriptor, b"\xff" * SLOT_BYTES, HEADER_BYTES)

    def _fill(self, _: Path) -> None:
        path = self._directory / f"filler-{self._random.randrange(FILLERS)}"
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            os.write(descriptor, bytes(FILLER_BYTES))
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
        finally:
            os.close(descriptor)

    def _watch(self, path: Path) -> None:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
        self._hold(descriptor)
        with mmap.mmap(descriptor, HEADER_BYTES, prot=mmap.PROT_READ | mmap.PROT_WRITE) as memory:
            memory[:8] = bytes(8)


def attack(directory: Path, uid: int, stop: Callable[[], bool]) -> int:
    """Become `uid` without groups, attack until `stop()`, clean up. Return the number of hostile operations.

    Call this function only in a child process, because the change of the user is permanent. Raises PermissionError if
    this user may not become `uid`.
    """
    if os.geteuid() != uid:
        os.setgroups([])
        os.setresgid(uid, uid, uid)
        os.setresuid(uid, uid, uid)
    attacker = Attacker(directory)
    while not stop():
        attacker.act()
    attacker.clean()
    return attacker.acts
