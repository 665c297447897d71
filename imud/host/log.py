"""Log of the daemon: one escaped line per message, written by a thread, so that a slow reader does not delay imud.

    log.warning(…) ──▶ LineFormatter: escape, cut ──▶ queue, LOG_QUEUE_MESSAGES ──▶ thread ──▶ standard error

External values (names in requests, texts of devices, contents of files, names of nodes) can contain any characters.
`LineFormatter` escapes every complete message, so that a caller cannot forget it. `printable` and `shown` limit the
length of one value, so that a long value does not displace the rest of its message. If the queue is full, the log drops
the newest messages and later reports their number.
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

# Maximum length of one value. The longest product string, of a USB descriptor, has 126 characters.
VALUE_CHARACTERS_MAX: Final = 200
# Maximum length of one message. Only the list of 256 changed devices after a reload is longer.
MESSAGE_CHARACTERS_MAX: Final = 2000
TRACEBACK_LINES_MAX: Final = 100  # maximum number of lines of one traceback, newest calls
LOG_QUEUE_MESSAGES: Final = 1000  # maximum number of messages in the queue: 1 s of the highest message rate, a few MB
STDERR: Final = 2
FLUSH_S: Final = 1.0  # maximum time that the end of the process waits for the reader of the log, s
POLL_MS: Final = 100  # interval at which the thread checks for `close` while the reader does not read, ms
# Priorities of syslog(3) by minimum level. Lower levels have priority 7, debug.
PRIORITIES: Final = ((logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6))
# pause after the first repetition, s
PAUSE_FIRST_S: Final = 1.0
# maximum pause, s
PAUSE_MOST_S: Final = 60.0
KNOWN_MOST: Final = 512  # maximum number of remembered messages: two for each of 256 devices
SAME_AS: Final = "same_as"  # attribute of a log record, set with `extra`
NUMBERS: Final = re.compile(r"\d+")
LEVELS_SHOWN: Final = 4
ITEMS_SHOWN: Final = 10


# --- texts and values from outside ------------------------------------------------------------------------------------


def printable(text: str, characters_max: int = VALUE_CHARACTERS_MAX) -> str:
    r"""Return `text` as one line of printable characters, with escapes (`\n`, `\x1b`), cut to a length."""
    if len(text) <= characters_max and text.isprintable():
        return text
    # isprintable is False for lone surrogates too: bytes without UTF-8 meaning, which no encoder accepts
    cut = text[:characters_max]
    escaped = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in cut)
    if len(text) <= characters_max and len(escaped) <= characters_max:
        return escaped
    return escaped[: characters_max - 1] + "…"


def printable_json(value: object) -> str:
    r"""Return `value` as one line of JSON with escapes (`\u202e`) for characters that control a terminal.

    Texts of devices, adapters and other hosts can contain such characters. JSON permits them without an escape.
    """
    import msgspec  # most commands print no JSON

    text: str = msgspec.json.encode(value).decode()
    if text.isprintable():
        return text
    # outside of strings, the text contains printable ASCII only
    return "".join(c if c.isprintable() else _json_escape(c) for c in text)


def _json_escape(character: str) -> str:
    data = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{data[i]:02x}{data[i + 1]:02x}" for i in range(0, len(data), 2))


def shown(value: object, characters_max: int = VALUE_CHARACTERS_MAX) -> str:
    """Return a Python literal of `value`, escaped, with limited length, depth and number of items. Never raises."""
    try:
        return printable(_SHORT.repr(value), characters_max)
    except Exception as error:  # noqa: BLE001 - a value's own __repr__ may raise anything
        return f"<{type(value).__name__} without a text form: {type(error).__name__}>"


class _ShortRepr(reprlib.Repr):
    """`reprlib` with the limits of this module. It cuts bytes before it converts them."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = LEVELS_SHOWN
        self.maxdict = self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdeque = ITEMS_SHOWN
        self.maxstring = self.maxother = self.maxlong = VALUE_CHARACTERS_MAX

    def repr_bytes(self, data: bytes, _level: int) -> str:
        return repr(data[: self.maxother])  # `shown` cuts this text and adds an ellipsis


_SHORT: Final = _ShortRepr()


