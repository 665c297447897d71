"""Ledger of a reader, across the network and restarts, for any order and repetition; UTC time of records."""

from collections import Counter
from typing import Any
from unittest.mock import patch

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.fleet.accounts import (
    BootClocks,
    BootKey,
    BootOffset,
    FleetLedger,
    GatewayState,
    PlacedTime,
    RecentStreams,
    SpoolPositions,
    StreamCounts,
    StreamKey,
    StreamPosition,
    boot_of,
    decode_state,
    key_of,
    offset_of,
    placed,
)
from imud.fleet.connection import FleetDelivery, ReaderConnection
from imud.fleet.messages import (
    VERSION,
    DropCause,
    FleetMessage,
    GatewayClock,
    Interval,
    MessageKind,
    Stream,
    encode_message,
)
from imud.fleet.reader import Fleet
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_S
from tests.fleet.fleet_gateway import UTC_NS, event_message, intervals_message, not_set, samples_message, synchronised
from tests.support.event_loops import VirtualClock

BOOTS_MAX, CLOCK_SET_NS, NUMBER_MOST = 100_000, 1_577_836_800_000_000_000, 1 << 62


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
    counts = counts_of(message(9, 10), message(3, 4), message(5, 9), message(3, 4), message(1, 1), from_begin=False)
    assert counts == StreamCounts(1, 10, whole=9, missing=1, duplicates=3), "the first messages arrive in any order"
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
    counts = counts_of(message(3, 4), message(8, 9), message(4, 4), message(8, 8), message(5, 7), message(5, 7))
    assert counts == StreamCounts(1, 9, whole=7, missing=2, duplicates=5)


RANGES = st.tuples(st.integers(1, 40), st.integers(0, 12)).map(lambda pair: (pair[0], pair[0] + pair[1]))


def test_old_boots_leave_the_ledger_of_the_gateway_with_the_most_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.accounts.STREAMS_MAX", 60)
    ledger = FleetLedger()
    good = [msgspec.structs.replace(message(1, 1), gateway=f"good{n}") for n in range(20)]
    for one in good:
        ledger.take(one, Stream.SAMPLES)
    for boot in range(1000):
        ledger.take(message(1, 1, boot=f"{boot:x}"), Stream.SAMPLES)
    keys = list(ledger.counts)
    assert [key.gateway for key in keys[:20]] == [one.gateway for one in good]
    own = [int(key.boot, 16) for key in keys[20:]]
    assert own == list(range(1000 - len(own), 1000)), "the newest boots stay"
    assert 35 <= len(own) <= 40
    assert ledger.take(good[0], Stream.SAMPLES) is None, "the ledger still recognizes duplicates"


def test_duplicates_are_limited() -> None:
    ledger, long = FleetLedger(), message(1, 1, MessageKind.DROPPED)
    long = msgspec.structs.replace(long, last=NUMBER_MOST - 1)
    for _ in range(9):
        ledger.take(long, Stream.SAMPLES)
    assert ledger.counts[key_of(long, Stream.SAMPLES)].duplicates == NUMBER_MOST


SET = GatewayClock(0, UTC_NS, synchronised=True, error_ns=40)
NOT_SET = GatewayClock(0, 123, synchronised=False)
KNOWN = BootOffset(1_000_000, UTC_NS, 40)


