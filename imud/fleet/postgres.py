"""Store of `imud fleet collect --to postgresql://…`: rows of samples, intervals, events and the ledger.

    COPY of rows ──▶ ledger ──▶ rows without UTC time ──▶ COMMIT ──▶ (the collector) acknowledge

Each record is stored exactly once, because one transaction contains the rows and the ledger. The primary key is
gateway, boot, device, number and time. If the database contains rows that the ledger does not, COPY fails. Then imud
repeats the transaction with temporary tables and ON CONFLICT DO NOTHING, which takes twice as long. If the server ends
the connection, imud connects again and repeats the transaction.

A gateway without a battery-backed clock starts with a wrong time. Its rows have the time of this clock and `utc_set`
false, until a message or a state of the same boot contains a synchronized clock. The same transaction then moves all
rows of the boot to their UTC time. It uses DELETE and INSERT, because TimescaleDB partitions tables by time.
"""

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext, suppress
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
from imud.host.installation import needs_extra
from imud.model.errors import ServerError
from imud.model.sample import values_of
from imud.model.units import NS_PER_S

VECTORS: Final = ("accel_m_s2", "gyro_rad_s", "mag_t", "quat_wxyz", "euler_rad", "incli_rad")
SCALARS: Final = ("temperature_c", "pressure_pa")
NUMBERS: Final = ("status", "pps_age_ms", "edge_seq")
# columns that older versions of imud did not create
_LATER: Final = (
    ("velocity_enu_m_s", "double precision[]"), ("heave_m", "double precision"), ("gnss_utc_ns", "bigint"),
    ("latitude_rad", "double precision"), ("longitude_rad", "double precision"), ("height_m", "double precision"),
    ("position_quality", "bigint"), ("satellites", "bigint"),
)  # fmt: skip
_NO_POSITION: Final = (None,) * 5
KEY: Final = "site text NOT NULL, gateway text NOT NULL, boot text NOT NULL, device text NOT NULL"
UTC_COLUMNS: Final = (("utc_ns", "bigint NOT NULL"), ("utc_set", "boolean NOT NULL"), ("utc_err_ns", "bigint"))
_OF_SAMPLE: Final = (
    ("seq", "bigint NOT NULL"), ("t_ns", "bigint NOT NULL"), ("t_err_ns", "bigint NOT NULL"),
    ("sync", "text NOT NULL"), ("t_rx_ns", "bigint NOT NULL"), ("t_dev_ns", "bigint"),
    *((name, "double precision[]") for name in VECTORS), *((name, "double precision") for name in SCALARS),
    *((name, "bigint") for name in NUMBERS), *_LATER,
)  # fmt: skip
_SAMPLE_NAMES: Final = tuple(name for name, _ in _OF_SAMPLE[:-5])
# its ISO text has no offset; the offset follows the fraction of the second
_EPOCH: Final = datetime(1970, 1, 1)  # noqa: DTZ001

Row = tuple[object, ...]  # values of all columns, in the order of `FleetTable.names`


class FleetTable(NamedTuple):
    """Table of rows with a time."""

    name: str
    columns: tuple[tuple[str, str], ...]  # name and type of the columns, without time and key
    primary: str

    @property
    def names(self) -> tuple[str, ...]:
        """Return all columns in the order of COPY."""
        return ("time", "site", "gateway", "boot", "device", *(name for name, _ in self.columns))

    def statement(self) -> str:
        """Return the statement that creates the table if it does not exist."""
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
# Statements that create the tables, by table name
SCHEMA: Final = {
    SAMPLES.name: SAMPLES.statement()
    + "".join(f"ALTER TABLE {SAMPLES.name} ADD COLUMN IF NOT EXISTS {name} {kind};" for name, kind in _LATER),
    RECORDS.name: RECORDS.statement(),
    # half of each page stays free: PostgreSQL can then update a ledger within its page, without an index update
    LEDGER: f"CREATE TABLE IF NOT EXISTS {LEDGER} (gateway text, boot text, device text, stream text, "
    "account jsonb NOT NULL, PRIMARY KEY (gateway, boot, device, stream)) WITH (fillfactor = 50);",
    BOOTS: f"CREATE TABLE IF NOT EXISTS {BOOTS} (gateway text, boot text, t_ns bigint NOT NULL, "
    "utc_offset_ns bigint NOT NULL, utc_err_ns bigint, PRIMARY KEY (gateway, boot));",
}


