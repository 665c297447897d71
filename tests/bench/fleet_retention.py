"""Cost of the retention: inserts, queries, upkeep and size of `imud_intervals` for several numbers of stored days.

`python -m tests.bench.fleet_retention [--days 10 100 300]`. Each day has the same number of rows and one partition
or chunk of TimescaleDB. The rows have 24 values of accelerometer and gyroscope. The values are random, so that
compression has little effect on them. Times are the minimum of CALLS calls, or of the calls in CALLS_S. The JIT
compiler of PostgreSQL is off, because it takes longer than most queries of many partitions.
"""

import argparse
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any, Final

from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.tables import COMPONENTS, INTERVALS
from imud.fleet.database.upkeep import Upkeep, _add_partition
from imud.fleet.statistics import MEASURES
from tests.fleet.postgres_server import NO_POSTGRES, NO_TIMESCALE, running_server
from tests.support.results import ProgramRun, Row, Table, add_json

NOW: Final = datetime(2026, 6, 15, tzinfo=UTC)
DAY: Final = timedelta(days=1)
GATEWAYS: Final = 20
CALLS: Final = 5
CALLS_S: Final = 5.0  # time after which no further call starts, s
BLOCK_DAYS: Final = 10  # days of rows that one INSERT creates
VALUES: Final = [
    one.column(name) for one in COMPONENTS if one.field in ("accel_m_s2", "gyro_rad_s") for name in MEASURES
]
# Row number n: one gateway after another, one boot per five days
ROWS: Final = (
    "INSERT INTO imud_intervals (time, site, gateway, boot, device, utc_ns, utc_set, utc_err_ns, stream, first, last, "
    f"samples, t_ns, end_t_ns, end_utc_ns, t_err_ns, sync, {', '.join(VALUES)}) "
    "SELECT at, 'mill', 'gw-' || n %% %(gateways)s, to_hex(extract(epoch FROM at)::bigint / 432000), 'bow', "
    "extract(epoch FROM at)::bigint * 1000000000, true, 1000, 'statistics', n * 100, n * 100 + 99, 100, "
    "n * 1000000000, n * 1000000000 + 990000000, extract(epoch FROM at)::bigint * 1000000000 + 990000000, 500, 'edge', "
    f"{', '.join('random()' for _ in VALUES)} FROM generate_series(%(first)s::bigint, %(last)s::bigint) AS n, "
    "LATERAL (SELECT %(begin)s::timestamptz + n * %(step)s::interval AS at) AS times"
)
QUERIES: Final = {
    "last hour of a gateway": "SELECT time, accel_x_mean_m_s2 FROM imud_intervals WHERE gateway = 'gw-7' "
    "AND device = 'bow' AND time > %(now)s - interval '1 hour'",
    "last day of a gateway": "SELECT time, accel_x_mean_m_s2 FROM imud_intervals WHERE gateway = 'gw-7' "
    "AND device = 'bow' AND time > %(now)s - interval '1 day'",
    "last hour of all gateways": "SELECT gateway, avg(accel_x_mean_m_s2) FROM imud_intervals WHERE "
    "time > %(now)s - interval '1 hour' GROUP BY gateway",
    "imud_hours, 7 days of a gateway": "SELECT time, accel_x_mean_m_s2 FROM imud_hours('2026-06-08 00:00+00', "
    "'2026-06-15 00:00+00') WHERE gateway = 'gw-7' AND device = 'bow'",
    "imud_intervals_1h, 7 days of a gateway": "SELECT time, accel_x_mean_m_s2 FROM imud_intervals_1h "
    "WHERE gateway = 'gw-7' AND device = 'bow' AND time >= '2026-06-08 00:00+00'",
    "boot without a time": "SELECT count(*) FROM imud_intervals WHERE gateway = 'gw-7' AND boot = %(boot)s",
}  # fmt: skip


