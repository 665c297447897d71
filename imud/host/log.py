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
import re
import reprlib
import select
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
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
PRIORITIES: Final = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
"""Priorities of syslog(3) by the least level that has them; all below is 7, debug."""
PAUSE_FIRST_S: Final = 1.0
PAUSE_MOST_S: Final = 60.0
KNOWN_MOST: Final = 512
"""Different messages that are remembered: some for each of 256 devices."""
SAME_AS: Final = "same_as"
"""Attribute of a record, by `extra`."""
NUMBERS: Final = re.compile(r"\d+")
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

    def __init__(self, *, journal: bool) -> None:
        """For the journal each line begins with its priority (sd-daemon(3)), else with the time and the level."""
        super().__init__()
        self._journal = journal

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of `record`, without its end; never raises."""
        head = f"<{_priority(record.levelno)}>" if self._journal else ""
        level = "" if self._journal else f"{self.formatTime(record)} {record.levelname} "
        line = f"{head}{level}{printable(_message(record), MESSAGE_CHARACTERS_MAX)}"
        if not record.exc_info:
            return line
        traceback = self.formatException(record.exc_info).splitlines()[-TRACEBACK_LINES_MAX:]
        return f"\n{head}    ".join([line, *(printable(one, MESSAGE_CHARACTERS_MAX) for one in traceback)])


def _priority(level: int) -> int:
    """The priority of syslog(3) for a level of `logging`."""
    return next((priority for least, priority in PRIORITIES if level >= least), 7)


class RepeatFilter(logging.Filter):
    """Lets trouble that repeats itself through less and less often, with the number of messages left out.

    Messages are the same when their text before its values, the first value (the device), and what `same_as` gave them
    are. After the first one there is a pause of PAUSE_FIRST_S, which doubles with every message up to PAUSE_MOST_S;
    when there was none for that long, it begins anew. Messages below WARNING all pass.
    """

    def __init__(self) -> None:
        super().__init__()
        self._known: dict[tuple[object, ...], _Repeated] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Decide whether `record` is logged; add to it how many were not."""
        if record.levelno < logging.WARNING:
            return True
        now_s, key = record.created, _key_of(record)
        known = self._known.pop(key, None)
        if known is None or not 0 <= now_s - known.seen_s <= PAUSE_MOST_S:  # new, over, or the clock was set back
            self._known[key] = _Repeated(now_s, now_s + PAUSE_FIRST_S, PAUSE_FIRST_S, 0, now_s)
            if len(self._known) > KNOWN_MOST:
                del self._known[next(iter(self._known))]
            return True
        self._known[key] = known  # the one that was seen last is the last that is forgotten
        known.seen_s = now_s
        if now_s < known.due_s:
            known.left_out += 1
            return False
        if known.left_out:
            since_s = now_s - known.told_s
            record.msg, record.args = f"{_message(record)}, {known.left_out} more like it in {since_s:.0f} s", None
        known.pause_s = min(2 * known.pause_s, PAUSE_MOST_S)
        known.due_s, known.told_s, known.left_out = now_s + known.pause_s, now_s, 0
        return True


def same_as(text: str) -> dict[str, str]:
    """Return the `extra` of a message whose text is itself a value: it is the same as those of this text.

    Numbers do not count: "3 samples lost" is the same as "5 samples lost", and not the same as "the adapter is gone".
    """
    return {SAME_AS: NUMBERS.sub("", text)}


@dataclass(slots=True)
class _Repeated:
    """A message that may come again; times in s."""

    seen_s: float
    due_s: float
    pause_s: float
    left_out: int
    told_s: float


def _key_of(record: logging.LogRecord) -> tuple[object, ...]:
    first = record.args[0] if isinstance(record.args, tuple) and record.args else None
    return record.name, record.levelno, record.msg, first if isinstance(first, str) else None, vars(record).get(SAME_AS)


def _message(record: logging.LogRecord) -> str:
    try:
        return record.getMessage()
    except Exception as error:  # noqa: BLE001 - a value's __str__, or one nested too deep: the message is ours to save
        return f"{record.msg} ({type(error).__name__} while its values were converted to text)"


# --- writing ----------------------------------------------------------------------------------------------------------


class LogWriter(logging.Handler):
    """Writes messages to a descriptor from a thread of its own. Synchronization: any thread may log."""

    def __init__(self, descriptor: int, *, journal: bool = False, messages_max: int = LOG_QUEUE_MESSAGES) -> None:
        super().__init__()
        self.setFormatter(LineFormatter(journal=journal))
        self._journal = journal
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
        head = "<4>" if self._journal else "WARNING "
        if missing and self._write(encoded(f"{head}{missing} messages dropped: the log was not read in time")):
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

    The journal adds the time, elsewhere the lines have it.
    """
    root = logging.getLogger()
    writer, level_before = LogWriter(descriptor, journal=is_journal(descriptor)), root.level
    writer.addFilter(RepeatFilter())
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


def is_journal(descriptor: int) -> bool:
    """Whether a descriptor is the stream to the journal that the service manager made (systemd.exec(5))."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        status = os.fstat(descriptor)
    except OSError:
        return False
    return (device, inode) == (str(status.st_dev), str(status.st_ino))


def messages_dropped() -> int:
    """Return how many messages the log of this process has dropped."""
    return sum(handler.dropped for handler in logging.getLogger().handlers if isinstance(handler, LogWriter))


def _log_unraisable(error: Any) -> None:
    """Log an exception that has no caller; Python's own hook writes to standard error, and may wait there."""
    log.error("exception ignored in %s", shown(error.object), exc_info=error.exc_value)


def _log_thread_error(error: Any) -> None:
    """Log an exception that ended a thread."""
    log.error("thread %s ended by an exception", error.thread.name if error.thread else "", exc_info=error.exc_value)
