"""Pipes as a log may be: read late, or never."""

import os
import select
from collections.abc import Iterator
from contextlib import contextmanager, suppress


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
