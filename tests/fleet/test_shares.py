"""Shares: the division among collectors, locks in a real PostgreSQL, and collectors that a test kills."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, closing, contextmanager, suppress
from pathlib import Path

import pytest

from imud.fleet import reader as fleet_reader
from imud.fleet import shares
from imud.fleet.collector import EVERYTHING, FleetCollector, Selection
from imud.fleet.database.leases import LeaseHolder, LeaseKey, LeaseKind
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.store import PostgresStore
from imud.fleet.reader import Fleet
from imud.fleet.shares import Changes, FleetShares, ShareLeases, ShareView, changes
from imud.model.errors import BadArgument, ServerError
from tests.bench.fleet_collectors import play, problems_of
from tests.fleet.fleet_gateway import SendingGateway, samples_message
from tests.fleet.mosquitto import NO_MOSQUITTO, Mosquitto
from tests.fleet.postgres_server import PostgresServer, query
from tests.fleet.test_connection import until
from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.event_loops import in_loop


def divided(total: int, *collectors: set[int], turns: int = 10) -> list[set[int]]:
    """Return the shares of each collector after some turns, in which each follows `changes`."""
    own = [set(one) for one in collectors]
    for _ in range(turns):
        for mine in own:
            view = ShareView(len(own), frozenset().union(*own))
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
    assert changes(3, ShareView(2, frozenset({1})), {1}, {0}) == Changes((2,), ())
    assert changes(2, ShareView(2, frozenset({0})), {0}, ()) == Changes((), ()), "the other collector takes share 1"


live = pytest.mark.live


@contextmanager
def locks(url: str, name: str, selection: Selection = EVERYTHING) -> Iterator[ShareLeases]:
    PostgresStore(url).close()
    with closing(ShareLeases(url, name, selection)) as made:
        made.connect()
        yield made


@live
def test_one_collector_at_a_time_has_a_share(server: PostgresServer) -> None:
    with locks(server.url, "a") as first, locks(server.url, "other") as other:
        with locks(server.url, "a") as second:
            assert [one.take(1) for one in (first, first, second, other)] == [True, True, False, True]
            assert second.take(0)
            assert first.view() == second.view() == ShareView(2, frozenset({0, 1}))
            first.release(1)
            first.release(1)
            assert second.take(1), "a share that was taken twice is released once"
            assert first.own == frozenset()
        wait_until(lambda: first.view() == ShareView(1, frozenset()), "PostgreSQL has released the locks")
        assert other.view() == ShareView(1, frozenset({1}))


@live
def test_collectors_with_one_name_have_one_selection(server: PostgresServer) -> None:
    mill, third = Selection(site="mill"), ShareLeases(server.url, "c", Selection(gateway="mill"))
    expected = pytest.raises(BadArgument, match=r"one selection of gateways.*'c'.*try another --name")
    with closing(third), locks(server.url, "c", mill), locks(server.url, "c", mill), expected:
        third.connect()


@live
def test_stopped_collector_loses_its_shares(server: PostgresServer) -> None:
    """A stopped process keeps its TCP connections open, but does not renew its leases."""
    PostgresStore(server.url).close()
    key = LeaseKey(LeaseKind.SHARE, "stopped", 0)
    stopped, other = LeaseHolder(server.url, 0.5), LeaseHolder(server.url)
    with closing(stopped), closing(other):
        stopped.connect()
        other.connect()
        assert stopped.take(key)
        wait_until(lambda: other.take(key), "the lease of the stopped collector has ended")
        with pytest.raises(ServerError, match=r"1 of 1 leases ended, .* 0\.5 s|terminating connection|idle-session"):
            stopped.renew()


@live
def test_rows_are_exactly_once_while_collectors_are_killed(
    tmp_path: Path, server: PostgresServer, database: str
) -> None:
    if NO_MOSQUITTO:
        pytest.skip(NO_MOSQUITTO)
    assert problems_of(play(tmp_path, server, gateways=4, seconds=10.0, interval_s=3.0), LIMIT_S) == []


@asynccontextmanager
async def collecting(broker: Mosquitto, url: str, total: int = 1) -> AsyncIterator[FleetShares]:
    """Run a collector until the end of the block."""
    fleet = Fleet(f"mqtt://127.0.0.1:{broker.port}", name="shared", retry_max_s=1.0)
    collector = FleetShares(fleet, url, CollectorSettings(shares=total), EVERYTHING)
    running = asyncio.ensure_future(collector.run())
    try:
        yield collector
    finally:
        collector.stop()
        await running


async def until_stored(url: str, last: int) -> None:
    """Wait until the numbers 1 to `last` are in the database. Each number is there once."""

    async def numbers() -> list[int]:
        found = await asyncio.to_thread(query, url, "SELECT seq FROM imud_samples ORDER BY seq")
        return [seq for (seq,) in found]

    found: list[int] = []
    with suppress(TimeoutError):
        async with asyncio.timeout(LIMIT_S):
            while (found := await numbers()) != list(range(1, last + 1)):
                await asyncio.sleep(0.05)
    assert found == list(range(1, last + 1))


async def send(gateway: SendingGateway, first: int, last: int) -> None:
    """Send one message for each number, with QoS 1."""
    await asyncio.to_thread(gateway.send, *(samples_message(seq, seq) for seq in range(first, last + 1)))


def subscribed(broker: Mosquitto) -> int:
    """Return the number of sessions with a subscription."""
    return len({line.split()[-1] for line in broker.log if "Received SUBSCRIBE from imud-reader-shared" in line})


@pytest.fixture
def short_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shares, "TURN_S", 0.1)


@live
@pytest.mark.usefixtures("short_turns")
@in_loop
async def test_a_standby_continues_with_the_sessions(database: str, broker: Mosquitto, gateway: SendingGateway) -> None:
    async with collecting(broker, database, 2) as standby:
        await until(lambda: standby.held == {0, 1})
        async with collecting(broker, database, 2) as other:
            await until(lambda: standby.held == {0} and other.held == {1} and subscribed(broker) == 2)
            await send(gateway, 1, 20)
            await until_stored(database, 20)
            assert standby.live == 2
        await send(gateway, 21, 40)
        await until(lambda: standby.held == {0, 1})
        await until_stored(database, 40)
    assert standby.held == frozenset()
    assert "streams: 1, missing: 0, dropped: 0" in standby.ledger_text()


@live
@pytest.mark.usefixtures("short_turns")
@in_loop
async def test_a_lost_database_connection_does_not_end_a_collector(
    database: str, broker: Mosquitto, gateway: SendingGateway
) -> None:
    cut = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = 'imud fleet collect'"
    async with collecting(broker, database, 2) as collector:
        await until(lambda: collector.held == {0, 1} and subscribed(broker) == 2)
        await asyncio.to_thread(query, database, cut)
        await send(gateway, 1, 20)
        await until(lambda: not collector.held)
        await until_stored(database, 20)
        await until(lambda: collector.held == {0, 1})


@live
@pytest.mark.usefixtures("short_turns")
@in_loop
async def test_blocked_transaction_is_reported(
    database: str, broker: Mosquitto, gateway: SendingGateway, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """The log names the session that holds a lock. The metrics show the database as not connected."""
    import psycopg

    monkeypatch.setattr(shares, "PROBLEM_S", 0.3)
    async with collecting(broker, database) as collector:
        await until(lambda: collector.held == {0} and subscribed(broker) == 1)
        with closing(psycopg.connect(database, application_name="editor")) as editor:
            await asyncio.to_thread(editor.execute, "LOCK TABLE imud_ledger IN EXCLUSIVE MODE")
            await send(gateway, 1, 20)
            blocked = (
                "share 0: PostgreSQL has not stored the messages for 0.3 s; other sessions hold locks: user 'imud', "
            )
            session = f"application 'editor' (SELECT pg_terminate_backend({editor.info.backend_pid}))"
            await until(lambda: blocked + session in caplog.text)
            status = collector.status()
            assert not status.database_connected
            assert status.write_s > 0.3
        await until_stored(database, 20)
        await until(lambda: collector.status().database_connected)
    assert caplog.text.count(blocked) == 1


@live
@pytest.mark.usefixtures("short_turns")
@in_loop
async def test_a_share_that_fails_does_not_end_the_others(
    database: str, broker: Mosquitto, gateway: SendingGateway, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    monkeypatch.setattr(shares, "RETRY_S", 0.5)
    working, failures = FleetCollector.run, [OSError("full"), ServerError("locked"), RuntimeError("wrong")]

    async def run(collector: FleetCollector) -> None:
        if collector.session.share.number == 1 and failures:
            raise failures.pop()
        await working(collector)

    monkeypatch.setattr(FleetCollector, "run", run)
    async with collecting(broker, database, 2) as collector:
        await until(lambda: not failures and subscribed(broker) == 2)
        await send(gateway, 1, 20)
        await until_stored(database, 20)
        assert collector.held == {0, 1}
    for problem in ("share 1: wrong", "share 1: locked", "share 1: full"):
        assert problem in caplog.text
    assert caplog.text.count("Traceback") == 1, "only the unknown error has a traceback"


@live
@pytest.mark.usefixtures("short_turns")
@in_loop
async def test_sessions_of_an_earlier_number_of_shares_are_emptied(
    database: str, broker: Mosquitto, gateway: SendingGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_reader, "DRAIN_S", 0.5)
    async with collecting(broker, database, 3) as three:
        await until(lambda: three.held == {0, 1, 2} and subscribed(broker) == 3)
    await send(gateway, 1, 30)
    async with collecting(broker, database, 1):
        await until_stored(database, 30)
        # after the sessions 1 and 2, the collector finds no session 3
        await until(lambda: any("imud-reader-shared.3" in line and "disconnected" in line for line in broker.log))
        await send(gateway, 31, 60)
        await until_stored(database, 60)
