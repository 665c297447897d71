"""Rows in a real PostgreSQL: exactly once whatever is killed when, and placed when the clock of a gateway is known."""

import json
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from imud.errors import ServerError
from imud.fleet import FleetBatch
from imud.formats.fleet.ledger import FleetLedger, StoredAccount, StreamKey
from imud.formats.fleet.messages import FleetMessage
from imud.formats.fleet.topics import Stream
from tests.fleet.fleet_gateway import LIMIT_S, UTC_NS, SendingGateway, dropped_message, samples_message
from tests.fleet.postgres_server import NO_POSTGRES, running_postgres
from tests.publishers.mqtt.mosquitto import Mosquitto

pytestmark = pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running_postgres() as url:
        yield url


@pytest.fixture
def database(server: str) -> str:
    query(server, "DROP SCHEMA public CASCADE; CREATE SCHEMA public")
    return server


def query(url: str, text: str) -> list[Any]:
    import psycopg

    with psycopg.connect(url) as connection:
        cursor = connection.execute(text.encode())
        return cursor.fetchall() if cursor.description else []


def write(url: str, *messages: FleetMessage) -> FleetLedger:
    """Write messages by a collector's store that begins anew."""
    from imud.fleet.postgres import PostgresStore

    store, ledger = PostgresStore(url), FleetLedger()
    store.restore(ledger)
    batches, changed = [], set()
    for message in messages:
        fresh = ledger.take(message, Stream.SAMPLES)
        changed.add(StreamKey(message.gateway, message.boot, message.device, "samples"))
        if fresh is not None:
            batches.append(FleetBatch("mill", Stream.SAMPLES, fresh))
    try:
        store.write(batches, {key: ledger.stored(key) for key in changed})
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
    assert query(database, "SELECT first, last, kind, content FROM imud_records") == [
        (3, 5, "dropped", {"cause": "space"})
    ]


def test_what_comes_again_after_a_restart_is_a_duplicate_and_no_row(database: str) -> None:
    write(database, samples_message(1, 5))
    ledger = write(database, samples_message(1, 5), samples_message(4, 7))
    assert query(database, "SELECT seq FROM imud_samples ORDER BY seq") == [(n,) for n in range(1, 8)]
    (counts,) = ledger.counts.values()
    assert (counts.whole, counts.duplicates, counts.balance) == (7, 7, 0)


def test_samples_without_a_clock_wait_until_it_is_set(database: str) -> None:
    write(database, samples_message(1, 3, utc_ns=0), samples_message(1, 2, boot="2", utc_ns=0))
    assert query(database, "SELECT count(*) FROM imud_samples") == [(0,)]
    write(database, samples_message(4, 5))
    found = query(database, "SELECT seq, utc_ns, extract(epoch FROM time) * 1000000 FROM imud_samples ORDER BY seq")
    assert found == [(n, UTC_NS + n * 1_000_000, (UTC_NS + n * 1_000_000) // 1000) for n in range(1, 6)]
    assert query(database, "SELECT boot, seq FROM imud_unplaced ORDER BY seq") == [("2", 1), ("2", 2)]


def test_a_transaction_that_fails_leaves_nothing(database: str) -> None:
    write(database)
    query(database, "ALTER TABLE imud_ledger ADD CHECK (device <> 'bow')")
    with pytest.raises(ServerError, match=r"PostgreSQL: .*violates check"):
        write(database, samples_message(1, 5))
    assert query(database, "SELECT count(*) FROM imud_samples") == [(0,)]


def test_a_server_that_is_not_there_is_named() -> None:
    from imud.fleet.postgres import PostgresStore

    with pytest.raises(ServerError, match=r"PostgreSQL: .*nowhere"):
        PostgresStore("postgresql:///postgres?host=/nowhere")


@pytest.mark.timeout(180)
def test_rows_are_exactly_once_when_the_collector_is_killed_at_random(
    database: str, broker: Mosquitto, gateway: SendingGateway
) -> None:
    draw = random.Random(5)

    def start() -> "subprocess.Popen[bytes]":
        url = f"mqtt://127.0.0.1:{broker.port}"
        return subprocess.Popen([sys.executable, "-m", "imud", "fleet", "collect", url, "--to", database])

    def rows() -> int:
        return int(query(database, "SELECT count(*) FROM imud_samples")[0][0])

    def until(number: int) -> None:
        end = time.monotonic() + 3 * LIMIT_S
        while rows() < number:
            assert time.monotonic() < end
            assert process.poll() is None
            time.sleep(0.02)

    write(database)
    process = start()
    try:
        while not any("imud-reader-collector 1 imud" in line for line in broker.log):
            assert process.poll() is None
        sent = 0
        for _ in range(4):
            gateway.send(*(samples_message(sent + 10 * n + 1, sent + 10 * n + 10) for n in range(300)))
            sent += 3000
            until(draw.randint(sent - 2900, sent - 1))
            process.kill()
            process.wait()
            process = start()
        until(sent)
        while query(database, "SELECT account->'counts'->>'newest' FROM imud_ledger") != [(str(sent),)]:
            assert process.poll() is None
    finally:
        process.kill()
        process.wait()
    assert query(database, "SELECT count(*), count(DISTINCT seq), min(seq), max(seq) FROM imud_samples") == [
        (sent, sent, 1, sent)
    ]
    ((account,),) = query(database, "SELECT account FROM imud_ledger")
    counts = msgspec.json.decode(json.dumps(account), type=StoredAccount).counts
    assert (counts.whole, counts.missing, counts.balance) == (sent, 0, 0)
