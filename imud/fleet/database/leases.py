"""Leases in the database of a fleet: which collectors run, and which shares they hold.

Each lease is a row of the table `imud_leases`. Only users with the right to write to the tables of imud can take a
lease. (Every user who can connect can take an advisory lock.) A lease ends if its holder releases it, if the session of
the holder ends, or if the holder does not renew it in time. PostgreSQL ends the session if the process is killed.

The leases only divide the work. Each row is stored once even if two collectors hold the same share for a moment: the
ledger in the database decides that.
"""

import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from enum import StrEnum
from typing import Any, Final, NamedTuple

from imud.fleet.database.connection import blocking_sessions, connected, deadline, sentence_of
from imud.fleet.database.tables import LEASES
from imud.model.errors import ServerError

# Time for which a collector holds a lease without a renewal, s. A slow host can miss some renewals.
LEASE_S: Final = 15
STATEMENT_S: Final = 5  # maximum time of a statement, s: the statements use a few rows
REPLY_S: Final = 8  # maximum time until the reply to a statement arrives, s

# A session that has ended loses its leases immediately.
VALID: Final = (
    "lease.expires_at > clock_timestamp() "
    "AND lease.pid IN (SELECT pid FROM pg_stat_activity WHERE datname = current_database())"
)
_EXPIRY: Final = "clock_timestamp() + make_interval(secs => %(lease_s)s)"
_TAKE: Final = (
    f"INSERT INTO {LEASES.name} AS lease (kind, name, number, holder, pid, detail, expires_at) "
    f"VALUES (%(kind)s, %(name)s, %(number)s, %(holder)s, pg_backend_pid(), %(detail)s, {_EXPIRY}) "
    "ON CONFLICT (kind, name, number) DO UPDATE SET holder = EXCLUDED.holder, pid = EXCLUDED.pid, "
    "detail = EXCLUDED.detail, expires_at = EXCLUDED.expires_at "
    f"WHERE lease.holder = EXCLUDED.holder OR NOT ({VALID}) RETURNING true"
)
_RENEW: Final = (
    f"UPDATE {LEASES.name} SET expires_at = {_EXPIRY} WHERE holder = %(holder)s AND pid = pg_backend_pid() "
    "RETURNING kind, name, number"
)
_READ: Final = (
    f"SELECT kind, name, number, holder, detail FROM {LEASES.name} AS lease WHERE name = %(name)s AND {VALID}"
)
_RELEASE: Final = (
    f"DELETE FROM {LEASES.name} WHERE kind = %(kind)s AND name = %(name)s AND number = %(number)s "
    "AND holder = %(holder)s RETURNING true"
)
_RELEASE_ALL: Final = f"DELETE FROM {LEASES.name} WHERE holder = %(holder)s RETURNING true"
_REMOVE_ENDED: Final = f"DELETE FROM {LEASES.name} AS lease WHERE kind = 'collector' AND NOT ({VALID}) RETURNING true"
COUNT: Final = (
    "SELECT count(*) FILTER (WHERE kind = 'collector'), count(*) FILTER (WHERE kind = 'share') "
    f"FROM {LEASES.name} AS lease WHERE {VALID}"
)
_LIMITS: Final = (
    "SELECT set_config(name, %(milliseconds)s, false) FROM pg_settings "
    "WHERE name IN ('statement_timeout', 'lock_timeout')"
)
# PostgreSQL 13 has no such setting. Then a process that stops keeps its connection, but not its leases.
_IDLE: Final = "SELECT set_config(name, %(milliseconds)s, false) FROM pg_settings WHERE name = 'idle_session_timeout'"


class LeaseKind(StrEnum):
    """Subject of a lease."""

    COLLECTOR = "collector"  # a running collector; the number identifies it
    SHARE = "share"  # a share of the collectors with one name
    METRICS = "metrics"  # the metrics of the whole fleet


