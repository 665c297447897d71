"""`imud events`: a line or an object per event, with its local time and priority."""

import json
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from threading import Event as Flag
from threading import Thread

import pytest

from imud.cli import main
from imud.cli.live.events import as_json, as_text, printed
from imud.event import Event, EventKind
from imud.publishers.socket.publisher import SocketServer
from imud.units import NS_PER_S
from tests.support.socket_rig import NOW_NS, Daemon, daemon

DOWN = Event(5 * NS_PER_S, "bow", EventKind.DOWN, "the adapter was pulled out", {"errno": 5})
OFFSET_NS = 1_790_000_000 * NS_PER_S + 123_999_999  # 2026-09-21 14:13:20 UTC


pytestmark = pytest.mark.usefixtures("in_kolkata")


def test_a_line_has_local_time_with_its_offset_and_the_priority() -> None:
    assert as_text(printed(DOWN, OFFSET_NS)) == (
        "2026-09-21T19:43:25.123+05:30 warning bow: down: the adapter was pulled out"
    )


def test_an_event_of_the_daemon_itself() -> None:
    event = Event(0, "", EventKind.CONFIGURATION, "read anew\nand more")
    assert as_text(printed(event, OFFSET_NS)) == (
        r"2026-09-21T19:43:20.123+05:30 warning imud: configuration: read anew\nand more"
    )


def test_an_object_has_what_the_socket_sends_and_more() -> None:
    assert json.loads(as_json(printed(DOWN, OFFSET_NS))) == {
        "time": "2026-09-21T19:43:25.123+05:30", "priority": "warning", "t_ns": 5 * NS_PER_S, "device": "bow",
        "kind": "down", "message": "the adapter was pulled out", "detail": {"errno": 5},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "priority"),
    [(EventKind.UP, "info"), (EventKind.SYNC, "info"), (EventKind.MARK, "debug"), (EventKind.LOSS, "warning")],
)
def test_priorities_are_those_of_the_log(kind: EventKind, priority: str) -> None:
    assert printed(Event(0, "bow", kind, ""), 0).priority == priority


def raising(event: Event, server: SocketServer) -> None:
    server.event(event)


def sent_again_and_again(served: Daemon, ended: Flag) -> None:
    """Two events of one device and one of another, until the end."""
    number = 0
    while not ended.wait(0.01):
        number += 1
        for event in (
            Event(number, "imu0", EventKind.UP, f"number {number}"),
            Event(number, "imu1", EventKind.MARK, f"pulse {number}"),
            Event(number, "imu1", EventKind.LOSS, f"{number} samples lost"),
        ):
            served.do(partial(raising, event))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], {"up: number ", "mark: pulse ", "samples lost"}),
        (["--device", "imu1"], {"mark: pulse ", "samples lost"}),
        (["--priority", "info"], {"up: number ", "samples lost"}),
        (["--priority", "warning", "--device", "imu0", "--device", "imu1"], {"samples lost"}),
        (["--json", "--device", "imu0"], {'"message":"number '}),
    ],
)
def test_events_as_they_come(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: set[str]
) -> None:
    with daemon(tmp_path) as served:
        ended = Flag()
        sender = Thread(target=sent_again_and_again, args=(served, ended))
        sender.start()
        try:
            assert main(["events", "--socket", str(served.path), "--count", "6", *options]) == 0
        finally:
            ended.set()
            sender.join()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6
    assert {word for word in words for line in lines if word in line} == words
    assert all(any(word in line for word in words) for line in lines)


def test_the_time_is_right_where_the_daemons_clock_is_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As through a socket that SSH forwards: the rig's CLOCK_MONOTONIC is not that of this machine."""

    def send(served: Daemon, ended: Flag) -> None:
        while not ended.wait(0.01):
            served.do(partial(raising, Event(NOW_NS - 3600 * NS_PER_S, "imu0", EventKind.UP, "an hour ago")))

    with daemon(tmp_path) as served:
        ended = Flag()
        sender = Thread(target=send, args=(served, ended))
        sender.start()
        try:
            assert main(["events", "--socket", str(served.path), "--count", "1"]) == 0
        finally:
            ended.set()
            sender.join()
    shown = datetime.fromisoformat(capsys.readouterr().out.split()[0])
    assert (datetime.now(UTC) - shown).total_seconds() == pytest.approx(3600, abs=30)


def test_an_unknown_device_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with daemon(tmp_path) as served:
        assert main(["events", "--socket", str(served.path), "--device", "imu7"]) == 2
    assert "imu7" in capsys.readouterr().err
