"""Output of the commands: tables, paragraphs and histograms as text; standard output and standard error."""

import errno
import io
import os
import select
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from itertools import zip_longest
from math import floor, log10
from typing import Final, TextIO

from imud.host.log import MESSAGE_CHARACTERS_MAX, printable
from imud.model.units import NS_PER_US

COLUMNS: Final = 80  # maximum width of texts, characters
CELL_LEAST: Final = 6  # minimum width of a column of a table, characters
WIDTH: Final = 40  # length of the longest bar of a histogram, characters
BARS: Final = 12  # maximum number of bars of a histogram
EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
NO_VALUE: Final = ("", "-")  # cells without a value in a column of numbers
STEPS: Final = (1, 2, 5, 10, 20)
TAIL: Final = 0.005  # Share of outliers on each side of a histogram. The outermost bars count the outliers.


def table(head: Sequence[str], rows: Iterable[Sequence[object]], width: int | None = None) -> str:
    """Format a table. Columns of numbers are right-aligned. The text has no line end after the last row.

    `width`: maximum length of a line, characters. Cells of the widest columns then have several lines. None: no limit.
    """
    cells = [[str(cell) for cell in head], *([_word(cell) for cell in row] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(head))]
    numbers = [all(_is_number(line[i]) for line in cells[1:] if line[i] not in NO_VALUE) for i in range(len(head))]
    while width is not None and sum(widths) + 2 * len(widths) - 2 > width and max(widths) > CELL_LEAST:
        widths[widths.index(max(widths))] -= 1
    lines = []
    for row in cells:
        parts = (
            textwrap.wrap(cell, most, break_on_hyphens=False) if len(cell) > most else [cell]
            for cell, most in zip(row, widths, strict=True)
        )
        lines += [_line(line, widths, numbers) for line in zip_longest(*parts, fillvalue="")]
    return "\n".join(lines)


def terminal_width() -> int | None:
    """Return the number of columns of the terminal; None if standard output is not a terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def shortened(text: str, width: int) -> str:
    """Return `text` in at most `width` characters. A character … replaces the middle of a longer text."""
    if len(text) <= width:
        return text
    end = (width - 1) // 2
    return f"{text[: width - 1 - end]}…{text[len(text) - end :]}"


def fitted(value: float, width: int, show: Callable[[float], str]) -> str:
    """Format a number in at most `width` characters: with `show`, with fewer decimals, or with a power of ten."""
    # from exact to rough: the first text that fits
    for text in (show(value), f"{value:.1f}", f"{value:.0f}", f"{value:.1e}", f"{value:.0e}"):
        short = text.replace("e+0", "e").replace("e-0", "e-").replace("e+", "e")
        if len(short) <= width:
            return short
    return "#" * width


def local_time(utc_ns: int) -> datetime:
    """Convert a time in ns since 1970-01-01 UTC to the local time zone, truncated to µs."""
    return (EPOCH + timedelta(microseconds=utc_ns // NS_PER_US)).astimezone()


def paragraph(label: str, text: str) -> list[str]:
    """Format a label and a text as lines of at most COLUMNS characters. Long words are shortened."""
    room = max(COLUMNS - len(label), COLUMNS // 2)
    words = " ".join(shortened(word, room) for word in printable(text, MESSAGE_CHARACTERS_MAX).split())
    lines = textwrap.wrap(words, room, break_on_hyphens=False) or [""]
    return [f"{label if not number else ' ' * len(label)}{line}".rstrip() for number, line in enumerate(lines)]


def histogram(values: Sequence[float], unit: str) -> list[str]:
    """Format a histogram, one line per bar: lower edge, share in percent, bar. Empty if `values` is empty."""
    if not values:
        return []
    ordered = sorted(values)
    low, high = ordered[int(TAIL * len(ordered))], ordered[-1 - int(TAIL * len(ordered))]
    width = bar_width(high - low)
    first = floor(low / width)
    counts = [0] * (floor(high / width) - first + 1)
    for value in ordered:
        counts[min(max(floor(value / width) - first, 0), len(counts) - 1)] += 1
    most = max(counts)
    digits = max(0, -floor(log10(width)))
    return [
        f"{(first + number) * width:12.{digits}f} {unit} {100 * count / len(ordered):5.1f} % "
        + "#" * round(WIDTH * count / most)
        for number, count in enumerate(counts)
    ]


def bar_width(span: float) -> float:
    """Return the smallest width 1, 2 or 5 · 10ⁿ with at most BARS bars over the span. Return 1 for an empty span."""
    if span <= 0:
        return 1.0
    power = 10.0 ** floor(log10(span / BARS))
    return next(step * power for step in STEPS if step * power * (BARS - 1) >= span)


def _word(cell: object) -> str:
    """Format a cell. Texts from devices and adapters can contain control characters, which are escaped."""
    return f"{cell:.1f}" if isinstance(cell, float) else printable(str(cell), MESSAGE_CHARACTERS_MAX)


def _line(cells: Sequence[str], widths: Sequence[int], numbers: Sequence[bool]) -> str:
    # the title of a column of numbers is left-aligned
    padded = (c.rjust(w) if n and _is_number(c) else c.ljust(w) for c, w, n in zip(cells, widths, numbers, strict=True))
    return "  ".join(padded).rstrip()


def _is_number(cell: str) -> bool:
    return cell.replace(".", "", 1).replace("-", "", 1).isdecimal()


STANDARD_STREAMS: Final = 3
ERROR_WAIT_MS: Final = 1000  # maximum wait for the reader of standard error, ms


def open_standard_streams() -> None:
    """Open /dev/null for closed standard descriptors. Write unencodable characters as backslash escapes.

    Without /dev/null, a port or socket would get the number of a closed descriptor and receive the printed text.
    """
    for descriptor in range(STANDARD_STREAMS):
        try:
            os.fstat(descriptor)
        except OSError:
            # open() returns the lowest free number, which is `descriptor`
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    sys.stdin = sys.stdin or open(0, closefd=False)  # noqa: SIM115 - open to the end of the process
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def discard_output() -> None:
    """Discard the buffer of standard output and all later output."""
    _discard(sys.stdout)


def raise_if_unread() -> None:
    """Raise BrokenPipeError if the reader of standard output closed the pipe or socket. Write nothing."""
    try:
        descriptor = sys.stdout.fileno()
    except OSError:  # a stream in memory has no descriptor
        return
    poll = select.poll()
    poll.register(descriptor, 0)  # poll reports POLLERR without a request
    if any(events & select.POLLERR for _, events in poll.poll(0)):
        raise BrokenPipeError(errno.EPIPE, "the reader of the output closed the pipe")


def complain(text: str) -> None:
    """Write `text` to standard error with control characters escaped. Discard the text if writing fails or blocks."""
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
        # the interpreter flushes the stream at exit: this flush must not fail
        os.dup2(null, stream.fileno())
        os.close(null)


def _writable(stream: TextIO) -> bool:
    """Return whether the stream accepts data within ERROR_WAIT_MS."""
    try:
        descriptor = stream.fileno()
    except OSError:  # a stream in memory has no descriptor
        return True
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return bool(poll.poll(ERROR_WAIT_MS))
