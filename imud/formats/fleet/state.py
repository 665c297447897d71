"""States of gateways, and accounts across the network: what a gateway says it has spooled against what has come.

    sent = received + dropped by cause + missing + in the spool        duplicates are counted beside it

`sent` is what the gateway has numbered: its retained state has, for each stream, the last number that is in its spool
or past it. A state can be older than what came since; the higher of both numbers counts.
"""

from collections.abc import Mapping
from typing import Final

import msgspec

from imud.formats.fleet.ledger import FleetLedger, StreamCounts, StreamKey
from imud.formats.fleet.messages import GatewayClock, check_boot, check_numbers, checked_json, clock_numbers

POSITIONS_MAX: Final = 100_000
"""Streams of which a state may have spoken; beyond it a reader raises instead of growing without end."""


class StreamPosition(msgspec.Struct, frozen=True):
    """How far a stream of a boot has come into the spool of its gateway."""

    boot: str
    device: str
    stream: str
    begin: int
    last: int


class GatewayState(msgspec.Struct, frozen=True, kw_only=True):
    """What is retained of a gateway: birth, death or last will."""

    v: int
    online: bool
    boot: str
    imud: str = ""
    """Version."""
    reason: str = ""
    """Why it is not online."""
    devices: list[str] = []  # msgspec copies a mutable default
    positions: list[StreamPosition] = []
    clock: GatewayClock | None = None
    """Its wall clock; None of one that is not online, or of a version that did not say."""
    mqtt: dict[str, object] = {}
    """Counters of the output, as `imud status --json` has them."""


class StreamAccount(msgspec.Struct, frozen=True):
    """The account of one stream between gateway and reader, in numbers: samples by `seq`, or events."""

    sent: int
    """Numbered by the gateway since `begin` of the reader's account."""
    in_spool: int
    """Of these, not sent yet or on the way."""
    counts: StreamCounts

    @property
    def received(self) -> int:
        """Came as they were, or as statistics in their place."""
        return self.counts.whole + self.counts.thinned

    @property
    def balance(self) -> int:
        """0: the account closes."""
        gaps = sum(self.counts.dropped.values()) + self.counts.missing
        return self.sent - self.received - gaps - self.in_spool


class SpoolPositions:
    """What gateways said last of their streams. Synchronization: one thread."""

    def __init__(self, *, from_begin: bool = False) -> None:
        """`from_begin`: what a stream had when a state first spoke of it is to come, too; else it is not counted."""
        self._from_begin = from_begin
        self._positions: dict[StreamKey, StreamPosition] = {}
        self._begins: dict[StreamKey, int] = {}
        """Where the account of a stream begins as long as nothing of it has come."""

    def take(self, gateway: str, state: GatewayState) -> None:
        """Note what a state says. Raises OverflowError beyond POSITIONS_MAX streams."""
        for one in state.positions:
            key = StreamKey(gateway, one.boot, one.device, one.stream)
            known = self._positions.get(key)
            if known is None and len(self._positions) >= POSITIONS_MAX:
                raise OverflowError(f"expected at most {POSITIONS_MAX} streams in states, got one more: {key}")
            if known is None:
                self._begins[key] = one.begin if self._from_begin else one.last + 1
            if known is None or one.last > known.last:
                self._positions[key] = one

    def accounts(self, ledger: FleetLedger) -> Mapping[StreamKey, StreamAccount]:
        """The account of every stream that a message or a state has named."""
        counts = dict(ledger.counts)
        for key, begin in self._begins.items():
            counts.setdefault(key, StreamCounts(begin, begin - 1))
        found = {}
        for key, count in counts.items():
            position = self._positions.get(key)
            last = count.newest if position is None else max(position.last, count.newest)
            found[key] = StreamAccount(last - count.begin + 1, last - count.newest, count)
        return found


_STATE: Final = msgspec.json.Decoder(GatewayState)


def decode_state(payload: bytes) -> GatewayState:
    """The state in a payload. Raises ValueError for anything else."""
    try:
        state = _STATE.decode(checked_json(payload))
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"expected the state of a gateway, got {len(payload)} other bytes") from error
    check_numbers(clock_numbers(state.clock))
    for boot in (state.boot, *(one.boot for one in state.positions)):
        check_boot(boot)
    for one in state.positions:
        check_numbers((one.begin, one.last))
    return state
