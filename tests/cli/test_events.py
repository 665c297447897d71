"""`imud events`: one line or object per event, with local time and priority.
Reconnection after a restart of the daemon, and the notes on standard error."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from operator import methodcaller
from pathlib import Path
from threading import Event as Flag
from threading import Thread
from unittest.mock import Mock

import pytest

from imud.cli.events import DeviceNotes, as_json, as_text, keep_connected, printed
from imud.formats.jsonrpc import RpcError
from imud.model.errors import LinkMissing, ServerError
from imud.model.event import Event, EventKind, StoredEvent
from imud.model.units import NS_PER_S
from tests.cli.conftest import Cli
from tests.support.socket_rig import NOW_NS, Daemon, daemon
from tests.support.surroundings import pipe

DOWN = Event(5 * NS_PER_S, "bow", EventKind.DOWN, "the adapter was pulled out", {"errno": 5})
OFFSET_NS = 1_790_000_000 * NS_PER_S + 123_999_999  # 2026-09-21 14:13:20 UTC


pytestmark = pytest.mark.usefixtures("in_kolkata")


def test_a_line_and_an_object_have_local_time_and_priority() -> None:
    text = as_text(printed(DOWN, OFFSET_NS))
    assert text == "2026-09-21T19:43:25.123+05:30 warning bow: down: the adapter was pulled out"
    text = as_text(printed(Event(0, "", EventKind.CONFIGURATION, "read anew\nand more"), OFFSET_NS))
    assert text == r"2026-09-21T19:43:20.123+05:30 warning imud: configuration: read anew\nand more"
    assert json.loads(as_json(printed(DOWN, OFFSET_NS))) == {
        "time": "2026-09-21T19:43:25.123+05:30", "priority": "warning", "t_ns": 5 * NS_PER_S, "device": "bow",
        "kind": "down", "message": "the adapter was pulled out", "detail": {"errno": 5},
    }  # fmt: skip
    kinds = (EventKind.UP, EventKind.SYNC, EventKind.MARK, EventKind.LOSS)
    priorities = [printed(Event(0, "bow", kind, ""), 0).priority for kind in kinds]
    assert priorities == ["info", "info", "debug", "warning"]
    for count in (1, 2):
        stored = printed(StoredEvent(6 * NS_PER_S, "bow", EventKind.LOSS, "few", {}, count, 5 * NS_PER_S), 0)
        assert as_text(stored).endswith("bow: loss: few" + " (×2 in 1 s)" * (count == 2))
        assert ("first_ns" in as_json(stored)) is (count == 2)


@contextmanager
def events_of(served: Daemon) -> Iterator[tuple[object, ...]]:
    """Send two events of one device and one of another device repeatedly. Return the command for this daemon."""
    ended = Flag()

    def send() -> None:
        number = 0
        while not ended.wait(0.01):
            number += 1
            for device, kind, words in (
                ("imu0", EventKind.UP, f"number {number}"), ("imu1", EventKind.MARK, f"pulse {number}"),
                ("imu1", EventKind.LOSS, f"{number} samples lost"),
            ):  # fmt: skip
                served.do(methodcaller("event", Event(NOW_NS - 3600 * NS_PER_S, device, kind, words)))

    sender = Thread(target=send)
    sender.start()
    try:
        yield "events", "--socket", served.path
    finally:
        ended.set()
        sender.join()


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[object, ...]]:
    with daemon(tmp_path_factory.mktemp("events")) as served, events_of(served) as found:
        yield found


@pytest.mark.live
def test_events_as_they_come(words: tuple[object, ...], cli: Cli) -> None:
    rows: list[tuple[list[str], set[str]]] = [
        ([], {"up: number ", "mark: pulse ", "samples lost"}),
        (["--device", "imu1"], {"mark: pulse ", "samples lost"}),
        (["--priority", "info"], {"up: number ", "samples lost"}),
        (["--priority", "warning", "--device", "imu0", "--device", "imu1"], {"samples lost"}),
        (["--json", "--device", "imu0"], {'"message":"number '}),
    ]
    for options, expected in rows:
        lines = cli(*words, "--count", 6, *options).out.splitlines()
        assert len(lines) == 6
        assert {word for word in expected for line in lines if word in line} == expected, options
        assert all(any(word in line for word in expected) for line in lines), options


@pytest.mark.live
def test_the_time_of_another_clock_and_an_unknown_device(words: tuple[object, ...], cli: Cli) -> None:
    """As with a forwarded socket (SSH): the daemon has another CLOCK_MONOTONIC than this host."""
    shown = datetime.fromisoformat(cli(*words, "--count", 1).out.split()[0])
    assert (datetime.now(UTC) - shown).total_seconds() == pytest.approx(3600, abs=120)
    cli.refuses("imu7", *words, "--device", "imu7")


def test_without_follow_a_missing_daemon_is_an_error_and_a_refusal_always_is(tmp_path: Path) -> None:
    with pytest.raises(LinkMissing, match="is imud running"):
        keep_connected("imud watch", str(tmp_path / "none"), Mock(side_effect=AssertionError), follow=False)
    with daemon(tmp_path) as served, pytest.raises(RpcError, match="imu7"):
        keep_connected("imud watch", str(served.path), lambda c: print(c.watch(["imu7"])), follow=True)


def test_follow_waits_for_the_daemon_and_says_so_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "imud.sock"
    waits: list[float] = []
    versions: list[str] = []

    def attempt() -> None:
        keep_connected("imud watch", str(path), lambda c: versions.append(c.hello.version), follow=True, wait=wait)

    def wait(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 3:
            with daemon(tmp_path):
                attempt()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        attempt()
    assert (waits, len(versions)) == ([1.0] * 3, 1)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"imud watch: no daemon at {path}: is imud running?")
    assert lines[0].endswith("; waiting for the daemon")


def test_follow_goes_on_after_a_lost_connection_and_a_timeout(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    silent, lost = TimeoutError("waited in vain for devices"), LinkMissing("the daemon closed the connection")
    work = Mock(side_effect=[silent, lost, silent, None])
    with daemon(tmp_path) as served:
        with pytest.raises(ServerError, match="in vain"):
            keep_connected("imud events", str(served.path), work, follow=False)
        keep_connected("imud events", str(served.path), work, follow=True, wait=lambda _s: None)
    assert work.call_count == 4
    assert capsys.readouterr().err.splitlines() == [
        f"imud events: {words}"
        for words in ("the daemon closed the connection; waiting for the daemon", "connected again",
                      "waited in vain for devices; waiting for the daemon", "connected again")
    ]  # fmt: skip


def test_waiting_ends_when_nobody_reads_the_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pipe() as (reader, writer), open(writer, "w", closefd=False) as output:
        monkeypatch.setattr(sys, "stdout", output)
        waits: list[float] = []

        def wait(seconds: float) -> None:
            waits.append(seconds)
            if len(waits) == 2:
                os.close(reader)

        with pytest.raises(BrokenPipeError):
            keep_connected("imud watch", str(tmp_path / "none"), Mock(), follow=True, wait=wait)
    assert len(waits) == 2


def test_notes_of_devices_that_are_gone_and_of_dropped_samples(capsys: pytest.CaptureFixture[str]) -> None:
    reason = {"code": "stopped", "message": "The device stopped sending 5 s ago."}
    missing = {"name": "bow", "condition": {"condition": "missing", "since_ns": 1, "reasons": [reason]}}
    client = Mock(devices=Mock(return_value=[{"name": "bow", "condition": None}]))
    notes = DeviceNotes(client, ["bow"])

    def told(now_s: float) -> str:
        notes.look(now_s)
        return capsys.readouterr().err

    assert told(0.0) == ""
    client.devices.return_value = [missing]
    assert told(1.0) == "", "a look every 2 s"
    assert told(2.0) == "imud watch: bow: missing: The device stopped sending 5 s ago.\n"
    reason["message"] = "The device stopped sending 7 s ago."
    assert told(4.0) == "", "once"
    client.devices.return_value = []
    assert told(6.0) == "imud watch: bow: no longer in the configuration\n"
    client.devices.return_value = [{"name": "bow", "condition": {"condition": "ok", "since_ns": 1}}]
    assert told(8.0) == "imud watch: bow: ok\n"
    for count in (5, 7):
        notes.add_dropped("bow", count)
    assert told(9.0) == ""
    assert told(10.0) == "imud watch: the daemon dropped 12 samples of bow because imud watch was too slow\n"
    assert told(12.0) == ""
