"""Cost of partitions: inserts, queries and size of `imud_intervals` with few and many partitions, and in TimescaleDB.

    python -m tests.bench.fleet_partitions --rows 1000000 --days 10 1000

Each run has the given number of rows, spread evenly over the days, with one partition per day. The rows have 24 values
of accelerometer and gyroscope with noise in all digits. Times are the minimum of five calls, ms.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any, Final

from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.tables import COMPONENTS, INTERVALS
from imud.fleet.database.upkeep import Upkeep, _add_partition
from imud.fleet.statistics import MEASURES
from tests.fleet.postgres_server import NO_TIMESCALE, running_server

NOW: Final = datetime(2026, 6, 15, tzinfo=UTC)
GATEWAYS: Final = 20
CALLS: Final = 5
VALUES: Final = [
    one.column(name) for one in COMPONENTS if one.field in ("accel_m_s2", "gyro_rad_s") for name in MEASURES
]
# Row number n of the table: one row per gateway and step, one boot per five days
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
    "last hour of a gateway, times as constants": "SELECT time, accel_x_mean_m_s2 FROM imud_intervals WHERE "
    "gateway = 'gw-7' AND device = 'bow' AND time > '2026-06-14 23:00+00' AND time < '2026-06-15 00:00+00'",
    "last day of a gateway": "SELECT time, accel_x_mean_m_s2 FROM imud_intervals WHERE gateway = 'gw-7' "
    "AND device = 'bow' AND time > %(now)s - interval '1 day'",
    "last hour of all gateways": "SELECT gateway, avg(accel_x_mean_m_s2) FROM imud_intervals WHERE "
    "time > %(now)s - interval '1 hour' GROUP BY gateway",
    "one boot without a time": "SELECT count(*) FROM imud_intervals WHERE gateway = 'gw-7' AND boot = %(boot)s",
    "rows of a boot without a known time": "DELETE FROM imud_intervals WHERE gateway = 'gw-7' AND boot = %(boot)s "
    "AND NOT utc_set",
}  # fmt: skip


def measure(url: str, rows: int, days: int) -> list[tuple[str, str]]:
    """Return the names and values of all figures."""
    import psycopg

    figures = []
    with psycopg.connect(url, autocommit=True) as connection, connection.cursor() as cursor:
        made = Upkeep(CollectorSettings(compress_after_days=None))
        with connection.transaction():
            made.prepare(cursor, NOW)
        is_native = cursor.execute("SELECT to_regclass('imud_intervals_set') IS NOT NULL").fetchone() == (True,)
        if is_native:
            for day in range(1, days + 1):
                with connection.transaction():
                    low = NOW - timedelta(days=day)
                    _add_partition(cursor, INTERVALS, low, low + timedelta(days=1))
        step, block = timedelta(days=days) / rows, 100_000

        def add(first: int, last: int, width: timedelta = step, begin: datetime = NOW - timedelta(days=days)) -> None:
            values = {"gateways": GATEWAYS, "first": first, "last": last, "begin": begin, "step": width}
            cursor.execute(ROWS.encode(), values)

        start = time.monotonic()
        for first in range(0, rows, block):
            add(first, min(first + block, rows) - 1)
        figures.append(("rows per second, by INSERT … SELECT", f"{rows / (time.monotonic() - start):,.0f}"))
        cursor.execute("ANALYZE imud_intervals")
        second = timedelta(seconds=1)
        numbers = iter(range(CALLS))
        figures.append(
            (
                "1,000 rows into the present partition",
                best(
                    lambda: add(
                        (one := rows + next(numbers) * 1000), one + 999, second / 1000, NOW - rows * second / 1000
                    )
                ),
            )
        )
        figures.append(("size", size(cursor, "imud_intervals")))
        if not is_native:
            start = time.monotonic()
            cursor.execute("SELECT compress_chunk(c) FROM show_chunks('imud_intervals') AS c")
            figures.append(("compression, s", f"{time.monotonic() - start:.1f}"))
            figures.append(("size after compression", size(cursor, "imud_intervals")))
        boot = f"{int((NOW - timedelta(days=days / 2)).timestamp()) // 432000:x}"
        for name, query in QUERIES.items():
            figures.append((name, best(partial(cursor.execute, query.encode(), {"now": NOW, "boot": boot}))))
        figures.append(("upkeep without work", best(lambda: run(made, cursor))))
        figures.append(("first upkeep of a collector", best(lambda: prepare(connection, cursor))))
    return figures


def run(made: Upkeep, cursor: Any) -> None:
    cursor.execute("UPDATE imud_schema SET upkeep_at = NULL")
    made.run(cursor, NOW)


def prepare(connection: Any, cursor: Any) -> None:
    with connection.transaction():
        Upkeep(CollectorSettings(compress_after_days=None)).prepare(cursor, NOW)


def best(work: Callable[[], object]) -> str:
    found = []
    for _ in range(CALLS):
        start = time.monotonic()
        work()
        found.append(time.monotonic() - start)
    return f"{min(found) * 1000:.1f} ms"


def size(cursor: Any, name: str) -> str:
    cursor.execute("SELECT to_regclass('imud_intervals_set') IS NOT NULL")
    if cursor.fetchone()[0]:
        cursor.execute("SELECT sum(pg_total_relation_size(relid)) FROM pg_partition_tree(%s)", (name,))
    else:
        cursor.execute("SELECT hypertable_size(%s)", (name,))
    return f"{int(cursor.fetchone()[0]) / 1e6:,.0f} MB"


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--days", type=int, nargs="+", default=[10, 1000])
    parser.add_argument("--engines", nargs="+", default=["partitions", "timescaledb"])
    args = parser.parse_args(words)
    for engine in args.engines:
        library = engine.removeprefix("partitions")
        if library and NO_TIMESCALE:
            print(NO_TIMESCALE)
            continue
        for days in args.days:
            with running_server(library) as server:
                print(f"\n{engine}, {args.rows:,} rows, {days} days", flush=True)
                for name, value in measure(server.url, args.rows, days):
                    print(f"| {name} | {value} |", flush=True)


if __name__ == "__main__":
    main()
