"""Ledger across the network: spooled numbers of gateways and received numbers, in any order and after restarts."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.fleet.accounts import (
    FleetLedger,
    GatewayState,
    SpoolPositions,
    StoredAccount,
    StreamCounts,
    StreamKey,
    StreamPosition,
    decode_state,
)
from imud.fleet.messages import GatewayClock, MessageKind, Stream
from imud.fleet.reader import Fleet, FleetDelivery, ReaderConnection
from tests.fleet.test_accounts import message

KEY = StreamKey("gw", "1", "bow", "samples")


def state(last: int, boot: str = "1") -> GatewayState:
    return GatewayState(v=1, online=True, boot=boot, positions=[StreamPosition(boot, "bow", "samples", 1, last)])


def account_of(positions: SpoolPositions, ledger: FleetLedger) -> tuple[int, int, int]:
    """Return the numbers that the gateway sent, the reader received, and the spool contains."""
    account = positions.accounts(ledger)[KEY]
    assert account.balance == 0
    return account.sent, account.received, account.in_spool


def test_numbers_spooled_before_the_first_state_count_only_with_from_begin() -> None:
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


def test_an_old_state_does_not_reduce_the_positions() -> None:
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
        msgspec.structs.replace(state(3), boot="x" * 65),
        msgspec.structs.replace(state(3), reason="\0"),
        msgspec.structs.replace(state(3), clock=GatewayClock(TOO_MUCH, 0, synchronised=True)),
        msgspec.structs.replace(state(3), clock=GatewayClock(0, -TOO_MUCH, synchronised=True)),
        msgspec.structs.replace(state(3), clock=GatewayClock(0, 0, synchronised=True, error_ns=TOO_MUCH)),
        msgspec.structs.replace(state(3), positions=[StreamPosition("", "bow", "samples", 1, 2)]),
        state(TOO_MUCH),
    ],
)
def test_values_that_no_database_can_store_are_rejected(bad: GatewayState) -> None:
    with pytest.raises(ValueError, match="expected"):
        decode_state(msgspec.json.encode(bad))
    assert decode_state(msgspec.json.encode(state(TOO_MUCH - 1)))


RANGES = st.tuples(st.integers(1, 40), st.integers(0, 12)).map(lambda pair: (pair[0], pair[0] + pair[1]))
KINDS = st.sampled_from([MessageKind.SAMPLES, MessageKind.DROPPED, MessageKind.INTERVALS])
MESSAGES = st.tuples(st.sampled_from(["1", "2"]), RANGES, KINDS)
STATES = st.tuples(st.sampled_from(["1", "2"]), st.integers(1, 60))


@given(st.lists(st.one_of(MESSAGES, STATES, st.just("restart"), st.just("killed"))))
def test_the_ledger_balances_for_any_sequence_and_any_number_of_restarts(steps: list[object]) -> None:
    ledger, positions = FleetLedger(from_begin=True), SpoolPositions(from_begin=True)
    seen: dict[str, set[int]] = {"1": set(), "2": set()}
    given_out: dict[str, list[int]] = {"1": [], "2": []}
    stored: dict[StreamKey, bytes] = {}
    newest: dict[str, int] = {}
    last: tuple[str, tuple[int, int], MessageKind] | None = None

    def take(boot: str, span: tuple[int, int], kind: MessageKind) -> None:
        fresh = ledger.take(message(*span, kind, boot=boot), Stream.SAMPLES)
        if fresh is not None and kind is MessageKind.SAMPLES:
            given_out[boot] += [one.seq for one in fresh.samples]
        seen[boot] |= set(range(span[0], span[1] + 1))
        stored[KEY._replace(boot=boot)] = msgspec.json.encode(ledger.stored(KEY._replace(boot=boot)))

    for step in steps:
        if step in ("restart", "killed"):
            ledger, positions = FleetLedger(from_begin=True), SpoolPositions(from_begin=True)
            newest.clear()
            for key, account in stored.items():
                ledger.restore(key, msgspec.json.decode(account, type=StoredAccount))
            if step == "killed" and last is not None:
                take(*last)
        elif isinstance(step, tuple) and len(step) == 3:
            last = step
            take(*step)
        else:
            assert isinstance(step, tuple)
            boot, position = step
            positions.take("gw", state(position, boot))
            newest[boot] = max(position, newest.get(boot, 0))
        for key, told in positions.accounts(ledger).items():
            numbers = seen[key.boot]
            assert (told.balance, told.sent) == (0, max(numbers | {newest.get(key.boot, 0)}))
            assert told.counts.missing == max(numbers, default=0) - len(numbers)
            assert told.in_spool == max(0, newest.get(key.boot, 0) - max(numbers, default=0))
    for seqs in given_out.values():
        assert len(seqs) == len(set(seqs))


def test_the_number_of_positions_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.accounts.POSITIONS_MAX", 2)
    positions = SpoolPositions(from_begin=True)
    for boot in ("1", "2", "1", "3"):
        positions.take("gw", state(5, boot))
    assert [key.boot for key in positions.accounts(FleetLedger())] == ["1", "3"]


def test_a_stored_ledger_does_not_change() -> None:
    ledger = FleetLedger()
    ledger.take(message(1, 4, MessageKind.DROPPED), Stream.SAMPLES)
    stored = ledger.stored(KEY)
    ledger.take(message(5, 9, MessageKind.DROPPED), Stream.SAMPLES)
    assert stored == StoredAccount(StreamCounts(1, 4, dropped={"space": 4}), [])


def test_the_size_of_the_stored_states_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.reader.STATES_BYTES", 100)
    fleet = Fleet("mqtt://broker")
    payload = b'{"v":1,"online":true,"boot":"1"}'  # 32 bytes
    for name in ("a", "b", "a", "c", "d", "b"):
        fleet.take(FleetDelivery(f"imud/site/{name}/state", payload, True, 0, ReaderConnection(fleet.brokers[0])))
    assert [gateway for _, gateway in fleet.states] == ["c", "d", "b"]