@pytest.mark.parametrize(
    ("utc_ns", "t_ns", "clock", "known", "expected"),
    [
        (UTC_NS + 5, 5, SET, None, PlacedTime(UTC_NS + 5, True, 40)),
        # the time and the offset were read microseconds apart
        (UTC_NS + 9_000, 5, SET, None, PlacedTime(UTC_NS + 9_000, True, 40)),
        (77, 5, SET, None, PlacedTime(UTC_NS + 5, True, 40)),  # the clock stepped after the sample, within one message
        (77, 5, NOT_SET, None, PlacedTime(77, False, None)),
        # systemd set the clock to a wrong time after 2020
        (CLOCK_SET_NS + 5, 5, NOT_SET, None, PlacedTime(CLOCK_SET_NS + 5, False, None)),
        (77, 5_000_000, NOT_SET, KNOWN, PlacedTime(UTC_NS + 5_000_000, True, 40 + 2_000)),  # 4 ms at 500 ppm: 2 us
        (77, None, NOT_SET, KNOWN, PlacedTime(77, False, None)),
        (CLOCK_SET_NS, 5, None, None, PlacedTime(CLOCK_SET_NS, True, None)),  # a gateway with an earlier version
        (CLOCK_SET_NS - 1, 5, None, None, PlacedTime(CLOCK_SET_NS - 1, False, None)),
        (0, 5, None, BootOffset(0, UTC_NS, None), PlacedTime(UTC_NS + 5, True, None)),
    ],
)
def test_utc_time_of_a_record(
    utc_ns: int, t_ns: int | None, clock: GatewayClock | None, known: BootOffset | None, expected: PlacedTime
) -> None:
    assert placed(utc_ns, t_ns, clock, known) == expected


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (synchronised(event_message(1, 5), t_ns=3, error_ns=40), BootOffset(3, UTC_NS, 40)),
        (not_set(samples_message(1, 2)), None), (samples_message(1, 2), BootOffset(2_000_000, UTC_NS, None)),
        (intervals_message(4, 6), BootOffset(4_000_000, UTC_NS, None)), (intervals_message(4, 6, utc_ns=0), None),
        (event_message(1, 5), None),
        (
            intervals_message(4, 6, utc_ns=CLOCK_SET_NS - 4_000_000),
            BootOffset(4_000_000, CLOCK_SET_NS - 4_000_000, None),
        ),
    ],
)  # fmt: skip
def test_clock_offset_of_a_message(message: FleetMessage, expected: BootOffset | None) -> None:
    assert offset_of(message) == expected


def test_a_boot_is_fresh_once_and_the_newest_offset_is_used() -> None:
    clocks = BootClocks()
    assert clocks.take(not_set(samples_message(1, 2))) is None
    assert clocks.take_fresh() == {}
    first = BootOffset(2, UTC_NS, 9)
    assert clocks.take(synchronised(samples_message(3, 4, boot="1-2"), t_ns=2, error_ns=9)) == first
    assert clocks.take_fresh() == {BootKey("gw", "1"): first}
    later = BootOffset(5, UTC_NS, 3)
    assert clocks.take(synchronised(samples_message(5, 6), t_ns=5, error_ns=3)) == later
    assert clocks.take(not_set(samples_message(7, 8))) == later
    assert clocks.take_fresh() == {}
    assert clocks.take(samples_message(1, 2, boot="2", utc_ns=0)) is None
    assert boot_of(samples_message(1, 1, boot="00ff-3")) == BootKey("gw", "00ff"), (
        "a device with a restarted count belongs to the boot"
    )


def test_a_state_contains_the_clock_offset() -> None:
    clocks, state = BootClocks(), GatewayState(v=1, online=True, boot="1", clock=SET)
    clocks.take_state("gw", msgspec.structs.replace(state, clock=NOT_SET))
    clocks.take_state("gw", msgspec.structs.replace(state, clock=None))
    assert clocks.offsets == {}
    clocks.take_state("gw", state)
    assert clocks.take_fresh() == clocks.offsets == {BootKey("gw", "1"): BootOffset(0, UTC_NS, 40)}
    clocks = BootClocks()
    for number in range(BOOTS_MAX + 1):
        clocks.take_state(f"gw-{number}", state)
    assert len(clocks.offsets) == BOOTS_MAX
    assert BootKey("gw-0", "1") not in clocks.offsets
    assert BootKey(f"gw-{BOOTS_MAX}", "1") in clocks.offsets
    assert len(clocks.take_fresh()) == BOOTS_MAX, "a reader may never take the offsets"


