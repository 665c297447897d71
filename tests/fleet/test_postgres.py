"""Rows in a real PostgreSQL: each record once despite killed processes, and UTC times after the clock is known.
Rows of the collector: values in the order of the columns, and UTC times."""

import json
import random
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import msgspec
import pytest

from imud.fleet import messages as fleet_messages
from imud.fleet.accounts import BootClocks, BootKey, BootOffset, FleetLedger, StoredAccount, StreamKey
from imud.fleet.collector import Offsets
from imud.fleet.messages import FleetMessage, MessageKind, Stream
from imud.fleet.postgres import RECORDS, SAMPLES, SCHEMA, FleetTable, PostgresStore, Row, record_rows, sample_rows
from imud.fleet.reader import FleetBatch
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.model.sample import Sample, Sync
from tests.fleet.fleet_gateway import (
    UTC_NS,
    SendingGateway,
    dropped_message,
    event_message,
    intervals_message,
    not_set,
    samples_message,
    synchronised,
)
from tests.fleet.mosquitto import Mosquitto
from tests.fleet.postgres_server import NO_POSTGRES, running_server
from tests.support.daemon_process import LIMIT_S, wait_until

pytestmark = [pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES), pytest.mark.live]


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running_server() as made:
        yield made.url


@pytest.fixture
def database(server: str) -> str:
    query(server, "DROP SCHEMA public CASCADE; CREATE SCHEMA public")
    return server


def query(url: str, text: str) -> list[Any]:
    import psycopg

    with psycopg.connect(url) as connection:
        cursor = connection.execute(text.encode())
        return cursor.fetchall() if cursor.description else []


NO_OFFSETS: Offsets = {}
STREAMS = {MessageKind.INTERVALS: Stream.STATISTICS, MessageKind.EVENTS: Stream.EVENTS}


def write(url: str, *messages: FleetMessage, offsets: Offsets = NO_OFFSETS) -> FleetLedger:
    store, ledger, clocks = PostgresStore(url), FleetLedger(), BootClocks()
    store.restore(ledger)
    batches, changed = [], set[StreamKey]()
    for message in messages:
        stream = STREAMS.get(message.kind, Stream.SAMPLES)
        fresh, offset = ledger.take(message, stream, changed), clocks.take(message)
        if fresh is not None:
            batches.append(FleetBatch("mill", stream, fresh, offset))
    try:
        store.write(batches, {key: ledger.stored(key) for key in changed}, {**clocks.take_fresh(), **offsets})
    finally:
        store.close()
    return ledger


def test_rows_have_time_numbers_and_values(database: str) -> None:
    write(database, samples_message(1, 2), dropped_message(3, 5))
    rows = query(
        database, "SELECT site, gateway, boot, device, seq, utc_ns, extract(epoch FROM time) * 1000000, accel_m_s2, "
        "gyro_rad_s, temperature_c FROM imud_samples ORDER BY seq"
    )  # fmt: skip
    assert rows[0] == (
        "mill", "gw", "1", "bow", 1, UTC_NS + 1_000_000, (UTC_NS + 1_000_000) // 1000, [0.125, 0.0, 9.75], None, 21.5
    )  # fmt: skip
    assert len(rows) == 2
    found = query(database, "SELECT first, last, kind, content FROM imud_records")
    assert found == [(3, 5, "dropped", {"cause": "space"})]


def test_repeated_messages_after_a_restart_are_duplicates_without_rows(database: str) -> None:
    write(database, samples_message(1, 5))
    ledger = write(database, samples_message(1, 5), samples_message(4, 7))
    assert query(database, "SELECT seq FROM imud_samples ORDER BY seq") == [(n,) for n in range(1, 8)]
    (counts,) = ledger.counts.values()
    assert (counts.whole, counts.duplicates, counts.balance) == (7, 7, 0)


LIFTED_NS = 1_750_000_000_000_000_000  # time to which systemd sets a clock without a battery: after 2020, but wrong


def placed(url: str) -> list[Any]:
    return query(
        url, "SELECT seq, utc_ns, extract(epoch FROM time) * 1000000, utc_set, utc_err_ns FROM imud_samples "
        "UNION ALL SELECT first, utc_ns, extract(epoch FROM time) * 1000000, utc_set, utc_err_ns FROM imud_records "
        "ORDER BY 1"
    )  # fmt: skip


