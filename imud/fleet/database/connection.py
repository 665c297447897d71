"""Connections to the database of a fleet: session parameters, deadlines, and sessions that block others.

The values of a role or a database (`ALTER ROLE … SET`) must not change the form of values or the limits of a collector.
Therefore, each connection sets the parameters that it depends on. `default_transaction_read_only` is not one of them:
it shows that another server has taken over.
"""

import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from threading import Timer
from typing import Any, Final

from imud.model.errors import ServerError

APPLICATION: Final = "imud fleet collect"  # application_name of the connections of a collector
CONNECT_S: Final = 10  # maximum time of an attempt to connect, s
# TCP keep-alives of both sides: 5 s + 3 · 3 s until a dead host is detected
KEEP_ALIVE: Final = {"idle": 5, "interval": 3, "count": 3}
DEAD_S: Final = 15  # maximum time without an acknowledgement of sent data, s
LOCK_S: Final = 20  # maximum wait for the lock of a row or a table, s
STATEMENT_S: Final = 60  # maximum time of a statement, s: a COPY of 8 MiB to a slow disk
ENCODING: Final = "UTF8"  # encoding of the database: texts of devices and messages can contain any character

# Parameters of a session that a role, a database or the server can set to another value
PARAMETERS: Final = {
    "array_nulls": "on",
    "bytea_output": "hex",
    "datestyle": "ISO, YMD",
    "extra_float_digits": "1",
    "idle_in_transaction_session_timeout": f"{DEAD_S}s",  # release locks of rows if this process stops
    "idle_session_timeout": "0",
    "intervalstyle": "postgres",
    "lock_timeout": f"{LOCK_S}s",
    "quote_all_identifiers": "off",
    "standard_conforming_strings": "on",
    "statement_timeout": f"{STATEMENT_S}s",
    "timezone": "UTC",
    "transaction_timeout": "0",
    "transform_null_equals": "off",
    **{f"tcp_keepalives_{name}": str(value) for name, value in KEEP_ALIVE.items()},
    "tcp_user_timeout": str(DEAD_S * 1000),
}
# The limits of a role can be shorter than the next statement needs.
_SET_FIRST: Final = "SET statement_timeout = 0"
# Older servers do not have all parameters.
_SET: Final = (
    "SELECT set_config(name, wanted.value, false) FROM pg_settings "
    "JOIN json_each_text(%s::json) AS wanted(key, value) ON lower(name) = wanted.key"
)
_BLOCKING: Final = (
    "SELECT pid, coalesce(usename, '?'), coalesce(application_name, '') FROM pg_stat_activity "
    "WHERE pid = ANY(pg_blocking_pids(%s))"
)
_LOCKING: Final = (
    "SELECT DISTINCT session.pid, coalesce(usename, '?'), coalesce(application_name, '') FROM pg_locks "
    "JOIN pg_stat_activity AS session USING (pid) JOIN pg_class ON pg_class.oid = relation "
    "WHERE granted AND relname LIKE %s AND session.pid <> pg_backend_pid() "
    "AND session.datname = current_database() ORDER BY session.pid"
)


def connected(url: str) -> Any:
    """Connect to a database. Both sides detect a dead host within DEAD_S. Raises ServerError."""
    import msgspec
    import psycopg

    keep_alive: dict[str, Any] = {f"keepalives_{name}": value for name, value in KEEP_ALIVE.items()}
    try:
        connection = psycopg.connect(
            url, connect_timeout=CONNECT_S, application_name=APPLICATION, client_encoding="utf8",
            tcp_user_timeout=DEAD_S * 1000, **keep_alive,
        )  # fmt: skip
        # a statement after a lock must see the rows that the transaction before it stored
        connection.isolation_level = psycopg.IsolationLevel.READ_COMMITTED
        with deadline(connection, CONNECT_S):
            connection.autocommit = True
            connection.execute(_SET_FIRST)
            connection.execute(_SET, (msgspec.json.encode(PARAMETERS).decode(),))
            connection.autocommit = False
    except psycopg.ProgrammingError as error:
        if error.sqlstate is not None:  # an error of the server, not of the URL
            raise ServerError(f"PostgreSQL: {sentence_of(error)}") from error
        raise ServerError(
            f"PostgreSQL: cannot parse the URL: {_unquoted(error)}; imud does not show it because of its password"
        ) from None
    except psycopg.Error as error:
        raise ServerError(f"PostgreSQL: {sentence_of(error)}") from error
    encoding = connection.info.parameter_status("server_encoding")
    if encoding != ENCODING:
        connection.close()
        raise ServerError(
            f"PostgreSQL: expected a database with the encoding {ENCODING}, got {encoding}; create another database: "
            f"createdb --encoding={ENCODING} --template=template0 NAME"
        )
    return connection


@contextmanager
def deadline(connection: Any, limit_s: float) -> Iterator[None]:
    """End the exchange with the server in the block if it lasts longer than `limit_s`. Raises ServerError.

    The limits of PostgreSQL have no effect if the server or the network does not reply.
    """
    import psycopg

    is_expired = False

    def expire() -> None:
        nonlocal is_expired
        is_expired = True
        with suppress(OSError, psycopg.Error), socket.socket(fileno=os.dup(connection.fileno())) as copy:
            copy.shutdown(socket.SHUT_RDWR)

    timer = Timer(limit_s, expire)
    timer.daemon = True
    timer.start()
    try:
        yield
    except psycopg.Error as error:
        if is_expired:
            raise ServerError(
                f"PostgreSQL: expected a reply within {limit_s:g} s, got none; see pg_stat_activity and the log of "
                "the server"
            ) from error
        raise
    finally:
        timer.cancel()
        timer.join()


def blocking_sessions(connection: Any, pid: int) -> str:
    """Return the sessions whose locks the server process `pid` waits for; empty if there are none."""
    return _names(connection.execute(_BLOCKING, (pid,)).fetchall())


def locking_sessions(cursor: Any, table: str) -> str:
    """Return the other sessions that hold a lock of a table or of its partitions; empty if there are none."""
    cursor.execute(_LOCKING, (f"{table}%",))
    return _names(cursor.fetchall())


def _names(rows: Sequence[tuple[int, str, str]]) -> str:
    """Format sessions with the statement that ends them."""
    return ", ".join(
        f"user {user!r}, application {application!r} (SELECT pg_terminate_backend({pid}))"
        for pid, user, application in rows
    )


def sentence_of(error: BaseException) -> str:
    """Return the text of an error as one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _unquoted(error: BaseException) -> str:
    """Return the problem without the part of the URL that libpq quotes."""
    return sentence_of(error).partition('"')[0].rstrip(": ")
