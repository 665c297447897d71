"""`imud record`: a recording of what devices deliver from now on, or of the last minutes, into a file of the user's.

The daemon sends the recording through a descriptor, this command writes it: the file belongs to who asked, and the
daemon opens none. What comes is looked at on the way, which gives the figures, and shows that it is whole.
"""

import argparse
import os
import select
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from time import monotonic
from types import FrameType
from typing import BinaryIO, Final

from imud.cli.arguments import CliCommand, add_socket, connect, duration_s
from imud.cli.recording.info import Contents
from imud.cli.streams import discard_output
from imud.client import Client
from imud.errors import BadArgument, ImudError, reason_of
from imud.formats.recording.file import RecordingReader

LOOK_S: Final = 0.2
"""Interrupts, the end of `--for` and the line of progress are looked after so often."""
PROGRESS_S: Final = 1.0
GIVE_UP_S: Final = 10.0
"""How long the daemon may send nothing after it was asked to end the recording."""
CHUNK_BYTES: Final = 1 << 16
CLEAR_LINE: Final = "\r\x1b[2K"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud record`."""
    add_socket(parser)
    parser.add_argument(
        "--device", action="append", metavar="NAME", help="record this one; may be given several times (default: all)"
    )
    parser.add_argument(
        "--for", dest="for_s", type=duration_s, metavar="DURATION", help="end after 90s, 10min, 2h (default: Ctrl-C)"
    )
    parser.add_argument(
        "--snapshot", action="store_true", help="save what the flight recorder has of the last minutes, and end"
    )
    parser.add_argument(
        "file",
        nargs="?",
        metavar="FILE",
        help="a file that does not exist yet, or - for standard output (default: by time)",
    )


def run(args: argparse.Namespace) -> int:
    """Record; 1 where the recording lost something, or ended otherwise than asked for. Needs permission to control.

    Raises ImudError where nothing can be recorded, or the file cannot be written.
    """
    if args.snapshot and (args.device or args.for_s):
        raise BadArgument("--snapshot: expected neither --device nor --for: it has what the flight recorder has")
    if args.file == "-" and sys.stdout.isatty():
        raise BadArgument("standard output is a terminal: expected a file, or a program that reads the recording")
    with connect(args) as client, interrupts(are_noted=not args.snapshot) as interrupt:
        descriptor = client.snapshot()[0] if args.snapshot else client.record(args.device)
        with open(descriptor, "rb", buffering=0) as stream, output(args.file) as (name, out):
            copy = Copy(stream, out, name)
            found = follow(copy, client, interrupt, args.for_s)
    return account(copy, found, name, asked=args.snapshot or copy.stopped)


class Interrupt:
    """Whether the user, or who started the command, wants it to end."""

    def __init__(self) -> None:
        self.asked = False

    def ask(self, _number: int, _frame: FrameType | None) -> None:
        """Note it; the second time end at once. Raises KeyboardInterrupt."""
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


@contextmanager
def interrupts(*, are_noted: bool) -> Iterator[Interrupt]:
    """Note SIGINT and SIGTERM in place of ending by them, if `are_noted`."""
    interrupt = Interrupt()
    numbers = (signal.SIGINT, signal.SIGTERM) if are_noted else ()
    before = {number: signal.signal(number, interrupt.ask) for number in numbers}
    try:
        yield interrupt
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def output(file: str | None) -> Iterator[tuple[str, BinaryIO]]:
    """Make the file; its name, and what to write to. Raises ImudError, also for one that exists."""
    if file == "-":
        yield "standard output", sys.stdout.buffer
        return
    name = file or f"imud-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.imudrec"
    try:
        made = open(name, "xb", buffering=0)  # noqa: SIM115 - closed below, and errors of opening are not those of writing
    except FileExistsError:
        raise ImudError(f"{name} exists already: expected the name of a new file") from None
    except (OSError, ValueError) as error:
        raise ImudError(f"{name}: {error.strerror if isinstance(error, OSError) else error}") from None
    with made:
        yield name, made
        os.fsync(made.fileno())


class Copy:
    """What comes from the daemon, written on while it is read. It is read as a file is."""

    def __init__(self, stream: BinaryIO, out: BinaryIO, name: str) -> None:
        self.bytes = 0
        self.stopped = False
        """Whether this side asked for the end."""
        self.look: Callable[[], None] = lambda: None
        """Called at least once in LOOK_S."""
        self._stream = stream
        self._out = out
        self._name = name
        self._moved_s = monotonic()

    def read(self, size: int, /) -> bytes:
        """Return what is there, or comes next; nothing at the end. Raises ImudError."""
        while True:
            self.look()
            if select.select((self._stream,), (), (), LOOK_S)[0]:
                break
            if self.stopped and monotonic() - self._moved_s > GIVE_UP_S:
                return b""
        data = self._stream.read(min(size, CHUNK_BYTES))
        self._moved_s = monotonic()
        self.bytes += len(data)
        self._write(data)
        return data

    def stop(self) -> None:
        """Note that the end was asked for."""
        self.stopped, self._moved_s = True, monotonic()

    def _write(self, data: bytes) -> None:
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[self._out.write(rest) :]
            self._out.flush()
        except BrokenPipeError:  # no `imud watch | head`: who asked for the recording does not have it
            discard_output()
            raise ImudError(f"{self._name}: nobody reads it any more; the recording ended before it was to") from None
        except OSError as error:
            raise ImudError(f"{self._name}: {reason_of(error)}; what was written before is whole") from None


def follow(copy: Copy, client: Client, interrupt: Interrupt, for_s: float | None) -> tuple[Contents, RecordingReader]:
    """Copy to the end of the recording, which is asked for when it is time; return what was in it."""
    contents, begun_s = Contents(), monotonic()
    shown_s = begun_s

    def look() -> None:
        nonlocal shown_s
        now_s = monotonic()
        if not copy.stopped and (interrupt.asked or (for_s is not None and now_s - begun_s >= for_s)):
            copy.stop()
            with suppress(ImudError, OSError):  # a daemon that has gone has ended the recording
                client.stop_recording()
        if sys.stderr.isatty() and now_s - shown_s >= PROGRESS_S:
            shown_s = now_s
            sys.stderr.write(f"{CLEAR_LINE}{now_s - begun_s:.0f} s: {figures(copy, contents)}")
            sys.stderr.flush()

    copy.look = look
    reader = RecordingReader(copy, "what the daemon sent")
    try:
        for record in reader:
            contents.add(record)
    finally:
        if sys.stderr.isatty():
            sys.stderr.write(CLEAR_LINE)
    return contents, reader


def figures(copy: Copy, contents: Contents) -> str:
    """Format what was recorded so far."""
    devices = [one for one in contents.devices.values() if one.name]
    samples = sum(one.samples for one in devices)
    return (
        f"{copy.bytes / 1e6:.2f} MB, {samples} samples of {len(devices)} device{'' if len(devices) == 1 else 's'}, "
        f"{contents.dropped or 'no'} record{'' if contents.dropped == 1 else 's'} dropped"
    )


def account(copy: Copy, found: tuple[Contents, RecordingReader], name: str, *, asked: bool) -> int:
    """Say what was recorded, and what is wrong with it; return the exit status."""
    contents, reader = found
    problems = list(reader.problems)
    if reader.ended and not asked and contents.end is not None:
        problems.append(f"the recording ended before it was to: {contents.end.reason}")
    if contents.dropped:
        problems.append(f"{contents.dropped} records are missing: this command was too slow")
    print(f"{name}: {contents.duration_s:.1f} s, {figures(copy, contents)}", file=sys.stderr)
    for problem in problems:
        print(f"imud record: {problem}", file=sys.stderr)
    return 1 if problems else 0


RECORD = CliCommand(add_arguments, run)
