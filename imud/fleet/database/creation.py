"""Creation of the tables of a fleet, as partitions or as hypertables of TimescaleDB."""

import logging
from collections.abc import Iterable
from typing import Any, Final

from imud.fleet.database.connection import sentence_of
from imud.fleet.database.tables import SCHEMA, SCHEMA_VERSION, TABLES, FleetTable
from imud.model.errors import ServerError

log = logging.getLogger(__name__)

# First version of TimescaleDB that can delete compressed rows
_TIMESCALE_MIN: Final = (2, 11)
# Columns that identify the stream of a row; TimescaleDB compresses the rows of one stream together
_OF_STREAM: Final = ("gateway", "boot", "device", "stream", "utc_set")


def execute_all(cursor: Any, statements: Iterable[str]) -> None:
    for one in statements:
        cursor.execute(one)


def has_relation(cursor: Any, name: str) -> bool:
    cursor.execute("SELECT to_regclass(%s) IS NOT NULL", (name,))
    return bool(cursor.fetchone()[0])


def check_version(cursor: Any) -> None:
    """Raise ServerError if the tables have another version."""
    cursor.execute(
        "SELECT attrelid::regclass::text FROM pg_attribute WHERE NOT attisdropped "
        "AND attname IN ('account', 'content') "
        "AND attrelid IN (to_regclass('imud_ledger'), to_regclass('imud_records'))"
    )
    old = cursor.fetchone()
    if old is not None:
        raise ServerError(
            f"PostgreSQL: expected tables of version {SCHEMA_VERSION}, got {old[0]} of a development version of imud; "
            "move the old tables to another schema (ALTER SCHEMA public RENAME TO imud_old; CREATE SCHEMA public) or "
            "use another database"
        )
    if has_relation(cursor, SCHEMA.name):
        cursor.execute(f"SELECT max(version) FROM {SCHEMA.name}")
        version = cursor.fetchone()[0]
        if version != SCHEMA_VERSION:
            raise ServerError(
                f"PostgreSQL: expected tables of version {SCHEMA_VERSION}, got version {version}; install the version "
                "of imud that created them or use another database"
            )


def missing_tables(cursor: Any) -> list[FleetTable]:
    return [table for table in TABLES if not has_relation(cursor, table.name)]


def check_owners(cursor: Any) -> None:
    """Raise ServerError if the tables have several owners: another user could have created a table in advance."""
    cursor.execute(
        "SELECT relowner::regrole::text, min(relname) FROM pg_class WHERE oid = ANY(%s::regclass[]) GROUP BY 1 "
        "ORDER BY 1", ([table.name for table in TABLES],),
    )  # fmt: skip
    owners = cursor.fetchall()
    if len(owners) > 1:
        tables = ", ".join(f"{table} of {owner}" for owner, table in owners)
        raise ServerError(
            f"PostgreSQL: expected one owner of all tables imud_*, got {tables}; change the owner (ALTER TABLE … OWNER "
            "TO …) or drop the tables of the other user"
        )


def create_schema_table(cursor: Any) -> None:
    """Create the table with the version. If another collector creates it at the same time, wait for that collector."""
    import psycopg

    try:
        with cursor.connection.transaction():
            create_table(cursor, SCHEMA, with_timescale=False)
            cursor.execute(f"INSERT INTO {SCHEMA.name} (version) VALUES (%s)", (SCHEMA_VERSION,))
    except (psycopg.errors.UniqueViolation, psycopg.errors.DuplicateTable):
        pass


def create_table(cursor: Any, table: FleetTable, *, with_timescale: bool) -> None:
    """Create a table with its partitions or as a hypertable. Raises ServerError without the right to create it."""
    import psycopg

    try:
        _create_with_partitions(cursor, table, with_timescale=with_timescale)
    except psycopg.errors.InsufficientPrivilege as error:
        raise ServerError(
            f"PostgreSQL: cannot create the table {table.name}: {error.diag.message_primary}; use a database that the "
            "user of the collector owns, or run GRANT CREATE ON SCHEMA public for this user"
        ) from error


def _create_with_partitions(cursor: Any, table: FleetTable, *, with_timescale: bool) -> None:
    is_partitioned = table.is_by_time and not with_timescale
    made = table._replace(options=" PARTITION BY LIST (utc_set)") if is_partitioned else table
    execute_all(cursor, made.statements())
    if not table.is_by_time:
        return
    # rows arrive almost in the order of their time: an index of ranges is small and makes queries by time fast
    cursor.execute(f"CREATE INDEX ON {table.name} USING brin (time) WITH (autosummarize = on)")
    name = table.name
    if is_partitioned:
        cursor.execute(f"CREATE TABLE {name}_unset PARTITION OF {name} FOR VALUES IN (false)")
        cursor.execute(f"CREATE TABLE {name}_set PARTITION OF {name} FOR VALUES IN (true) PARTITION BY RANGE (time)")
        cursor.execute(f"CREATE TABLE {name}_other PARTITION OF {name}_set DEFAULT")
        cursor.execute(f"CREATE INDEX ON {name}_other (time)")
        return
    cursor.execute("SELECT create_hypertable(%s::regclass, 'time'::name, create_default_indexes => false)", (name,))
    cursor.execute(f"CREATE INDEX ON {name} (gateway, boot) WHERE NOT utc_set")
    if has_license(cursor):
        segments = ", ".join(one for one in table.primary if one in _OF_STREAM)
        order = ", ".join(["time", *(one for one in table.primary if one not in (*_OF_STREAM, "time"))])
        cursor.execute(
            f"ALTER TABLE {name} SET (timescaledb.compress, timescaledb.compress_segmentby = '{segments}', "
            f"timescaledb.compress_orderby = '{order}')"
        )


def has_timescale(cursor: Any, *, is_wanted: bool) -> bool:
    """Return whether the database contains TimescaleDB. If it is wanted, try to create the extension."""
    import psycopg

    cursor.execute("SELECT installed_version, default_version FROM pg_available_extensions WHERE name = 'timescaledb'")
    installed, available = cursor.fetchone() or (None, None)
    version = installed or available
    if version is None or tuple(map(int, version.split("-")[0].split(".")[:2])) < _TIMESCALE_MIN:
        return False
    if installed is not None or not is_wanted:
        return installed is not None
    # without shared_preload_libraries, CREATE EXTENSION ends the connection; only the library defines this parameter
    cursor.execute("SELECT current_setting('timescaledb.disable_load', true)")
    if cursor.fetchone()[0] is None:
        return False
    try:
        with cursor.connection.transaction():
            cursor.execute("CREATE EXTENSION timescaledb")
    except psycopg.Error as error:
        log.info("PostgreSQL: without TimescaleDB: %s", sentence_of(error))
        return False
    return True


def has_license(cursor: Any) -> bool:
    """Return whether the license of TimescaleDB allows compression and continuous aggregates."""
    cursor.execute("SELECT current_setting('timescaledb.license', true)")
    return bool(cursor.fetchone()[0] == "timescale")


def is_hypertable(cursor: Any, table: FleetTable) -> bool:
    if not has_relation(cursor, "timescaledb_information.hypertables"):
        return False
    cursor.execute(
        "SELECT count(*) > 0 FROM timescaledb_information.hypertables WHERE "
        "format('%%I.%%I', hypertable_schema, hypertable_name)::regclass = to_regclass(%s)", (table.name,),
    )  # fmt: skip
    return bool(cursor.fetchone()[0])
