"""`imud events`: one line or object per event, with local time and priority.
Reconnection after a restart of the daemon, and the notes on standard error."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from threading import Event as Flag
from threading import Thread
from typing import Any
from unittest.mock import Mock

import pytest

from imud.cli.events import DeviceNotes, as_json, as_text, keep_connected, printed
from imud.client.connection import Client
from imud.formats.jsonrpc import RpcError
from imud.model.errors import LinkMissing, ServerError
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_S
from imud.publishers.socket.server import SocketServer
from tests.cli.conftest import Cli
from tests.support.socket_rig import NOW_NS, Daemon, daemon
from tests.support.surroundings import pipe

DOWN = Event(5 * NS_PER_S, "bow", EventKind.DOWN, "the adapter was pulled out", {"errno": 5})
OFFSET_NS = 1_790_000_000 * NS_PER_S + 123_999_999  # 2026-09-21 14:13:20 UTC


pytestmark = pytest.mark.usefixtures("in_kolkata")


def test_a_line_and_an_object_have_local_time_and_priority() -> None:
    assert as_text(printed(DOWN, OFFSET_NS)) == (
        "2026-09-21T19:43:25.123+05:30 warning bow: down: the adapter was pulled out"
    )
    event = Event(0, "", EventKind.CONFIGURATION, "read anew\nand more")
    assert as_text(printed(event, OFFSET_NS)) == (
        r"2026-09-21T19:43:20.123+05:30 warning imud: configuration: read anew\nand more"
    )
    assert json.loads(as_json(printed(DOWN, OFFSET_NS))) == {
        "time": "2026-09-21T19:43:25.123+05:30", "priority": "warning", "t_ns": 5 * NS_PER_S, "device": "bow",
        "kind": "down", "message": "the adapter was pulled out", "detail": {"errno": 5},
    }  # fmt: skip
    kinds = (EventKind.UP, EventKind.SYNC, EventKind.MARK, EventKind.LOSS)
    priorities = [printed(Event(0, "bow", kind, ""), 0).priority for kind in kinds]
    assert priorities == ["info", "info", "debug", "warning"]


def raising(event: Event, server: SocketServer) -> None:
    server.event(event)


@contextmanager
def events_of(served: Daemon) -> Iterator[tuple[object, ...]]:
    """Send two events of one device and one of another device repeatedly. Return the command for this daemon."""
    ended = Flag()

    def send() -> None:
        number = 0
        while not ended.wait(0.01):
            number += 1
            t_ns = NOW_NS - 3600 * NS_PER_S
            for event in (
                Event(t_ns, "imu0", EventKind.UP, f"number {number}"),
                Event(t_ns, "imu1", EventKind.MARK, f"pulse {number}"),
                Event(t_ns, "imu1", EventKind.LOSS, f"{number} samples lost"),
            ):
                served.do(partial(raising, event))

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
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ([], {"up: number ", "mark: pulse ", "samples lost"}),
        (["--device", "imu1"], {"mark: pulse ", "samples lost"}),
        (["--priority", "info"], {"up: number ", "samples lost"}),
        (["--priority", "warning", "--device", "imu0", "--device", "imu1"], {"samples lost"}),
        (["--json", "--device", "imu0"], {'"message":"number '}),
    ],
)
def test_events_as_they_come(words: tuple[object, ...], cli: Cli, options: list[str], expected: set[str]) -> None:
    lines = cli(*words, "--count", 6, *options).out.splitlines()
    assert len(lines) == 6
    assert {word for word in expected for line in lines if word in line} == expected
    assert all(any(word in line for word in expected) for line in lines)


@pytest.mark.live
def test_the_time_is_right_where_the_daemons_clock_is_another(words: tuple[object, ...], cli: Cli) -> None:
    """As with a forwarded socket (SSH): the daemon has another CLOCK_MONOTONIC than this host."""
    shown = datetime.fromisoformat(cli(*words, "--count", 1).out.split()[0])
    assert (datetime.now(UTC) - shown).total_seconds() == pytest.approx(3600, abs=120)


@pytest.mark.live
def test_an_unknown_device_is_an_error(words: tuple[object, ...], cli: Cli) -> None:
    cli.refuses("imu7", *words, "--device", "imu7")


def test_without_follow_a_missing_daemon_is_an_error_and_a_refusal_always_is(tmp_path: Path) -> None:
    def work(_client: Client) -> None:
        raise AssertionError

    with pytest.raises(LinkMissing, match="is imud running"):
        keep_connected("imud watch", str(tmp_path / "none"), work, follow=False)
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
    assert waits == [1.0] * 3
    assert len(versions) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"imud watch: no daemon at {path}: is imud running?")
    assert lines[0].endswith("; waiting for the daemon")


def test_only_follow_goes_on_after_a_lost_connection_and_a_timeout(
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
            keep_connected("imud watch", str(tmp_path / "none"), lambda _c: None, follow=True, wait=wait)
    assert len(waits) == 2


class Answers:
    def __init__(self) -> None:
        self.found: list[dict[str, Any]] = [{"name": "bow", "condition": None}]

    def devices(self) -> list[dict[str, Any]]:
        return self.found


def test_a_device_that_is_gone_is_reported_once_and_when_it_is_back(capsys: pytest.CaptureFixture[str]) -> None:
    client = Answers()
    notes = DeviceNotes(client, ["bow"])
    notes.look(0.0)
    assert capsys.readouterr().err == ""
    reason = {"code": "stopped", "message": "The device stopped sending 5 s ago."}
    bow = {"name": "bow", "condition": {"condition": "missing", "since_ns": 1, "reasons": [reason]}}
    client.found = [bow]
    notes.look(1.0)
    assert capsys.readouterr().err == ""
    for now_s in (2.0, 4.0):
        notes.look(now_s)
        reason["message"] = "The device stopped sending 7 s ago."
    assert capsys.readouterr().err == "imud watch: bow: missing: The device stopped sending 5 s ago.\n"
    client.found = []
    notes.look(6.0)
    client.found = [{"name": "bow", "condition": {"condition": "ok", "since_ns": 1}}]
    notes.look(8.0)
    assert capsys.readouterr().err == "imud watch: bow: no longer in the configuration\nimud watch: bow: ok\n"


def test_dropped_samples_are_reported_together(capsys: pytest.CaptureFixture[str]) -> None:
    notes = DeviceNotes(Answers(), [])
    notes.look(0.0)
    for count in (5, 7):
        notes.add_dropped("bow", count)
    notes.look(1.0)
    assert capsys.readouterr().err == ""
    notes.look(2.0)
    notes.look(4.0)
    assert (
        capsys.readouterr().err == "imud watch: the daemon dropped 12 samples of bow because imud watch was too slow\n"
    )
