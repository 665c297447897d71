"""`imud events`: one line or object per event, with local time and priority."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from threading import Event as Flag
from threading import Thread

import pytest

from imud.cli.events import as_json, as_text, printed
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_S
from imud.publishers.socket.server import SocketServer
from tests.cli.conftest import Cli
from tests.support.socket_rig import NOW_NS, Daemon, daemon

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
