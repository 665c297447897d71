"""The thread that reads the daemon for a view."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event as Flag
from time import monotonic_ns, time_ns
from unittest.mock import create_autospec

import pytest

from imud.client.connection import Client
from imud.client.feed import Feed, News, Wish, clock_ahead_ns, utc_offset_ns
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_S
from tests.client.news import Listener
from tests.support.socket_rig import NOW_NS, Daemon, batch, daemon

SAME_CLOCK_NS = 2 * NS_PER_S

LIMIT_S = 60.0
OVERVIEW = Wish((), news_s=0.02, newest=True, newest_s=0.02)


@contextmanager
def feeding(path: str, wanted: Wish | None) -> Iterator[tuple[Feed, Listener]]:
    heard = Listener()
    feed = Feed(path, wanted)
    feed.start(heard.on_news)
    try:
        yield feed, heard
    finally:
        feed.close()


def clients(served: Daemon) -> int:
    return served.do(lambda server: len(server.hub.connections))


def until(condition: Callable[[], object], heard: Listener) -> None:
    """Check a condition with each `News` until it is true."""
    while not condition():
        heard.wait_for(lambda news: True)


def test_the_news_have_the_greeting_and_every_sample_comes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    watch = create_autospec(Client.watch, side_effect=Client.watch)
    monkeypatch.setattr(Client, "watch", watch)
    with daemon(tmp_path) as served, feeding(str(served.path), Wish(("imu0",), news_s=0.02)) as (_, heard):
        first = heard.wait_for(lambda news: news.statuses)
        assert first.hello is not None
        assert (first.hello.epoch, first.newest) == (4886718345, None)
        served.do(lambda server: server.publish(batch("imu1", 1)))
        served.do(lambda server: server.publish(batch("imu0", 1, 50)))
        found: list[int] = []
        while len(found) < 50:
            news = heard.wait_for(lambda news: news.samples)
            assert {sample.device for sample in news.samples} == {"imu0"}
            assert news.hello is None
            found += [sample.seq for sample in news.samples]
        assert found == [*range(1, 51)]
    assert watch.call_count == 1, "the feed repeated its request"


def test_the_feed_counts_the_samples_that_the_daemon_dropped(tmp_path: Path) -> None:
    """The feed does not read until the daemon has published 1.3 MB, with a queue of 16 samples."""
    may_read, received, dropped = Flag(), 0, 0
    heard = Listener()

    def on_news(news: News) -> None:
        assert may_read.wait(LIMIT_S)
        heard.on_news(news)

    with daemon(tmp_path, queue_samples=16) as served:
        feed = Feed(str(served.path), Wish(("imu0",), news_s=0.02))
        may_read.set()
        feed.start(on_news)
        heard.wait_for(lambda news: news.statuses)
        may_read.clear()
        for number in range(100):
            published = batch("imu0", 1 + 50 * number, 50)
            served.do(lambda server: server.publish(published))  # noqa: B023  # `do` waits for the call
        may_read.set()
        while received + dropped < 5000:
            news = heard.wait_for(lambda _: True)
            received, dropped = received + len(news.samples), dropped + news.dropped
        feed.close()
    assert dropped > 0


def test_the_feed_is_disconnected_without_a_wish(tmp_path: Path) -> None:
    with daemon(tmp_path) as served, feeding(str(served.path), None) as (feed, heard):
        assert clients(served) == 0
        feed.want(OVERVIEW)
        heard.wait_for(lambda news: news.statuses)
        assert clients(served) == 1
        feed.want(None)
        while clients(served):
            pass
        feed.want(OVERVIEW)
        assert heard.wait_for(lambda news: news.hello).hello is not None


def test_newest_samples_events_and_the_time_come_without_a_watch(tmp_path: Path) -> None:
    with daemon(tmp_path) as served, feeding(str(served.path), OVERVIEW) as (_, heard):
        news = heard.wait_for(lambda news: news.statuses)
        assert news.ahead_ns == pytest.approx(NOW_NS - monotonic_ns(), abs=LIMIT_S * NS_PER_S)
        assert news.now_ns == pytest.approx(NOW_NS, abs=LIMIT_S * NS_PER_S)
        assert NOW_NS + utc_offset_ns(news.ahead_ns) == pytest.approx(time_ns(), abs=LIMIT_S * NS_PER_S)
        served.do(lambda server: server.publish(batch("imu1", 7)))
        news = heard.wait_for(lambda news: news.newest)
        assert news.newest is not None
        assert [(one.device, one.seq) for one in news.newest] == [("imu1", 7)]
        assert not news.samples
        served.do(lambda server: server.event(Event(5, "imu1", EventKind.UP, "is there")))
        served.do(lambda server: server.event(Event(6, "imu1", EventKind.DOWN, "is not there")))
        found: list[str] = []
        while len(found) < 2:
            found += [event.message for event in heard.wait_for(lambda news: news.events).events]
        assert found == ["is there", "is not there"]


def test_the_feed_ignores_unknown_devices_and_ends_its_watch(tmp_path: Path) -> None:
    with daemon(tmp_path) as served, feeding(str(served.path), Wish(("gone",), news_s=0.02)) as (feed, heard):
        assert not heard.wait_for(lambda news: news.statuses).problem
        feed.want(Wish(("gone", "imu1"), news_s=0.03))
        numbers = iter(range(1, 10_000))
        served.do(lambda server: server.publish(batch("imu1", next(numbers))))

        def came() -> bool:
            served.do(lambda server: server.publish(batch("imu1", next(numbers))))
            return bool(heard.wait_for(lambda news: True).samples)

        until(came, heard)
        served.do(lambda server: server.event(Event(5, "imu1", EventKind.UP, "is there")))
        assert heard.wait_for(lambda news: news.events).events[0].message == "is there"
        feed.want(Wish(("gone",), news_s=0.02))
        until(lambda: served.do(lambda server: server.hub.clients()[0].encoding == ""), heard)


def test_it_connects_again_to_a_daemon_that_was_restarted(tmp_path: Path) -> None:
    with daemon(tmp_path) as served:
        path, heard = str(served.path), Listener()
        feed = Feed(path, OVERVIEW)
        feed.start(heard.on_news)
        heard.wait_for(lambda news: news.statuses)
    assert path in heard.wait_for(lambda news: news.problem).problem
    with daemon(tmp_path):
        assert heard.wait_for(lambda news: news.hello).statuses
        feed.close()
        feed.close()


@pytest.mark.parametrize("sign", [1, -1])
def test_a_small_difference_of_clocks_counts_as_one_clock(monkeypatch: pytest.MonkeyPatch, sign: int) -> None:
    monkeypatch.setattr("imud.client.feed.monotonic_ns", lambda: NOW_NS)
    assert clock_ahead_ns(NOW_NS + sign * SAME_CLOCK_NS) == 0  # the reply may be late
    assert clock_ahead_ns(NOW_NS + sign * (SAME_CLOCK_NS + 1)) == sign * (SAME_CLOCK_NS + 1)
    monkeypatch.setattr("imud.client.feed.time_ns", lambda: NOW_NS + 7)
    assert utc_offset_ns(5) == 2
