"""Rows and ledger in a real PostgreSQL: each record once despite killed processes, and UTC times after the clock is
known."""

import random
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import msgspec
import pytest

from imud.fleet import messages as fleet_messages
from imud.fleet.accounts import GatewayState
from imud.fleet.database.store import PostgresStore
from imud.fleet.messages import FleetMessage, MessageKind
from imud.fleet.statistics import SCALARS, VECTORS
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_S
from tests.fleet.database.deliveries import BALANCE, deliveries, delivery, delivery_of, ledgers, write
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
from tests.fleet.postgres_server import NO_POSTGRES, query, running_server
from tests.support.daemon_process import LIMIT_S, wait_until

pytestmark = [pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES), pytest.mark.live]


FIELDS = ", ".join((*VECTORS, *SCALARS))


def test_rows_have_time_numbers_and_values(database: str) -> None:
    write(database, samples_message(1, 2), dropped_message(3, 5), from_begin=True)
    rows = query(
        database, "SELECT site, gateway, boot, device, seq, utc_ns, extract(epoch FROM time) * 1000000, accel_x_m_s2, "
        "accel_z_m_s2, gyro_x_rad_s, temperature_c, sync FROM imud_samples ORDER BY seq"
    )  # fmt: skip
    assert rows[0] == (
        "mill", "gw", "1", "bow", 1, UTC_NS + 1_000_000, (UTC_NS + 1_000_000) // 1000, 0.125, 9.75, None, 21.5, "edge",
    )  # fmt: skip
    assert len(rows) == 2
    assert query(database, "SELECT first, last, stream, cause FROM imud_dropped") == [(3, 5, "samples", "space")]
    assert ledgers(
        database, f"site, begin, newest, whole, dropped, dropped_by_cause, missing, gaps, sent, {BALANCE}"
    ) == [("mill", 1, 5, 2, 3, {"space": 3}, 0, [], None, 0)]


def test_repeated_messages_after_a_restart_are_duplicates_without_rows(database: str) -> None:
    write(database, samples_message(1, 5))
    store = write(database, samples_message(1, 5), samples_message(4, 7))
    assert query(database, "SELECT seq FROM imud_samples ORDER BY seq") == [(n,) for n in range(1, 8)]
    assert ledgers(database, f"whole, duplicates, {BALANCE}") == [(7, 7, 0)]
    assert (store.counts.messages, store.counts.rows, store.counts.duplicates) == (2, 2, 7)
    with closing(PostgresStore(database)) as other:
        other.write(deliveries(samples_message(9, 9), dropped_message(10, 12)))
        assert other.ledger_text().splitlines() == [
            "this run: 2 messages, 2 rows, 0 duplicate numbers, 0 rejected messages",
            "ledger of the database: streams: 1, missing: 1, dropped: 3",
        ]


LIFTED_NS = 1_750_000_000_000_000_000  # time to which systemd sets a clock without a battery: after 2020, but wrong


NUMBERS = {"imud_samples": "seq", "imud_intervals": "first", "imud_events": "number", "imud_dropped": "first"}


def placed(url: str) -> list[Any]:
    return query(
        url,
        " UNION ALL ".join(
            f"SELECT {number}, utc_ns, extract(epoch FROM time) * 1000000, utc_set, utc_err_ns FROM {table}"
            for table, number in NUMBERS.items()
        )
        + " ORDER BY 1",
    )


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
    found = query(database, "SELECT utc_ns, end_utc_ns FROM imud_intervals")
    assert found == [(UTC_NS + 4_000_000, UTC_NS + 5_000_000)]
    rows = placed(database)
    write(database, *(not_set(one, wrong_ns) for one in before), *map(synchronised, before))
    assert placed(database) == rows, "a repeated message is a duplicate, although the time of its rows changed"


