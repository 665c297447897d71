"""Several collectors on one real PostgreSQL: rows exactly once for any order, repetition and collector; races of
transactions in a controlled order."""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from itertools import count
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.fleet.accounts import GatewayState, StreamPosition
from imud.fleet.database.store import PostgresStore
from imud.fleet.database.transaction import DecodedDelivery, FleetTransaction, copy_rows
from imud.fleet.messages import FleetMessage, GatewayClock, MessageKind, Stream
from imud.model.errors import ServerError
from tests.fleet.database.deliveries import BALANCE, delivery_of, ledgers, write
from tests.fleet.fleet_gateway import (
    UTC_NS,
    dropped_message,
    intervals_message,
    not_set,
    samples_message,
    synchronised,
)
from tests.fleet.postgres_server import PostgresServer, query
from tests.support.daemon_process import LIMIT_S, wait_until

pytestmark = pytest.mark.live

WRONG_NS = UTC_NS - 10**9  # time of an unset clock at t_ns = 0
KINDS = (MessageKind.SAMPLES, MessageKind.INTERVALS, MessageKind.DROPPED)  # order of the columns in the ledger
MESSAGES = st.tuples(
    st.sampled_from(KINDS), st.integers(1, 40), st.integers(0, 12), st.sampled_from(["1", "1-2"]), st.booleans()
)
# A collector, by number, stores messages in one transaction.
TURNS = st.lists(st.tuples(st.integers(0, 1), st.lists(MESSAGES, min_size=1, max_size=4)), max_size=12)
NUMBER = count()


def made(kind: MessageKind, first: int, last: int, boot: str, *, has_clock: bool) -> FleetMessage:
    utc_ns = UTC_NS if has_clock else WRONG_NS
    if kind is MessageKind.SAMPLES:
        message = samples_message(first, last, boot=boot, utc_ns=utc_ns)
    elif kind is MessageKind.INTERVALS:
        message = intervals_message(first, last, boot=boot, utc_ns=utc_ns)
    else:
        message = dropped_message(first, last, boot=boot)
    return synchronised(message) if has_clock else not_set(message, WRONG_NS)


@given(turns=TURNS, from_begin=st.booleans())
def test_rows_are_exactly_once_for_any_order_and_any_collector(
    server: PostgresServer, turns: Any, *, from_begin: bool
) -> None:
    """Two collectors receive messages of two streams of one boot. A clock is known in some of the messages."""
    gateway = f"gw-{next(NUMBER)}"
    seen: dict[str, dict[int, MessageKind]] = {"1": {}, "1-2": {}}
    ranges: set[tuple[str, int, int, MessageKind]] = set()
    arrived, is_known = dict.fromkeys(seen, 0), False
    one, two = stores = [PostgresStore(server.url, from_begin=from_begin) for _ in range(2)]
    with closing(one), closing(two):
        for number, content in turns:
            messages = []
            for kind, first, length, boot, has_clock in content:
                last = first + length
                message = msgspec.structs.replace(made(kind, first, last, boot, has_clock=has_clock), gateway=gateway)
                messages.append(delivery_of(message, Stream.SAMPLES))
                is_known |= has_clock
                arrived[boot] += length + 1
                if new := set(range(first, last + 1)) - seen[boot].keys():
                    ranges.add((boot, first, last, kind))
                seen[boot] |= dict.fromkeys(new, kind)
            stores[number].write(messages)

    def rows(columns: str, table: str) -> list[Any]:
        return query(server.url, f"SELECT {columns} FROM {table} WHERE gateway = '{gateway}' ORDER BY 1, 2, 3")

    assert rows(f"boot, begin, newest, whole, thinned, dropped, missing, duplicates, {BALANCE}", "imud_ledger") == [
        (
            boot, begin := 1 if from_begin else min(numbers), max(numbers),
            *(sum(one is kind for one in numbers.values()) for kind in KINDS),
            max(numbers) - begin + 1 - len(numbers), arrived[boot] - len(numbers), 0,
        )
        for boot, numbers in seen.items() if numbers
    ]  # fmt: skip
    offset_ns = UTC_NS if is_known else WRONG_NS
    samples = sorted((boot, seq) for boot, kinds in seen.items() for seq in kinds if kinds[seq] is MessageKind.SAMPLES)
    assert rows("boot, seq, utc_ns - t_ns, utc_set", "imud_samples") == [(*one, offset_ns, is_known) for one in samples]
    for table, kind in (("imud_intervals", MessageKind.INTERVALS), ("imud_dropped", MessageKind.DROPPED)):
        own = sorted((boot, first, last) for boot, first, last, of in ranges if of is kind)
        assert rows("boot, first, last, utc_set", table) == [(*one, is_known) for one in own]


