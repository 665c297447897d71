"""Ledger of a reader: it balances after each message, for any order and any repetition."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.fleet.accounts import FleetLedger, StreamCounts, StreamKey, key_of
from imud.fleet.messages import NUMBER_MOST, VERSION, DropCause, FleetMessage, Interval, MessageKind, Stream
from imud.model.sample import Sample, Sync


def message(first: int, last: int, kind: MessageKind = MessageKind.SAMPLES, *, boot: str = "1") -> FleetMessage:
    samples = [Sample("bow", seq, seq, 0, Sync.ARRIVAL, seq, seq) for seq in range(first, last + 1)]
    return FleetMessage(
        v=VERSION, gateway="gw", boot=boot, device="bow", kind=kind, begin=1, first=first, last=last,
        count=last - first + 1, utc_ns=0, cause=DropCause.SPACE if kind is MessageKind.DROPPED else None,
        samples=samples if kind is MessageKind.SAMPLES else [],
        intervals=[Interval(first, last, 1, 0, 0, 0, 0, 0, Sync.ARRIVAL, {})] if kind is MessageKind.INTERVALS else [],
    )  # fmt: skip


def counts_of(*messages: FleetMessage, stream: Stream = Stream.SAMPLES, from_begin: bool = True) -> StreamCounts:
    ledger = FleetLedger(from_begin=from_begin)
    for one in messages:
        ledger.take(one, stream)
    (counts,) = ledger.counts.values()
    assert counts.balance == 0
    return counts


def test_each_number_counts_once_and_is_delivered_once() -> None:
    dropped, intervals = MessageKind.DROPPED, MessageKind.INTERVALS
    counts = counts_of(message(1, 10), message(11, 20, intervals), message(21, 25, dropped), message(28, 30))
    assert counts == StreamCounts(1, 30, whole=13, thinned=10, dropped={"space": 5}, missing=2)
    assert counts_of(message(1, 4, intervals), stream=Stream.STATISTICS) == StreamCounts(1, 4, whole=4)
    counts = counts_of(message(1, 10), message(5, 20, dropped))
    assert counts == StreamCounts(1, 20, whole=10, dropped={"space": 10}, duplicates=6)
    counts = counts_of(message(1, 2), message(9, 10), message(4, 6))
    assert counts == StreamCounts(1, 10, whole=7, missing=3), "missing samples can arrive later"
    assert counts_of(message(7, 8), from_begin=False) == StreamCounts(7, 8, whole=2)
    assert counts_of(message(7, 8)) == StreamCounts(1, 8, whole=2, missing=6)
    ledger = FleetLedger()
    assert ledger.take(message(1, 10), Stream.SAMPLES) is not None
    assert ledger.take(message(1, 10), Stream.SAMPLES) is None
    partly = ledger.take(message(8, 12), Stream.SAMPLES)
    assert partly is not None
    assert [one.seq for one in partly.samples] == [11, 12]
    (counts,) = ledger.counts.values()
    assert counts == StreamCounts(1, 12, whole=12, duplicates=13)
    ledger.take(message(1, 3, boot="2"), Stream.SAMPLES)
    assert [one.whole for one in ledger.counts.values()] == [12, 3]


def test_a_duplicate_fills_no_gap() -> None:
    counts = counts_of(message(3, 4), message(8, 9), message(4, 4), message(8, 8), message(5, 7), message(5, 7))
    assert counts == StreamCounts(1, 9, whole=7, missing=2, duplicates=5)


RANGES = st.tuples(st.integers(1, 40), st.integers(0, 12)).map(lambda pair: (pair[0], pair[0] + pair[1]))


@given(
    st.lists(
        st.tuples(RANGES, st.sampled_from([MessageKind.SAMPLES, MessageKind.DROPPED, MessageKind.INTERVALS])),
        min_size=1,
    )
)
def test_the_ledger_balances_for_any_sequence_of_messages(taken: list[tuple[tuple[int, int], MessageKind]]) -> None:
    ledger = FleetLedger(from_begin=True)
    seen: set[int] = set()
    for (first, last), kind in taken:
        fresh = ledger.take(message(first, last, kind), Stream.SAMPLES)
        new = set(range(first, last + 1)) - seen
        assert (fresh is None) == (not new)
        if fresh is not None and kind is MessageKind.SAMPLES:
            assert {one.seq for one in fresh.samples} == new
        seen |= new
        (counts,) = ledger.counts.values()
        assert counts.balance == 0
        assert counts.missing == max(seen) - len(seen)


def test_old_boots_leave_the_ledger_of_the_gateway_with_the_most_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.accounts.STREAMS_MAX", 60)
    ledger, changed = FleetLedger(), set[StreamKey]()
    good = [msgspec.structs.replace(message(1, 1), gateway=f"good{n}") for n in range(20)]
    for one in good:
        ledger.take(one, Stream.SAMPLES, changed)
    for boot in range(1000):
        ledger.take(message(1, 1, boot=f"{boot:x}"), Stream.SAMPLES, changed)
    keys = list(ledger.counts)
    assert [key.gateway for key in keys[:20]] == [one.gateway for one in good]
    own = [int(key.boot, 16) for key in keys[20:]]
    assert own == list(range(1000 - len(own), 1000)), "the newest boots stay"
    assert 35 <= len(own) <= 40
    assert len(changed) == 1020
    assert {key for key in changed if ledger.stored(key) is not None} == set(keys)
    assert ledger.take(good[0], Stream.SAMPLES) is None, "the ledger still recognizes duplicates"


def test_the_sum_of_duplicates_is_limited() -> None:
    ledger, long = FleetLedger(), message(1, 1, MessageKind.DROPPED)
    long = msgspec.structs.replace(long, last=NUMBER_MOST - 1)
    for _ in range(9):
        ledger.take(long, Stream.SAMPLES)
    assert ledger.counts[key_of(long, Stream.SAMPLES)].duplicates == NUMBER_MOST
    assert msgspec.json.encode(ledger.stored(key_of(long, Stream.SAMPLES)))
