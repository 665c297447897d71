"""`imud fleet collect --to postgresql://…`: rows of samples, intervals, events, and the ledger, in one transaction.

    COPY of rows ──▶ ledger ──▶ rows that waited for their clock ──▶ COMMIT ──▶ (the collector) acknowledge

Exactly once: the ledger is kept beside the rows, so that a collector that was killed, or whose server was, knows what
it has. Gateway, boot, device and number, with the time, are the primary key: should rows be there that the ledger does
not know, COPY fails, and the transaction is done again through temporary tables with ON CONFLICT DO NOTHING, which
takes twice as long.

A gateway without a battery for its clock starts with any time. Its rows have that (`utc_set` is false) until a message
or the state of the same boot says that the clock is synchronised; the same transaction moves all rows of the boot to
where they belong: DELETE and INSERT, because a row changes its time, by which TimescaleDB divides tables.
"""

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from functools import lru_cache
from typing import Any, Final, NamedTuple

import msgspec

from imud.fleet.accounts import (
    DRIFT,
    Accounts,
    BootKey,
    BootOffset,
    FleetLedger,
    PlacedTime,
    StoredAccount,
    StreamKey,
    boot_of,
)
from imud.fleet.collector import Offsets
from imud.fleet.messages import Interval
from imud.fleet.reader import FleetBatch
from imud.model.errors import ServerError
from imud.model.units import NS_PER_S

VECTORS: Final = ("accel_m_s2", "gyro_rad_s", "mag_t", "quat_wxyz", "euler_rad", "incli_rad")
SCALARS: Final = ("temperature_c", "pressure_pa")
NUMBERS: Final = ("status", "pps_age_ms", "edge_seq")
KEY: Final = "site text NOT NULL, gateway text NOT NULL, boot text NOT NULL, device text NOT NULL"
UTC_COLUMNS: Final = (("utc_ns", "bigint NOT NULL"), ("utc_set", "boolean NOT NULL"), ("utc_err_ns", "bigint"))
_OF_SAMPLE: Final = (
    ("seq", "bigint NOT NULL"), ("t_ns", "bigint NOT NULL"), ("t_err_ns", "bigint NOT NULL"),
    ("sync", "text NOT NULL"), ("t_rx_ns", "bigint NOT NULL"), ("t_dev_ns", "bigint"),
    *((name, "double precision[]") for name in VECTORS), *((name, "double precision") for name in SCALARS),
    *((name, "bigint") for name in NUMBERS),
)  # fmt: skip
_SAMPLE_NAMES: Final = tuple(name for name, _ in _OF_SAMPLE)
_EPOCH: Final = datetime(1970, 1, 1)  # noqa: DTZ001  # its text has no offset, which stands behind the fraction

Row = tuple[object, ...]
"""Values of all columns, in the order of `FleetTable.names`."""


class FleetTable(NamedTuple):
    """A table of rows that have a time."""

    name: str
    columns: tuple[tuple[str, str], ...]
    """Name and type, without those of time and key."""
    primary: str

    @property
    def names(self) -> tuple[str, ...]:
        """All columns, in the order of COPY."""
        return ("time", "site", "gateway", "boot", "device", *(name for name, _ in self.columns))

    def statement(self) -> str:
        """The statement that makes it where it is missing."""
        columns = ", ".join(f"{name} {kind}" for name, kind in self.columns)
        return (
            f"CREATE TABLE IF NOT EXISTS {self.name} (time timestamptz NOT NULL, {KEY}, {columns}, "
            f"PRIMARY KEY ({self.primary}));"
        )