# --- races -----------------------------------------------------------------------------------------------------------


@contextmanager
def open_transaction(url: str, *messages: FleetMessage) -> Iterator[Any]:
    """Store messages in a transaction that ends with the block. Yield its connection."""
    import psycopg

    items = [DecodedDelivery(delivery_of(one), "mill", "gw", "samples", one, []) for one in messages]
    with psycopg.connect(url) as connection:
        FleetTransaction(connection.cursor(), items, {}, from_begin=False).run(copy_rows)
        yield connection


@contextmanager
def waiting(url: str, *messages: FleetMessage) -> Iterator[Future[PostgresStore]]:
    """Store messages in a thread. Run the block after the store waits for a lock, then wait for the store."""
    with ThreadPoolExecutor(1) as pool:
        found = pool.submit(write, url, *messages)
        blocked = "SELECT 1 FROM pg_stat_activity WHERE wait_event_type = 'Lock'"
        wait_until(lambda: found.done() or bool(query(url, blocked)), "the store waits")
        assert not found.done(), found.exception()
        yield found
        found.result(LIMIT_S)


LATE = not_set(samples_message(6, 9, utc_ns=WRONG_NS), WRONG_NS)
SET = synchronised(samples_message(1, 5, device="aft"))


@pytest.mark.parametrize("is_known", [True, False], ids=["a boot with rows", "a new boot"])
@pytest.mark.parametrize(("first", "second"), [(LATE, SET), (SET, LATE)], ids=["rows first", "clock first"])
def test_rows_get_the_clock_of_a_concurrent_transaction(
    database: str, first: FleetMessage, second: FleetMessage, *, is_known: bool
) -> None:
    before = [not_set(samples_message(1, 2, utc_ns=WRONG_NS), WRONG_NS)] if is_known else []
    write(database, *before)
    with open_transaction(database, first) as connection, waiting(database, second):
        connection.commit()
    found = query(database, "SELECT DISTINCT utc_set, utc_ns - t_ns FROM imud_samples")
    assert found == [(True, UTC_NS)]
    assert query(database, "SELECT count(*) FROM imud_samples") == [(11 if is_known else 9,)]


def test_concurrent_transactions_share_the_ledger_of_a_stream(database: str) -> None:
    """The first two messages create the ledger, the other two messages change it. No message has a clock offset, so
    that the transactions share the lock of the boot."""
    write(database)
    for first, second in (((1, 5), (1, 9)), ((20, 25), (10, 12))):
        one, two = (not_set(samples_message(*span)) for span in (first, second))
        with open_transaction(database, one) as connection, waiting(database, two) as store:
            connection.commit()
        assert store.result().counts.duplicates == (5 if first == (1, 5) else 0)
    assert query(database, "SELECT seq FROM imud_samples ORDER BY 1") == [(n,) for n in (*range(1, 13), *range(20, 26))]
    assert ledgers(database, f"newest, whole, missing, duplicates, {BALANCE}") == [(25, 18, 7, 5, 0)]


def test_a_transaction_that_ends_without_a_commit_leaves_nothing(database: str) -> None:
    write(database)
    with open_transaction(database, samples_message(1, 5)) as connection, waiting(database, samples_message(1, 9)):
        connection.rollback()
    assert ledgers(database, "whole, duplicates") == [(9, 0)]