def sample_rows(batch: FleetBatch) -> Iterable[Row]:
    """Yield the rows of the samples of a message."""
    head = _head(batch)
    for one in batch.message.samples:
        values = [getattr(one, name) for name in _SAMPLE_NAMES]
        yield (
            *_times(head, batch.time_of(one.utc_ns, one.t_ns)),
            *[list(value) if isinstance(value, tuple) else value for value in values],
            *(_NO_POSITION if one.position is None else values_of(one.position)),
        )


def record_rows(batch: FleetBatch) -> Iterable[Row]:
    """Yield the rows of intervals, events and dropped records."""
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
    return msgspec.json.encode(value).decode()


def _head(batch: FleetBatch) -> Row:
    message = batch.message
    return batch.site, message.gateway, message.boot, message.device


def _times(head: Row, at: PlacedTime) -> Row:
    second, rest_ns = divmod(at.utc_ns, NS_PER_S)
    return (f"{_second_text(second)}.{rest_ns // 1000:06}+00:00", *head, at.utc_ns, at.is_set, at.error_ns)


@lru_cache(1024)
def _second_text(second: int) -> str:
    """Return a second as UTC text. Many rows share the same second."""
    return (_EPOCH + timedelta(seconds=second)).isoformat()


def _placed(batch: FleetBatch, one: Interval, begin: PlacedTime) -> Interval:
    """Return an interval with its UTC times. If the time of its start is correct, the clock did not step later."""
    if begin.utc_ns == one.begin_utc_ns:
        return one
    end = batch.time_of(one.end_utc_ns, one.end_t_ns)
    return msgspec.structs.replace(one, begin_utc_ns=begin.utc_ns, end_utc_ns=end.utc_ns)


log = logging.getLogger(__name__)

# Classes of SQLSTATE that the values of a row can cause: data exception, program limit exceeded
OF_VALUES: Final = ("22", "54")
LOCK: Final = 0x696D7564  # Number of the advisory lock, "imud". One collector at a time writes to a database.
LOCK_S: Final = 20  # Maximum wait for the lock, s. The lock of a killed collector ends with its last statement.
CONNECT_S: Final = 10  # maximum time of an attempt to connect, s
# Number of attempts to connect again, and the pause before each, s. The restart of a server takes some seconds.
ATTEMPTS: Final = 20
ATTEMPT_PAUSE_S: Final = 0.5
_UTC_NS: Final = "t_ns + %(utc_offset_ns)s"
# SQL expressions of the columns that change when the clock of a boot is known, equal to `accounts.placed`
_PLACED: Final = {
    "time": f"timestamptz 'epoch' + ({_UTC_NS}) / 1000 * interval '1 microsecond'",
    "utc_ns": _UTC_NS,
    "utc_set": "true",
    "utc_err_ns": f"%(utc_err_ns)s::bigint + abs(t_ns - %(at_ns)s) / {DRIFT}",
    "content": "CASE kind WHEN 'interval' THEN content || jsonb_build_object("
    "'begin_utc_ns', (content->>'begin_t_ns')::bigint + %(utc_offset_ns)s, "
    "'end_utc_ns', (content->>'end_t_ns')::bigint + %(utc_offset_ns)s) ELSE content END",
}