KEY = StreamKey("gw", "1", "bow", "samples")


def state(last: int, boot: str = "1") -> GatewayState:
    return GatewayState(v=1, online=True, boot=boot, positions=[StreamPosition(boot, "bow", "samples", 1, last)])


def account_of(positions: SpoolPositions, ledger: FleetLedger) -> tuple[int, int, int]:
    """Return the numbers that the gateway sent, the reader received, and the spool contains."""
    account = positions.accounts(ledger)[KEY]
    assert account.balance == 0
    return account.sent, account.received, account.in_spool


def test_the_spooled_numbers_follow_the_states() -> None:
    positions, ledger = SpoolPositions(), FleetLedger()
    positions.take("gw", state(40))
    assert account_of(positions, ledger) == (0, 0, 0)
    positions.take("gw", state(50))
    assert account_of(positions, ledger) == (10, 0, 10)
    ledger.take(message(31, 40), Stream.SAMPLES)
    assert account_of(positions, ledger) == (20, 10, 10)
    positions = SpoolPositions(from_begin=True)
    positions.take("gw", state(40))
    assert account_of(positions, FleetLedger()) == (40, 0, 40)
    positions, ledger = SpoolPositions(), FleetLedger()
    ledger.take(message(1, 30), Stream.SAMPLES)
    positions.take("gw", state(50))
    positions.take("gw", state(20))
    assert account_of(positions, ledger) == (50, 30, 20)
    positions.take("gw", state(7, "2"))
    account = positions.accounts(ledger)[KEY._replace(boot="2")]
    assert (account.sent, account.in_spool) == (0, 0), "a reboot has its own account"


DEEP = b'{"v":1,"online":true,"boot":"1","mqtt":{"deep":' + b"[" * 100_000


@pytest.mark.parametrize("payload", [b"", b"[]", b'{"v":1}', b'{"v":1,"online":1,"boot":"1"}', b"\xff", DEEP])
def test_invalid_payloads_are_rejected(payload: bytes) -> None:
    with pytest.raises(ValueError, match="expected the state of a gateway"):
        decode_state(payload)
    assert decode_state(b'{"v":1,"online":false,"boot":"ab","reason":"lost"}').reason == "lost", "a will is a state"


TOO_MUCH = 1 << 62


@pytest.mark.parametrize(
    "bad",
    [
        msgspec.structs.replace(state(3), boot="x" * 65), msgspec.structs.replace(state(3), reason="\0"),
        msgspec.structs.replace(state(3), clock=GatewayClock(TOO_MUCH, 0, synchronised=True)),
        msgspec.structs.replace(state(3), clock=GatewayClock(0, -TOO_MUCH, synchronised=True)),
        msgspec.structs.replace(state(3), clock=GatewayClock(0, 0, synchronised=True, error_ns=TOO_MUCH)),
        msgspec.structs.replace(state(3), positions=[StreamPosition("", "bow", "samples", 1, 2)]), state(TOO_MUCH),
    ],
)  # fmt: skip
def test_values_that_no_database_can_store_are_rejected(bad: GatewayState) -> None:
    with pytest.raises(ValueError, match="expected"):
        decode_state(msgspec.json.encode(bad))
    assert decode_state(msgspec.json.encode(state(TOO_MUCH - 1)))


KINDS = st.sampled_from([MessageKind.SAMPLES, MessageKind.DROPPED, MessageKind.INTERVALS])
MESSAGES = st.tuples(st.sampled_from(["1", "2"]), RANGES, KINDS)
STATES = st.tuples(st.sampled_from(["1", "2"]), st.integers(1, 60))


