"""`imud fleet collect --to postgresql://…`: rows of samples, intervals, events, and the ledger, in one transaction.

    COPY into temporary tables ──▶ INSERT … ON CONFLICT DO NOTHING ──▶ ledger ──▶ COMMIT ──▶ (the collector) acknowledge

Exactly once: a row is known by gateway, boot, device and number, which with its time are its primary key; time is in
it because TimescaleDB wants the column that it divides a table by in every unique index. The ledger is kept beside the
rows, so that a collector that was killed knows what it has. The schema is in docs/fleet.md.

A gateway without a battery for its clock starts without a wall clock. What it sends then has a `utc_ns` before 2020; it
waits in `imud_unplaced` by `t_ns`, and is placed in the transaction that brings the first sample of the same boot with
a clock that is set: its `utc_ns` less its `t_ns` is the offset of the boot.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

import msgspec

from imud.errors import ServerError
from imud.fleet.reader import FleetBatch
from imud.formats.fleet.ledger import Accounts, FleetLedger, StoredAccount, StreamKey
from imud.publishers.mqtt.spool import CLOCK_SET_NS
from imud.sample import Sample

LOCK: Final = 0x696D7564
"""Number of the advisory lock ("imud"): one collector at a time writes to a database."""
LOCK_S: Final = 20
"""The lock of a collector that was killed goes with its last statement."""
EXTRA_MISSING: Final = "--to postgresql needs the extra fleet: pip install 'imud[fleet]'"
US: Final = "timestamptz 'epoch' + {} / 1000 * interval '1 microsecond'"

VECTORS: Final = ("accel_m_s2", "gyro_rad_s", "mag_t", "quat_wxyz", "euler_rad", "incli_rad")
SCALARS: Final = ("temperature_c", "pressure_pa")
NUMBERS: Final = ("status", "pps_age_ms", "edge_seq")
KEY: Final = "site text NOT NULL, gateway text NOT NULL, boot text NOT NULL, device text NOT NULL"


class _Table(NamedTuple):
    """A table of rows that have a time."""

    name: str
    columns: tuple[tuple[str, str], ...]
    """Name and type, besides time and key; the first of them is in the primary key."""

    @property
    def names(self) -> tuple[str, ...]:
        """All columns but `time`, in the order of COPY."""
        return ("site", "gateway", "boot", "device", *(name for name, _ in self.columns))


_COMMON: Final = (
    ("seq", "bigint NOT NULL"), ("t_ns", "bigint NOT NULL"), ("t_err_ns", "bigint NOT NULL"),
    ("sync", "text NOT NULL"), ("t_rx_ns", "bigint NOT NULL"), ("utc_ns", "bigint NOT NULL"),
    ("t_dev_ns", "bigint"),
    *((name, "double precision[]") for name in VECTORS), *((name, "double precision") for name in SCALARS),
    *((name, "bigint") for name in NUMBERS),
)  # fmt: skip
SAMPLES: Final = _Table("imud_samples", _COMMON)
UNPLACED: Final = _Table("imud_unplaced", _COMMON)
RECORDS: Final = _Table(
    "imud_records",
    (("first", "bigint NOT NULL"), ("last", "bigint NOT NULL"), ("stream", "text NOT NULL"), ("kind", "text NOT NULL"),
     ("utc_ns", "bigint NOT NULL"), ("content", "jsonb NOT NULL")),
)  # fmt: skip


def schema() -> str:
    """The statements that make the tables where they are missing."""

    def made(one: _Table, head: str, key: str) -> str:
        columns = ", ".join(f"{name} {kind}" for name, kind in one.columns)
        return f"CREATE TABLE IF NOT EXISTS {one.name} ({head}{KEY}, {columns}, PRIMARY KEY ({key}));"

    return "\n".join(
        (
            made(SAMPLES, "time timestamptz NOT NULL, ", "gateway, boot, device, seq, time"),
            made(UNPLACED, "", "gateway, boot, device, seq"),
            made(RECORDS, "time timestamptz NOT NULL, ", "gateway, boot, device, stream, first, last, kind, time"),
            "CREATE TABLE IF NOT EXISTS imud_ledger (gateway text, boot text, device text, stream text, "
            "account jsonb NOT NULL, PRIMARY KEY (gateway, boot, device, stream));",
            "CREATE TABLE IF NOT EXISTS imud_boots (gateway text, boot text, utc_offset_ns bigint NOT NULL, "
            "PRIMARY KEY (gateway, boot));",
        )
    )


class PostgresStore:
    """The store. Synchronization: one thread at a time."""

    def __init__(self, url: str) -> None:
        """Connect and make the tables. Raises ServerError."""
        try:
            import psycopg
        except ImportError as error:
            raise ServerError(EXTRA_MISSING) from error
        self._error: type[Exception] = psycopg.Error
        self._offsets: set[tuple[str, str]] = set()
        """Gateways and boots whose clock is known."""
        self._unplaced: set[tuple[str, str]] = set()
        """Those of which samples wait for it."""
        try:
            self._connection: Any = psycopg.connect(url, connect_timeout=10, application_name="imud fleet collect")
            with self._connection.transaction(), self._connection.cursor() as cursor:
                cursor.execute(f"SET lock_timeout = '{LOCK_S}s'")
                cursor.execute("SELECT pg_advisory_lock(%s)", (LOCK,))
                cursor.execute(schema())
                for one in (SAMPLES, UNPLACED, RECORDS):
                    _make_new(cursor, one.name, ", ".join(one.names))
                _make_new(cursor, "imud_ledger", "*")
        except psycopg.Error as error:
            self.close()
            raise ServerError(f"PostgreSQL: {_sentence(error)}") from error

    def restore(self, ledger: FleetLedger) -> None:
        """Enter the accounts that are kept into a ledger. Raises ServerError."""
        try:
            with self._connection.transaction(), self._connection.cursor() as cursor:
                cursor.execute("SELECT gateway, boot, device, stream, account::text FROM imud_ledger")
                for *key, account in cursor:
                    ledger.restore(StreamKey(*key), msgspec.json.decode(account, type=StoredAccount))
                cursor.execute("SELECT gateway, boot FROM imud_boots")
                self._offsets = {(gateway, boot) for gateway, boot in cursor}
                cursor.execute("SELECT DISTINCT gateway, split_part(boot, '-', 1) FROM imud_unplaced")
                self._unplaced = {(gateway, boot) for gateway, boot in cursor}
        except (self._error, OverflowError, msgspec.DecodeError) as error:
            raise ServerError(f"PostgreSQL: {_sentence(error)}") from error

    def write(self, batches: Sequence[FleetBatch], accounts: Accounts) -> None:
        """Keep batches and the accounts that they changed, all or nothing. Raises ServerError."""
        try:
            with self._connection.transaction(), self._connection.cursor() as cursor:
                known = self._write_offsets(cursor, batches)
                samples = [(batch, one) for batch in batches for one in batch.message.samples]
                placed = [_sample_row(*pair) for pair in samples if pair[1].utc_ns >= CLOCK_SET_NS]
                waiting = [_sample_row(*pair) for pair in samples if pair[1].utc_ns < CLOCK_SET_NS]
                self._insert(cursor, SAMPLES, placed)
                self._insert(cursor, UNPLACED, waiting)
                self._insert(cursor, RECORDS, [row for batch in batches for row in _record_rows(batch)])
                unplaced = self._unplaced | {_boot_of(batch) for batch, one in samples if one.utc_ns < CLOCK_SET_NS}
                placeable = unplaced & (self._offsets | known)
                self._place(cursor, placeable)
                with cursor.copy("COPY new_imud_ledger FROM STDIN") as copy:
                    for key, account in accounts.items():
                        copy.write_row((*key, _json(account)))
                cursor.execute(
                    "INSERT INTO imud_ledger SELECT * FROM new_imud_ledger "
                    "ON CONFLICT (gateway, boot, device, stream) DO UPDATE SET account = EXCLUDED.account"
                )
        except self._error as error:
            raise ServerError(f"PostgreSQL: {_sentence(error)}") from error
        self._offsets |= known
        self._unplaced = unplaced - placeable

    def close(self) -> None:
        """End the connection; may be called twice."""
        connection = getattr(self, "_connection", None)
        if connection is not None:
            with suppress(self._error):
                connection.close()

    # --- one transaction ---------------------------------------------------------------------------------------------

    def _insert(self, cursor: Any, one: _Table, rows: Sequence[tuple[object, ...]]) -> None:
        """COPY rows, and insert those that are not there yet."""
        if not rows:
            return
        columns = ", ".join(one.names)
        with cursor.copy(f"COPY new_{one.name} ({columns}) FROM STDIN") as copy:
            for row in rows:
                copy.write_row(row)
        time, value = ("", "") if one is UNPLACED else ("time, ", US.format("utc_ns") + ", ")
        cursor.execute(
            f"INSERT INTO {one.name} ({time}{columns}) SELECT {value}{columns} FROM new_{one.name} "
            "ON CONFLICT DO NOTHING"
        )

    def _write_offsets(self, cursor: Any, batches: Iterable[FleetBatch]) -> set[tuple[str, str]]:
        """Note the clock of each boot that is known from here on; return these boots."""
        found: dict[tuple[str, str], int] = {}
        for batch in batches:
            boot = _boot_of(batch)
            for one in batch.message.samples:
                if one.utc_ns >= CLOCK_SET_NS and boot not in self._offsets:
                    found.setdefault(boot, one.utc_ns - one.t_ns)
        if found:
            cursor.executemany(
                "INSERT INTO imud_boots VALUES (%s, %s, %s) ON CONFLICT DO NOTHING",
                [(*boot, offset) for boot, offset in found.items()],
            )
        return set(found)

    def _place(self, cursor: Any, boots: Iterable[tuple[str, str]]) -> None:
        """Move samples that wait for the clock of a boot to the others."""
        others = ", ".join(name for name in SAMPLES.names if name != "utc_ns")
        placed = "t_ns + utc_offset_ns"
        cursor.executemany(
            "WITH gone AS (DELETE FROM imud_unplaced w USING imud_boots b WHERE b.gateway = w.gateway "
            "AND b.boot = split_part(w.boot, '-', 1) AND b.gateway = %s AND b.boot = %s "
            "RETURNING w.*, b.utc_offset_ns) "
            f"INSERT INTO imud_samples (time, utc_ns, {others}) SELECT {US.format(f'({placed})')}, {placed}, {others} "
            "FROM gone ON CONFLICT DO NOTHING",
            sorted(boots),
        )


def _make_new(cursor: Any, name: str, columns: str) -> None:
    """Make the temporary table whose rows go into a table."""
    cursor.execute(
        f"CREATE TEMPORARY TABLE new_{name} ON COMMIT DELETE ROWS AS SELECT {columns} FROM {name} WITH NO DATA"
    )


def _boot_of(batch: FleetBatch) -> tuple[str, str]:
    """Gateway and boot, without the number of a device that was made anew."""
    return batch.message.gateway, batch.message.boot.partition("-")[0]


def _sample_row(batch: FleetBatch, sample: Sample) -> tuple[object, ...]:
    message = batch.message
    head = (batch.site, message.gateway, message.boot, message.device)
    values = (getattr(sample, name) for name, _ in SAMPLES.columns)
    return (*head, *(list(value) if isinstance(value, tuple) else value for value in values))


def _record_rows(batch: FleetBatch) -> Iterable[tuple[object, ...]]:
    """Intervals, events and what was dropped."""
    message, stream = batch.message, batch.stream.value
    head = (batch.site, message.gateway, message.boot, message.device)
    for one in message.intervals:
        yield *head, one.first, one.last, stream, "interval", one.begin_utc_ns, _json(one)
    for number, event in enumerate(message.events, message.first):
        yield *head, number, number, stream, "event", message.utc_ns, _json(event)
    if message.cause is not None:
        yield *head, message.first, message.last, stream, "dropped", message.utc_ns, _json({"cause": message.cause})


def _json(value: object) -> str:
    return msgspec.json.encode(value).decode()


def _sentence(error: BaseException) -> str:
    return " ".join(str(error).split())
