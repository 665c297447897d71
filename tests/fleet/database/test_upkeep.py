"""Upkeep of a real database with partitions or hypertables: retention, expiry, and collectors that write during it."""

import logging
import re
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from datetime import UTC, datetime, timedelta
from itertools import count
from pathlib import Path
from typing import Any, Final

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import asdict

from imud.config import load_options
from imud.fleet.database import upkeep
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.store import PostgresStore
from imud.fleet.database.tables import BOOTS, EVENTS, GATEWAYS, INTERVALS, LEDGER, SAMPLES, TIMED, FleetTable
from imud.fleet.database.upkeep import Upkeep
from imud.model.errors import ServerError
from imud.model.units import NS_PER_S
from tests.fleet.database.fleet_rows import insert
from tests.fleet.postgres_server import NO_POSTGRES, NO_TIMESCALE, running_server
from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT

live = pytest.mark.live
needs_postgres = pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES)
needs_timescale = pytest.mark.skipif(bool(NO_TIMESCALE), reason=NO_TIMESCALE)
ENGINES: Final = [
    pytest.param("", id="partitions", marks=needs_postgres),
    pytest.param("timescaledb", id="timescaledb", marks=needs_timescale),
]
both = pytest.mark.parametrize("library", ENGINES)

NOW: Final = datetime(2026, 6, 15, 13, 30, tzinfo=UTC)
DAY: Final = timedelta(days=1)
NUMBERS = count()


@pytest.fixture(scope="module")
def servers() -> Iterator[Callable[[str], str]]:
    """Return the URL of the server with a library. Start each server at its first use."""
    found: dict[str, Any] = {}

    def url(library: str) -> str:
        if library not in found:
            found[library] = running_server(library)
            found[library] = (found[library], found[library].__enter__())
        made: str = found[library][1].url
        return made

    yield url
    for context, _ in found.values():
        context.__exit__(None, None, None)


class Database:
    """Empty database of one test with a connection and a fixed clock."""

    def __init__(self, url: str) -> None:
        import psycopg

        name = f"test{next(NUMBERS)}"
        with psycopg.connect(url, autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}")
        self.url = url.replace("/postgres?", f"/{name}?")
        self.connection = psycopg.connect(self.url)

    def query(self, text: str, *values: object) -> list[Any]:
        with self.connection.transaction():
            cursor = self.connection.execute(text.encode(), values)
            return cursor.fetchall() if cursor.description else []

    def prepare(self, now: datetime = NOW, **settings: Any) -> Upkeep:
        """Return the prepared upkeep."""
        made = Upkeep(CollectorSettings(**settings))
        with self.connection.transaction(), self.connection.cursor() as cursor:
            made.prepare(cursor, now)
        return made

    def run(self, made: Upkeep, now: datetime = NOW) -> Upkeep:
        self.query("UPDATE imud_schema SET upkeep_at = NULL")
        made.run(self.connection.cursor(), now)
        return made

    def add(self, table: FleetTable, **values: Any) -> None:
        """Insert a row. The other columns have default values."""
        with self.connection.transaction(), self.connection.cursor() as cursor:
            times: dict[str, Any] = {name: NOW for name in ("time", "updated_at") if name in table.names}
            insert(cursor, table, **(times | values))

    def times(self, table: FleetTable = SAMPLES) -> list[datetime]:
        self.query("SET timezone = 'UTC'")
        return [one for (one,) in self.query(f"SELECT time FROM {table.name} ORDER BY time")]


@pytest.fixture
def database(servers: Callable[[str], str], request: pytest.FixtureRequest) -> Iterator[Database]:
    library = request.getfixturevalue("library") if "library" in request.fixturenames else ""
    made = Database(servers(library))
    with closing(made.connection):
        yield made


# --- tables -----------------------------------------------------------------------------------------------------------