def measure(url: str, engine: str, days: int, per_day: int) -> Row:
    """Return the figures of a database with `days` days."""
    import psycopg

    rows = days * per_day
    figures: dict[str, Any] = {"days": days, "rows": rows}
    with psycopg.connect(url, autocommit=True) as connection, connection.cursor() as cursor:
        prepare(cursor)
        if engine == "partitions":
            for day in range(1, days + 1):
                with connection.transaction():
                    _add_partition(cursor, INTERVALS, NOW - day * DAY, NOW - (day - 1) * DAY)

        def add(first: int, count: int) -> None:
            begin, last = NOW - days * DAY, first + count - 1
            values = {"gateways": GATEWAYS, "first": first, "last": last, "begin": begin, "step": DAY / per_day}
            cursor.execute(ROWS.encode(), values)

        start = time.monotonic()
        for first in range(0, rows, BLOCK_DAYS * per_day):
            add(first, min(BLOCK_DAYS * per_day, rows - first))
        figures["rows/s, INSERT … SELECT"] = round(rows / (time.monotonic() - start))
        cursor.execute("ANALYZE imud_intervals")
        numbers = iter(range(rows, rows + CALLS * 1000, 1000))
        figures["1,000 new rows, ms"] = best_ms(lambda: add(next(numbers), 1000))
        figures["size, MB"] = size_mb(cursor, engine)
        if engine == "timescaledb":
            cursor.execute("SELECT compress_chunk(c) FROM show_chunks('imud_intervals') AS c")
            figures["size after compression, MB"] = size_mb(cursor, engine)
            cursor.execute("CALL refresh_continuous_aggregate('imud_intervals_1h', NULL, NULL)")
        values = {"now": NOW, "boot": f"{int((NOW - days * DAY / 2).timestamp()) // 432000:x}"}
        for name, query in QUERIES.items():
            figures[f"{name}, ms"] = best_ms(partial(cursor.execute, query.encode(), values))
        figures["start of a collector, ms"] = best_ms(lambda: prepare(cursor))
        figures["upkeep without work, ms"] = best_ms(lambda: run_upkeep(cursor, None))
        start = time.monotonic()
        removed = run_upkeep(cursor, days - 1)
        figures["upkeep that removes a day, ms"] = (time.monotonic() - start) * 1000
        if removed != 1:
            raise RuntimeError(f"expected one removed partition or chunk, got {removed}")
    return figures


def prepare(cursor: Any) -> None:
    with cursor.connection.transaction():
        Upkeep(CollectorSettings(compress_after_days=None)).prepare(cursor, NOW)


def run_upkeep(cursor: Any, intervals_days: float | None) -> int:
    """Do the upkeep. Return the number of removed partitions or chunks."""
    cursor.execute("UPDATE imud_schema SET upkeep_at = NULL")
    upkeep = Upkeep(CollectorSettings(intervals_days=intervals_days, compress_after_days=None))
    upkeep.run(cursor, NOW)
    return upkeep.dropped_partitions


def best_ms(work: Callable[[], object]) -> float:
    found = list[float]()
    while len(found) < CALLS and sum(found) < CALLS_S:
        start = time.monotonic()
        work()
        found.append(time.monotonic() - start)
    return min(found) * 1000


def size_mb(cursor: Any, engine: str) -> int:
    if engine == "timescaledb":
        cursor.execute("SELECT hypertable_size('imud_intervals')")
    else:
        cursor.execute("SELECT sum(pg_total_relation_size(relid)) FROM pg_partition_tree('imud_intervals')")
    return round(int(cursor.fetchone()[0]) / 1e6)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-retention")
    parser.add_argument("--days", type=int, nargs="+", default=[10, 100, 300, 1000], help="each at least 10")
    parser.add_argument("--rows-per-day", type=int, default=10_000)
    add_json(parser)
    args, program_run = parser.parse_args(), ProgramRun()
    if NO_POSTGRES:
        print(NO_POSTGRES)
        return 1
    tables = []
    for engine, library, reason in (("partitions", "", ""), ("timescaledb", "timescaledb", NO_TIMESCALE)):
        if reason:
            print(f"{engine}: not measured: {reason}")
            continue
        rows = []
        for days in args.days:
            with running_server(library, "-c jit=off") as server:
                rows.append(measure(server.url, engine, days, args.rows_per_day))
            print(rows[-1], flush=True)
        tables.append(Table(engine, rows))
    program_run.save(args.json, tables)
    return 0


if __name__ == "__main__":
    sys.exit(main())