@given(st.lists(st.one_of(MESSAGES, STATES)))
def test_the_ledger_balances_for_any_sequence(steps: list[tuple[Any, ...]]) -> None:
    ledger, positions = FleetLedger(from_begin=True), SpoolPositions(from_begin=True)
    seen: dict[str, set[int]] = {"1": set(), "2": set()}
    newest: dict[str, int] = {}

    def take(boot: str, span: tuple[int, int], kind: MessageKind) -> None:
        fresh = ledger.take(message(*span, kind, boot=boot), Stream.SAMPLES)
        new = set(range(span[0], span[1] + 1)) - seen[boot]
        assert (fresh is None) == (not new)
        if fresh is not None and kind is MessageKind.SAMPLES:
            assert [one.seq for one in fresh.samples] == sorted(new)
        seen[boot] |= new

    for step in steps:
        if len(step) == 3:
            take(*step)
        else:
            boot, position = step
            positions.take("gw", state(position, boot))
            newest[boot] = max(position, newest.get(boot, 0))
        for key, told in positions.accounts(ledger).items():
            numbers = seen[key.boot]
            assert (told.balance, told.sent) == (0, max(numbers | {newest.get(key.boot, 0)}))
            assert told.counts.missing == max(numbers, default=0) - len(numbers)
            assert told.in_spool == max(0, newest.get(key.boot, 0) - max(numbers, default=0))


@given(st.permutations([(first, first + 2) for first in range(1, 43, 3)]), st.booleans())
def test_late_numbers_of_gaps_that_are_not_stored_are_new(spans: list[tuple[int, int]], from_begin: bool) -> None:
    """Shares of a fleet can differ by more messages than a ledger stores gaps."""
    with patch("imud.fleet.accounts.RANGES_MAX", 2):
        ledger, delivered = FleetLedger(from_begin=from_begin), Counter[int]()
        for span in spans:
            fresh = ledger.take(message(*span), Stream.SAMPLES)
            delivered.update(one.seq for one in (fresh.samples if fresh is not None else []))
            (counts,) = ledger.counts.values()
            assert counts.balance == 0
        assert delivered == Counter(range(1, 43))
        assert counts == StreamCounts(1, 42, whole=42)
        assert ledger.take(message(1, 42), Stream.SAMPLES) is None, (
            "without missing numbers, all numbers are duplicates"
        )


def test_the_number_of_positions_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.accounts.POSITIONS_MAX", 2)
    positions = SpoolPositions(from_begin=True)
    for boot in ("1", "2", "1", "3"):
        positions.take("gw", state(5, boot))
    assert [key.boot for key in positions.accounts(FleetLedger())] == ["1", "3"]


DAY_NS = 24 * 3600 * NS_PER_S
BOOTS = [f"{number}" for number in range(1, 8)]
# a message with the next number, a message after a gap, a fill of the gaps, or a state with a number that is not sent
STEPS = st.lists(
    st.tuples(st.sampled_from(BOOTS), st.sampled_from(["next", "gap", "fill", "state"]), st.integers(0, 5))
)


def delivery_of(fleet: Fleet, content: FleetMessage | GatewayState) -> FleetDelivery:
    if isinstance(content, GatewayState):
        topic, payload = "imud/mill/gw/state", msgspec.json.encode(content)
    else:
        topic, payload = "imud/mill/gw/bow/samples", encode_message(content)
    return FleetDelivery(topic, payload, False, 0, ReaderConnection(fleet.brokers[0]))