@live
@both
def test_tables_are_created_once_and_have_partitions(database: Database, library: str) -> None:
    for _ in range(2):
        database.run(database.prepare())
    found = {name for (name,) in database.query("SELECT relname FROM pg_class WHERE relkind IN ('r', 'p')")}
    if library:
        assert {"imud_samples", "imud_ledger", "imud_schema"} <= found
        names = database.query("SELECT hypertable_name FROM timescaledb_information.hypertables ORDER BY 1")
        assert {name for (name,) in names} >= {table.name for table in TIMED}
        return
    days = [f"imud_events_202606{day:02}_00" for day in range(8, 18)]
    assert {*days, "imud_events_other", "imud_events_unset"} <= found
    assert not {"imud_events_20260607_00", "imud_events_20260618_00"} & found


@live
@needs_postgres
def test_tables_of_other_versions_are_rejected(database: Database) -> None:
    database.query("CREATE TABLE imud_ledger (gateway text, account jsonb)")
    with pytest.raises(ServerError, match=r"expected tables of version 1, got imud_ledger .*ALTER SCHEMA public"):
        database.prepare()
    database.query("ALTER SCHEMA public RENAME TO imud_old; CREATE SCHEMA public")
    database.prepare()
    database.query("UPDATE imud_schema SET version = 2")
    with pytest.raises(ServerError, match="expected tables of version 1, got version 2"):
        database.prepare()


@live
@needs_postgres
def test_a_user_who_does_not_own_the_tables_gets_one_log_line(
    database: Database, caplog: pytest.LogCaptureFixture
) -> None:
    database.query("CREATE ROLE writer; SET ROLE writer")
    with pytest.raises(ServerError, match=r"cannot create the table imud_schema: permission denied.*GRANT CREATE"):
        database.prepare()
    database.query("RESET ROLE")
    database.prepare()
    database.query("GRANT SELECT, INSERT, UPDATE, DELETE ON ALL TABLES IN SCHEMA public TO writer")
    database.query("SET ROLE writer")
    with caplog.at_level(logging.WARNING):
        made = database.prepare(NOW + 3 * DAY, events_days=1)
        for _ in range(3):
            database.run(made, NOW + 3 * DAY)
    assert [one.getMessage() for one in caplog.records] == [
        "PostgreSQL: the user writer cannot create partitions or remove old rows, because imud owns the tables; run at "
        "least one collector as imud"
    ]
    database.add(SAMPLES, time=NOW + 9 * DAY)
    assert database.times() == [NOW + 9 * DAY]


# --- retention --------------------------------------------------------------------------------------------------------


@live
@both
def test_retention_removes_exactly_the_old_partitions(database: Database, library: str) -> None:
    made = database.prepare(samples_days=3, events_days=2, compress_after_days=None)
    hours = [NOW - timedelta(hours=12 * n) for n in range(-4, 24)]
    for table in (SAMPLES, EVENTS, INTERVALS):
        for time in hours:
            database.add(table, time=time)
    database.run(made)
    for table, day in ((SAMPLES, 12), (EVENTS, 13)):
        # NOW - 3 days is 12 June 13:30: the partition of 12 June stays
        kept = sorted(one for one in hours if one >= datetime(2026, 6, day, tzinfo=UTC))
        assert database.times(table) == kept
    assert len(database.times(INTERVALS)) == len(hours), "without a retention, all rows stay"
    database.run(made, NOW + 30 * DAY)
    assert database.times() == database.times(EVENTS) == []
    assert made.dropped_partitions >= 10
    if not library:
        names = [
            name for (name,) in database.query("SELECT relname FROM pg_class WHERE relname ~ '^imud_samples_2.*_00$'")
        ]
        assert sorted(names) == [f"imud_samples_202607{day:02}_00" for day in range(12, 18)]


