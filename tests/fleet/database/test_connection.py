"""Connections to a real PostgreSQL: parameters of roles and databases, encodings, and servers that do not reply."""

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress

import psycopg
import pytest

from imud.fleet.database import connection
from imud.fleet.database.connection import PARAMETERS, blocking_sessions, connected, deadline
from imud.fleet.database.overview import FleetSelection, OverviewReader
from imud.fleet.database.store import PostgresStore
from imud.model.errors import ServerError
from tests.fleet.database.deliveries import deliveries, delivery
from tests.fleet.fleet_gateway import samples_message
from tests.fleet.postgres_server import NO_POSTGRES, PostgresServer, query
from tests.support.daemon_process import wait_until

pytestmark = [pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES), pytest.mark.live]

# Values that another program of the server needs, and that a collector must not depend on
OTHER_VALUES = {
    "datestyle": "German", "timezone": "Asia/Kathmandu", "intervalstyle": "sql_standard", "client_encoding": "LATIN1",
    "bytea_output": "escape", "extra_float_digits": "-15", "standard_conforming_strings": "off", "array_nulls": "off",
    "default_transaction_isolation": "serializable", "default_transaction_deferrable": "on",
    "quote_all_identifiers": "on", "statement_timeout": "50ms", "lock_timeout": "1ms", "transform_null_equals": "on",
    "idle_in_transaction_session_timeout": "20ms", "idle_session_timeout": "1s",
}  # fmt: skip


@contextmanager
def altered(database: str, name: str, value: str) -> Iterator[None]:
    query(database, "DROP ROLE IF EXISTS keeper; CREATE ROLE keeper LOGIN SUPERUSER")
    query(database, f"ALTER ROLE imud SET {name} = '{value}'")
    try:
        yield
    finally:
        query(database.replace("user=imud", "user=keeper"), f"ALTER ROLE imud RESET {name}")


@pytest.mark.parametrize("name", sorted(OTHER_VALUES))
def test_collector_ignores_parameters_of_role(server: PostgresServer, database: str, name: str) -> None:
    with altered(database, name, OTHER_VALUES[name]):
        with closing(PostgresStore(database)) as store:
            store.write([*deliveries(samples_message(1, 5)), delivery("imud/mill/gw/state", b"\x00")])
            store._upkeep.run(store._connection.cursor())
            assert (store.counts.rows, store.counts.rejected) == (5, 1)
        with OverviewReader(database) as reader:
            assert len(reader.gateways(FleetSelection())) == 1
            assert reader.payload(1) == (b"\x00", 1)
            assert reader.rejected()[0][0].time.utcoffset() is not None


def test_connection_has_all_parameters(database: str) -> None:
    with closing(connected(database)) as session:
        for name in ("datestyle", "intervalstyle", "bytea_output", "timezone"):
            assert session.execute(f"SHOW {name}").fetchone() == (PARAMETERS[name],)
        assert session.execute("SHOW statement_timeout").fetchone() == ("1min",)


@pytest.mark.parametrize("encoding", ["LATIN1", "SQL_ASCII"])
def test_database_with_other_encoding_is_refused(server: PostgresServer, encoding: str) -> None:
    with closing(psycopg.connect(server.url, autocommit=True)) as session:
        session.execute("DROP DATABASE IF EXISTS other")
        session.execute(f"CREATE DATABASE other ENCODING '{encoding}' TEMPLATE template0")
    expected = (
        f"expected a database with the encoding UTF8, got {encoding}; create another database: createdb --encoding=UTF8"
    )
    with pytest.raises(ServerError, match=expected):
        PostgresStore(server.url.replace("/postgres?", "/other?"))


def test_deadline_ends_exchange_with_silent_server(server: PostgresServer) -> None:
    """A stopped server process acknowledges the bytes of TCP, but does not reply."""
    session = connected(server.url)
    pid = session.info.backend_pid
    os.kill(pid, signal.SIGSTOP)
    try:
        with pytest.raises(ServerError, match=r"expected a reply within 0\.2 s, got none"), deadline(session, 0.2):
            session.execute("SELECT 1")
        assert session.closed
    finally:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
        session.close()


def test_server_that_accepts_and_does_not_reply(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "CONNECT_S", 2)
    expected = pytest.raises(ServerError, match="PostgreSQL: connection timeout expired")
    with socket.create_server(("127.0.0.1", 0)) as silent, expected:
        connected(f"postgresql://imud@127.0.0.1:{silent.getsockname()[1]}/fleet")


def test_blocking_sessions_have_names(database: str) -> None:
    PostgresStore(database).close()
    with (
        closing(psycopg.connect(database, application_name="editor")) as holder,
        closing(psycopg.connect(database)) as waiting,
        closing(connected(database)) as observer,
    ):
        holder.execute("LOCK TABLE imud_ledger IN EXCLUSIVE MODE")
        waiting.pgconn.send_query(b"DELETE FROM imud_ledger")
        pid = waiting.info.backend_pid
        wait_until(lambda: bool(blocking_sessions(observer, pid)), "the session waits")
        expected = f"user 'imud', application 'editor' (SELECT pg_terminate_backend({holder.info.backend_pid}))"
        assert blocking_sessions(observer, pid) == expected
        holder.rollback()