SAMPLES: Final = FleetTable("imud_samples", (*UTC_COLUMNS, *_OF_SAMPLE), "gateway, boot, device, seq, time")
RECORDS: Final = FleetTable(
    "imud_records",
    (*UTC_COLUMNS, ("first", "bigint NOT NULL"), ("last", "bigint NOT NULL"), ("stream", "text NOT NULL"),
     ("kind", "text NOT NULL"), ("t_ns", "bigint"), ("content", "jsonb NOT NULL")),
    "gateway, boot, device, stream, first, last, kind, time",
)  # fmt: skip
LEDGER: Final = "imud_ledger"
BOOTS: Final = "imud_boots"
SCHEMA: Final = {
    SAMPLES.name: SAMPLES.statement(),
    RECORDS.name: RECORDS.statement(),
    # half of each page is free, so that an account is replaced in its page, without a change of the index
    LEDGER: f"CREATE TABLE IF NOT EXISTS {LEDGER} (gateway text, boot text, device text, stream text, "
    "account jsonb NOT NULL, PRIMARY KEY (gateway, boot, device, stream)) WITH (fillfactor = 50);",
    BOOTS: f"CREATE TABLE IF NOT EXISTS {BOOTS} (gateway text, boot text, t_ns bigint NOT NULL, "
    "utc_offset_ns bigint NOT NULL, utc_err_ns bigint, PRIMARY KEY (gateway, boot));",
}
"""Statements that make the tables, by their names."""


def sample_rows(batch: FleetBatch) -> Iterable[Row]:
    """Rows of the samples of a message."""
    head = _head(batch)
    for one in batch.message.samples:
        values = [getattr(one, name) for name in _SAMPLE_NAMES]
        yield (
            *_times(head, batch.time_of(one.utc_ns, one.t_ns)),
            *[list(value) if isinstance(value, tuple) else value for value in values],
        )


def record_rows(batch: FleetBatch) -> Iterable[Row]:
    """Rows of intervals, events and what was dropped."""
    message, stream, head = batch.message, batch.stream.value, _head(batch)
    for one in message.intervals:
        at = batch.time_of(one.begin_utc_ns, one.begin_t_ns)
        content = json_of(_placed(batch, one, at))
        yield (*_times(head, at), one.first, one.last, stream, "interval", one.begin_t_ns, content)
    for number, event in enumerate(message.events, message.first):
        at = batch.time_of(message.utc_ns, event.t_ns)
        yield (*_times(head, at), number, number, stream, "event", event.t_ns, json_of(event))
    if message.cause is not None:
        numbers, content = (message.first, message.last), json_of({"cause": message.cause})
        at = batch.time_of_newest()
        yield (*_times(head, at), *numbers, stream, "dropped", message.newest_t_ns, content)


def json_of(value: object) -> str:
    """A value as JSON."""
    return msgspec.json.encode(value).decode()


def _head(batch: FleetBatch) -> Row:
    message = batch.message
    return batch.site, message.gateway, message.boot, message.device


def _times(head: Row, at: PlacedTime) -> Row:
    second, rest_ns = divmod(at.utc_ns, NS_PER_S)
    return (f"{_second_text(second)}.{rest_ns // 1000:06}+00:00", *head, at.utc_ns, at.is_set, at.error_ns)


@lru_cache(1024)
def _second_text(second: int) -> str:
    """A second as text, UTC: many rows are of the same one."""
    return (_EPOCH + timedelta(seconds=second)).isoformat()


def _placed(batch: FleetBatch, one: Interval, begin: PlacedTime) -> Interval:
    """An interval with the times at which it lies: where its begin stays, the clock was not stepped after it."""
    if begin.utc_ns == one.begin_utc_ns:
        return one
    end = batch.time_of(one.end_utc_ns, one.end_t_ns)
    return msgspec.structs.replace(one, begin_utc_ns=begin.utc_ns, end_utc_ns=end.utc_ns)


LOCK: Final = 0x696D7564
"""Number of the advisory lock ("imud"): one collector at a time writes to a database."""
LOCK_S: Final = 20
"""The lock of a collector that was killed goes with its last statement."""
EXTRA_MISSING: Final = "--to postgresql needs the extra fleet: pip install 'imud[fleet]'"
_UTC_NS: Final = "t_ns + %(utc_offset_ns)s"
_PLACED: Final = {
    "time": f"timestamptz 'epoch' + ({_UTC_NS}) / 1000 * interval '1 microsecond'",
    "utc_ns": _UTC_NS,
    "utc_set": "true",
    "utc_err_ns": f"%(utc_err_ns)s::bigint + abs(t_ns - %(at_ns)s) / {DRIFT}",
    "content": "CASE kind WHEN 'interval' THEN content || jsonb_build_object("
    "'begin_utc_ns', (content->>'begin_t_ns')::bigint + %(utc_offset_ns)s, "
    "'end_utc_ns', (content->>'end_t_ns')::bigint + %(utc_offset_ns)s) ELSE content END",
}
"""Columns that change when the clock of a boot is known: the same as `boots.placed` does, in SQL."""


