"""Pulses for chronyd: samples for the socket of a reference clock (SOCK).

A sample starts with a `struct timeval`. It has 16 bytes, or 8 bytes if the program uses a 32-bit `time_t` (32-bit ARM
and x86 before the change to 64 bits). chronyd ignores samples of another length, and reports nothing to the sender.
imud therefore reads the program that owns the socket:

    owner of the socket ─▶ process with the name chronyd ─▶ installed program ─▶ unknown

A service without permission for the processes of other users sees only the installed program.
"""

import os
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from imud.host.files import read_regular
from imud.model.units import NS_PER_S, NS_PER_US

LONG_BYTES: Final = 40  # length of a sample with a 64-bit `time_t`
SHORT_BYTES: Final = 32  # length of a sample with a 32-bit `time_t`
PROC: Final = Path("/proc")
PROGRAMS: Final = (Path("/usr/sbin/chronyd"), Path("/usr/local/sbin/chronyd"), Path("/usr/bin/chronyd"))
NAME: Final = b"chronyd"
PROGRAM_BYTES_MAX: Final = 16 << 20  # maximum length of the read part of a program, bytes. chronyd has 300 kB.
TABLE_BYTES_MAX: Final = 4 << 20  # maximum length of the read part of a table in /proc, bytes

ELF: Final = struct.Struct("=4sB11xHH")  # magic number, class, type, machine; in the byte order of this host
ELF_MAGIC: Final = b"\x7fELF"
CLASS_32, CLASS_64 = 1, 2
LONG_TIME_MACHINES: Final = (62, 243, 258)  # 32-bit programs that always have a 64-bit time: x32, RISC-V, LoongArch
LONG_TIME_SYMBOLS: Final = (b"clock_gettime64", b"gettimeofday64")  # functions of libc with a 64-bit time


def find_sample_bytes(path: str, proc: Path = PROC, programs: tuple[Path, ...] = PROGRAMS) -> int | None:
    """Return the length of a sample for the socket at `path`; None if imud cannot know it."""
    for candidates in (_owners(path, proc), _processes(proc), iter(programs)):
        lengths = {length for program in candidates if (length := _sample_bytes_of(program)) is not None}
        if len(lengths) == 1:
            return lengths.pop()
    return None


def _owners(path: str, proc: Path) -> Iterator[Path]:
    """Yield the programs of the processes that have the socket open and that imud may read."""
    links = {f"socket:[{inode}]" for inode in _inodes(path, proc)}
    if not links:
        return
    for process in _process_folders(proc):
        with suppress(OSError):
            descriptors = os.listdir(process / "fd")
            if any(_link(process / "fd" / name) in links for name in descriptors):
                yield process / "exe"


def _processes(proc: Path) -> Iterator[Path]:
    """Yield the programs of the processes with the name chronyd. Each user may read their command lines."""
    for process in _process_folders(proc):
        with suppress(OSError):
            if (process / "comm").read_bytes().strip() == NAME:
                command = (process / "cmdline").read_bytes().split(b"\0")[0]
                yield Path(os.fsdecode(command))


def _inodes(path: str, proc: Path) -> list[str]:
    """Return the numbers of the sockets that are bound to a path."""
    with suppress(OSError):
        with (proc / "net/unix").open("rb") as table:
            lines = table.read(TABLE_BYTES_MAX).decode(errors="surrogateescape").splitlines()
        fields = [line.split(maxsplit=7) for line in lines]
        return [field[6] for field in fields if len(field) == 8 and field[7] == path]
    return []


def _process_folders(proc: Path) -> list[Path]:
    with suppress(OSError):
        return [proc / name for name in os.listdir(proc) if name.isdecimal()]
    return []


def _link(path: Path) -> str:
    with suppress(OSError):
        return os.readlink(path)
    return ""


