"""Waiting for files and device nodes through Linux inotify(7), without polling.

Python's standard library has no inotify; the three calls are made through ctypes. A wait watches the directory of the
path; where that directory is missing too (`/dev/serial/by-id` without any adapter), the nearest parent that exists;
where the path is a symbolic link, the directories on its way as well.
"""

import asyncio
import concurrent.futures.thread  # noqa: F401 - `run_in_executor` imports it late, when there may be no descriptor left
import ctypes
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

from imud.errors import LinkDenied, LinkError

IN_ATTRIB: Final = 0x0004
IN_MOVED_TO: Final = 0x0080
IN_CREATE: Final = 0x0100
IN_DELETE: Final = 0x0200
IN_DELETE_SELF: Final = 0x0400
IN_MOVE_SELF: Final = 0x0800
IN_ONLYDIR: Final = 0x0100_0000
WATCH_MASK: Final = IN_ATTRIB | IN_MOVED_TO | IN_CREATE | IN_DELETE | IN_DELETE_SELF | IN_MOVE_SELF | IN_ONLYDIR
"""IN_ATTRIB because udev sets group and mode of a fresh node after the kernel made it."""

EVENT_BUFFER_BYTES: Final = 4096
"""Room for at least 15 events: 16 bytes and a name of at most 256 each (inotify(7))."""
LINKS_MAX: Final = 40
"""Symbolic links followed, as the kernel does (path_resolution(7))."""

libc = ctypes.CDLL(None, use_errno=True)


class DirectoryWatch:
    """An inotify descriptor that watches some directories. Synchronization: the loop's thread only."""

    def __init__(self) -> None:
        """Raises LinkError when the user's inotify instances are used up."""
        self._fd: int = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise LinkError(
                f"inotify: {os.strerror(ctypes.get_errno())}; look at /proc/sys/fs/inotify/max_user_instances"
            )

    def add(self, directory: Path) -> bool:
        """Watch a directory; False when it is gone or may not be read."""
        return int(libc.inotify_add_watch(self._fd, os.fsencode(directory), WATCH_MASK)) >= 0

    async def changed(self) -> None:
        """Return when something happened in a watched directory since it was added, or since the last call."""
        loop = asyncio.get_running_loop()
        readable = loop.create_future()
        loop.add_reader(self._fd, lambda: None if readable.done() else readable.set_result(None))
        try:
            await readable
        finally:
            loop.remove_reader(self._fd)
        os.read(self._fd, EVENT_BUFFER_BYTES)

    def close(self) -> None:
        """Release the descriptor; may be called twice. A thread does it: the kernel needs 8 ms and more."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            asyncio.get_running_loop().run_in_executor(None, os.close, fd)


async def wait_until(path: Path, ready: Callable[[], bool]) -> None:
    """Return as soon as `ready()` holds; it is asked again after every change on the way to `path`.

    The watch is set before `ready` is asked, so no change is missed. Raises LinkError when inotify is not to be had,
    LinkDenied when the directory may not be read.
    """
    if ready():
        return
    watch = DirectoryWatch()
    try:
        while True:
            directories = directories_of(path)
            watched = [watch.add(directory) for directory in directories]
            if directories_of(path) != directories:
                await asyncio.sleep(0)  # it changed while the watches were set: look again
                continue
            if not any(watched):
                raise LinkDenied(f"cannot watch {directories[0]} for {path.name}: may this user read that directory?")
            if ready():
                return
            await watch.changed()
    finally:
        watch.close()


def directories_of(path: Path) -> list[Path]:
    """The directories whose changes can make `path` appear, vanish, or become another file."""
    directories: list[Path] = []
    for _ in range(LINKS_MAX):
        directory = _nearest_directory(path.parent)
        if directory not in directories:
            directories.append(directory)
        if not path.is_symlink():
            break
        try:
            path = path.parent / path.readlink()
        except OSError:  # the link went away in between
            break
    return directories


def _nearest_directory(directory: Path) -> Path:
    while not directory.is_dir() and directory != directory.parent:
        directory = directory.parent
    return directory
