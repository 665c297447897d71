"""Surroundings that a daemon must withstand.

These are processes of other users, which only root can start, and pipes that nothing reads.
"""

import os
import select
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import takewhile
from typing import Final

import pytest

from tests.support.files import ROOT

DAEMON_UID: Final = 65534
HOSTILE_UID: Final = 65533

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can run a process as another user")


BECOME: Final = """
import os
os.setgroups([])
os.setgid({uid})
os.setuid({uid})
"""


@contextmanager
def python_as(uid: int, program: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A Python program of the user `uid`, without groups; killed at the end.

    It changes to that user after its imports: the interpreter may lie in a home directory that only its owner enters.
    """
    lines = program.strip().splitlines()
    imports = list(takewhile(lambda line: not line or line.startswith(("import ", "from ")), lines))
    text = "\n".join((*imports, BECOME.format(uid=uid), *lines[len(imports) :]))
    command = [sys.executable, "-X", "dev", "-c", text, *arguments]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def pipe(*, full: bool = False) -> Iterator[tuple[int, int]]:
    """Both ends of a pipe, the reader's first; filled if so wanted. The caller may close them."""
    reader, writer = os.pipe()
    if full:
        os.set_blocking(writer, False)
        with suppress(BlockingIOError):
            while True:
                os.write(writer, b"-" * 4096)
        os.set_blocking(writer, True)
    try:
        yield reader, writer
    finally:
        for descriptor in (reader, writer):
            with suppress(OSError):
                os.close(descriptor)


def read_until(descriptor: int, end: bytes) -> bytes:
    """What can be read, up to some text."""
    data = b""
    while end not in data:
        assert select.select([descriptor], [], [], 10)[0], data[-200:]
        data += os.read(descriptor, 65536)
    return data
