"""Views of the fleet database in a real PostgreSQL: values computed by hand, comments, and false values."""

import math
from collections.abc import Iterator
from typing import Any

import pytest

from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.tables import GATEWAYS, INTERVALS, LEDGER
from imud.fleet.database.upkeep import Upkeep
from imud.fleet.database.views import AGGREGATED, DAYS, HOURS, refresh_policies, views
from imud.fleet.messages import NUMBER_MOST
from imud.fleet.statistics import MEASURES
from tests.fleet.database.fleet_rows import insert
from tests.fleet.postgres_server import NO_POSTGRES, NO_TIMESCALE, running_server

pytestmark = [pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES), pytest.mark.live]


KINDS = {"postgresql": "", "timescaledb": NO_TIMESCALE}  # with the reason to skip


@pytest.fixture(scope="module", params=KINDS)
def server(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Yield a connection to a server with all tables and views."""
    import psycopg

    if KINDS[request.param]:
        pytest.skip(KINDS[request.param])
    library = request.param.removeprefix("postgresql")
    with running_server(library) as made, psycopg.connect(made.url) as connection:
        prepare(connection)
        yield connection


def prepare(connection: Any) -> None:
    """Create tables and views. With its library, TimescaleDB stores the intervals."""
    with connection.transaction(), connection.cursor() as cursor:
        Upkeep(CollectorSettings()).prepare(cursor)


@pytest.fixture
def cursor(server: Any) -> Iterator[Any]:
    """Yield a cursor of a transaction that leaves no rows."""
    yield server.cursor()
    server.rollback()


def test_columns_have_the_declared_types_and_comments(cursor: Any) -> None:
    cursor.execute(
        "SELECT attrelid::regclass::text, attname, format_type(atttypid, atttypmod), col_description(attrelid, attnum) "
        "FROM pg_attribute WHERE attrelid::regclass::text LIKE 'imud\\_%' AND attnum > 0 ORDER BY attrelid, attnum"
    )
    found = {(table, name): (kind, comment) for table, name, kind, comment in cursor}
    shown = {"timestamptz": "timestamp with time zone"}
    for view in views(with_timescale=False):
        for column in view.columns:
            expected = (shown.get(column.type, column.type), column.comment)
            assert found[view.name, column.name] == expected, column.name
        assert {name for table, name in found if table == view.name} == {column.name for column in view.columns}
        cursor.execute("SELECT obj_description(%s::regclass)", (view.name,))
        assert cursor.fetchone() == (view.comment,)


def test_a_stream_shows_its_spool_and_its_balance(cursor: Any) -> None:
    insert(cursor, LEDGER, newest=100, whole=80, thinned=10, dropped=4, missing=6, sent=120)
    insert(cursor, LEDGER, device="mast", begin=11, newest=20, whole=9)
    insert(cursor, LEDGER, device="keel", newest=20, whole=20, sent=19)
    cursor.execute("SELECT device, in_spool, balance FROM imud_streams ORDER BY device")
    assert cursor.fetchall() == [("bow", 20, 0), ("keel", 0, 0), ("mast", 0, 1)]


def test_a_gateway_has_the_sums_of_its_streams_in_all_boots(cursor: Any) -> None:
    insert(cursor, GATEWAYS, devices=["bow"], utc_set=True, stored_at="2026-01-01 10:00+00")
    insert(cursor, GATEWAYS, gateway="gw-2", online=False, reason="shutdown", stored_at="now")
    insert(cursor, LEDGER, missing=1, dropped=2, thinned=3, duplicates=4, newest=5, sent=10)
    insert(cursor, LEDGER, boot="b", missing=10, dropped=20, thinned=30, duplicates=40, updated_at="now")
    insert(cursor, LEDGER, gateway="gw-3")
    names = "gateway, online, reason, devices, missing, dropped, thinned, duplicates, in_spool, utc_set"
    cursor.execute(f"SELECT {names} FROM imud_gateway_status ORDER BY gateway")
    assert cursor.fetchall() == [
        ("gw-1", True, "", ["bow"], 11, 22, 33, 44, 5, True),
        ("gw-2", False, "shutdown", ["bow"], 0, 0, 0, 0, 0, None),
        ("gw-3", None, None, None, 0, 0, 0, 0, 0, None),
    ]
    cursor.execute(
        "SELECT gateway, silent_s = extract(epoch FROM now() - timestamptz '2026-01-01 10:00+00')::float8, silent_s "
        "FROM imud_gateway_status ORDER BY gateway"
    )
    (_, _, newest), (_, _, state), (_, is_old, _) = cursor.fetchall()
    assert 0 <= newest < 60  # "now": the start of this statement, after the start of the transaction
    assert 0 <= state < 60
    assert is_old


def angles(mean: float) -> dict[str, float]:
    return {f"roll_{measure}_rad": mean for measure in MEASURES}


def test_hours_and_days_have_weighted_statistics(cursor: Any) -> None:
    accel = ("accel_x_mean_m_s2", "accel_x_min_m_s2", "accel_x_max_m_s2", "accel_x_rms_m_s2")

    def add(at_s: float, samples: int, values: tuple[float, ...], **more: object) -> None:
        insert(cursor, INTERVALS, at_s, samples=samples, **dict(zip(accel, values, strict=True)), **more)

    add(0, 1, (1, 0, 2, 1), **angles(0.5))
    add(3599.5, 3, (5, 4, 9, 5), temperature_mean_c=20.0)
    # both sides of ±π: the mean direction is π + 0.1
    add(3600, 2, (10, 10, 10, 10), first=2, **angles(math.pi - 0.2))
    add(3601, 2, (10, -10, 10, 10), first=3, **angles(-math.pi + 0.4))
    add(3602, 100, (50, 50, 50, 50), first=4, utc_set=False)
    add(3603, 7, (3, 3, 3, 3), stream="samples")  # thinned samples, which the stream `statistics` also contains
    names = "samples, accel_x_mean_m_s2, accel_x_min_m_s2, accel_x_max_m_s2, accel_x_rms_m_s2"
    names += ", temperature_mean_c, gyro_x_mean_rad_s"

    def rows(view: str) -> list[Any]:
        cursor.execute(
            f"SELECT time::text, site, gateway, device, stream, {names} FROM {view} ORDER BY time, stream DESC"
        )
        return list(cursor)

    cursor.execute("SET TIME ZONE 'Asia/Kolkata'")  # 5:30 from UTC: hours and days start by UTC
    key = ("mill", "gw-1", "bow")
    hours = [
        # mean (1·1 + 3·5) / 4, RMS √((1·1² + 3·5²) / 4) = √19
        ("2026-01-01 15:30:00+05:30", *key, "statistics", 4, 4.0, 0.0, 9.0, 4.358898943540674, 20.0, None),
        ("2026-01-01 16:30:00+05:30", *key, "statistics", 4, 10.0, -10.0, 10.0, 10.0, None, None),
        ("2026-01-01 16:30:00+05:30", *key, "samples", 7, 3.0, 3.0, 3.0, 3.0, None, None),
    ]
    assert rows(HOURS) == hours
    # mean (16 + 40) / 8, RMS √((76 + 400) / 8) = √59.5
    assert rows(DAYS) == [
        ("2026-01-01 05:30:00+05:30", *key, "statistics", 8, 7.0, -10.0, 10.0, 7.713624310270756, 20.0, None),
        ("2026-01-01 05:30:00+05:30", *key, "samples", 7, 3.0, 3.0, 3.0, 3.0, None, None),
    ]
    cursor.execute(
        "SELECT roll_mean_rad, roll_min_rad, roll_max_rad FROM imud_intervals_1h WHERE samples = 4 ORDER BY time"
    )
    first, second = cursor.fetchall()
    assert first == pytest.approx((0.5, 0.5, 0.5))
    assert second == pytest.approx((0.1 - math.pi, 0.4 - math.pi, math.pi - 0.2))


def test_functions_return_the_hours_and_days_of_a_range(cursor: Any) -> None:
    for day in (1, 2, 3, 4):
        for hour in (0, 12, 23):
            insert(cursor, INTERVALS, time=f"2026-01-0{day} {hour}:00:01+00", accel_x_mean_m_s2=day + hour)
    names = "time, site, gateway, device, stream, samples, accel_x_mean_m_s2"
    for function, view, since, until, count in (
        ("imud_hours", HOURS, "2026-01-02 12:59", "2026-01-03 12:00", 3),  # 12:00 and 23:00, and 0:00
        ("imud_hours", HOURS, "2026-01-02 12:59", "2026-01-03 12:00:00.000001", 4),
        ("imud_days", DAYS, "2026-01-02 23:59", "2026-01-04 00:00", 2),
        ("imud_days", DAYS, "2026-01-02 23:59", "2026-01-04 00:01", 3),
        ("imud_hours", HOURS, "0001-01-01", "9999-01-01", 12),
        ("imud_days", DAYS, "2026-01-03", "2026-01-02", 0),
    ):
        values = {"since": f"{since}+00", "until": f"{until}+00"}
        cursor.execute(f"SELECT {names} FROM {function}(%(since)s, %(until)s) ORDER BY time", values)
        found = cursor.fetchall()
        width = view.removeprefix("imud_intervals_")
        cursor.execute(
            f"SELECT {names} FROM {view} WHERE time > %(since)s::timestamptz - interval '{width}' "
            "AND time < %(until)s ORDER BY time", values,
        )  # fmt: skip
        assert found == cursor.fetchall()
        assert len(found) == count, function


@pytest.mark.parametrize("server", ["postgresql"], indirect=True)
@pytest.mark.parametrize("function", ["imud_hours", "imud_days"])
def test_functions_read_only_the_partitions_of_their_range(cursor: Any, function: str) -> None:
    for day in range(1, 5):
        cursor.execute(
            f"CREATE TABLE old_{day} PARTITION OF imud_intervals_set FOR VALUES FROM ('2020-01-0{day} 00:00+00') "
            f"TO ('2020-01-0{day + 1} 00:00+00')"
        )
    cursor.execute(f"EXPLAIN SELECT samples FROM {function}('2020-01-02 10:00+00', '2020-01-03 11:00+00')")
    plan = "\n".join(line for (line,) in cursor)
    assert [day for day in range(1, 5) if f"old_{day}" in plan] == [2, 3]


@pytest.mark.parametrize("value", [1.7e308, -1.7e308, 5e-324, math.inf, math.nan])
def test_false_values_do_not_make_a_view_fail(cursor: Any, value: float) -> None:
    """Any client of the broker can send such values."""
    columns = [one.column(measure) for one in AGGREGATED for measure in MEASURES]
    for first, samples in enumerate((NUMBER_MOST - 1, NUMBER_MOST - 1, NUMBER_MOST - 1, 1, 0, -1)):
        insert(cursor, INTERVALS, first=first, samples=samples, **dict.fromkeys(columns, value))
    insert(cursor, INTERVALS, first=9, samples=1, **dict.fromkeys(columns, 2.0))
    for first, last in ((-NUMBER_MOST + 1, NUMBER_MOST - 1), (1, 2)):
        insert(cursor, LEDGER, boot=str(first), begin=first, newest=last, missing=NUMBER_MOST - 1, sent=NUMBER_MOST - 1)
    insert(cursor, LEDGER, boot="3", missing=NUMBER_MOST - 1)
    insert(cursor, LEDGER, boot="4", newest=-NUMBER_MOST + 1, sent=NUMBER_MOST - 1)
    insert(cursor, INTERVALS, first=10, time="0001-01-01 00:00+00")
    insert(cursor, INTERVALS, first=10, time="9999-12-31 23:59+00")
    cursor.execute("SELECT samples, accel_x_mean_m_s2, accel_x_rms_m_s2, yaw_mean_rad FROM imud_intervals_1d")
    ((samples, *means),) = [row for row in cursor.fetchall() if row[0] > 1]
    assert samples == (1 << 63) - 1
    assert means == pytest.approx([2.0, 2.0, 2.0])
    cursor.execute("SELECT missing FROM imud_gateway_status")
    assert cursor.fetchall() == [((1 << 63) - 1,)]
    cursor.execute("SELECT max(in_spool) FROM imud_streams")
    assert cursor.fetchall() == [(2 * NUMBER_MOST - 2,)]


@pytest.mark.parametrize("server", ["timescaledb"], indirect=True)
def test_timescaledb_stores_hours_and_days(server: Any) -> None:
    """The stored rows contain late intervals after a refresh, and stay when imud removes intervals."""
    import psycopg

    with psycopg.connect(server.info.dsn, autocommit=True) as connection:
        connection.execute("CREATE DATABASE hours")
    with psycopg.connect(server.info.dsn, dbname="hours", autocommit=True) as connection:
        cursor = connection.cursor()
        prepare(connection)

        def refresh(days: float | None) -> None:
            for statement in refresh_policies(days):
                cursor.execute(statement.encode())
            jobs = "SELECT job_id FROM timescaledb_information.jobs WHERE proc_name LIKE '%refresh%' ORDER BY job_id"
            for (job,) in cursor.execute(jobs).fetchall():
                cursor.execute("CALL run_job(%s)", (job,))

        def add(at_s: float, mean: float, **more: object) -> None:
            insert(cursor, INTERVALS, at_s, accel_x_mean_m_s2=mean, **more)

        def means(view: str) -> list[float]:
            return [mean for (mean,) in cursor.execute(f"SELECT accel_x_mean_m_s2 FROM {view} ORDER BY time")]

        add(0, 1.0)
        add(3600, 2.0)
        refresh(None)
        add(1, 3.0, first=2)
        assert (means(HOURS), means(DAYS)) == ([1.0, 2.0], [1.5])  # stored: without the late interval
        refresh(None)
        assert (means(HOURS), means(DAYS)) == ([2.0, 2.0], [2.0])
        add(0, 7.0, first=3, time="now")
        assert (means(HOURS), means(DAYS)) == ([2.0, 2.0, 7.0], [2.0, 7.0])
        cursor.execute("SELECT drop_chunks('imud_intervals', interval '30 days')")
        assert means(INTERVALS.name) == [7.0]
        refresh(30)
        assert (means(HOURS), means(DAYS)) == ([2.0, 2.0, 7.0], [2.0, 7.0])
        refresh(0.1)  # the window is too short: TimescaleDB stores no hours
        assert means(HOURS) == [2.0, 2.0, 7.0]