class LineFormatter(logging.Formatter):
    """Formatter that makes one line of each message, and indents tracebacks: they cannot imitate a message."""

    def __init__(self, *, journal: bool) -> None:
        """Journal: each line starts with its priority (sd-daemon(3)). Otherwise: with the time and the level."""
        super().__init__()
        self._journal = journal

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of `record` without its end. Never raises."""
        head = f"<{_priority(record.levelno)}>" if self._journal else ""
        level = "" if self._journal else f"{self.formatTime(record)} {record.levelname} "
        line = f"{head}{level}{printable(_message(record), MESSAGE_CHARACTERS_MAX)}"
        if not record.exc_info:
            return line
        traceback = self.formatException(record.exc_info).splitlines()[-TRACEBACK_LINES_MAX:]
        return f"\n{head}    ".join([line, *(printable(one, MESSAGE_CHARACTERS_MAX) for one in traceback)])


def _priority(level: int) -> int:
    return next((priority for least, priority in PRIORITIES if level >= least), 7)


class RepeatFilter(logging.Filter):
    """Filter that passes repeated messages less and less often, with the number of suppressed messages.

    Two messages are equal if their format string, their first value (the device) and their `same_as` are equal. The
    pause after the first message is PAUSE_FIRST_S. It doubles with every passed message up to PAUSE_MOST_S. After
    PAUSE_MOST_S without the message, the filter starts again. Messages below WARNING always pass.
    """

    def __init__(self) -> None:
        super().__init__()
        self._known: dict[tuple[object, ...], _Repeated] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether `record` passes. Add the number of suppressed messages to its text."""
        if record.levelno < logging.WARNING:
            return True
        now_s, key = record.created, _key_of(record)
        known = self._known.pop(key, None)
        if known is None or not 0 <= now_s - known.seen_s <= PAUSE_MOST_S:  # new, expired, or the clock was set back
            self._known[key] = _Repeated(now_s, now_s + PAUSE_FIRST_S, PAUSE_FIRST_S, 0, now_s)
            if len(self._known) > KNOWN_MOST:
                del self._known[next(iter(self._known))]
            return True
        self._known[key] = known  # the newest message is the last to be forgotten
        known.seen_s = now_s
        if now_s < known.due_s:
            known.left_out += 1
            return False
        if known.left_out:
            since_s = now_s - known.told_s
            record.msg, record.args = f"{_message(record)}, {known.left_out} similar messages in {since_s:.0f} s", None
        known.pause_s = min(2 * known.pause_s, PAUSE_MOST_S)
        known.due_s, known.told_s, known.left_out = now_s + known.pause_s, now_s, 0
        return True


def same_as(text: str) -> dict[str, str]:
    """Return `extra` for a message whose text is a value. Messages with equal texts, except for numbers, are equal. "3
    samples lost" equals "5 samples lost" and differs from "the adapter is absent"."""
    return {SAME_AS: NUMBERS.sub("", text)}


@dataclass(slots=True)
class _Repeated:
    """State of a repeated message; times in s."""

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
        return f"{record.msg} ({type(error).__name__} in the conversion of its values)"


# --- writing ----------------------------------------------------------------------------------------------------------


class LogWriter(logging.Handler):
    """Handler that writes messages to a descriptor from its own thread. Synchronization: any thread may log."""

    def __init__(self, descriptor: int, *, journal: bool = False, messages_max: int = LOG_QUEUE_MESSAGES) -> None:
        super().__init__()
        self.setFormatter(LineFormatter(journal=journal))
        self._journal = journal
        self._descriptor = descriptor
        self._queue: queue.Queue[bytes | None] = queue.Queue(messages_max)
        self._refused = 0  # Number of messages dropped from the full queue. Changed under the lock of the handler.
        self._unwritten = 0  # Number of messages dropped after a failed write. Changed by the thread.
        self._reported = 0
        self._ending = self._abandoned = False
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Number of messages dropped so far."""
        return self._refused + self._unwritten

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a message without blocking; drop it if the queue is full."""
        try:
            self._queue.put_nowait(encoded(self.format(record)))
        except queue.Full:
            self._refused += 1
        except Exception:  # noqa: BLE001 - a failed message must not stop the caller
            self.handleError(record)

    def handleError(self, record: logging.LogRecord) -> None:
        """Count a message that failed. The default handler writes to standard error, which may block."""
        self._refused += 1

    def close(self) -> None:
        """Write the queued messages for at most FLUSH_S and end the thread. A second call does nothing."""
        if self._abandoned:
            return
        self._ending = True
        with suppress(queue.Full):  # queue full: the thread sees `_ending` after the last message
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
        """Write the number of newly dropped messages; keep the number until the write succeeds."""
        dropped = self.dropped
        missing = dropped - self._reported
        head = "<4>" if self._journal else "WARNING "
        if missing and self._write(encoded(f"{head}{missing} messages dropped: the log was not read in time")):
            self._reported = dropped

    def _write(self, line: bytes) -> bool:
        """Write a line. Wait for the reader while the handler is open. Return whether the complete line was written."""
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
    """Return the bytes of a line: UTF-8 with its end."""
    return line.encode("utf-8", "backslashreplace") + b"\n"


@contextmanager
def log_to(descriptor: int, level: str) -> Iterator[LogWriter]:
    """Log messages of `level` and above, and reports of Python itself, to `descriptor` until the context ends."""
    root = logging.getLogger()
    # the journal adds the time; other logs contain it in the line
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
    """Return whether a descriptor is the journal stream of the service manager (systemd.exec(5))."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        status = os.fstat(descriptor)
    except OSError:
        return False
    return (device, inode) == (str(status.st_dev), str(status.st_ino))


def messages_dropped() -> int:
    """Return the number of messages that the log of this process has dropped."""
    return sum(handler.dropped for handler in logging.getLogger().handlers if isinstance(handler, LogWriter))


def _log_unraisable(error: Any) -> None:
    """Log an exception without a caller. Python's own hook writes to standard error, which may block."""
    # since Python 3.14, err_msg contains the object
    text = error.err_msg or "Exception ignored in"
    log.error("%s", text if error.object is None else f"{text} {shown(error.object)}", exc_info=error.exc_value)


def _log_thread_error(error: Any) -> None:
    log.error("thread %s ended by an exception", error.thread.name if error.thread else "", exc_info=error.exc_value)
