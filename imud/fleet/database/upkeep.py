"""Upkeep of the fleet database: tables, partitions, removal of old rows and boots.

    imud_samples ─┬─ imud_samples_unset                              rows without a known time (utc_set is false)
                  └─ imud_samples_set ─┬─ imud_samples_20261128_00   rows of one day
                                       ├─ …
                                       └─ imud_samples_other         all other times

Retention drops whole partitions. Only the end of its boot removes a row without a known time: its wrong time can be
older than the retention, and the row gets its UTC time later. With TimescaleDB, each of these tables is a hypertable.

Several collectors use one database. Each step of the upkeep is a short transaction that locks the row of `imud_schema`.
A user without the right to write to this table cannot lock the row. A step waits at most LOCK_MS for a lock of a table,
because collectors wait behind it. A user who can read a table can hold such a lock for hours: the log then names the
sessions.
"""

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import chain
from typing import Any, Final, NamedTuple

from imud.fleet.database.connection import deadline, locking_sessions, sentence_of
from imud.fleet.database.creation import (
    check_owners,
    check_version,
    create_schema_table,
    create_table,
    execute_all,
    has_license,
    has_relation,
    has_timescale,
    is_hypertable,
    missing_tables,
)
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.tables import (
    BOOTS,
    GATEWAYS,
    INTERVALS,
    LEDGER,
    SAMPLES,
    SCHEMA,
    TIMED,
    FleetTable,
)
from imud.fleet.database.views import refresh_policies, views

log = logging.getLogger(__name__)

_LOCK: Final = f"SELECT FROM {SCHEMA.name} FOR UPDATE"
PREPARE_S: Final = 20  # maximum wait for another collector that creates the tables, s
LOCK_MS: Final = 1000  # Maximum wait for a lock of a table, ms. Collectors wait for the same time.
BLOCKED_MIN: Final = 2  # number of consecutive failures of a step after which the log names the sessions with locks
STEP_S: Final = 30  # maximum time of a step until the reply arrives, s
STATEMENT_S: Final = 10  # Maximum time of a statement, s. The collector stores no messages during this time.
ROWS_STEP: Final = 10_000  # maximum number of rows that a step deletes
STEPS_MAX: Final = 20  # Maximum number of steps of each kind in one run. The next run continues.
BOOTS_STEP: Final = 100  # maximum number of boots that a step removes
SILENT_DAYS: Final = 7  # time without a message after which imud removes a boot with missing numbers, days
INTERVAL_S: Final = 50  # minimum time between two runs of all collectors, s
AHEAD: Final = 2  # number of partitions after the present partition
# Age of the oldest partition in a new database, hours. The spool of a gateway keeps messages for this time by default.
BEHIND_H: Final = 168
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)

_CHOSEN: Final = "IN (SELECT * FROM unnest(%(gateways)s::text[], %(boots)s::text[]))"
# the second condition uses the index
_OF_BOOTS: Final = f"(gateway, split_part(boot, '-', 1)) {_CHOSEN} AND gateway = ANY(%(gateways)s)"


class _Partition(NamedTuple):
    """Partition, or chunk of a hypertable."""

    name: str  # with schema and quotes as SQL requires
    begin: datetime
    end: datetime  # first time after the partition


