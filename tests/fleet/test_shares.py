"""Shares: the division among collectors, locks in a real PostgreSQL, and collectors that a test kills."""

from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from imud.fleet import shares
from imud.fleet.collector import EVERYTHING, Selection
from imud.fleet.shares import Changes, LockView, ShareLocks, changes
from imud.model.errors import BadArgument, ServerError
from tests.fleet.postgres_server import NO_POSTGRES, PostgresServer, running_server
from tests.support.daemon_process import wait_until


def divided(total: int, *collectors: set[int], turns: int = 10) -> list[set[int]]:
    """Return the shares of each collector after some turns, in which each follows `changes`."""
    own = [set(one) for one in collectors]
    for _ in range(turns):
        for mine in own:
            view = LockView(len(own), frozenset().union(*own))
            todo = changes(total, view, mine, ())
            mine |= set(todo.take)
            mine -= set(todo.release)
    return own


def test_collectors_divide_the_shares() -> None:
    assert divided(3, set()) == [{0, 1, 2}]
    assert divided(3, {0, 1, 2}, set()) == [{0, 1}, {2}]
    assert divided(3, {0, 1}, {2}, set()) == [{0}, {2}, {1}]
    assert divided(3, {0}, {2}, {1}, set()) == [{0}, {2}, {1}, set()], "a standby"
    assert divided(12, set(range(12)), set(), set(), set(), set()) == [
        {0, 1, 2}, {3, 4, 5}, {6, 7, 8}, {9, 10, 11}, set(),
    ]  # fmt: skip
    for count in range(1, 9):
        own = divided(7, *[set() for _ in range(count)])
        assert sorted(number for one in own for number in one) == list(range(7)), "each share has one collector"
        assert max(map(len, own)) == -(-7 // count)


def test_a_paused_share_is_left_to_others() -> None:
    assert changes(3, LockView(2, frozenset({1})), {1}, {0}) == Changes((2,), ())
    assert changes(2, LockView(2, frozenset({0})), {0}, ()) == Changes((), ()), "the other collector takes share 1"


live = pytest.mark.live


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    if NO_POSTGRES:
        pytest.skip(NO_POSTGRES)
    with running_server() as made:
        yield made


@contextmanager
def locks(url: str, name: str, selection: Selection = EVERYTHING) -> Iterator[ShareLocks]:
    with closing(ShareLocks(url, name, selection)) as made:
        made.connect()
        yield made


@live
def test_one_collector_at_a_time_has_a_share(server: PostgresServer) -> None:
    with locks(server.url, "a") as first, locks(server.url, "other") as other:
        with locks(server.url, "a") as second:
            assert [one.take(1) for one in (first, first, second, other)] == [True, True, False, True]
            assert second.take(0)
            assert first.view() == second.view() == LockView(2, frozenset({0, 1}))
            first.release(1)
            first.release(1)
            assert second.take(1), "a share that was taken twice is released once"
            assert first.own == frozenset()
        wait_until(lambda: first.view() == LockView(1, frozenset()), "PostgreSQL has released the locks")
        assert other.view() == LockView(1, frozenset({1}))


@live
def test_collectors_with_one_name_have_one_selection(server: PostgresServer) -> None:
    mill, third = Selection(site="mill"), ShareLocks(server.url, "c", Selection(gateway="mill"))
    expected = pytest.raises(BadArgument, match=r"one selection of gateways.*'c'.*try another --name")
    with closing(third), locks(server.url, "c", mill), locks(server.url, "c", mill), expected:
        third.connect()


@live
def test_a_collector_that_stops_loses_its_shares(server: PostgresServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """PostgreSQL ends a connection without a statement for IDLE_S. A stopped process keeps its TCP connections open."""
    assert f"'{shares.IDLE_S * 1000}'" in shares._IDLE
    monkeypatch.setattr(shares, "_IDLE", shares._IDLE.replace(f"'{shares.IDLE_S * 1000}'", "'500'"))
    with locks(server.url, "stopped") as stopped:
        assert stopped.take(0)
        monkeypatch.undo()
        with locks(server.url, "stopped") as other:
            wait_until(lambda: other.take(0), "PostgreSQL has released the locks of the stopped collector")
            with pytest.raises(ServerError, match="PostgreSQL"):
                stopped.view()