@live
@needs_postgres
def test_rows_of_other_times_move_into_their_partition(database: Database) -> None:
    made = database.prepare()
    late, future, far = NOW - 30 * DAY, NOW + 10 * DAY, datetime(9999, 1, 1, tzinfo=UTC)
    places = "SELECT seq, tableoid::regclass::text FROM imud_samples ORDER BY seq"
    for seq, time in enumerate((late, future, far)):
        database.add(SAMPLES, time=time, seq=seq)
    database.run(made)
    assert {place for _, place in database.query(places)} == {"imud_samples_other"}
    database.run(made, NOW + 8 * DAY)
    assert [place for _, place in database.query(places)] == [
        "imud_samples_other", "imud_samples_20260625_00", "imud_samples_other"
    ]  # fmt: skip
    database.run(database.prepare(samples_days=20))
    assert database.times() == [future, far], "retention also removes late rows"
    made = database.prepare(NOW + 40 * DAY, partition_hours=7)
    for _ in range(2):
        database.run(made, NOW + 40 * DAY)
    for day in range(30, 44):
        database.add(SAMPLES, time=NOW + day * DAY, seq=day)
    ((other,),) = database.query("SELECT count(*) FROM imud_samples_other WHERE time < '9000-01-01'")
    assert other == 6, "only 7 days and 2 partitions of 7 hours have partitions"


@live
@both
def test_rows_without_a_known_time_stay_until_their_boot_ends(database: Database, library: str) -> None:
    made = database.prepare(samples_days=3, keep_boots=1, compress_after_days=None)
    old = NOW - 6 * DAY
    for boot, at in (("a", NOW - DAY), ("b", NOW)):
        database.add(BOOTS, gateway="gw", boot=boot, first_at=at)
        database.add(LEDGER, gateway="gw", boot=boot, stream="samples", missing=int(boot == "a"))
        for name in (boot, f"{boot}-2"):
            for time in (datetime(1970, 1, 1, tzinfo=UTC), old, NOW):
                database.add(SAMPLES, gateway="gw", boot=name, time=time, utc_set=False)
    database.add(LEDGER, gateway="gw", boot="a-2", stream="samples")
    database.add(SAMPLES, gateway="gw", boot="a", time=old, seq=7)
    database.add(SAMPLES, gateway="gw", boot="a", time=NOW, seq=8)
    database.run(made)
    rows = "SELECT boot, seq, count(*) FROM imud_samples GROUP BY 1, 2 ORDER BY 1, 2"
    assert database.query(rows) == [("a", 1, 3), ("a", 8, 1), ("a-2", 1, 3), ("b", 1, 3), ("b-2", 1, 3)]
    database.query("UPDATE imud_ledger SET missing = 0")
    assert database.run(made).expired_boots == 1
    assert database.query(rows) == [("a", 8, 1), ("b", 1, 3), ("b-2", 1, 3)]


# --- boots ------------------------------------------------------------------------------------------------------------


@live
@needs_postgres
def test_complete_boots_end_and_incomplete_boots_stay_for_a_week(database: Database) -> None:
    made = database.prepare(keep_boots=2)
    streams = {
        "complete": {"updated_at": NOW, "sent": 0}, "missing": {"updated_at": NOW - 6 * DAY, "missing": 1},
        "spooled": {"updated_at": NOW - 6 * DAY, "newest": 5, "sent": 6},
        "silent": {"updated_at": NOW - 8 * DAY, "missing": 1},
        "without": None, "present": {"updated_at": NOW - 9 * DAY}, "new1": {"updated_at": NOW},
        "new2": {"updated_at": NOW, "missing": 9},
    }  # fmt: skip
    for gateway in ("gw", "other"):
        for number, (boot, values) in enumerate(streams.items()):
            database.add(BOOTS, gateway=gateway, boot=boot, first_at=NOW - 20 * DAY + timedelta(hours=number))
            if values is not None:
                database.add(LEDGER, gateway=gateway, boot=boot, device="bow", stream="samples", **values)
                database.add(LEDGER, gateway=gateway, boot=f"{boot}-2", device="bow", stream="samples", **values)
        database.add(GATEWAYS, gateway=gateway, boot="present-3")
    database.run(made)
    left = [boot for (boot,) in database.query("SELECT boot FROM imud_boots WHERE gateway = 'gw' ORDER BY first_at")]
    assert left == ["missing", "spooled", "present", "new1", "new2"]
    names = database.query(
        "SELECT DISTINCT split_part(boot, '-', 1) FROM imud_ledger WHERE gateway = 'other' ORDER BY 1"
    )
    assert [name for (name,) in names] == sorted(left)
    assert (made.expired_boots, made.expired_incomplete) == (6, 2)
    database.query("UPDATE imud_ledger SET newest = 6 WHERE boot LIKE 'spooled%%'")
    database.run(made, NOW + 2 * DAY)
    assert (made.expired_boots, made.expired_incomplete) == (10, 4)