def _sample_bytes_of(program: Path) -> int | None:
    """Return the length of the samples of a program; None if it is not a readable program."""
    try:
        head = read_regular(program, ELF.size)
        if len(head) < ELF.size:
            return None
        magic, elf_class, _, machine = ELF.unpack(head)
        if magic != ELF_MAGIC or elf_class not in (CLASS_32, CLASS_64):
            return None
        if elf_class == CLASS_64 or machine in LONG_TIME_MACHINES:
            return LONG_BYTES
        content = read_regular(program, PROGRAM_BYTES_MAX)
    except OSError:
        return None
    return LONG_BYTES if any(symbol in content for symbol in LONG_TIME_SYMBOLS) else SHORT_BYTES


MAGIC: Final = 0x534F434B
LAYOUTS: Final = {LONG_BYTES: struct.Struct("=qqdiiii"), SHORT_BYTES: struct.Struct("=IIdiiii")}
HALF_NS: Final = NS_PER_S // 2
SECONDS_MASK: Final = 0xFFFFFFFF  # a 32-bit time overflows in 2038


def encode(system_ns: int, offset_ns: int, *, pulse: bool, leap: int = 0, sample_bytes: int = LONG_BYTES) -> bytes:
    """Encode a sample for chronyd: at `system_ns`, true time was `offset_ns` later (`pulse`: modulo 1 s)."""
    seconds, rest_ns = divmod(system_ns, NS_PER_S)
    if sample_bytes == SHORT_BYTES:
        seconds &= SECONDS_MASK
    return LAYOUTS[sample_bytes].pack(seconds, rest_ns // NS_PER_US, offset_ns / NS_PER_S, pulse, leap, 0, MAGIC)


UNKNOWN_LENGTH: Final = (
    "{}: not verified that it uses the samples, because imud cannot read its program; compare the field Reach of "
    "`chronyc sources`, and set lines.pps.chrony_sample_bytes to 40, or to 32 for a chronyd with a 32-bit time"
)


class ChronyFeed:
    """Sender of samples to chronyd. It never blocks. Synchronization: one thread."""

    def __init__(
        self,
        path: str,
        utc_offset_ns: Callable[[], int],
        sample_bytes: int | None = None,
        find_length: Callable[[str], int | None] = find_sample_bytes,
    ) -> None:
        """`path` is chronyd's socket, which may not exist yet. `utc_offset_ns`: see `SourceContext.utc_offset_ns`.
        `sample_bytes` is the configured length of a sample; None: imud reads the program of chronyd."""
        self.title = f"chronyd at {path}"
        # reason why chronyd may not use the samples, one sentence; empty if the socket accepted the last sample and
        # imud knows its length
        self.problem = ""
        self.sent = 0
        self.refused = 0  # number of samples that chronyd did not accept: it is not running, or it is too slow
        self._path = path
        self._utc_offset_ns = utc_offset_ns
        self._configured_bytes = sample_bytes
        self._sample_bytes = sample_bytes
        self._find_length = find_length
        self._is_accepted = False  # whether the socket accepted the last sample
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send_pulse(self, t_ns: int, unix_s: int | None = None) -> bool:
        """Send a pulse at CLOCK_MONOTONIC `t_ns`, the start of `unix_s` if known. Return whether chronyd accepted it.
        Call this method soon after the pulse. Without the second, chronyd needs another source for it (`lock`)."""
        system_ns = t_ns + self._utc_offset_ns()
        second_s = (system_ns + HALF_NS) // NS_PER_S if unix_s is None else unix_s
        offset_ns = second_s * NS_PER_S - system_ns
        sample_bytes = self._sample_bytes or LONG_BYTES
        return self._send(encode(system_ns, offset_ns, pulse=unix_s is None, sample_bytes=sample_bytes))

    def close(self) -> None:
        with suppress(OSError):
            self._socket.close()

    def _send(self, sample: bytes) -> bool:
        try:
            self._socket.sendto(sample, self._path)
        except OSError as error:
            self.refused += 1
            self.problem = f"{self.title} rejects samples: {error.strerror or error}; is it running with this socket?"
            self._is_accepted = False
            return False
        self.sent += 1
        if not self._is_accepted and self._configured_bytes is None:  # chronyd started, perhaps another program
            self._sample_bytes = self._find_length(self._path)
        self._is_accepted = True
        self.problem = "" if self._sample_bytes is not None else UNKNOWN_LENGTH.format(self.title)
        return True