class PostgresStore:
    """The store. Synchronization: one thread at a time."""

    def __init__(self, url: str) -> None:
        """Connect and make the tables. Raises ServerError."""
        try:
            import psycopg
        except ImportError as error:
            raise ServerError(EXTRA_MISSING) from error
        self._error: type[Exception] = psycopg.Error
        self._conflict: type[Exception] = psycopg.errors.UniqueViolation
        self._offsets: dict[BootKey, BootOffset] = {}
        """Wall clocks of boots, as the table has them."""
        try:
            self._connection: Any = psycopg.connect(url, connect_timeout=10, application_name="imud fleet collect")
            with self._connection.transaction(), self._connection.cursor() as cursor:
                cursor.execute(f"SET lock_timeout = '{round(LOCK_S * 1000)}ms'")
                cursor.execute("SELECT pg_advisory_lock(%s)", (LOCK,))
                _make_tables(cursor)
                for name in (SAMPLES.name, RECORDS.name, LEDGER):
                    _make_new(cursor, name)
        except psycopg.errors.LockNotAvailable as error:
            self.close()
            raise ServerError(
                f"PostgreSQL: expected that no other collector writes to this database, got one that still does after "
                f"{LOCK_S} s: look at application_name in pg_stat_activity"
            ) from error
        except psycopg.ProgrammingError as error:
            self.close()
            if error.sqlstate is not None:  # of the server
                raise ServerError(f"PostgreSQL: {_sentence(error)}") from error
            raise ServerError(
                f"PostgreSQL: the URL cannot be read: {_unquoted(error)}; it may have a password and is not shown"
            ) from None
        except psycopg.Error as error:
            self.close()
            raise ServerError(f"PostgreSQL: {_sentence(error)}") from error

    def restore(self, ledger: FleetLedger) -> None:
        """Enter the accounts that are kept into a ledger. Raises ServerError."""
        try:
            with self._connection.transaction(), self._connection.cursor() as cursor:
                cursor.execute(f"SELECT gateway, boot, device, stream, account::text FROM {LEDGER}")
                for *key, account in cursor:
                    ledger.restore(StreamKey(*key), msgspec.json.decode(account, type=StoredAccount))
                cursor.execute("SELECT gateway, boot, t_ns, utc_offset_ns, utc_err_ns FROM imud_boots")
                self._offsets = {BootKey(*row[:2]): BootOffset(*row[2:]) for row in cursor}
        except (self._error, OverflowError, msgspec.DecodeError) as error:
            raise ServerError(f"PostgreSQL: {_sentence(error)}") from error

    def write(self, batches: Sequence[FleetBatch], accounts: Accounts, offsets: Offsets) -> None:
        """Keep batches and the accounts that they changed, place rows of `offsets`, all or nothing.

        Raises ServerError.
        """
        known = [batch._replace(offset=batch.offset or self._offsets.get(boot_of(batch.message))) for batch in batches]
        fresh = {key: offset for key, offset in offsets.items() if key not in self._offsets}
        try:
            try:
                self._transact(self._copy, known, accounts, fresh)
            except self._conflict:
                self._transact(self._insert, known, accounts, fresh)
        except self._error as error:
            raise ServerError(f"PostgreSQL: {_sentence(error)}") from error
        self._offsets |= fresh

    def close(self) -> None:
        """End the connection; may be called twice."""
        connection = getattr(self, "_connection", None)
        if connection is not None:
            with suppress(self._error):
                connection.close()

    # --- one transaction ---------------------------------------------------------------------------------------------

    def _transact(
        self, insert: Callable[[Any, FleetTable, Iterable[Row]], None], batches: Sequence[FleetBatch],
        accounts: Accounts, fresh: Offsets,
    ) -> None:  # fmt: skip
        """Write everything; `insert` says how rows come into their table."""
        with self._connection.transaction(), self._connection.cursor() as cursor:
            insert(cursor, SAMPLES, (row for batch in batches for row in sample_rows(batch)))
            insert(cursor, RECORDS, (row for batch in batches for row in record_rows(batch)))
            if accounts:
                _copy_rows(cursor, f"new_{LEDGER}", ((*key, json_of(one)) for key, one in accounts.items()))
                cursor.execute(
                    f"INSERT INTO {LEDGER} SELECT * FROM new_{LEDGER} "
                    "ON CONFLICT (gateway, boot, device, stream) DO UPDATE SET account = EXCLUDED.account"
                )
            self._place(cursor, fresh)

    def _copy(self, cursor: Any, table: FleetTable, rows: Iterable[Row]) -> None:
        """Give rows to their table, none of which is there."""
        _copy_rows(cursor, f"{table.name} ({', '.join(table.names)})", rows)

    def _insert(self, cursor: Any, table: FleetTable, rows: Iterable[Row]) -> None:
        """Give rows to their table, but for those that are there."""
        columns = ", ".join(table.names)
        _copy_rows(cursor, f"new_{table.name} ({columns})", rows)
        cursor.execute(
            f"INSERT INTO {table.name} ({columns}) SELECT {columns} FROM new_{table.name} ON CONFLICT DO NOTHING"
        )

    def _place(self, cursor: Any, fresh: Offsets) -> None:
        """Note clocks that are known from now on, and move the rows of their boots to where they belong."""
        for key, offset in fresh.items():
            cursor.execute(
                "INSERT INTO imud_boots (gateway, boot, t_ns, utc_offset_ns, utc_err_ns) "
                "VALUES (%s, %s, %s, %s, %s) ON CONFLICT DO NOTHING", (*key, *offset),
            )  # fmt: skip
            cursor.execute(
                f"SELECT DISTINCT boot FROM {LEDGER} WHERE gateway = %s AND split_part(boot, '-', 1) = %s", key
            )
            values = {
                "gateway": key.gateway, "boots": [boot for (boot,) in cursor], "at_ns": offset.t_ns,
                "utc_offset_ns": offset.utc_offset_ns, "utc_err_ns": offset.utc_err_ns,
            }  # fmt: skip
            for table in (SAMPLES, RECORDS):
                cursor.execute(_place_statement(table), values)