@given(STEPS, st.integers(1, 4))
def test_complete_boots_leave_the_memory_and_other_boots_do_not(
    steps: list[tuple[str, str, int]], keep: int
) -> None:  # fmt: skip
    """Compare the reader with sets of numbers of each boot. A step has a boot, a message, and a pause in days."""
    clock = VirtualClock()
    fleet = Fleet("mqtt://broker", from_begin=True, now_ns=clock.now_ns)
    fleet.keep_boots = keep
    seen: dict[str, set[int]] = {}  # numbers of each boot in memory, oldest boot first
    ends: dict[str, int] = {}
    at_ns: dict[str, int] = {}
    removed = incomplete = 0
    for boot, kind, days in steps:
        clock.advance(days * DAY_NS)
        is_new = boot not in seen
        numbers = seen[boot] = seen.pop(boot, set())
        newest = max(numbers, default=0)
        at_ns[boot] = clock.now_ns()
        if kind == "state":
            ends[boot] = max(newest + 1, ends.get(boot, 0))
            fleet.take(delivery_of(fleet, state(ends[boot], boot)))
        else:
            first, last = {"next": (newest + 1,) * 2, "gap": (newest + 3,) * 2, "fill": (1, newest + 1)}[kind]
            batch = fleet.take(delivery_of(fleet, message(first, last, MessageKind.DROPPED, boot=boot)))
            assert (batch is not None) == (not set(range(first, last + 1)) <= numbers)
            numbers |= set(range(first, last + 1))
        for old in list(seen)[:-keep] if is_new else ():
            is_complete = len(seen[old]) == max(seen[old], default=0) >= ends.get(old, 0)
            if is_complete or clock.now_ns() - at_ns[old] > 7 * DAY_NS:
                removed, incomplete = removed + 1, incomplete + (not is_complete)
                del seen[old]
                ends.pop(old, None)
        assert {key.boot for key in fleet.accounts} == set(seen)
        assert all(one.balance == 0 for one in fleet.accounts.values())
    assert (fleet.expired_boots, fleet.expired_incomplete) == (removed, incomplete)


def test_the_memory_of_boots_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.reader.INCOMPLETE_MAX", 5)
    fleet = Fleet("mqtt://broker", from_begin=True)
    for number in range(40):
        fleet.take(delivery_of(fleet, synchronised(message(5, 5, boot=f"{number:x}"))))
    assert [key.boot for key in fleet.accounts] == [f"{number:x}" for number in range(25, 40)]
    assert {key.boot for key in fleet.offsets} == {key.boot for key in fleet.accounts}
    assert (fleet.expired_boots, fleet.expired_incomplete) == (25, 25)
    fleet.take(delivery_of(fleet, message(5, 5, boot="27-2")))
    assert len(fleet.accounts) == 16, "a restarted device belongs to its boot"


RECENT = st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 6), st.integers(1, 4)))


@given(RECENT, st.integers(1, 20))
def test_the_limit_removes_streams_of_the_oldest_boot_of_the_largest_gateway(
    uses: list[tuple[str, int, int]], most: int
) -> None:
    recent, model, removed = RecentStreams(most), list[StreamKey](), 0
    for gateway, boot, device in uses:
        key = StreamKey(gateway, f"{boot}", f"{device}", "samples")
        own = [one for one in model if one[:2] == key[:2]]
        model = [one for one in model if one[:2] != key[:2]] + (own if key in own else [*own, key])
        before = Counter(one.gateway for one in model)
        gone = recent.use(key)
        if gone:
            assert len(model) == most + 1
            assert before[gone[0].gateway] == max(before.values())
            assert list(gone) == [one for one in model if one.gateway == gone[0].gateway][: len(gone)]
            assert key not in gone
        model = [one for one in model if one not in gone]
        removed += len(gone)
        boots = {BootKey(*one[:2]) for one in model}
        assert [one for boot in sorted(boots) for one in recent.streams_of(boot)] == sorted(
            model, key=lambda one: BootKey(*one[:2])
        )
    assert recent.removed == removed
    for old in {BootKey(*one[:2]) for one in model}:
        assert set(recent.forget(old)) == {one for one in model if one[:2] == old}
        assert recent.streams_of(old) == ()


def test_the_size_of_the_stored_states_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.reader.STATES_BYTES", 100)
    fleet = Fleet("mqtt://broker")
    payload = b'{"v":1,"online":true,"boot":"1"}'  # 32 bytes
    for name in ("a", "b", "a", "c", "d", "b"):
        fleet.take(FleetDelivery(f"imud/site/{name}/state", payload, True, 0, ReaderConnection(fleet.brokers[0])))
    assert [gateway for _, gateway in fleet.states] == ["c", "d", "b"]
