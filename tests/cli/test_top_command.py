"""The feed of `imud top`, and the errors of the command."""

import sys
from pathlib import Path

import pytest

from imud.cli.top import TopFeed
from imud.model.event import Event, EventKind
from tests.cli.conftest import Cli
from tests.client.news import Listener
from tests.support.socket_rig import batch, daemon


@pytest.mark.live
def test_status_samples_and_events_come_and_a_page_gets_those_of_its_device(tmp_path: Path) -> None:
    heard = Listener()
    with daemon(tmp_path) as served:
        feed = TopFeed(str(served.path))
        feed.look_at("imu1")
        feed.start(heard.on_news)
        first = heard.wait_for(lambda news: news.statuses)
        assert first.statuses is not None
        assert [status.name for status in first.statuses] == ["imu0", "imu1"]
        assert (first.clients, first.problem) == (1, "")
        served.do(lambda server: server.publish(batch("imu0", 1)))
        served.do(lambda server: server.publish(batch("imu1", 2)))
        assert {one.device for one in heard.wait_for(lambda news: news.samples).samples} == {"imu1"}
        feed.look_at(None)
        heard.wait_for(lambda news: news.now_ns)
        heard.wait_for(lambda news: news.now_ns)
        served.do(lambda server: server.publish(batch("imu0", 7)))
        assert heard.wait_for(lambda news: news.samples).samples[-1].seq == 7
        served.do(lambda server: server.event(Event(5, "imu1", EventKind.UP, "is there")))
        assert heard.wait_for(lambda news: news.events).events[0].message == "is there"
        feed.close()
        feed.close()


@pytest.mark.live
def test_it_connects_again_to_a_daemon_that_was_restarted(tmp_path: Path) -> None:
    heard = Listener()
    with daemon(tmp_path) as served:
        path = str(served.path)
        feed = TopFeed(path)
        feed.start(heard.on_news)
        heard.wait_for(lambda news: news.statuses)
    assert path in heard.wait_for(lambda news: news.problem).problem
    with daemon(tmp_path):
        assert not heard.wait_for(lambda news: news.statuses).problem
        feed.close()


def test_without_a_terminal_or_the_library_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch, cli: Cli) -> None:
    words = "imud top needs a terminal; for files and pipes, use `imud status` or `imud watch`"
    assert cli("top", status=2).err == f"imud top: {words}\n"
    for stream in (sys.stdin, sys.stdout):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    monkeypatch.setitem(sys.modules, "textual.app", None)
    monkeypatch.delitem(sys.modules, "imud.cli.top", raising=False)
    cli.refuses("pip install 'imud[top]'", "top")