def test_a_stored_clock_offset_is_used_after_a_restart(database: str) -> None:
    write(database, synchronised(intervals_message(1, 5), t_ns=5_000_000))
    late = [samples_message(1, 1, utc_ns=0), intervals_message(6, 8, utc_ns=0), event_message(9, 9_000_000, utc_ns=0)]
    write(database, *(not_set(one) for one in late))
    assert [(number, at_ns, is_set) for number, at_ns, _, is_set, _ in placed(database)] == [
        (1, UTC_NS + 1_000_000, True), (1, UTC_NS + 1_000_000, True), (6, UTC_NS + 6_000_000, True),
        (9, UTC_NS + 9_000_000, True),
    ]  # fmt: skip
    found = query(database, "SELECT end_utc_ns FROM imud_intervals ORDER BY first")
    assert found == [(UTC_NS + 5_000_000,), (UTC_NS + 8_000_000,)]


def test_intervals_contain_the_clock_of_a_gateway_without_a_clock_field(database: str) -> None:
    """Default messages of a gateway with an earlier version, first at 1970, then with a set clock."""
    write(database, intervals_message(1, 5, utc_ns=0))
    write(database, intervals_message(6, 9))
    assert placed(database) == [
        (n, UTC_NS + n * 1_000_000, (UTC_NS + n * 1_000_000) // 1000, True, None) for n in (1, 6)
    ]


def test_the_state_of_a_gateway_gives_earlier_rows_their_utc_time(database: str) -> None:
    write(database, not_set(intervals_message(1, 5, utc_ns=0)))
    clock = fleet_messages.GatewayClock(0, UTC_NS, synchronised=True, error_ns=7)
    write(database, GatewayState(v=1, online=True, boot="1", clock=clock))
    assert placed(database) == [(1, UTC_NS + 1_000_000, (UTC_NS + 1_000_000) // 1000, True, 507)]


def test_rows_missing_in_the_ledger_are_not_duplicated(database: str) -> None:
    write(database, samples_message(1, 5), intervals_message(1, 5), event_message(1, 1))
    assert len(ledgers(database, "stream")) == 3
    query(database, "DELETE FROM imud_ledger")
    write(database, samples_message(4, 9), intervals_message(1, 5), intervals_message(6, 9), event_message(1, 1))
    assert query(database, "SELECT count(*), count(DISTINCT seq) FROM imud_samples") == [(9, 9)]
    assert query(database, "SELECT first FROM imud_intervals ORDER BY first") == [(1,), (6,)]
    assert query(database, "SELECT number FROM imud_events") == [(1,)]


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
    write(database, *messages)
    assert [row[1] for row in placed(database)] == [offset_ns, offset_ns]
    clock = fleet_messages.GatewayClock(-t_ns, offset_ns, synchronised=True, error_ns=MOST)
    known = msgspec.structs.replace(intervals_message(1, 1), clock=clock)
    write(database, known)
    assert [row[1] for row in placed(database) if row[0] == MOST] == [t_ns + offset_ns] * 2
    ((message, details),) = query(database, "SELECT message, details FROM imud_events")
    assert (message, details | {"value": float(details["value"])}) == (text.message, text.detail)


def test_a_bad_message_affects_only_itself(database: str, caplog: pytest.LogCaptureFixture) -> None:
    sample = Sample("bow", 1, -MOST, 0, Sync.EDGE, 0, MOST)
    first = msgspec.structs.replace(samples_message(1, 1, boot="a"), samples=[sample], clock=None)
    set_at_0 = fleet_messages.GatewayClock(0, 0, synchronised=False, error_ns=None)
    second = msgspec.structs.replace(samples_message(2, 2, boot="a", utc_ns=0), clock=set_at_0)
    write(database, first, second)
    assert query(database, "SELECT count(*) FROM imud_samples") == [(2,)]


def test_messages_that_cannot_be_stored_are_rejected(database: str) -> None:
    state = delivery("imud/mill/gw/state", b"{}")
    unknown = msgspec.structs.replace(intervals_message(6, 7).intervals[0], values={"light": fleet_messages.Measures()})
    wide = msgspec.structs.replace(unknown, values={"mag_t": fleet_messages.Measures(mean=(1.0, 2.0))})
    strange = [msgspec.structs.replace(intervals_message(6, 7), intervals=[one]) for one in (unknown, wide)]
    with closing(PostgresStore(database)) as store:
        # a database error of the class of value errors: division by zero
        query(database, "ALTER TABLE imud_events ADD CHECK (1 / (number - 3) < 9)")
        long = delivery("imud/mill/gw/bow/samples", b"x" * 5000)
        store.write([state, long, *deliveries(*(event_message(n, n) for n in range(1, 10)), *strange)])
        assert (store.counts.messages, store.counts.rows, store.counts.rejected) == (8, 8, 5)
    assert query(database, "SELECT array_agg(number::int ORDER BY number) FROM imud_events") == [
        ([1, 2, *range(4, 10)],)
    ]
    assert ledgers(database, f"whole, missing, gaps, {BALANCE}") == [(8, 1, [3, 3], 0)]
    found = query(
        database, "SELECT topic, payload_bytes, payload, reason FROM imud_rejected ORDER BY reason COLLATE \"C\""
    )  # fmt: skip
    reasons = [reason.partition(", got")[0].partition(" CONTEXT")[0] for *_, reason in found]
    assert [(*row[:2], reason) for row, reason in zip(found, reasons, strict=True)] == [
        ("imud/mill/gw/bow/events", len(delivery_of(event_message(3, 3)).payload), "division by zero"),
        ("imud/mill/gw/bow/statistics", len(delivery_of(strange[1]).payload), "expected 3 components of mag_t"),
        ("imud/mill/gw/bow/samples", 5000, "expected a message of a gateway"),
        ("imud/mill/gw/state", 2, "expected the state of a gateway"),
        ("imud/mill/gw/bow/statistics", len(delivery_of(strange[0]).payload), "expected values of " + FIELDS),
    ]  # fmt: skip
    assert [bytes(row[2]) for row in found[2:4]] == [b"x" * 4096, b"{}"]


def test_the_days_of_a_transaction_are_limited(database: str) -> None:
    """A message of a false sender with thousands of days would need more locks than PostgreSQL has."""

    def over_days(first: int, days: int) -> FleetMessage:
        made = samples_message(first, first + days - 1)
        samples = [
            msgspec.structs.replace(one, utc_ns=one.utc_ns - day * 86_400 * NS_PER_S)
            for day, one in enumerate(made.samples)
        ]
        return msgspec.structs.replace(made, samples=samples)

    with closing(PostgresStore(database)) as store:
        # 120 days in one transaction become two transactions
        store.write(deliveries(over_days(1, 100), over_days(101, 120), over_days(221, 20)))
        assert (store.counts.rows, store.counts.rejected) == (120, 1)
    ((reason,),) = query(database, "SELECT reason FROM imud_rejected")
    assert reason.startswith("expected records of at most 100 different days, got 120;")
    assert ledgers(database, f"newest, whole, missing, gaps, {BALANCE}") == [(240, 120, 120, [101, 220], 0)]


def test_the_number_of_rejected_messages_is_limited(database: str) -> None:
    with closing(PostgresStore(database)) as store:
        query(
            database, "INSERT INTO imud_rejected (topic, reason, payload_bytes, payload) "
            "SELECT 'old', '', 0, '' FROM generate_series(1, 10010)"
        )  # fmt: skip
        store.write([delivery("imud/mill/gw/state", b"")])
    assert query(database, "SELECT count(*), max(id) FROM imud_rejected") == [(10_000, 10_011)]


CUT = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()"


def test_a_lost_connection_is_replaced(caplog: pytest.LogCaptureFixture) -> None:
    with running_server() as server, closing(PostgresStore(server.url)) as store:
        for first in (1, 6, 11):
            store.write(deliveries(samples_message(first, first + 4)))
            if first == 1:
                query(server.url, CUT)
            elif first == 6:
                server.kill()
                server.start()
        assert query(server.url, "SELECT count(*) FROM imud_samples") == [(15,)]
    assert caplog.text.count("connecting again") == 2


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
        self.until("SELECT max(newest) FROM imud_ledger", sent)
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
    assert ledgers(database, f"whole, missing, {BALANCE}") == [(sent, 0, 0)]


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
                server.start()
            assert collecting.process.poll() is None, "the collector waits for the database"
            collecting.settle(sent)
            assert_exactly_once(server.url, sent)
        finally:
            collecting.kill()