@live
@needs_postgres
def test_bounded_steps_remove_everything(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("ROWS_STEP", 3), ("BOOTS_STEP", 2)):
        monkeypatch.setattr(f"imud.fleet.database.upkeep.{name}", value)
    made = database.prepare(samples_days=1, keep_boots=1)
    for number in range(8):
        database.add(BOOTS, gateway="gw", boot=f"{number}", first_at=NOW + number * DAY)
        database.add(SAMPLES, gateway="gw", boot=f"{number}", time=NOW - 50 * DAY)
        for seq in range(4):
            database.add(SAMPLES, gateway="gw", boot=f"{number}", seq=seq, time=NOW, utc_set=False)
    database.run(made)
    assert database.query("SELECT boot FROM imud_boots") == [("7",)]
    assert database.query("SELECT boot, count(*) FROM imud_samples GROUP BY 1") == [("7", 4)]


@live
@both
def test_the_store_does_the_upkeep_each_minute(database: Database, library: str) -> None:
    old, minutes = datetime(2001, 1, 1, tzinfo=UTC), iter(range(1, 100))
    store = PostgresStore(database.url, CollectorSettings(samples_days=1), now_ns=lambda: next(minutes) * 60 * NS_PER_S)
    with closing(store):
        for seq in range(3):
            database.add(SAMPLES, time=old, seq=seq)
            database.query("UPDATE imud_schema SET upkeep_at = NULL")
            store.write([])
            assert database.times() == []
            locks = "SELECT count(*) FROM pg_locks JOIN pg_stat_activity USING (pid) WHERE application_name ~ '^imud'"
            assert database.query(locks) == [(0,)], "the upkeep ends its transactions"


# --- several collectors -----------------------------------------------------------------------------------------------


@contextmanager
def other_connection(database: Database) -> Iterator[Any]:
    import psycopg

    with closing(psycopg.connect(database.url)) as connection:
        yield connection


@live
@needs_postgres
def test_one_collector_at_a_time_does_the_upkeep(database: Database) -> None:
    made = database.prepare(samples_days=1)
    database.add(SAMPLES, time=NOW - 5 * DAY)
    with other_connection(database) as other:
        database.query("UPDATE imud_schema SET upkeep_at = NULL")
        other.execute(upkeep._LOCK)
        made.run(database.connection.cursor(), NOW)
        other.commit()
    assert database.times() == [NOW - 5 * DAY]
    database.run(made)
    assert database.times() == []
    database.add(SAMPLES, time=NOW - 5 * DAY)
    for seconds, rows in ((40, 1), (60, 0), (70, 0)):
        made.run(database.connection.cursor(), NOW + timedelta(seconds=seconds))
        assert len(database.times()) == rows, "the next run is after 50 s"


@live
@both
def test_collectors_prepare_and_run_together(
    database: Database, caplog: pytest.LogCaptureFixture, library: str
) -> None:
    gate = threading.Barrier(3)

    def collect() -> None:
        with other_connection(database) as connection:
            made = Upkeep(CollectorSettings(samples_days=2, partition_hours=24))
            gate.wait(LIMIT_S)
            with connection.transaction(), connection.cursor() as cursor:
                made.prepare(cursor, NOW)
            for day in range(6):
                made.run(connection.cursor(), NOW + day * DAY)

    with ThreadPoolExecutor() as pool:
        for one in [pool.submit(collect) for _ in range(3)]:
            one.result()
    assert [one.getMessage() for one in caplog.records if one.levelno >= logging.WARNING] == []
    if not library:
        made = database.run(database.prepare(NOW + 5 * DAY, samples_days=2), NOW + 5 * DAY)
        database.run(made, NOW + 5 * DAY)
        names = database.query("SELECT relname FROM pg_class WHERE relname ~ '^imud_samples_2.*_00$' ORDER BY 1")
        assert [name for (name,) in names] == [f"imud_samples_202606{day}_00" for day in range(18, 23)]