class Upkeep:
    """Tables of one database, with the removal of old rows. Synchronization: one thread."""

    def __init__(self, settings: CollectorSettings) -> None:
        self.dropped_partitions = 0  # number of partitions that this collector removed
        self.expired_boots = 0  # number of boots that this collector removed from the ledger
        self.expired_incomplete = 0  # number of removed boots with missing numbers
        self._settings = settings
        self._reported: set[str] = set()
        self._blocked: Counter[str] = Counter()  # consecutive failures of a step because of a lock, by its name
        self._old: list[tuple[str, str]] = []  # gateway and boot of the boots that the present run removes

    # --- start --------------------------------------------------------------------------------------------------------

    def prepare(self, cursor: Any, now: datetime | None = None) -> None:
        """Create missing tables, partitions and views in the transaction of `cursor`. If all tables exist, the user
        needs no right to create tables. `now` is the present time; None: the clock of the database. Raises ServerError
        for tables of another version."""
        cursor.execute(f"SET LOCAL lock_timeout = '{PREPARE_S}s'; SET LOCAL timezone = 'UTC'")
        check_version(cursor)
        missing = missing_tables(cursor)
        if SCHEMA in missing:
            create_schema_table(cursor)
        if missing:
            cursor.execute(_LOCK)
            missing = missing_tables(cursor)  # another collector can have created the tables before the lock
        with_timescale = has_timescale(cursor, is_wanted=any(table.is_by_time for table in missing))
        for table in missing:
            create_table(cursor, table, with_timescale=with_timescale)
        check_owners(cursor)
        self._check_schemas(cursor)
        has_aggregates = is_hypertable(cursor, INTERVALS) and has_license(cursor)
        for view in views(with_timescale=has_aggregates):
            if not has_relation(cursor, view.name):
                execute_all(cursor, view.statements())
        if self._is_owner(cursor):
            cursor.execute(_LOCK)
            # a reader can hold locks of tables for hours
            cursor.execute(f"SET LOCAL lock_timeout = '{LOCK_MS}ms'")
            self._divide(cursor, now or _now(cursor), has_aggregates=has_aggregates)
        if with_timescale:
            # the UTC time of a boot can change more compressed rows than the default limit, 100,000
            cursor.execute("SET timescaledb.max_tuples_decompressed_per_dml_transaction = 0")

    def _divide(self, cursor: Any, now: datetime, *, has_aggregates: bool) -> None:
        """Create partitions, or configure hypertables and continuous aggregates."""
        for table in TIMED:
            if is_hypertable(cursor, table):
                self._guarded(cursor, f"set the chunks of {table.name}", partial(self._tune, table, cursor))
            elif _is_partitioned(cursor, table):
                name = f"create partitions of {table.name}"
                self._guarded(cursor, name, partial(self._extend_all, table, cursor, now))
            else:
                self._report(f"cannot remove old rows of {table.name}: expected partitions, got a plain table")
        if has_aggregates:
            policies = refresh_policies(self._settings.intervals_days)
            self._guarded(cursor, "set the refresh of hours and days", partial(execute_all, cursor, policies))

    def _extend_all(self, table: FleetTable, cursor: Any, now: datetime) -> None:
        # one transaction creates few partitions, because it holds several locks for each of them
        while self._extend(table, cursor, now, timedelta()):
            pass

    def _tune(self, table: FleetTable, cursor: Any) -> None:
        """Set the width of new chunks and the compression of a hypertable."""
        width = timedelta(hours=self._settings.partition_hours)
        cursor.execute("SELECT set_chunk_time_interval(%s::regclass, %s)", (table.name, width))
        if not has_license(cursor):
            return
        days = self._settings.compress_after_days
        after = None if days is None else timedelta(days=days)
        cursor.execute(
            "SELECT (config->>'compress_after')::interval FROM timescaledb_information.jobs "
            "WHERE config ? 'compress_after' AND format('%%I.%%I', hypertable_schema, hypertable_name)::regclass "
            "= %s::regclass",
            (table.name,),
        )
        if [row[0] for row in cursor] == ([] if after is None else [after]):
            return
        cursor.execute("SELECT remove_compression_policy(%s::regclass, if_exists => true)", (table.name,))
        if after is not None:
            cursor.execute("SELECT add_compression_policy(%s::regclass, %s::interval)", (table.name, after))

    # --- every minute -------------------------------------------------------------------------------------------------

    def run(self, cursor: Any, now: datetime | None = None) -> None:
        """Create partitions, and remove old partitions and boots. Call it outside a transaction. `now` is the present
        time; None: the clock of the database. Do nothing if another collector did this work in the last INTERVAL_S.
        Raises psycopg.Error only if the connection is lost. Other problems are in the log, each once."""
        # each step ends its transaction, so that collectors wait for one step only
        assert not cursor.connection.info.transaction_status, "expected a connection outside a transaction"
        if not self._guarded(cursor, "start the upkeep", partial(self._locked, cursor, self._claim, now)):
            return
        for name, step in self._steps():
            for _ in range(STEPS_MAX):
                if not self._guarded(cursor, name, partial(self._locked, cursor, step, now)):
                    break

    def _claim(self, cursor: Any, now: datetime) -> bool:
        """Return whether this collector does the present upkeep."""
        if not self._is_owner(cursor):
            return False
        cursor.execute(
            f"UPDATE {SCHEMA.name} SET upkeep_at = %(now)s WHERE upkeep_at IS NULL "
            "OR upkeep_at NOT BETWEEN %(now)s - %(interval)s AND %(now)s",
            {"now": now, "interval": timedelta(seconds=INTERVAL_S)},
        )
        return bool(cursor.rowcount)

    def _is_owner(self, cursor: Any) -> bool:
        """Return whether the user owns the tables. Log it once if not."""
        cursor.execute(
            "SELECT pg_has_role(relowner, 'USAGE'), current_user, relowner::regrole::text FROM pg_class "
            "WHERE oid = %s::regclass", (SAMPLES.name,),
        )  # fmt: skip
        is_owner, user, owner = cursor.fetchone()
        if not is_owner:
            self._report(
                f"the user {user} cannot create partitions or remove old rows, because {owner} owns the tables; run at "
                f"least one collector as {owner}"
            )
        return bool(is_owner)

    def _steps(self) -> Iterator[tuple[str, Callable[[Any, datetime], bool]]]:
        """Yield the name and the function of each kind of work. The function returns whether more work is left."""
        for table in TIMED:
            yield f"create partitions of {table.name}", partial(self._extend, table)
            yield f"remove old rows of {table.name}", partial(self._retain, table)
        yield "remove old boots", self._expire

    def _locked(self, cursor: Any, step: Callable[[Any, datetime], bool], now: datetime | None) -> bool:
        """Run a step if no other collector runs one. Return whether more work is left."""
        cursor.execute(
            f"SET LOCAL lock_timeout = '{LOCK_MS}ms'; SET LOCAL statement_timeout = '{STATEMENT_S}s'; "
            "SET LOCAL timezone = 'UTC'"
        )
        cursor.execute(f"{_LOCK} SKIP LOCKED")
        return bool(cursor.rowcount) and step(cursor, now or _now(cursor))

    def _guarded(self, cursor: Any, name: str, work: Callable[[], Any]) -> bool:
        """Do work in a transaction. Return its result; False after an error of the database, which goes to the log."""
        import psycopg

        try:
            with deadline(cursor.connection, STEP_S), cursor.connection.transaction():
                result = bool(work())
        except psycopg.errors.DeadlockDetected:
            return False
        except psycopg.errors.LockNotAvailable:
            self._blocked[name] += 1
            if self._blocked[name] >= BLOCKED_MIN:
                self._report_locks(cursor, name)
            return False
        except psycopg.Error as error:
            if cursor.connection.closed:
                raise
            self._report(f"cannot {name}: {sentence_of(error)}")
            return False
        self._blocked.pop(name, None)
        return result

    def _report_locks(self, cursor: Any, name: str) -> None:
        """Log the sessions that hold locks of the tables."""
        sessions = locking_sessions(cursor, "imud\\_") or "they have ended"
        self._report(f"cannot {name}: other sessions hold locks of the tables for a long time: {sessions}")

    def _check_schemas(self, cursor: Any) -> None:
        """Log the schemas in which every user can create tables and functions."""
        cursor.execute(
            "SELECT nspname FROM pg_namespace WHERE nspname = ANY(current_schemas(false)) "
            "AND has_schema_privilege('public', oid, 'CREATE') ORDER BY nspname"
        )
        for (schema,) in cursor.fetchall():
            self._report(
                f"every user of the database can create tables and functions in the schema {schema}, and can thereby "
                f"stop or change the collector; run REVOKE CREATE ON SCHEMA {schema} FROM PUBLIC"
            )

    def _report(self, text: str) -> None:
        """Log a problem once."""
        if text not in self._reported:
            self._reported.add(text)
            log.warning("PostgreSQL: %s", text)

    # --- partitions ---------------------------------------------------------------------------------------------------

    def _cut(self, table: FleetTable, now: datetime) -> datetime | None:
        """Return the oldest time of rows that stay; None: all rows stay."""
        settings = self._settings
        days = {SAMPLES.name: settings.samples_days, INTERVALS.name: settings.intervals_days}.get(
            table.name, settings.events_days
        )
        return None if days is None else now - timedelta(days=days)

    def _extend(
        self, table: FleetTable, cursor: Any, now: datetime, behind: timedelta = timedelta(hours=BEHIND_H)
    ) -> bool:  # fmt: skip
        """Create one missing partition. `behind`: age of the oldest one. Return whether one was missing."""
        if not _is_partitioned(cursor, table):
            return False
        width, cut = timedelta(hours=self._settings.partition_hours), self._cut(table, now)
        present = _EPOCH + (now - _EPOCH) // width * width
        known = _partitions(cursor, table)
        ahead = _free(present, present + (AHEAD + 1) * width, width, known)
        for low, high in chain(ahead, _free(present - behind // width * width, present, width, known)):
            if cut is None or high > cut:
                _add_partition(cursor, table, low, high)
                return True
        return False

    def _retain(self, table: FleetTable, cursor: Any, now: datetime) -> bool:
        """Remove one old partition, or some old rows. Return whether more can be left."""
        cut = self._cut(table, now)
        if cut is None:
            return False
        if is_hypertable(cursor, table):
            return self._retain_chunk(cursor, table, cut)
        if not _is_partitioned(cursor, table):
            return False
        for one in _partitions(cursor, table):
            if one.end <= cut:
                cursor.execute(f"DROP TABLE {one.name}")
                self.dropped_partitions += 1
                return True
        return _delete(cursor, f"{table.name}_other", "time < %(cut)s", {"cut": cut})

    def _retain_chunk(self, cursor: Any, table: FleetTable, cut: datetime) -> bool:
        """Drop one old chunk. If it contains rows without a known time, delete a part of its other rows."""
        for one in _chunks(cursor, table, cut):
            if not _has_unset(cursor, one):
                cursor.execute(f"LOCK TABLE {one.name} IN ACCESS EXCLUSIVE MODE")
                if _has_unset(cursor, one):
                    return True
                cursor.execute(
                    "SELECT drop_chunks(%s::regclass, older_than => %s::timestamptz, newer_than => %s::timestamptz)",
                    (table.name, one.end, one.begin),
                )
                self.dropped_partitions += 1
                return True
            cursor.execute(
                f"SELECT min(time) FROM {table.name} WHERE time >= %s AND time < %s AND utc_set", (one.begin, one.end)
            )
            oldest = cursor.fetchone()[0]
            if oldest is not None:
                high = min(one.end, oldest + (one.end - one.begin) / 24)
                cursor.execute(f"DELETE FROM {table.name} WHERE time >= %s AND time < %s AND utc_set", (oldest, high))
                return True
        return False

    # --- boots --------------------------------------------------------------------------------------------------------

    def _expire(self, cursor: Any, now: datetime) -> bool:
        """Remove some boots of gateways with more than `keep_boots` boots. Return whether more can be left."""
        if not self._old:
            self._old = list(self._old_boots(cursor, now))
        chosen, self._old = self._old[:BOOTS_STEP], self._old[BOOTS_STEP:]
        if not chosen:
            return False
        keys = {"gateways": [gateway for gateway, _ in chosen], "boots": [boot for _, boot in chosen]}
        locked = self._lock(cursor, keys)
        # a collector can have stored a message before the lock
        still = self._old_boots(cursor, now, keys["gateways"])
        found = {key: still[key] for key in chosen if key in still}
        keys = {"gateways": [gateway for gateway, _ in found], "boots": [boot for _, boot in found]}
        # also boots with -2, -3 …
        names = {*found, *(one for one in locked if (one[0], one[1].partition("-")[0]) in found)}
        if any(_delete_unset(cursor, table, names) for table in TIMED):
            self._old = [*found, *self._old]
            return True
        cursor.execute(f"DELETE FROM {LEDGER.name} WHERE {_OF_BOOTS}", keys)
        cursor.execute(f"DELETE FROM {BOOTS.name} WHERE (gateway, boot) {_CHOSEN}", keys)
        incomplete = sum(not is_complete for is_complete in found.values())
        self.expired_boots += len(found)
        self.expired_incomplete += incomplete
        log.info("PostgreSQL: removed %d old boots, %d of them with missing numbers", len(found), incomplete)
        return bool(self._old)

    def _lock(self, cursor: Any, keys: Mapping[str, Sequence[str]]) -> Sequence[tuple[str, str]]:
        """Lock boots and their ledgers, in the order of the collectors. Return gateway and boot of the ledgers."""
        cursor.execute(
            f"SELECT FROM {BOOTS.name} WHERE (gateway, boot) {_CHOSEN} ORDER BY gateway, boot FOR UPDATE", keys
        )
        cursor.execute(
            f"SELECT gateway, boot FROM {LEDGER.name} WHERE {_OF_BOOTS} "
            "ORDER BY gateway, boot, device, stream FOR UPDATE", keys,
        )  # fmt: skip
        return list(cursor)

    def _old_boots(
        self, cursor: Any, now: datetime, gateways: Sequence[str] | None = None
    ) -> dict[tuple[str, str], bool]:  # fmt: skip
        """Return gateway and boot of boots to remove, and whether all numbers of the boot arrived. `gateways`: only
        boots of these gateways; None: some boots of all gateways."""
        many = f"SELECT gateway FROM {BOOTS.name} GROUP BY gateway HAVING count(*) > %(keep)s"
        cursor.execute(
            f"WITH many AS ({many if gateways is None else 'SELECT unnest(%(gateways)s::text[]) AS gateway'}), "
            "streams AS (SELECT gateway, split_part(boot, '-', 1) AS boot, max(updated_at) AS updated_at, "
            f"bool_and(missing = 0 AND coalesce(sent, newest) <= newest) AS complete FROM {LEDGER.name} "
            "WHERE gateway IN (SELECT gateway FROM many) GROUP BY 1, 2), known AS (SELECT gateway, boot, "
            "coalesce(complete, true) AS complete, greatest(first_at, updated_at) AS newest_at, row_number() OVER "
            "(PARTITION BY gateway ORDER BY coalesce(first_at, updated_at) DESC, boot DESC) AS position "
            f"FROM (SELECT * FROM {BOOTS.name} WHERE gateway IN (SELECT gateway FROM many)) AS boots "
            "FULL JOIN streams USING (gateway, boot)) "
            "SELECT gateway, boot, complete FROM known WHERE position > %(keep)s "
            f"AND (complete OR newest_at < %(silent)s) AND NOT EXISTS (SELECT FROM {GATEWAYS.name} AS state "
            "WHERE state.gateway = known.gateway AND split_part(state.boot, '-', 1) = known.boot) "
            "ORDER BY gateway, boot LIMIT %(most)s",
            {
                "keep": self._settings.keep_boots, "silent": now - timedelta(days=SILENT_DAYS), "gateways": gateways,
                "most": BOOTS_STEP * STEPS_MAX if gateways is None else None,
            },
        )  # fmt: skip
        return {(gateway, boot): complete for gateway, boot, complete in cursor}


# --- tables -----------------------------------------------------------------------------------------------------------


def _now(cursor: Any) -> datetime:
    cursor.execute("SELECT now()")
    found: datetime = cursor.fetchone()[0]
    return found


# --- TimescaleDB ------------------------------------------------------------------------------------------------------


def _chunks(cursor: Any, table: FleetTable, cut: datetime) -> Sequence[_Partition]:
    """Return the chunks that end before `cut`, oldest first."""
    cursor.execute(
        "SELECT format('%%I.%%I', chunk_schema, chunk_name), range_start, range_end "
        "FROM timescaledb_information.chunks WHERE "
        "format('%%I.%%I', hypertable_schema, hypertable_name)::regclass = to_regclass(%s) AND range_end <= %s "
        "ORDER BY range_start", (table.name, cut),
    )  # fmt: skip
    return [_Partition(*row) for row in cursor]


def _has_unset(cursor: Any, chunk: _Partition) -> bool:
    """Return whether a chunk contains rows without a known time."""
    cursor.execute(f"SELECT EXISTS (SELECT FROM {chunk.name} WHERE NOT utc_set)")
    return bool(cursor.fetchone()[0])


# --- partitions -------------------------------------------------------------------------------------------------------


def _is_partitioned(cursor: Any, table: FleetTable) -> bool:
    return has_relation(cursor, f"{table.name}_set")


def _partitions(cursor: Any, table: FleetTable) -> Sequence[_Partition]:
    """Return the partitions of a table, oldest first."""
    cursor.execute(
        "SELECT inhrelid::regclass::text, bounds[1]::timestamptz, bounds[2]::timestamptz FROM pg_inherits "
        "JOIN pg_class ON pg_class.oid = inhrelid, "
        r"regexp_match(pg_get_expr(relpartbound, inhrelid), $$FROM \('(.+)'\) TO \('(.+)'\)$$) AS bounds "
        "WHERE inhparent = %s::regclass AND bounds IS NOT NULL ORDER BY 2", (f"{table.name}_set",),
    )  # fmt: skip
    return [_Partition(*row) for row in cursor]


def _free(
    begin: datetime, end: datetime, width: timedelta, known: Iterable[_Partition]
) -> Iterator[tuple[datetime, datetime]]:
    """Yield the ranges from `begin` to `end` that no partition covers, divided at multiples of `width`."""
    while begin < end:
        high = begin + width
        low = begin
        for one in known:
            if one.begin < high and low < one.end:
                if low < one.begin:
                    yield low, one.begin
                low = one.end
        if low < high:
            yield low, high
        begin = high


def _add_partition(cursor: Any, table: FleetTable, low: datetime, high: datetime) -> None:
    """Create a partition and move its rows out of the partition of all other times."""
    parent, other = f"{table.name}_set", f"{table.name}_other"
    cursor.execute("SELECT relnamespace::regnamespace::text FROM pg_class WHERE oid = %s::regclass", (parent,))
    name = f"{cursor.fetchone()[0]}.{table.name}_{low:%Y%m%d_%H}"
    cursor.execute(f"LOCK TABLE {other} IN ACCESS EXCLUSIVE MODE")
    cursor.execute(f"CREATE TABLE {name} (LIKE {parent} INCLUDING ALL EXCLUDING COMMENTS)")
    cursor.execute(
        f"WITH moved AS (DELETE FROM {other} WHERE time >= %s AND time < %s RETURNING *) "
        f"INSERT INTO {name} SELECT * FROM moved", (low, high),
    )  # fmt: skip
    bounds = f"FROM ('{low.isoformat()}') TO ('{high.isoformat()}')"
    cursor.execute(f"ALTER TABLE {parent} ATTACH PARTITION {name} FOR VALUES {bounds}")


# --- rows -------------------------------------------------------------------------------------------------------------


def _delete(cursor: Any, name: str, condition: str, values: dict[str, Any]) -> bool:
    """Delete at most ROWS_STEP rows of a table without partitions. Return whether more can be left."""
    cursor.execute(
        f"DELETE FROM {name} WHERE ctid = ANY(ARRAY(SELECT ctid FROM {name} WHERE {condition} LIMIT {ROWS_STEP}))",
        values,
    )
    return bool(cursor.rowcount == ROWS_STEP)


def _delete_unset(cursor: Any, table: FleetTable, names: Iterable[tuple[str, str]]) -> bool:
    """Delete rows of boots without a known time. Return whether more can be left."""
    condition = "gateway = ANY(%(gateways)s) AND boot = ANY(%(boots)s) AND gateway || '/' || boot = ANY(%(keys)s)"
    names = sorted(names)
    values = {
        "gateways": sorted({gateway for gateway, _ in names}), "boots": sorted({boot for _, boot in names}),
        "keys": ["/".join(name) for name in names],
    }  # fmt: skip
    if _is_partitioned(cursor, table):
        return _delete(cursor, f"{table.name}_unset", condition, values)
    # TimescaleDB cannot select compressed rows by ctid
    cursor.execute(f"DELETE FROM {table.name} WHERE {condition} AND NOT utc_set", values)
    return False