class LeaseKey(NamedTuple):
    """Key of a lease."""

    kind: LeaseKind
    name: str  # name of the collectors; empty for the metrics
    number: int  # number of the share or of the collector; 0 for the metrics


class Lease(NamedTuple):
    """Valid lease of any holder."""

    key: LeaseKey
    holder: int
    detail: str  # selection of a collector; otherwise empty


class LeaseHolder:
    """Connection that takes, renews and releases leases. Synchronization: one thread at a time."""

    def __init__(self, url: str, lease_s: float = LEASE_S) -> None:
        """Leases end after `lease_s` without a renewal."""
        self.number = secrets.randbelow(1 << 62)  # identifies this holder
        self._url, self._lease_s = url, lease_s
        self._keys: set[LeaseKey] = set()
        self._connection: Any = None

    @property
    def is_connected(self) -> bool:
        return self._connection is not None

    def connect(self) -> None:
        """Connect, without a lease. Raises ServerError."""
        self.close()
        self._connection = connected(self._url)
        self._connection.autocommit = True
        self._call(_LIMITS, {"milliseconds": str(STATEMENT_S * 1000)})
        self._call(_IDLE, {"milliseconds": str(round(self._lease_s * 1000))})
        self._call(_REMOVE_ENDED, {})

    def take(self, key: LeaseKey, detail: str = "") -> bool:
        """Take a lease. Return False if another holder has it. Raises ServerError."""
        if self._call(_TAKE, {**self._values(key), "detail": detail}):
            self._keys.add(key)
            return True
        return False

    def release(self, key: LeaseKey) -> None:
        """Release a lease. Do nothing if this holder does not have it. Raises ServerError."""
        if key in self._keys:
            self._keys.discard(key)
            self._call(_RELEASE, self._values(key))

    def renew(self) -> None:
        """Renew all leases of this holder. Raises ServerError if another holder has one of them."""
        rows = self._call(_RENEW, {"holder": self.number, "lease_s": self._lease_s})
        renewed_keys = {LeaseKey(LeaseKind(kind), name, number) for kind, name, number in rows}
        if missing_keys := self._keys - renewed_keys:
            raise ServerError(
                f"PostgreSQL: {len(missing_keys)} of {len(self._keys)} leases ended, because this process did not "
                f"renew them for {self._lease_s:g} s"
            )

    def read(self, name: str) -> list[Lease]:
        """Return the valid leases of all collectors with a name. Raises ServerError."""
        rows = self._call(_READ, {"name": name})
        return [
            Lease(LeaseKey(LeaseKind(kind), name, number), holder, detail)
            for kind, name, number, holder, detail in rows
        ]

    def blocking_sessions(self, pid: int) -> str:
        """Return the sessions that the server process `pid` waits for; empty if there are none. Raises ServerError."""
        with self._exchange() as connection:
            return blocking_sessions(connection, pid)

    def close(self) -> None:
        """Release all leases and close the connection. A second call does nothing."""
        if self._keys and self._connection is not None:
            with suppress(ServerError):
                self._call(_RELEASE_ALL, {"holder": self.number})
        self._keys.clear()
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _values(self, key: LeaseKey) -> dict[str, object]:
        return {**key._asdict(), "holder": self.number, "lease_s": self._lease_s}

    @contextmanager
    def _exchange(self) -> Iterator[Any]:
        """Yield the connection for one exchange. Raises ServerError."""
        import psycopg

        if self._connection is None:
            raise ServerError("PostgreSQL: the connection with the leases is closed")
        try:
            with deadline(self._connection, REPLY_S):
                yield self._connection
        except psycopg.Error as error:
            raise ServerError(f"PostgreSQL: {sentence_of(error)}") from error

    def _call(self, statement: str, values: Mapping[str, object]) -> Sequence[Any]:
        """Return the rows of a statement. Raises ServerError."""
        with self._exchange() as connection:
            rows: Sequence[Any] = connection.execute(statement, values).fetchall()
            return rows