def _place_statement(table: FleetTable) -> str:
    """Move rows of the boots of a gateway to where they belong."""
    return (
        f"WITH gone AS (DELETE FROM {table.name} WHERE gateway = %(gateway)s AND boot = ANY(%(boots)s) "
        f"AND NOT utc_set AND t_ns IS NOT NULL RETURNING *) INSERT INTO {table.name} ({', '.join(table.names)}) "
        f"SELECT {', '.join(_PLACED.get(name, name) for name in table.names)} FROM gone ON CONFLICT DO NOTHING"
    )


def _copy_rows(cursor: Any, target: str, rows: Iterable[Row]) -> None:
    """COPY rows into a table."""
    with cursor.copy(f"COPY {target} FROM STDIN") as copy:
        for row in rows:
            copy.write_row(row)


def _make_tables(cursor: Any) -> None:
    """Make the tables that are missing; where none is, that needs no right to make any."""
    for name, statement in SCHEMA.items():
        cursor.execute("SELECT to_regclass(%s)", (name,))
        if cursor.fetchone()[0] is None:
            cursor.execute(statement)


def _make_new(cursor: Any, name: str) -> None:
    """Make the temporary table whose rows go into a table."""
    cursor.execute(f"CREATE TEMPORARY TABLE new_{name} ON COMMIT DELETE ROWS AS SELECT * FROM {name} WITH NO DATA")


def _sentence(error: BaseException) -> str:
    return " ".join(str(error).split())


def _unquoted(error: BaseException) -> str:
    """The problem without the part of the URL that libpq quotes."""
    return _sentence(error).partition('"')[0].rstrip(": ")
