"""Leases in a real PostgreSQL, and users of the database who try to stop the collectors."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import psycopg
import pytest

from imud.fleet.collector import EVERYTHING
from imud.fleet.database.leases import LeaseHolder, LeaseKey, LeaseKind
from imud.fleet.database.overview import OverviewReader
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.store import PostgresStore
from imud.fleet.database.upkeep import Upkeep
from imud.fleet.shares import ShareLeases, ShareView
from imud.model.errors import ServerError
from tests.fleet.database.deliveries import deliveries
from tests.fleet.database.gateway_rows import make_tables
from tests.fleet.fleet_gateway import samples_message
from tests.fleet.postgres_server import NO_POSTGRES, query
from tests.support.daemon_process import wait_until

pytestmark = [pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES), pytest.mark.live]

# a user without USAGE on the schema does not see the table
REFUSALS = (psycopg.errors.InsufficientPrivilege, psycopg.errors.UndefinedTable)
SHARE = LeaseKey(LeaseKind.SHARE, "c", 0)


@pytest.fixture
def database(database: str) -> Iterator[str]:
    make_tables(database)
    query(
        database,
        "DROP ROLE IF EXISTS visitor; CREATE ROLE visitor LOGIN; DROP ROLE IF EXISTS viewer; CREATE ROLE viewer LOGIN; "
        "GRANT USAGE ON SCHEMA public TO viewer; GRANT SELECT ON ALL TABLES IN SCHEMA public TO viewer",
    )
    yield database
    query(database, "DROP OWNED BY visitor, viewer; DROP ROLE visitor, viewer")


@contextmanager
def session(database: str, user: str) -> Iterator[Any]:
    """Yield a connection of another user."""
    with closing(psycopg.connect(database.replace("user=imud", f"user={user}"), autocommit=True)) as connection:
        yield connection


def test_user_without_rights_cannot_take_leases(database: str) -> None:
    """Advisory locks of any number, row locks and table locks of other users do not stop a collector."""
    with session(database, "visitor") as visitor, session(database, "viewer") as viewer:
        for connection in (visitor, viewer):
            for statement in (
                "SELECT FROM imud_leases FOR UPDATE", "SELECT FROM imud_schema FOR SHARE",
                "LOCK TABLE imud_leases IN ROW SHARE MODE", "DELETE FROM imud_leases",
            ):  # fmt: skip
                with pytest.raises(REFUSALS), connection.transaction():
                    connection.execute(statement)
        visitor.execute("SELECT pg_advisory_lock(7595432043217477739), pg_advisory_lock(7595432043149750628)")
        viewer.execute("BEGIN; SELECT count(*) FROM imud_leases")
        with closing(ShareLeases(database, "c", EVERYTHING)) as leases:
            leases.connect()
            assert leases.take(0)
            assert leases.view() == ShareView(1, frozenset({0}))
        with closing(PostgresStore(database)) as store:
            store.write(deliveries(samples_message(1, 5)))
            assert store.counts.messages == 1


def test_lease_of_lost_session_is_free(database: str) -> None:
    first, second = LeaseHolder(database, 3600), LeaseHolder(database, 3600)  # no lease ends by its time
    with closing(first), closing(second):
        first.connect()
        second.connect()
        assert [first.take(SHARE), first.take(SHARE), second.take(SHARE)] == [True, True, False]
        query(database, "SELECT pg_terminate_backend(pid) FROM imud_leases")
        wait_until(lambda: second.take(SHARE), "the lease of the ended session is free")
        with pytest.raises(ServerError):
            first.renew()
        first.connect()
        assert not first.take(SHARE)
        second.release(SHARE)
        assert first.take(SHARE)


def test_lost_lease_is_reported_by_renewal(database: str) -> None:
    with closing(LeaseHolder(database)) as holder:
        holder.connect()
        holder.take(SHARE)
        holder.renew()
        query(database, "UPDATE imud_leases SET holder = 1")
        with pytest.raises(ServerError, match="1 of 1 leases ended, because this process did not renew them for 15 s"):
            holder.renew()


def test_overview_counts_valid_leases(database: str) -> None:
    with closing(ShareLeases(database, "c", EVERYTHING)) as leases, OverviewReader(database) as reader:
        leases.connect()
        assert leases.take(3)
        assert reader.collectors() == (1, 1)
        query(database, "UPDATE imud_leases SET expires_at = now()")
        assert reader.collectors() == (0, 0)


def test_upkeep_names_sessions_with_table_locks(
    database: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("imud.fleet.database.upkeep.LOCK_MS", 20)
    with session(database, "viewer") as viewer, closing(psycopg.connect(database)) as connection:
        upkeep = Upkeep(CollectorSettings(samples_days=1, partition_hours=1))
        viewer.execute("BEGIN; SELECT count(*) FROM imud_samples")
        for _ in range(2):
            query(database, "UPDATE imud_schema SET upkeep_at = NULL")
            upkeep.run(connection.cursor())
    text = caplog.text
    assert "cannot create partitions of imud_samples: other sessions hold locks of the tables for a long time:" in text
    assert "user 'viewer', application '' (SELECT pg_terminate_backend(" in text


def test_start_does_not_wait_for_readers(database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader can hold locks for hours. The start of a collector waits for them for a short time only."""
    monkeypatch.setattr("imud.fleet.database.upkeep.LOCK_MS", 20)
    monkeypatch.setattr("imud.fleet.database.upkeep.PREPARE_S", 3600)
    with session(database, "viewer") as viewer:
        viewer.execute("BEGIN; SELECT count(*) FROM imud_samples")
        PostgresStore(database, CollectorSettings(partition_hours=1)).close()


def test_open_schema_is_reported_once(database: str, caplog: pytest.LogCaptureFixture) -> None:
    query(database, "GRANT CREATE ON SCHEMA public TO PUBLIC")
    PostgresStore(database).close()
    assert caplog.text.count("run REVOKE CREATE ON SCHEMA public FROM PUBLIC") == 1