def test_a_transaction_is_repeated_after_a_deadlock(database: str, caplog: pytest.LogCaptureFixture) -> None:
    import psycopg

    both = [samples_message(1, 5, device=device) for device in ("aft", "bow")]
    write(database, *both)
    lock = "SELECT 1 FROM imud_ledger WHERE device = %s FOR UPDATE"
    with psycopg.connect(database) as connection:
        connection.execute("SET LOCAL deadlock_timeout = '1h'")  # the store detects the deadlock
        connection.execute(lock, ("bow",))
        with waiting(database, *both):
            connection.execute(lock, ("aft",))
            connection.commit()
    assert "deadlock detected" in caplog.text
    assert ledgers(database, "device, whole, duplicates") == [("aft", 5, 5), ("bow", 5, 5)]


def test_the_number_of_repetitions_is_limited(database: str, caplog: pytest.LogCaptureFixture) -> None:
    write(database)
    query(
        database, "CREATE FUNCTION nothing() RETURNS trigger LANGUAGE plpgsql AS 'BEGIN RETURN NULL; END'; "
        "CREATE TRIGGER gone BEFORE INSERT ON imud_ledger FOR EACH ROW EXECUTE FUNCTION nothing()"
    )  # fmt: skip
    with pytest.raises(ServerError, match="cannot store messages after 10 conflicts with other transactions"):
        write(database, samples_message(1, 5))
    assert caplog.text.count("another transaction removed a row") == 10


# --- states ----------------------------------------------------------------------------------------------------------


def state(last: int, boot: str = "1", *, clock: GatewayClock | None = None) -> GatewayState:
    positions = [StreamPosition(boot, "bow", "samples", 3, last), StreamPosition("0", "bow", "samples", 1, 99)]
    return GatewayState(
        v=1, online=True, boot="1", imud="0.1.0", devices=["aft", "bow"], positions=positions, clock=clock,
        mqtt={"sent": last},
    )  # fmt: skip


def test_the_newest_state_of_a_gateway_is_a_row(database: str) -> None:
    columns = "site, gateway, boot, online, reason, version, devices, utc_set, utc_err_ns, mqtt"
    clock = GatewayClock(0, UTC_NS, synchronised=True, error_ns=9)
    write(database, state(1), state(2, clock=clock))
    first = ("mill", "gw", "1", True, "", "0.1.0", ["aft", "bow"], True, 9, {"sent": 2})
    assert query(database, f"SELECT {columns} FROM imud_gateways") == [first]
    write(database, GatewayState(v=1, online=False, boot="1", reason="lost"))
    assert query(database, f"SELECT {columns} FROM imud_gateways") == [
        ("mill", "gw", "1", False, "lost", "0.1.0", ["aft", "bow"], None, None, {"sent": 2})
    ]
    write(database, msgspec.structs.replace(state(3), devices=["mast"], imud="0.2.0"))
    assert query(database, "SELECT version, devices, mqtt FROM imud_gateways") == [("0.2.0", ["mast"], {"sent": 3})]


@pytest.mark.parametrize("from_begin", [False, True])
def test_a_state_adds_the_sent_numbers_to_the_ledger(database: str, *, from_begin: bool) -> None:
    columns = f"boot, begin, newest, whole, missing, sent, {BALANCE}"
    write(database, state(9), from_begin=from_begin)
    begin = 3 if from_begin else 10
    assert ledgers(database, columns) == [("1", begin, begin - 1, 0, 0, 9, 0)], "earlier boots are not in the ledger"
    message = msgspec.structs.replace(samples_message(5, 7), begin=3)
    write(database, message, from_begin=from_begin)
    begin = 3 if from_begin else 5
    expected = ("1", begin, 7, 3, 5 - begin, 9, 0)
    assert ledgers(database, columns) == [expected]
    write(database, state(8), from_begin=from_begin)
    assert ledgers(database, columns) == [expected], "a repeated earlier state changes nothing"
    write(database, samples_message(1, 1, boot="0"), state(20), from_begin=from_begin)
    assert [row[5] for row in ledgers(database, columns)] == [99, 20]


def test_a_state_does_not_change_the_time_of_the_newest_message(database: str) -> None:
    write(database, samples_message(1, 5))
    (before,) = ledgers(database, "updated_at")
    write(database, state(9))
    assert ledgers(database, "updated_at") == [before]
    write(database, samples_message(1, 5))
    assert ledgers(database, "updated_at") > [before]
