"""The daemon's log: lines that cannot be forged, written by a thread, so that a log without a reader stops nothing.

    log.warning(…) ──▶ LineFormatter: escaped, bounded ──▶ queue, LOG_QUEUE_MESSAGES ──▶ thread ──▶ standard error

What came from outside (names in requests, texts of devices, contents of files, names of nodes) may hold anything:
`LineFormatter` escapes every message as a whole, so that no call can forget it; `printable` and `shown` bound a single
value, so that a long one does not push the rest of its message out. A full queue drops the newest messages and counts
them; the log says how many as soon as it flows again.
"""

import logging
import os
import queue
import reprlib
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

log = logging.getLogger(__name__)

VALUE_CHARACTERS_MAX: Final = 200
"""Of one value in a message; the longest product string of a device, a USB descriptor's, has 126."""
MESSAGE_CHARACTERS_MAX: Final = 2000
"""Of one message: the list of 256 device names that a reload changed is cut, everything else fits."""
TRACEBACK_LINES_MAX: Final = 100
"""Of one traceback, the newest calls."""
LOG_QUEUE_MESSAGES: Final = 1000
"""Messages that wait for the log's reader: a second of the loudest trouble, at most a few MB."""
STDERR: Final = 2
FLUSH_S: Final = 1.0
"""How long the end of the process waits for the log's reader."""
POLL_MS: Final = 100
"""How soon the thread notices that its handler was closed while nobody reads."""
LEVELS_SHOWN: Final = 4
ITEMS_SHOWN: Final = 10


# --- texts and values from outside ------------------------------------------------------------------------------------


def printable(text: str, characters_max: int = VALUE_CHARACTERS_MAX) -> str:
    """Return `text` in one line of printable characters, the others as escapes (`\\n`, `\\x1b`), cut to a length.

    Lone surrogates, which stand for bytes that are not UTF-8 and which no encoder accepts, are escaped too.
    """
    if len(text) <= characters_max and text.isprintable():
        return text
    cut = text[:characters_max]
    escaped = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in cut)
    if len(text) <= characters_max and len(escaped) <= characters_max:
        return escaped
    return escaped[: characters_max - 1] + "…"


def shown(value: object, characters_max: int = VALUE_CHARACTERS_MAX) -> str:
    """Return a Python literal of `value`, escaped and cut in length, in number of items and in depth; never raises."""
    try:
        return printable(_SHORT.repr(value), characters_max)
    except Exception as error:  # noqa: BLE001 - a value's own __repr__ may raise anything
        return f"<{type(value).__name__} that cannot be shown: {type(error).__name__}>"


class _ShortRepr(reprlib.Repr):
    """`reprlib` with this module's limits; bytes are cut before they are converted."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = LEVELS_SHOWN
        self.maxdict = self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdeque = ITEMS_SHOWN
        self.maxstring = self.maxother = self.maxlong = VALUE_CHARACTERS_MAX

    def repr_bytes(self, data: bytes, _level: int) -> str:
        """Return the first bytes as a literal."""
        return repr(data[: self.maxother]) + ("…" if len(data) > self.maxother else "")


_SHORT: Final = _ShortRepr()


class LineFormatter(logging.Formatter):
    """Makes one line of each message; only a traceback has more, each indented, so that none looks like a message."""

    def __init__(self, *, stamped: bool) -> None:
        """`stamped` lines begin with the time."""
        super().__init__()
        self._stamped = stamped

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of `record`, without its end; never raises."""
        stamp = self.formatTime(record) + " " if self._stamped else ""
        line = f"{stamp}{record.levelname} {printable(_message(record), MESSAGE_CHARACTERS_MAX)}"
        if not record.exc_info:
            return line
        traceback = self.formatException(record.exc_info).splitlines()[-TRACEBACK_LINES_MAX:]
        return "\n    ".join([line, *(printable(one, MESSAGE_CHARACTERS_MAX) for one in traceback)])


def _message(record: logging.LogRecord) -> str:
    try:
        return record.getMessage()
    except Exception as error:  # noqa: BLE001 - a value's __str__, or one nested too deep: the message is ours to save
        return f"{record.msg} ({type(error).__name__} while its values were converted to text)"