@live
@both
def test_a_collector_writes_during_the_upkeep(database: Database, library: str) -> None:
    made = database.prepare(samples_days=2, compress_after_days=None)
    database.connection.commit()
    ready = threading.Event()

    def write() -> None:
        """Write rows of the present and of old days, like a collector that receives old messages."""
        with other_connection(database) as connection:
            for seq in range(100):
                with connection.transaction(), connection.cursor() as cursor:
                    for day in (-40, -1, 0, 1, 5):
                        cursor.execute(INSERT, (NOW + day * DAY, seq))
                ready.set()

    with ThreadPoolExecutor() as pool:
        writing = pool.submit(write)
        ready.wait(LIMIT_S)
        for step in count():
            database.run(made, NOW + step % 3 * timedelta(hours=9))
            if writing.done():
                break
        writing.result()
    database.run(made)
    found = database.query("SELECT (time - %s)::text, count(DISTINCT seq), count(*) FROM imud_samples GROUP BY 1", NOW)
    assert sorted(found) == [(name, 100, 100) for name in ("-1 days", "00:00:00", "1 day", "5 days")]


INSERT: Final = (
    "INSERT INTO imud_samples (time, site, gateway, boot, device, utc_ns, utc_set, seq, t_ns, t_err_ns, sync, t_rx_ns) "
    "VALUES (%s, 'mill', 'gw', '1', 'bow', 0, true, %s, 0, 0, 'edge', 0)"
)


@live
@both
def test_a_step_waits_only_a_short_time_for_a_lock(
    database: Database, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, library: str
) -> None:
    made = database.prepare(samples_days=2, compress_after_days=None)
    database.run(made)
    monkeypatch.setattr("imud.fleet.database.upkeep.LOCK_MS", 20)
    with other_connection(database) as other:
        other.execute(INSERT, (NOW, 1))
        other.commit()
        other.execute("SELECT count(*) FROM imud_samples")
        before = made.dropped_partitions
        database.run(made, NOW + 10 * DAY)
        assert [one.message for one in caplog.records if one.levelno >= logging.WARNING] == []
        assert database.query("SELECT count(*) FROM imud_samples WHERE time = %s", NOW) == [(1,)]
        other.commit()
    database.run(made, NOW + 10 * DAY)
    assert database.times() == []
    assert made.dropped_partitions > before


# --- TimescaleDB ------------------------------------------------------------------------------------------------------


@live
@pytest.mark.parametrize("library", ENGINES[1:])
def test_compressed_chunks_accept_late_rows_and_are_removed(database: Database, library: str) -> None:
    made = database.prepare(samples_days=20, keep_boots=1)
    old = NOW - 10 * DAY
    for seq in range(50):
        database.add(SAMPLES, gateway="gw", boot="1", device="bow", seq=seq, time=old)
        database.add(SAMPLES, gateway="gw", boot="1", device="bow", seq=seq, time=old, utc_set=False)
    database.query("SELECT compress_chunk(c, if_not_compressed => true) FROM show_chunks('imud_samples') AS c")
    with database.connection.transaction(), database.connection.cursor() as cursor:
        with cursor.copy(
            "COPY imud_samples (time, site, gateway, boot, device, utc_ns, utc_set, seq, t_ns, t_err_ns, sync, "
            "t_rx_ns) FROM STDIN"
        ) as copy:
            copy.write_row((old, "mill", "gw", "1", "bow", 0, True, 99, 0, 0, "edge", 0))
        cursor.execute(INSERT + " ON CONFLICT DO NOTHING", (old, 7))
    assert database.query("SELECT utc_set, count(*) FROM imud_samples GROUP BY 1 ORDER BY 1") == [
        (False, 50),
        (True, 51),
    ]
    database.run(made, NOW + 11 * DAY)
    assert database.query("SELECT utc_set, count(*) FROM imud_samples GROUP BY 1") == [(False, 50)]
    for boot, at in (("1", NOW), ("2", NOW + DAY)):
        database.add(BOOTS, gateway="gw", boot=boot, first_at=at)
    database.run(made, NOW + 11 * DAY)
    assert database.times() == []
    database.run(made, NOW + 11 * DAY)
    assert database.query("SELECT count(*) FROM timescaledb_information.chunks") == [(0,)]