@pytest.mark.parametrize("wrong_ns", [0, LIFTED_NS])
def test_rows_get_their_utc_time_when_the_clock_is_set(database: str, wrong_ns: int) -> None:
    before = [
        samples_message(1, 2, utc_ns=wrong_ns), samples_message(3, 3, boot="1-2", utc_ns=wrong_ns),
        intervals_message(4, 5, utc_ns=wrong_ns), event_message(6, 6_000_000, utc_ns=wrong_ns),
        msgspec.structs.replace(dropped_message(7, 8), utc_ns=wrong_ns + 8_000_000),
    ]  # fmt: skip
    write(database, *(not_set(one, wrong_ns) for one in before))
    write(database, not_set(samples_message(9, 9, boot="2", utc_ns=wrong_ns), wrong_ns))
    assert [(seq, at_ns // 1_000_000_000, is_set, err) for seq, at_ns, _, is_set, err in placed(database)] == [
        (number, wrong_ns // 1_000_000_000, False, None) for number in (1, 2, 3, 4, 6, 7, 9)
    ]
    write(database, synchronised(samples_message(10, 10), t_ns=10_000_000))
    t_ns = {1: 1_000_000, 2: 2_000_000, 3: 3_000_000, 4: 4_000_000, 6: 6_000_000, 7: 8_000_000, 10: 10_000_000}
    assert [row for row in placed(database) if row[3]] == [
        (number, UTC_NS + at, (UTC_NS + at) // 1000, True, 1000 + (10_000_000 - at) // 2000)
        for number, at in t_ns.items()
    ]
    assert [row[0] for row in placed(database) if not row[3]] == [9]
    ((content,),) = query(database, "SELECT content FROM imud_records WHERE kind = 'interval'")
    assert (content["begin_utc_ns"], content["end_utc_ns"]) == (UTC_NS + 4_000_000, UTC_NS + 5_000_000)


def test_a_stored_clock_offset_is_used_after_a_restart(database: str) -> None:
    write(database, synchronised(intervals_message(1, 5), t_ns=5_000_000))
    late = [samples_message(1, 1, utc_ns=0), intervals_message(6, 8, utc_ns=0), event_message(9, 9_000_000, utc_ns=0)]
    write(database, *(not_set(one) for one in late))
    assert [(number, at_ns, is_set) for number, at_ns, _, is_set, _ in placed(database)] == [
        (1, UTC_NS + 1_000_000, True), (1, UTC_NS + 1_000_000, True), (6, UTC_NS + 6_000_000, True),
        (9, UTC_NS + 9_000_000, True),
    ]  # fmt: skip
    found = query(database, "SELECT content->>'end_utc_ns' FROM imud_records WHERE kind = 'interval' ORDER BY first")
    assert found == [(str(UTC_NS + 5_000_000),), (str(UTC_NS + 8_000_000),)]


def test_intervals_contain_the_clock_of_a_gateway_without_a_clock_field(database: str) -> None:
    """Default messages of a gateway with an earlier version, first at 1970, then with a set clock."""
    write(database, intervals_message(1, 5, utc_ns=0))
    write(database, intervals_message(6, 9))
    assert placed(database) == [
        (n, UTC_NS + n * 1_000_000, (UTC_NS + n * 1_000_000) // 1000, True, None) for n in (1, 6)
    ]


def test_the_state_of_a_gateway_gives_earlier_rows_their_utc_time(database: str) -> None:
    write(database, not_set(intervals_message(1, 5, utc_ns=0)))
    write(database, offsets={BootKey("gw", "1"): BootOffset(0, UTC_NS, 7)})
    assert placed(database) == [(1, UTC_NS + 1_000_000, (UTC_NS + 1_000_000) // 1000, True, 507)]


def test_rows_missing_in_the_ledger_are_not_duplicated(database: str) -> None:
    first = write(database, samples_message(1, 5), intervals_message(1, 5), event_message(1, 1))
    assert len(first.counts) == 3
    query(database, "DELETE FROM imud_ledger")
    write(database, samples_message(4, 9), intervals_message(1, 5), intervals_message(6, 9), event_message(1, 1))
    assert query(database, "SELECT count(*), count(DISTINCT seq) FROM imud_samples") == [(9, 9)]
    assert query(database, "SELECT kind, first FROM imud_records ORDER BY kind, first") == [
        ("event", 1), ("interval", 1), ("interval", 6),
    ]  # fmt: skip


MOST = fleet_messages.NUMBER_MOST - 1


@pytest.mark.parametrize(("t_ns", "offset_ns"), [(-MOST, -MOST), (-MOST, MOST), (MOST, MOST)])
def test_the_largest_numbers_that_are_decoded_are_rows(database: str, t_ns: int, offset_ns: int) -> None:
    """The records arrive before the clock of their boot is known. The clock differs by the maximum value."""
    sample = Sample("bow", MOST, t_ns, MOST, Sync.EDGE, t_ns, offset_ns, t_ns, status=MOST, pps_age_ms=MOST)
    text = Event(t_ns, "bow", EventKind.UP, "\x01\ufffd'\"\\", {"number": MOST, "value": 1.7e308})
    head = not_set(samples_message(1, 1), offset_ns)
    messages = [
        msgspec.structs.replace(head, first=MOST, last=MOST, utc_ns=offset_ns, samples=[sample]),
        msgspec.structs.replace(
            head, first=MOST, last=MOST, kind=MessageKind.EVENTS, utc_ns=offset_ns, samples=[], events=[text]
        ),
    ]
    write(database, *(fleet_messages.decode_message(fleet_messages.encode_message(one)) for one in messages))
    assert [row[1] for row in placed(database)] == [offset_ns, offset_ns]
    clock = fleet_messages.GatewayClock(-t_ns, offset_ns, synchronised=True, error_ns=MOST)
    known = msgspec.structs.replace(intervals_message(1, 1), clock=clock)
    write(database, fleet_messages.decode_message(fleet_messages.encode_message(known)))
    assert [row[1] for row in placed(database) if row[0] == MOST] == [t_ns + offset_ns] * 2
    ((content,),) = query(database, "SELECT content FROM imud_records WHERE kind = 'event'")
    assert content["message"] == text.message


def test_a_bad_message_affects_only_itself(database: str, caplog: pytest.LogCaptureFixture) -> None:
    sample = Sample("bow", 1, -MOST, 0, Sync.EDGE, 0, MOST)
    first = msgspec.structs.replace(samples_message(1, 1, boot="a"), samples=[sample], clock=None)
    set_at_0 = fleet_messages.GatewayClock(0, 0, synchronised=False, error_ns=None)
    second = msgspec.structs.replace(samples_message(2, 2, boot="a", utc_ns=0), clock=set_at_0)
    write(database, *(fleet_messages.decode_message(fleet_messages.encode_message(one)) for one in (first, second)))
    assert query(database, "SELECT count(*) FROM imud_samples") == [(2,)]
    too_large = Sample("bow", 1 << 63, 1, 0, Sync.EDGE, 0, UTC_NS)
    bad = msgspec.structs.replace(samples_message(3, 3, boot="b"), samples=[too_large])
    write(database, samples_message(1, 5), bad, samples_message(6, 9))
    assert query(database, "SELECT count(*) FROM imud_samples WHERE boot = '1'") == [(9,)]
    assert "cannot store a message of mill/gw/b/bow" in caplog.text
    assert query(database, "SELECT count(*) FROM imud_ledger") == [(3,)]


def test_a_lost_connection_is_replaced(caplog: pytest.LogCaptureFixture) -> None:
    with running_server() as server, closing(PostgresStore(server.url)) as store:
        for first in (1, 6, 11):
            store.write([FleetBatch("mill", Stream.SAMPLES, samples_message(first, first + 4))], {}, {})
            if first == 1:
                query(
                    server.url, "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()"
                )
            elif first == 6:
                server.kill()
                server.start()
        assert query(server.url, "SELECT count(*) FROM imud_samples") == [(15,)]
    assert caplog.text.count("connecting again") == 2


def test_ledgers_of_old_boots_are_removed(database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.accounts.STREAMS_MAX", 3)
    for boot in "12345":
        write(database, samples_message(1, 5, boot=boot))
    assert query(database, "SELECT boot FROM imud_ledger ORDER BY boot") == [("3",), ("4",), ("5",)]


def test_a_transaction_that_fails_leaves_nothing(database: str) -> None:
    write(database)
    query(database, "ALTER TABLE imud_ledger ADD CHECK (device <> 'bow')")
    with pytest.raises(ServerError, match=r"PostgreSQL: .*violates check"):
        write(database, samples_message(1, 5))
    assert query(database, "SELECT count(*) FROM imud_samples") == [(0,)]


def test_a_user_without_the_right_to_create_tables_can_write_rows(database: str) -> None:
    write(database)
    query(
        database,
        "DROP ROLE IF EXISTS writer; CREATE ROLE writer LOGIN; REVOKE CREATE ON SCHEMA public FROM public; "
        "GRANT USAGE ON SCHEMA public TO public; "
        "GRANT SELECT, INSERT, UPDATE, DELETE ON ALL TABLES IN SCHEMA public TO writer",
    )
    write(database.replace("user=imud", "user=writer"), samples_message(1, 5))
    assert query(database, "SELECT count(*) FROM imud_samples") == [(5,)]
    query(database, "DROP OWNED BY writer; DROP ROLE writer")


def test_a_second_collector_reports_the_first(database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.postgres.LOCK_S", 0.1)
    first = PostgresStore(database)
    with pytest.raises(ServerError, match="another collector still writes"):
        PostgresStore(database)
    first.close()


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("postgresql://u:se%cret@h/x", "invalid percent-encoded token"),
        ("postgresql://u:secret@[::1/x", "end of string reached when looking for matching"),
        ("postgresql://u:secret@h/x?port=1&colour=2", "invalid URI query parameter"),
    ],
)
def test_an_invalid_url_is_not_printed_and_a_missing_server_is_named(url: str, problem: str) -> None:
    with pytest.raises(ServerError, match=f"^PostgreSQL: cannot parse the URL: {problem}; imud does not ") as refused:
        PostgresStore(url)
    assert refused.value.__suppress_context__, "a traceback does not print it either"
    assert "cret" not in str(refused.value)
    with pytest.raises(ServerError, match=r"PostgreSQL: .*nowhere"):
        PostgresStore("postgresql:///postgres?host=/nowhere")


class Collecting:
    """Process of `imud fleet collect`. The test kills it or its server."""

    def __init__(self, broker: Mosquitto, database: str) -> None:
        self.broker, self.database = broker, database
        write(database)
        self.start()
        wait_until(lambda: any("imud-reader-collector 1 imud" in line for line in broker.log), "it has subscribed")

    def start(self) -> None:
        url = f"mqtt://127.0.0.1:{self.broker.port}"
        words = [sys.executable, "-m", "imud", "fleet", "collect", url, "--to", self.database]
        self.process = subprocess.Popen(words, stderr=subprocess.DEVNULL)

    def until(self, text: str, least: int) -> None:
        wait_until(lambda: (query(self.database, text)[0][0] or 0) >= least, f"{text} gives {least}", 2 * LIMIT_S)

    def until_rows(self, number: int) -> None:
        self.until("SELECT count(*) FROM imud_samples", number)

    def settle(self, sent: int) -> None:
        self.until_rows(sent)
        self.until("SELECT max((account->'counts'->>'newest')::bigint) FROM imud_ledger", sent)
        self.kill()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def collecting(database: str, broker: Mosquitto) -> Iterator[Collecting]:
    one = Collecting(broker, database)
    yield one
    one.kill()


def assert_exactly_once(database: str, sent: int) -> None:
    found = query(database, "SELECT count(*), count(DISTINCT seq), min(seq), max(seq) FROM imud_samples")
    assert found == [(sent, sent, 1, sent)]
    ((account,),) = query(database, "SELECT account FROM imud_ledger")
    counts = msgspec.json.decode(json.dumps(account), type=StoredAccount).counts
    assert (counts.whole, counts.missing, counts.balance) == (sent, 0, 0)


def send(gateway: SendingGateway, sent: int) -> int:
    """Send 3,000 more samples. Return the number of all samples."""
    gateway.send(*(samples_message(sent + 10 * n + 1, sent + 10 * n + 10) for n in range(300)))
    return sent + 3000


def test_rows_are_exactly_once_after_kills(database: str, collecting: Collecting, gateway: SendingGateway) -> None:
    draw, sent = random.Random(5), 0
    for _ in range(3):
        sent = send(gateway, sent)
        collecting.until_rows(draw.randint(sent - 2900, sent - 1))
        collecting.kill()
        collecting.start()
    collecting.settle(sent)
    assert_exactly_once(database, sent)


def test_rows_are_exactly_once_when_the_server_is_killed(broker: Mosquitto, gateway: SendingGateway) -> None:
    import psycopg

    with running_server() as server:
        collecting, sent = Collecting(broker, server.url), 0
        try:
            for is_held in (True, False):
                holder = psycopg.connect(server.url)
                if is_held:  # the transaction has written its rows and waits for the ledger
                    holder.execute("LOCK TABLE imud_ledger IN EXCLUSIVE MODE")
                sent = send(gateway, sent)
                if is_held:
                    collecting.until(
                        "SELECT count(*) FROM pg_stat_activity WHERE wait_event_type = 'Lock' "
                        "AND application_name = 'imud fleet collect' AND query LIKE '%imud_ledger%'", 1
                    )  # fmt: skip
                server.kill()
                holder.close()
                assert collecting.process.wait(LIMIT_S) == 2
                server.start()
                collecting.start()
            collecting.settle(sent)
            assert_exactly_once(server.url, sent)
        finally:
            collecting.kill()


KNOWN = BootOffset(0, UTC_NS, 40)


def named(table: FleetTable, row: Row) -> dict[str, object]:
    return dict(zip(table.names, row, strict=True))


def record(message: FleetMessage, offset: BootOffset | None = None) -> dict[str, object]:
    (row,) = record_rows(FleetBatch("mill", Stream.STATISTICS, message, offset))
    return named(RECORDS, row)


def test_a_sample_row_contains_its_values_by_column_name() -> None:
    (row,) = sample_rows(FleetBatch("mill", Stream.SAMPLES, synchronised(samples_message(3, 3), error_ns=40)))
    found = {name: value for name, value in named(SAMPLES, row).items() if value is not None}
    # 1,790,000,000 s after 1970: `date -u -d @1790000000`
    assert found == {
        "time": "2026-09-21T14:13:20.003000+00:00", "site": "mill", "gateway": "gw", "boot": "1", "device": "bow",
        "utc_ns": UTC_NS + 3_000_000, "utc_set": True, "utc_err_ns": 40, "seq": 3, "t_ns": 3_000_000, "t_err_ns": 500,
        "sync": "edge", "t_rx_ns": 3_000_010, "accel_m_s2": [0.375, 0.0, 9.75], "temperature_c": 21.5,
    }  # fmt: skip


def test_a_record_without_a_clock_uses_the_offset_of_its_boot() -> None:
    for message, t_ns in (
        (intervals_message(2, 4, utc_ns=0), 2_000_000), (event_message(5, 5_000_000, utc_ns=0), 5_000_000),
        (msgspec.structs.replace(dropped_message(6, 7), utc_ns=7_000_000), 7_000_000),
    ):  # fmt: skip
        waiting, known = record(not_set(message)), record(not_set(message), KNOWN)
        assert (waiting["utc_ns"], waiting["utc_set"], waiting["utc_err_ns"]) == (t_ns, False, None)
        assert (known["utc_ns"], known["utc_set"], known["t_ns"]) == (UTC_NS + t_ns, True, t_ns)
        assert known["utc_err_ns"] == 40 + t_ns // 2000
    content = json.loads(str(record(not_set(intervals_message(2, 4, utc_ns=0)), KNOWN)["content"]))
    assert (content["begin_utc_ns"], content["end_utc_ns"]) == (UTC_NS + 2_000_000, UTC_NS + 4_000_000)
    found = record(msgspec.structs.replace(dropped_message(6, 7), cause=fleet_messages.DropCause.AGE, utc_ns=-1))
    assert (found["time"], found["utc_ns"], found["t_ns"], found["utc_set"]) == (
        "1969-12-31T23:59:59.999999+00:00", -1, None, False,
    )  # fmt: skip
    assert found["content"] == '{"cause":"age"}'
    assert all(one.strip().startswith("CREATE TABLE IF NOT EXISTS imud_") for one in SCHEMA.values())