# --- writing ----------------------------------------------------------------------------------------------------------


class LogWriter(logging.Handler):
    """Writes messages to a descriptor from a thread of its own. Synchronization: any thread may log."""

    def __init__(self, descriptor: int, *, stamped: bool = False, messages_max: int = LOG_QUEUE_MESSAGES) -> None:
        super().__init__()
        self.setFormatter(LineFormatter(stamped=stamped))
        self._descriptor = descriptor
        self._queue: queue.Queue[bytes | None] = queue.Queue(messages_max)
        self._refused = 0
        """Dropped because the queue was full; changed under the handler's lock."""
        self._unwritten = 0
        """Dropped because they could not be written; changed by the thread."""
        self._reported = 0
        self._ending = self._abandoned = False
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Messages dropped so far."""
        return self._refused + self._unwritten

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a message; drop it if the queue is full. Returns at once."""
        try:
            self._queue.put_nowait(encoded(self.format(record)))
        except queue.Full:
            self._refused += 1
        except Exception:  # noqa: BLE001 - a message must not end what it is about
            self.handleError(record)

    def handleError(self, record: logging.LogRecord) -> None:
        """Count a message that could not be formatted; the default writes to standard error, and may wait there."""
        self._refused += 1

    def close(self) -> None:
        """Write what is queued, for at most FLUSH_S, and end the thread; may be called twice."""
        if self._abandoned:
            return
        self._ending = True
        with suppress(queue.Full):  # then the thread sees `_ending` when it has emptied the queue
            self._queue.put_nowait(None)
        self._thread.join(FLUSH_S)
        self._abandoned = True
        super().close()

    def _run(self) -> None:
        while not self._abandoned:
            line = self._queue.get()
            if line is not None:
                self._unwritten += not self._write(line)
            if self._queue.empty():
                self._report_dropped()
                if self._ending:
                    return

    def _report_dropped(self) -> None:
        """Write how many messages are missing, if any; the number is kept until that can be written."""
        dropped = self.dropped
        missing = dropped - self._reported
        if missing and self._write(encoded(f"WARNING {missing} messages dropped: the log was not read in time")):
            self._reported = dropped

    def _write(self, line: bytes) -> bool:
        """Write a line, waiting for the reader as long as the handler is open. Returns whether all was written."""
        poll = select.poll()
        poll.register(self._descriptor, select.POLLOUT)
        try:
            while line and not self._abandoned:
                if poll.poll(POLL_MS):
                    line = line[os.write(self._descriptor, line[: select.PIPE_BUF]) :]
        except OSError:
            return False
        return not line


def encoded(line: str) -> bytes:
    """Return a line as it is written: UTF-8, with its end."""
    return line.encode("utf-8", "backslashreplace") + b"\n"


@contextmanager
def log_to(descriptor: int, level: str) -> Iterator[LogWriter]:
    """Log messages of `level` and above to `descriptor`, and what Python itself reports, until the context ends.

    Under a service manager the journal adds the time, else we do.
    """
    root = logging.getLogger()
    writer, level_before = LogWriter(descriptor, stamped="JOURNAL_STREAM" not in os.environ), root.level
    hooks_before = sys.unraisablehook, threading.excepthook
    root.addHandler(writer)
    root.setLevel(level.upper())
    logging.captureWarnings(True)
    sys.unraisablehook, threading.excepthook = _log_unraisable, _log_thread_error
    try:
        yield writer
    finally:
        sys.unraisablehook, threading.excepthook = hooks_before
        logging.captureWarnings(False)
        root.setLevel(level_before)
        writer.close()
        root.removeHandler(writer)


def messages_dropped() -> int:
    """Return how many messages the log of this process has dropped."""
    return sum(handler.dropped for handler in logging.getLogger().handlers if isinstance(handler, LogWriter))


def _log_unraisable(error: Any) -> None:
    """Log an exception that has no caller; Python's own hook writes to standard error, and may wait there."""
    log.error("exception ignored in %s", shown(error.object), exc_info=error.exc_value)


def _log_thread_error(error: Any) -> None:
    """Log an exception that ended a thread."""
    log.error("thread %s ended by an exception", error.thread.name if error.thread else "", exc_info=error.exc_value)