@live
@pytest.mark.parametrize("library", ENGINES[1:])
def test_compression_and_chunks_follow_the_configuration(database: Database, library: str) -> None:
    after = (
        "SELECT DISTINCT (config->>'compress_after')::interval FROM timescaledb_information.jobs "
        "WHERE config ? 'compress_after' AND hypertable_name LIKE 'imud%%'"
    )
    database.prepare(compress_after_days=7)
    jobs = "SELECT job_id FROM timescaledb_information.jobs WHERE config ? 'compress_after' ORDER BY 1"
    before = database.query(jobs)
    assert (len(before), database.query(after)) == (4, [(7 * DAY,)])
    database.prepare(compress_after_days=7)
    assert database.query(jobs) == before
    database.prepare(compress_after_days=1.5, partition_hours=6)
    assert database.query(after) == [(1.5 * DAY,)]
    widths = database.query(
        "SELECT DISTINCT time_interval FROM timescaledb_information.dimensions WHERE hypertable_name ~ 'imud'"
    )
    assert (timedelta(hours=6),) in widths
    database.prepare(compress_after_days=None)
    assert database.query(after) == []


@live
@needs_timescale
def test_the_apache_license_has_hypertables_without_compression() -> None:
    with running_server("timescaledb", "-c timescaledb.license=apache") as server:
        database = Database(server.url)
        with closing(database.connection):
            made = database.prepare(samples_days=3)
            database.add(SAMPLES, time=NOW - 6 * DAY)
            assert database.run(made).dropped_partitions == 1
            found = "SELECT DISTINCT compression_enabled FROM timescaledb_information.hypertables"
            assert database.query(found) == [(False,)]
            assert database.query("SELECT count(*) FROM imud_intervals_1h") == [(0,)]


# --- documentation ----------------------------------------------------------------------------------------------------


def test_the_page_has_a_valid_configuration_and_all_settings_of_the_upkeep(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "fleet-database.md").read_text()
    ((example,),) = [re.findall(r"```yaml\n(# collector.yaml.*?)```", page, re.DOTALL)]
    (tmp_path / "collector.yaml").write_text(example)
    made = load_options(str(tmp_path / "collector.yaml"), CollectorSettings)
    assert (made.samples_days, made.intervals_days, made.events_days) == (30, 730, 730)
    section = page.partition("## Partitions and retention")[2].partition("\n## ")[0]
    rows = dict(re.findall(r"^\| `(\w+)` \| ([\w.]+) \|", section, re.MULTILINE))
    shown = {name: "never" if value is None else f"{value:g}" for name, value in asdict(CollectorSettings()).items()
             if name in rows}  # fmt: skip
    assert rows == shown
    assert {name for name in rows if name.endswith("days")} == {
        name for name in CollectorSettings.__struct_fields__ if name.endswith("days")
    }


# --- ranges -----------------------------------------------------------------------------------------------------------

RANGE = st.tuples(st.integers(0, 90), st.integers(1, 20))


@given(st.lists(RANGE), st.integers(1, 24), st.integers(0, 30), st.integers(1, 60))
def test_free_ranges_cover_each_hour_once(ranges: list[tuple[int, int]], width: int, begin: int, hours: int) -> None:
    """The width of partitions can change: new partitions fill the time between the old partitions."""
    hour, known, covered = timedelta(hours=1), [], set[int]()
    for low, length in sorted(ranges):
        if not covered & set(range(low, low + length)):
            known.append(upkeep._Partition("", NOW + low * hour, NOW + (low + length) * hour))
            covered |= set(range(low, low + length))
    end = begin + hours // width * width
    found: list[int] = []
    for first, after in upkeep._free(NOW + begin * hour, NOW + end * hour, width * hour, known):
        assert timedelta() < after - first <= width * hour
        found += range((first - NOW) // hour, (after - NOW) // hour)
    assert sorted(found) == sorted(set(range(begin, end)) - covered)
