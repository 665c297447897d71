"""The attack on shared memory next to a running daemon, with a reader that must not get false samples.

A user without rights makes operations in the directory of the rings, as fast as possible, in a process of its own:
`python -m tests.attack.rings DIRECTORY UID SECONDS`. In `/run/imud/shm`, the kernel refuses every operation. In a
sticky directory such as /dev/shm, the user can make names, and lock and map readable files. There, the daemon changes
the size of its rings, so that names become free for the hostile user. The daemon must keep working.
"""

import errno
import fcntl
import mmap
import os
import stat
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from threading import Event, Thread
from time import monotonic, monotonic_ns, sleep
from typing import Final

from imud.client.ring import Ring
from imud.formats.ring import HEADER_BYTES, STATE_LIVE, RingHeader, encode_header
from imud.formats.slot import SLOT_BYTES
from imud.model.errors import ServerError
from tests.attack.hostile import become
from tests.attack.stage import SLOTS, AttackedDaemon

PRIVATE_MODE: Final = 0o755  # like /run/imud/shm
STICKY_MODE: Final = 0o1777  # like /dev/shm
OTHER_SLOTS: Final = 2 * SLOTS  # another size, so that the daemon creates the rings again
READ_S: Final = 0.02  # interval of reads
SETTLE_S: Final = 0.3
"""Time until new rings contain samples and a heartbeat, s."""
REMADE_MISSED_MAX: Final = 500
"""Maximum number of missed samples while the daemon creates all rings twice: half a second at 1 kHz."""
DEVICES: Final = ("a", "bow", "demo", "imu", "imu0", "stern")
"""Names of possible devices. The attack also uses the names of the existing rings."""
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


@dataclass
class Witness:
    stage: AttackedDaemon
    samples: int = 0
    missed: int = 0
    newest: int = 0
    refused: int = 0
    """Number of forged files that the reader rejected."""
    problems: list[str] = field(default_factory=list)
    over: Event = field(default_factory=Event)

    def run(self) -> None:
        try:
            with Ring(self.stage.rings / "imud.d0") as ring:
                self._follow(ring)
        except ServerError as error:
            self.problems.append(f"the reader failed: {error}")

    def _follow(self, ring: Ring) -> None:
        epoch, self.newest = ring.epoch, ring.newest_seq
        while not self.over.wait(READ_S):
            samples, missed = ring.read()
            self.samples += len(samples)
            self.missed += missed
            for sample in samples:
                if sample.seq <= self.newest:
                    self.problems.append(f"the reader received sample {sample.seq} after {self.newest}")
                self.newest = sample.seq
            self._open_foreign(epoch)
        if ring.epoch != epoch or not ring.alive(monotonic_ns()):
            self.problems.append("expected a ring with a current heartbeat at the end, got none")

    def _open_foreign(self, epoch: int) -> None:
        for name in DEVICES:
            try:
                with closing(Ring(self.stage.rings / f"imud.{name}")) as ring:
                    if ring.epoch != epoch:
                        self.problems.append(f"the reader accepted a forged ring of {name}")
            except ServerError as error:
                self.refused += "no such ring" not in str(error)


def attack(stage: AttackedDaemon, uid: int, seconds: float, sticky: bool) -> tuple[list[str], int]:
    """Let user `uid` attack the directory of the rings. Return the problems and the number of operations."""
    stage.rings.chmod(STICKY_MODE if sticky else PRIVATE_MODE)
    witness = Witness(stage)
    reading = Thread(target=witness.run)
    reading.start()
    argv = [sys.executable, "-m", "tests.attack.rings", str(stage.rings), str(uid), str(seconds)]
    child = subprocess.Popen(argv, stdout=subprocess.PIPE, text=True)
    if sticky:
        sleep(seconds / 2)
        stage.change(slots=OTHER_SLOTS)
        sleep(SETTLE_S)
        stage.change()
    out, _ = child.communicate(timeout=seconds + 30)
    sleep(SETTLE_S)
    witness.over.set()
    reading.join()
    stage.rings.chmod(PRIVATE_MODE)
    problems = (
        []
        if child.returncode == 0 and int(out)
        else [f"the hostile process failed with exit status {child.returncode}"]
    )
    return problems + witness.problems + _judged(witness, sticky), int(out or 0)


def _judged(witness: Witness, sticky: bool) -> list[str]:
    problems = []
    if not witness.samples:
        problems.append("the reader received no samples")
    limit = REMADE_MISSED_MAX if sticky else 0
    if witness.missed > limit:
        problems.append(f"the reader missed {witness.missed} samples, expected at most {limit}")
    if sticky and not witness.refused:
        problems.append("expected forged files that the reader rejects, got none: the attack had no effect")
    return problems


def main(directory: str, uid: str, seconds: str) -> None:
    """Become this user without groups, attack, clean up. Print the number of hostile operations."""
    become(int(uid), int(uid))
    attacker, end_s = Attacker(Path(directory)), monotonic() + float(seconds)
    while monotonic() < end_s:
        attacker.act()
    attacker.clean()
    print(attacker.acts)


if __name__ == "__main__":
    main(*sys.argv[1:])