class PostgresStore:
    """Store in a PostgreSQL database. Synchronization: one thread at a time."""

    def __init__(self, url: str) -> None:
        """Connect and create the tables. Raises ServerError."""
        with needs_extra("fleet", ServerError):
            import psycopg
        self._url = url
        self._error: type[Exception] = psycopg.Error
        self._conflict: type[Exception] = psycopg.errors.UniqueViolation
        self.refused = 0  # number of messages, ledgers and offsets that the database could not store
        self._offsets: dict[BootKey, BootOffset] = {}  # clock offsets in the table `imud_boots`
        self._connect()

    def _connect(self) -> None:
        import psycopg

        try:
            self._connection: Any = psycopg.connect(
                self._url, connect_timeout=CONNECT_S, application_name="imud fleet collect"
            )
            with self._connection.transaction(), self._connection.cursor() as cursor:
                cursor.execute(f"SET lock_timeout = '{round(LOCK_S * 1000)}ms'")
                cursor.execute("SELECT pg_advisory_lock(%s)", (LOCK,))
                _make_tables(cursor)
                for name in (SAMPLES.name, RECORDS.name, LEDGER):
                    _make_new(cursor, name)
        except psycopg.errors.LockNotAvailable as error:
            self.close()
            raise ServerError(
                f"PostgreSQL: another collector still writes to this database after {LOCK_S} s; see "
                f"application_name in pg_stat_activity"
            ) from error
        except psycopg.ProgrammingError as error:
            self.close()
            if error.sqlstate is not None:  # an error of the server, not of the URL
                raise ServerError(f"PostgreSQL: {_sentence(error)}") from error
            raise ServerError(
                f"PostgreSQL: cannot parse the URL: {_unquoted(error)}; imud does not show it because of its password"
            ) from None
        except psycopg.Error as error:
            self.close()
            raise ServerError(f"PostgreSQL: {_sentence(error)}") from error

    def restore(self, ledger: FleetLedger) -> None:
        """Add the stored ledgers to `ledger`. Raises ServerError."""
        try:
            with self._connection.transaction(), self._connection.cursor() as cursor:
                cursor.execute(f"SELECT gateway, boot, device, stream, account::text FROM {LEDGER}")
                for *key, account in cursor:
                    ledger.restore(StreamKey(*key), msgspec.json.decode(account, type=StoredAccount))
                cursor.execute("SELECT gateway, boot, t_ns, utc_offset_ns, utc_err_ns FROM imud_boots")
                self._offsets = {BootKey(*row[:2]): BootOffset(*row[2:]) for row in cursor}
        except (self._error, msgspec.DecodeError) as error:
            raise ServerError(f"PostgreSQL: {_sentence(error)}") from error

    def write(self, batches: Sequence[FleetBatch], accounts: Accounts, offsets: Offsets) -> None:
        """Store batches, changed ledgers and clock offsets in one transaction. Raises ServerError. If the database
        cannot store a message, store each part in its own transaction and ignore the parts that fail. If the server
        ends the connection, connect again and repeat the transaction."""
        try:
            self._write(batches, accounts, offsets)
        except ServerError as error:
            if not self._connection.closed:
                raise
            self._connect_again(error)
            self._write(batches, accounts, offsets)

    def _connect_again(self, cause: ServerError) -> None:
        """Connect to a server that ended the connection. Raises ServerError after ATTEMPTS attempts."""
        log.warning("%s; connecting again", cause)
        for attempt in range(ATTEMPTS):
            time.sleep(ATTEMPT_PAUSE_S)
            with suppress(ServerError) if attempt < ATTEMPTS - 1 else nullcontext():
                self._connect()
                return

    def _write(self, batches: Sequence[FleetBatch], accounts: Accounts, offsets: Offsets) -> None:
        known = [batch._replace(offset=batch.offset or self._offsets.get(boot_of(batch.message))) for batch in batches]
        fresh = {key: offset for key, offset in offsets.items() if key not in self._offsets}
        try:
            try:
                self._transact(self._copy, known, accounts, fresh)
            except self._conflict:
                self._transact(self._insert, known, accounts, fresh)
            self._offsets |= fresh
        except (self._error, ValueError, OverflowError) as error:
            self._check_cause(error)
            self._write_parts(known, accounts, fresh)

    def _write_parts(self, batches: Sequence[FleetBatch], accounts: Accounts, fresh: Offsets) -> None:
        """Store each message, ledger and offset in its own transaction. Raises ServerError."""
        parts: list[tuple[str, list[FleetBatch], Accounts, Offsets]] = []
        parts += [(f"a message of {'/'.join(map(str, _head(batch)))}", [batch], {}, {}) for batch in batches]
        parts += [(f"the ledger of {'/'.join(key)}", [], {key: one}, {}) for key, one in accounts.items()]
        parts += [(f"the clock offset of {'/'.join(key)}", [], {}, {key: one}) for key, one in fresh.items()]
        for name, some_batches, some_accounts, some_offsets in parts:
            try:
                self._transact(self._insert, some_batches, some_accounts, some_offsets)
                self._offsets |= some_offsets
            except (self._error, ValueError, OverflowError) as error:
                self._check_cause(error)
                self.refused += 1
                log.warning("PostgreSQL: cannot store %s: %s; ignoring it", name, _sentence(error))

    def _check_cause(self, error: Exception) -> None:
        """Raise ServerError if the values of a message are not the cause of an error."""
        if isinstance(error, self._error) and not (getattr(error, "sqlstate", None) or "").startswith(OF_VALUES):
            raise ServerError(f"PostgreSQL: {_sentence(error)}") from error

    def close(self) -> None:
        """Close the connection. A second call does nothing."""
        connection = getattr(self, "_connection", None)
        if connection is not None:
            with suppress(self._error):
                connection.close()

    # --- one transaction ---------------------------------------------------------------------------------------------

    def _transact(
        self, insert: Callable[[Any, FleetTable, Iterable[Row]], None], batches: Sequence[FleetBatch],
        accounts: Accounts, fresh: Offsets,
    ) -> None:  # fmt: skip
        """Write all rows in one transaction. `insert` is `_copy` or `_insert`."""
        with self._connection.transaction(), self._connection.cursor() as cursor:
            insert(cursor, SAMPLES, (row for batch in batches for row in sample_rows(batch)))
            insert(cursor, RECORDS, (row for batch in batches for row in record_rows(batch)))
            if accounts:
                kept = ((*key, json_of(one)) for key, one in accounts.items() if one is not None)
                _copy_rows(cursor, f"new_{LEDGER}", kept)
                cursor.execute(
                    f"INSERT INTO {LEDGER} SELECT * FROM new_{LEDGER} "
                    "ON CONFLICT (gateway, boot, device, stream) DO UPDATE SET account = EXCLUDED.account"
                )
                cursor.executemany(
                    f"DELETE FROM {LEDGER} WHERE gateway = %s AND boot = %s AND device = %s AND stream = %s",
                    [key for key, one in accounts.items() if one is None],
                )
            self._place(cursor, fresh)

    def _copy(self, cursor: Any, table: FleetTable, rows: Iterable[Row]) -> None:
        """Copy new rows into their table."""
        _copy_rows(cursor, f"{table.name} ({', '.join(table.names)})", rows)

    def _insert(self, cursor: Any, table: FleetTable, rows: Iterable[Row]) -> None:
        """Copy rows into their table except rows that it already contains."""
        columns = ", ".join(table.names)
        _copy_rows(cursor, f"new_{table.name} ({columns})", rows)
        cursor.execute(
            f"INSERT INTO {table.name} ({columns}) SELECT {columns} FROM new_{table.name} ON CONFLICT DO NOTHING"
        )

    def _place(self, cursor: Any, fresh: Offsets) -> None:
        """Store new clock offsets and give the rows of their boots a UTC time."""
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
    """Return the statement that gives the rows of the boots of a gateway a UTC time."""
    return (
        f"WITH gone AS (DELETE FROM {table.name} WHERE gateway = %(gateway)s AND boot = ANY(%(boots)s) "
        f"AND NOT utc_set AND t_ns IS NOT NULL RETURNING *) INSERT INTO {table.name} ({', '.join(table.names)}) "
        f"SELECT {', '.join(_PLACED.get(name, name) for name in table.names)} FROM gone ON CONFLICT DO NOTHING"
    )


def _copy_rows(cursor: Any, target: str, rows: Iterable[Row]) -> None:
    with cursor.copy(f"COPY {target} FROM STDIN") as copy:
        for row in rows:
            copy.write_row(row)


def _make_tables(cursor: Any) -> None:
    """Create missing tables. Without a missing table, the user needs no right to create tables."""
    for name, statement in SCHEMA.items():
        cursor.execute("SELECT to_regclass(%s)", (name,))
        if cursor.fetchone()[0] is None:
            cursor.execute(statement)


def _make_new(cursor: Any, name: str) -> None:
    """Create the temporary table for the rows of a table."""
    cursor.execute(f"CREATE TEMPORARY TABLE new_{name} ON COMMIT DELETE ROWS AS SELECT * FROM {name} WITH NO DATA")


def _sentence(error: BaseException) -> str:
    return " ".join(str(error).split())


def _unquoted(error: BaseException) -> str:
    """Return the problem without the part of the URL that libpq quotes."""
    return _sentence(error).partition('"')[0].rstrip(": ")
