"""The kernel `imud/_kernel.c`, if it is installed for this Python: the results of the Python code in less CPU time.

The value 0 of the environment variable IMUD_KERNEL switches the kernel off.
"""

import os
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Final, NamedTuple
from zlib import crc32

from imud.model.errors import reason_of
from imud.model.ledger import Ledger

SOURCE: Final = Path(__file__).parent.parent / "_kernel.c"


class Kernel(NamedTuple):
    """The loaded kernel, or the reason why imud does not use it."""

    module: ModuleType | None
    problem: str = ""  # one sentence; empty if the kernel is loaded


def load(setting: str | None) -> Kernel:
    """Load the kernel. `setting` is the value of IMUD_KERNEL."""
    if setting == "0":
        return Kernel(None, "IMUD_KERNEL=0 switches it off")
    try:
        module = import_module("imud._kernel")
        source_crc = crc32(SOURCE.read_bytes())
    except (ImportError, OSError) as error:
        return Kernel(None, f"it is not installed: {reason_of(error)}")
    if getattr(module, "source_crc", None) != source_crc:  # a checkout with an older library
        return Kernel(None, "it was compiled from another version of imud/_kernel.c; compile it again")
    return Kernel(module)


@dataclass(frozen=True, slots=True)
class KernelFormat:
    """Format of frames that the kernel decodes."""

    name: str  # name in the table `formats` of the kernel
    head: bytes  # first bytes of every frame
    size_bytes: int  # size of a frame


class KernelFrames:
    """Part of a codec whose usual frames the kernel decodes: its undecoded bytes."""

    kernel_format: KernelFormat  # format of the newest frame

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self._tail = b""  # incomplete rest of the bytes: starts with a sync word, or is the first half of a sync word

    def take(self, frames: bytes, count: int, data: bytes) -> bytes:
        """Count the first `count` frames as samples. `frames` are the pending bytes and new bytes `data`. Return the
        end of `data` that the codec must decode."""
        ledger, size_bytes = self.ledger, self.kernel_format.size_bytes
        size = count * size_bytes
        ledger.bytes_in_good_frames += size
        ledger.frames_good += count
        ledger.frames_in_samples += count
        if frames is data and size == len(data):  # the usual case: complete frames only
            ledger.bytes_in += size
            return b""
        rest, head = frames[size:], self.kernel_format.head
        is_start = len(rest) < size_bytes and rest[: len(head)] == head[: len(rest)]
        self._tail = rest if is_start else b""
        ledger.bytes_in += len(data) if is_start else len(data) - len(rest)
        ledger.bytes_pending = len(self._tail)
        return b"" if is_start else rest


# Kernel of this process. Users read it at each call, so that a test can replace it.
present = load(os.environ.get("IMUD_KERNEL"))


def is_at(path: bytes, st_dev: int, st_ino: int) -> bool:
    """Return whether `path` is the file with these numbers of `os.stat_result`, and not a link to it."""
    module = present.module
    if module is not None:
        return bool(module.is_at(path, st_dev, st_ino))
    try:
        found = os.lstat(path)
    except OSError:
        return False
    return found.st_ino == st_ino and found.st_dev == st_dev
