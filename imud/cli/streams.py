"""Standard input, output and error of a command: there, able to show every text, and never waited for at the end.

A command may be started with a descriptor closed, with its output on a full disk or on a pipe that nobody reads, and in
a locale that has only ASCII. None of that may end in a traceback, or in an exit status that says the opposite.
"""

import errno
import io
import os
import select
import sys
from contextlib import suppress
from typing import Final, TextIO

from imud.log import MESSAGE_CHARACTERS_MAX, printable

STANDARD_STREAMS: Final = 3
ERROR_WAIT_MS: Final = 1000
"""How long the end of a command waits for the reader of its standard error."""


def open_standard_streams() -> None:
    """Open /dev/null in place of closed descriptors, which a port or socket would get else; escape what is not shown.

    Characters that the locale's encoding does not have are written as backslash escapes.
    """
    for descriptor in range(STANDARD_STREAMS):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    sys.stdin = sys.stdin or open(0, closefd=False)  # noqa: SIM115 - open to the end of the process
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def discard_output() -> None:
    """Throw away what is buffered for standard output, and all that follows: it cannot be written."""
    _discard(sys.stdout)


def raise_if_unread() -> None:
    """Raise BrokenPipeError where standard output is a pipe or socket whose reader has gone, without writing to it."""
    try:
        descriptor = sys.stdout.fileno()
    except OSError:  # a stream without a descriptor, in memory
        return
    poll = select.poll()
    poll.register(descriptor, 0)  # errors are reported unasked
    if any(events & select.POLLERR for _, events in poll.poll(0)):
        raise BrokenPipeError(errno.EPIPE, "nobody reads the output any more")


def complain(text: str) -> None:
    """Write `text` to standard error, each line escaped; give up when it cannot be written, or nobody reads it."""
    try:
        for line in text.splitlines():
            if not _writable(sys.stderr):
                return
            print(printable(line, MESSAGE_CHARACTERS_MAX), file=sys.stderr, flush=True)
    except OSError:
        _discard(sys.stderr)


def _discard(stream: TextIO) -> None:
    with suppress(OSError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def _writable(stream: TextIO) -> bool:
    """Whether a write would not wait, now or soon."""
    try:
        descriptor = stream.fileno()
    except OSError:  # a stream without a descriptor, in memory
        return True
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return bool(poll.poll(ERROR_WAIT_MS))
