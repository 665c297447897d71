"""Each message is one line for any content, and a slow reader of the log never delays the caller."""

import json
import logging
import os
import re
import select
import sys
import threading
import warnings
from pathlib import Path

import pytest

from imud.host import log as host_log
from tests.support.daemon_process import wait_until
from tests.support.surroundings import pipe, read_until

log = logging.getLogger("imud.test")
WRITE_S = 60.0


@pytest.fixture(autouse=True)
def _time_to_write(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait longer for the last messages at the end, because a loaded host writes slowly."""
    monkeypatch.setattr("imud.host.log.FLUSH_S", WRITE_S)


FORGED = "bow\n2026-11-22 05:00:00,000 WARNING root logged in"
HOSTILE = (
    FORGED, "\x1b[2J\x1b]0;title\x07", "a\rb", "\x00", "\x85next", "\u2028line", "\u202eevil", "\udc80\ud800",
    "\x9b31m", "x" * 10_000, "\n" * 10_000,
)  # fmt: skip


def nested(levels: int) -> object:
    """Return the value of 974 nested brackets in a request."""
    value: object = {}
    for number in range(levels):
        value = [value] if number % 2 else {"a": value}
    return value


def formatted(message: str, *values: object, **more: object) -> str:
    """Return the line of one message."""
    record = logging.LogRecord("imud", logging.WARNING, __file__, 1, message, values, None)
    record.__dict__.update(more)
    return host_log.LineFormatter(journal=True).format(record)


# --- journal, repeated messages ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("level", "priority"),
    [(logging.CRITICAL, 2), (logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.DEBUG, 7), (1, 7)],
)
def test_lines_for_the_journal_begin_with_their_priority(level: int, priority: int) -> None:
    record = logging.LogRecord("imud", level, __file__, 1, "bow is %s", ("up",), None)
    assert host_log.LineFormatter(journal=True).format(record) == f"<{priority}>bow is up"
    elsewhere = rf"\d{{4}}-\d\d-\d\d \d\d:\d\d:\d\d,\d{{3}} {logging.getLevelName(level)} bow is up"
    assert re.fullmatch(elsewhere, host_log.LineFormatter(journal=False).format(record))


def passed(
    repeats: host_log.RepeatFilter, t_s: float, message: str, *values: object, level: int = logging.WARNING
) -> str:
    """Return the line that passes the filter at a time; empty if none passes."""
    record = logging.LogRecord("imud", level, __file__, 1, message, values, None)
    record.created = t_s
    return host_log.LineFormatter(journal=True).format(record) if repeats.filter(record) else ""


def test_repeated_messages_pass_less_and_less_often_and_others_immediately() -> None:
    repeats = host_log.RepeatFilter()
    told = {t: line for t in range(200) if (line := passed(repeats, 1000 + t, "%s: %d lost", "bow", t))}
    assert (list(told), told[1]) == ([0, 1, 3, 7, 15, 31, 63, 123, 183], "<4>bow: 1 lost")
    assert told[7] == "<4>bow: 7 lost, 3 similar messages in 4 s"
    assert told[183] == "<4>bow: 183 lost, 59 similar messages in 60 s"
    assert passed(repeats, 1300, "%s: %d lost", "bow", 1) == "<4>bow: 1 lost"  # new after one quiet minute
    repeats = host_log.RepeatFilter()
    assert passed(repeats, 0, "%s: %d lost", "bow", 1)
    assert not passed(repeats, 0, "%s: %d lost", "bow", 2)
    assert passed(repeats, 0, "%s: %d lost", "stern", 2)
    assert passed(repeats, 0, "%s: gone", "bow")
    assert passed(repeats, 0, "%s: %d lost", "bow", 3, level=logging.ERROR)
    for _ in range(10):
        assert passed(repeats, 0, "%s: up", "bow", level=logging.INFO)
    assert passed(repeats, -100, "%s: %d lost", "bow", 1)  # the clock was set back
    assert passed(repeats, 0, "nothing %s", 5)
    repeats, passes = host_log.RepeatFilter(), list[bool]()
    for text in ("3 samples lost", "5 samples lost", "the adapter is gone"):
        values = {"msg": "%s: %s", "args": ("bow", text), "levelno": logging.WARNING, "created": 0.0}
        passes.append(repeats.filter(logging.makeLogRecord(values | host_log.same_as(text))))
    assert passes == [True, False, True]
    repeats = host_log.RepeatFilter()
    for number in range(513):
        assert passed(repeats, 0, f"message {number}")
    assert passed(repeats, 0, "message 0")  # forgotten
    assert not passed(repeats, 0, "message 512")


# --- texts and values -------------------------------------------------------------------------------------------------


def test_printable_marks_a_cut_and_shown_is_a_literal_where_it_fits() -> None:
    assert host_log.printable("Überseeschiff 3 °C") == "Überseeschiff 3 °C"
    assert host_log.printable("a\nb\x1b\udc80\u202e") == r"a\nb\x1b\udc80\u202e"
    assert host_log.printable("x" * 201) == "x" * 199 + "…"
    assert host_log.printable("x" * 300, 10) == "x" * 9 + "…"
    assert host_log.printable("\n" * 6, 10) == r"\n\n\n\n\n"[:9] + "…"
    assert host_log.shown({"rate_hz": 100, "name": "a'b"}) == """{'name': "a'b", 'rate_hz': 100}"""
    assert host_log.shown(list(range(12))) == "[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ...]"
    assert host_log.shown(b"\x01") == r"b'\x01'"
    assert host_log.shown(nested(100_001)) == "{'a': [{'a': [{...}]}]}"


class Unshowable:
    def __repr__(self) -> str:
        raise ValueError("no")


@pytest.mark.parametrize(
    "value",
    [nested(974), nested(100_000), {f"k{n}": "\n" for n in range(10_000)}, b"\n\xff" * 10_000, 10**5000, Unshowable(),
     [Unshowable()], *HOSTILE],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_printable_and_shown_are_one_bounded_line_of_any_value_for_every_encoding(value: object) -> None:
    for line in (host_log.shown(value), host_log.printable(value) if isinstance(value, str) else ""):
        assert line.isprintable()
        assert len(line) <= 200
        line.encode("utf-8")


# --- messages ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", HOSTILE)
def test_a_message_is_one_line_and_each_line_of_a_traceback_is_escaped(text: str) -> None:
    for line in (formatted("%s: gone", text), formatted(text)):
        assert line.isprintable()
        assert line.startswith("<4>")
        assert len(line) <= 2000 + len("<4>")
    try:
        raise ValueError(text)
    except ValueError:
        lines = formatted("it failed", exc_info=sys.exc_info()).split("\n")
    assert all(line.isprintable() and len(line) <= 2000 + len("<4>    ") for line in lines)
    assert all(line.startswith("<4>    ") for line in lines[1:]), "no line of a traceback looks like a message"


@pytest.mark.parametrize(
    ("message", "values"), [("%d of %s", ("x", "y")), ("%s", (nested(100_000),)), ("%s", (Unshowable(),)), ("%s", ())]
)
def test_a_message_that_cannot_be_made_is_still_one(message: str, values: tuple[object, ...]) -> None:
    line = formatted(message, *values)
    assert line.isprintable()
    assert line.startswith("<4>")


def test_a_long_traceback_is_cut_and_its_end_is_kept() -> None:
    try:
        raise ValueError("\n".join(f"line {number}" for number in range(10_000)))
    except ValueError:
        lines = formatted("it failed", exc_info=sys.exc_info()).split("\n")
    assert lines[0] == "<4>it failed"
    assert len(lines) == 101
    assert lines[-1] == "<4>    line 9999"


# --- the writer -------------------------------------------------------------------------------------------------------


def test_messages_arrive_in_order_and_whole_at_the_end() -> None:
    with pipe() as (reader, descriptor):
        with host_log.log_to(descriptor, "info"):
            for number in range(100):
                log.info("message %d", number)
            log.debug("not this one")
        os.close(descriptor)
        lines = os.read(reader, 1 << 16).decode().splitlines()
    assert [line.partition("INFO ")[2] for line in lines] == [f"message {number}" for number in range(100)]


@pytest.mark.live
def test_a_log_without_a_reader_never_blocks_and_reports_dropped_messages() -> None:
    with pipe(full=True) as (reader, descriptor), host_log.log_to(descriptor, "info") as writer:
        for number in range(5000):
            log.info("message %d", number)
        dropped = writer.dropped
        assert 3900 < dropped <= 4000  # messages outside the queue and the thread
        assert host_log.messages_dropped() == dropped
        text = read_until(reader, b"messages dropped").decode()
        lines = text.splitlines()
        assert f"WARNING {dropped} messages dropped: the log was not read in time" in lines
        assert sum("INFO message " in line for line in lines) == 5000 - dropped
        log.warning("it flows")
        assert "dropped" not in read_until(reader, b"it flows\n").decode()


def no_thread_is_left() -> None:
    wait_until(lambda: all(thread.name != "log" for thread in threading.enumerate()), "the thread has ended")


@pytest.mark.live
def test_the_end_does_not_wait_for_a_reader_that_reads_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float | None] = []
    monkeypatch.undo()  # the real limit, without waiting
    monkeypatch.setattr(threading.Thread, "join", lambda _thread, wait_s=None: waits.append(wait_s))
    with pipe(full=True) as (reader, descriptor):
        with host_log.log_to(descriptor, "info"):
            log.warning("lost")
        writer = host_log.LogWriter(descriptor)
        writer.close()
        writer.close()
        assert waits == [1.0] * 2, "the second time it returns at once"
        no_thread_is_left()
        # a pipe with one free page is writable; a longer write would block
        assert len(os.read(reader, select.PIPE_BUF)) == select.PIPE_BUF
        with host_log.log_to(descriptor, "info"):
            try:
                raise ValueError("\n".join("x" * 200 for _ in range(50)))
            except ValueError:
                log.exception("long")
        no_thread_is_left()


def test_a_message_that_cannot_be_formatted_is_counted_and_nothing_else(capfd: pytest.CaptureFixture[str]) -> None:
    class Broken(logging.Formatter):
        def format(self, record: logging.LogRecord) -> str:
            raise ValueError(record.msg)

    with pipe() as (_, descriptor), host_log.log_to(descriptor, "info") as writer:
        writer.setFormatter(Broken())
        log.warning("one")
        assert writer.dropped == 1
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("journal", [False, True])
def test_the_journal_adds_the_time_itself(journal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    with pipe() as (reader, descriptor):
        assert not host_log.is_journal(descriptor)
        status = os.fstat(descriptor)
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino + (not journal)}")  # else redirected
        with host_log.log_to(descriptor, "info"):
            log.info("begun")
        line = os.read(reader, 1 << 16).decode()
    assert line == "<6>begun\n" if journal else line.endswith(" INFO begun\n")
    assert not host_log.is_journal(-1)


@pytest.mark.parametrize("kind", ["no reader", "full disk", "closed"])
def test_messages_that_cannot_be_written_are_counted(kind: str) -> None:
    reader, descriptor = os.pipe()
    os.close(reader)
    if kind == "full disk":
        os.close(descriptor)
        descriptor = os.open("/dev/full", os.O_WRONLY)
    elif kind == "closed":
        os.close(descriptor)
    with host_log.log_to(descriptor, "info") as writer:
        log.warning("one")
        log.warning("two")
        wait_until(lambda: writer.dropped == 2, "both are counted")
    if kind != "closed":
        os.close(descriptor)


def test_a_file_receives_messages_and_reports_of_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Unclosable:
        def __del__(self) -> None:
            raise KeyError("not closed")

    hooks = print, repr
    monkeypatch.setattr(sys, "unraisablehook", hooks[0])
    monkeypatch.setattr(threading, "excepthook", hooks[1])
    with (tmp_path / "log").open("wb") as file, host_log.log_to(file.fileno(), "info"):
        thread = threading.Thread(target=lambda: {}["missing"], name="worker")  # type: ignore[index]
        thread.start()
        thread.join()
        Unclosable()
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.warn("out of date", DeprecationWarning, stacklevel=1)
    assert (sys.unraisablehook, threading.excepthook) == hooks
    text = (tmp_path / "log").read_text()
    assert "ERROR thread worker ended by an exception" in text
    assert "KeyError: 'missing'" in text
    assert re.search(r"ERROR Exception ignored (in|while calling deallocator) <function \S*Unclosable\.__del__", text)
    assert "KeyError: 'not closed'" in text
    assert "DeprecationWarning: out of date" in text


@pytest.mark.parametrize("text", [*HOSTILE[:-5], HOSTILE[-3], "\u202eevil", "\x9b31m", "\U000e0001tag", "plain °µ"])
def test_json_has_no_control_characters(text: str) -> None:
    line = host_log.printable_json({"name": text, text: [text]})
    assert line.isprintable()
    assert json.loads(line) == {"name": text, text: [text]}
