"""Ledger of a reader: each number of a stream is whole, thinned, dropped by the gateway, or missing.

    whole + thinned + dropped + missing = newest - begin + 1        (duplicates are a separate counter)

A gateway sends the numbers of a stream in order, but several collectors receive them in any order. A gateway can send a
message again, alone or as part of a message with the kind `dropped`, if it did not receive the acknowledgement. Numbers
that the ledger already contains count as duplicates.
"""

from collections.abc import Mapping, Sequence
from itertools import chain, islice
from typing import Final, NamedTuple, Self

import msgspec

from imud.fleet.messages import (
    CLOCK_SET_NS,
    NUMBER_MOST,
    FleetMessage,
    GatewayClock,
    MessageKind,
    Stream,
    check_boot,
    check_numbers,
    checked_json,
    clock_numbers,
)
from imud.model.units import NS_PER_MS

# Maximum number of stored gaps per stream. The ledger cannot distinguish late numbers of older gaps from duplicates. It
# accepts all of them: a store with a primary key does not store a row twice.
RANGES_MAX: Final = 1000
# Maximum number of streams of all gateways and boots: 1,000 gateways with 3 streams and 33 boots
STREAMS_MAX: Final = 100_000


class StreamKey(NamedTuple):
    """Key of a stream. Sequence numbers are unique within a stream."""

    gateway: str
    boot: str
    device: str
    stream: str


def key_of(message: FleetMessage, stream: Stream) -> StreamKey:
    return StreamKey(message.gateway, message.boot, message.device, stream.value)


class StreamCounts(msgspec.Struct):
    """Ledger of one stream, in numbers: `seq` of samples, or number of events."""

    begin: int
    newest: int  # highest number that a message covered
    whole: int = 0  # numbers of complete samples; in the stream `statistics`, numbers of declared intervals
    thinned: int = 0  # numbers that arrived as statistics because the spool was full
    # Numbers that the gateway dropped, by cause
    dropped: dict[str, int] = {}  # msgspec copies a mutable default
    missing: int = 0  # numbers that no message covers
    duplicates: int = 0  # numbers that arrived again; at most NUMBER_MOST

    @property
    def balance(self) -> int:
        """Return the difference of both sides of the equation; 0 if the ledger balances."""
        covered = self.whole + self.thinned + sum(self.dropped.values()) + self.missing
        return self.newest - self.begin + 1 - covered


class StreamLedger:
    """Ledger of one stream with its gaps."""

    def __init__(self, counts: StreamCounts, gaps: Sequence[tuple[int, int]] = ()) -> None:
        self.counts = counts
        self.gaps = list(gaps)  # first and last number of each gap that a later message can fill

    @classmethod
    def before(cls, message: FleetMessage, *, from_begin: bool) -> Self:
        """Return an empty ledger for the first message of a stream. With `from_begin`, earlier numbers are missing."""
        begin = message.begin if from_begin else message.first
        return cls(StreamCounts(begin, begin - 1))

    def take(self, message: FleetMessage, stream: Stream) -> FleetMessage | None:
        """Add a message. Return its new part, None for a duplicate. If only a part of a message with statistics is new,
        return the complete message."""
        fresh = self._fresh(message, stream)
        if not fresh:
            return None
        if fresh == [(message.first, message.last)] or not message.samples:
            return message
        samples = [one for one in message.samples if any(first <= one.seq <= last for first, last in fresh)]
        return msgspec.structs.replace(message, samples=samples)

    def _fresh(self, message: FleetMessage, stream: Stream) -> list[tuple[int, int]]:
        """Add a message. Return the ranges of new numbers."""
        counts = self.counts
        # missing numbers without a stored gap; their gaps are older than all stored gaps
        unknown = counts.missing - _numbers_of(self.gaps) if counts.missing else 0
        if message.first < counts.begin:
            # several collectors receive the first messages of a stream in any order
            earlier = counts.begin - message.first
            if unknown:
                unknown += earlier
            else:
                self.gaps.insert(0, (message.first, counts.begin - 1))
            counts.missing += earlier
            counts.begin = message.first
        last = min(message.last, counts.newest)
        late = (message.first, min(last, self.gaps[0][0] - 1 if self.gaps else last))
        fresh = self._filled(message.first, last)
        if message.last > counts.newest:
            # a gap before the message
            first = max(message.first, counts.newest + 1)
            if first > counts.newest + 1:
                self.gaps.append((counts.newest + 1, first - 1))
                counts.missing += first - 1 - counts.newest
            fresh.append((first, message.last))
            counts.newest = message.last
        del self.gaps[:-RANGES_MAX]
        number = _numbers_of(fresh)
        if unknown and late[0] <= late[1]:
            found = min(_numbers_of([late]), unknown)
            counts.missing -= found
            number += found
            fresh.insert(0, late)
        # the part that is not new
        counts.duplicates = min(counts.duplicates + message.last - message.first + 1 - number, NUMBER_MOST)
        if message.kind is MessageKind.DROPPED:
            cause = message.cause.value if message.cause is not None else "unknown"
            counts.dropped[cause] = counts.dropped.get(cause, 0) + number
        elif message.kind is MessageKind.INTERVALS and stream is Stream.SAMPLES:
            counts.thinned += number
        else:
            counts.whole += number
        return fresh

    def _filled(self, first: int, last: int) -> list[tuple[int, int]]:
        """Remove a range from the gaps. Return the removed parts."""
        found, left = [], []
        for begin, end in self.gaps:
            low, high = max(begin, first), min(end, last)
            if low > high:
                left.append((begin, end))
                continue
            found.append((low, high))
            self.counts.missing -= high - low + 1
            left += [one for one in ((begin, low - 1), (high + 1, end)) if one[0] <= one[1]]
        self.gaps = left
        return found


def _numbers_of(ranges: Sequence[tuple[int, int]]) -> int:
    return sum([last - first + 1 for first, last in ranges])


class BootKey(NamedTuple):
    """Key of one start of a gateway's daemon."""

    gateway: str
    boot: str  # boot without the suffix `-N` of a device that restarted its counter


class RecentStreams:
    """Streams in the order of the use of their boots, with a maximum number. Synchronization: one thread.

    A sender of many streams must not remove the streams of other gateways. If there are too many streams, the gateway
    with the most streams loses the streams of its oldest boots.
    """

    def __init__(self, most: int) -> None:
        self.removed = 0  # number of streams that left because there were too many
        self._most = most
        self._count = 0
        # streams by gateway and boot, oldest boot first
        self._by_gateway: dict[str, dict[BootKey, dict[StreamKey, None]]] = {}
        self._sizes: dict[str, int] = {}  # number of streams of each gateway, oldest gateway first

    def use(self, key: StreamKey) -> Sequence[StreamKey]:
        """Make the boot of a stream the newest. Return the streams that are removed because there are too many."""
        boots = self._by_gateway.setdefault(key.gateway, {})
        boot = _boot_of(key)
        own = boots[boot] = boots.pop(boot, {})
        is_new = key not in own
        self._sizes[key.gateway] = self._sizes.pop(key.gateway, 0) + is_new
        own[key] = None
        self._count += is_new
        return () if self._count <= self._most else self._shrink()

    def _shrink(self) -> Sequence[StreamKey]:
        """Remove old streams of the gateway with the most streams."""
        largest = max(self._sizes, key=self._sizes.__getitem__)
        # several at a time: the search for the largest takes 3 ms for 100,000 gateways
        removed = list(islice(chain.from_iterable(self._by_gateway[largest].values()), 1 + self._sizes[largest] // 20))
        for one in removed:
            self._remove(one)
        self.removed += len(removed)
        return removed

    def _remove(self, key: StreamKey) -> None:
        boots, boot = self._by_gateway[key.gateway], _boot_of(key)
        del boots[boot][key]
        self._count -= 1
        self._sizes[key.gateway] -= 1
        if not boots[boot]:
            del boots[boot]
        if not boots:
            del self._by_gateway[key.gateway], self._sizes[key.gateway]

    def streams_of(self, boot: BootKey) -> Sequence[StreamKey]:
        """Return the streams of a boot."""
        return tuple(self._by_gateway.get(boot.gateway, {}).get(boot, ()))

    def forget(self, boot: BootKey) -> Sequence[StreamKey]:
        """Remove the streams of a boot. Return them."""
        removed = self.streams_of(boot)
        for one in removed:
            self._remove(one)
        return removed


def _boot_of(key: StreamKey) -> BootKey:
    return BootKey(key.gateway, key.boot.partition("-")[0])


class FleetLedger:
    """Ledgers of all streams of a reader. Synchronization: one thread."""

    def __init__(self, *, from_begin: bool = False) -> None:
        """Create an empty ledger. With `from_begin`, numbers before the first received message count as missing."""
        self._from_begin = from_begin
        self._accounts: dict[StreamKey, StreamLedger] = {}
        self._recent = RecentStreams(STREAMS_MAX)

    @property
    def counts(self) -> Mapping[StreamKey, StreamCounts]:
        """Return the counters of each stream."""
        return {key: account.counts for key, account in self._accounts.items()}

    @property
    def removed_streams(self) -> int:
        """Return the number of streams that left the ledger because it had more than STREAMS_MAX streams."""
        return self._recent.removed

    def take(self, message: FleetMessage, stream: Stream) -> FleetMessage | None:
        """Add a message. Return its new part, see `StreamLedger.take`."""
        key = key_of(message, stream)
        for one in self._recent.use(key):
            self._accounts.pop(one, None)
        account = self._accounts.get(key)
        if account is None:
            account = self._accounts[key] = StreamLedger.before(message, from_begin=self._from_begin)
        return account.take(message, stream)

    def of_boot(self, boot: BootKey) -> Mapping[StreamKey, StreamCounts]:
        """Return the counters of each stream of a boot."""
        return {key: self._accounts[key].counts for key in self._recent.streams_of(boot)}

    def forget(self, boot: BootKey) -> None:
        """Remove the streams of a boot."""
        for key in self._recent.forget(boot):
            del self._accounts[key]


# Maximum number of streams in the states of all gateways
POSITIONS_MAX: Final = 100_000


class StreamPosition(msgspec.Struct, frozen=True):
    """Newest number of a stream of one boot that reached the spool of its gateway."""

    boot: str
    device: str
    stream: str
    begin: int
    last: int


class GatewayState(msgspec.Struct, frozen=True, kw_only=True):
    """Retained state of a gateway: birth, death or last will."""

    v: int
    online: bool
    boot: str
    imud: str = ""  # version of imud
    reason: str = ""  # reason of an offline gateway
    devices: list[str] = []  # msgspec copies a mutable default
    positions: list[StreamPosition] = []
    clock: GatewayClock | None = None  # wall clock; None if the gateway is offline or its version does not send it
    mqtt: dict[str, object] = {}  # counters of the output `mqtt`, as in `imud status --json`
    # Interval of the states of the gateway, s; None if its version does not send it
    status_s: float | None = None


class StreamAccount(msgspec.Struct, frozen=True):
    """Ledger of one stream between gateway and reader, in numbers: `seq` of samples, or number of events."""

    sent: int  # numbers that the gateway assigned since `begin` of the reader's ledger
    in_spool: int  # numbers in the spool or on the way to the reader
    counts: StreamCounts

    @property
    def received(self) -> int:
        """Return the numbers that arrived as complete samples or as statistics."""
        return self.counts.whole + self.counts.thinned

    @property
    def balance(self) -> int:
        """Return the difference of both sides of the equation; 0 if the ledger balances."""
        gaps = sum(self.counts.dropped.values()) + self.counts.missing
        return self.sent - self.received - gaps - self.in_spool


class SpoolPositions:
    """Newest stream positions of all gateways. Synchronization: one thread."""

    def __init__(self, *, from_begin: bool = False) -> None:
        """With `from_begin`, numbers before the first state of a stream count as not yet received."""
        self._from_begin = from_begin
        self._positions: dict[StreamKey, StreamPosition] = {}
        self._recent = RecentStreams(POSITIONS_MAX)
        self._begins: dict[StreamKey, int] = {}  # first number of the ledger of each stream without a message

    def take(self, gateway: str, state: GatewayState) -> None:
        """Store the positions of a state."""
        for one in state.positions:
            key = StreamKey(gateway, one.boot, one.device, one.stream)
            known = self._positions.get(key)
            for old in self._recent.use(key):
                self._positions.pop(old, None)
                self._begins.pop(old, None)
            if known is None:
                self._begins[key] = one.begin if self._from_begin else one.last + 1
            if known is None or one.last > known.last:
                self._positions[key] = one

    def is_complete(self, boot: BootKey, ledger: FleetLedger) -> bool:
        """Return whether all numbers of a boot arrived: none is missing or in the spool."""
        counts = ledger.of_boot(boot)
        if any(one.missing for one in counts.values()):
            return False
        for key in self._recent.streams_of(boot):
            position = self._positions[key]
            if position.last > (counts[key].newest if key in counts else position.begin - 1):
                return False
        return True

    def forget(self, boot: BootKey) -> None:
        """Remove the positions of a boot."""
        for key in self._recent.forget(boot):
            del self._positions[key], self._begins[key]

    def accounts(self, ledger: FleetLedger) -> Mapping[StreamKey, StreamAccount]:
        """Return the ledger of each stream that appeared in a message or a state."""
        counts = dict(ledger.counts)
        for key, begin in self._begins.items():
            counts.setdefault(key, StreamCounts(begin, begin - 1))
        found = {}
        for key, count in counts.items():
            # the gateway sends its state less often than messages: a message can have a higher number
            position = self._positions.get(key)
            last = count.newest if position is None else max(position.last, count.newest)
            found[key] = StreamAccount(last - count.begin + 1, last - count.newest, count)
        return found


_STATE: Final = msgspec.json.Decoder(GatewayState)


def decode_state(payload: bytes) -> GatewayState:
    """Return the state of a payload. Raises ValueError if the payload is invalid."""
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


# Maximum deviation of `utc_ns` from the clock in its message, ns. A larger deviation means a step of the clock after
# the sample. The gateway reads the clock within microseconds.
STEP_NS: Final = NS_PER_MS
# Divisor for the drift, 500 ppm: maximum frequency error that the kernel assumes for an unsynchronized clock
# (adjtimex(2))
DRIFT: Final = 2000
# Maximum number of boots with a stored offset, equal to STREAMS_MAX. imud removes the oldest.
BOOTS_MAX: Final = 100_000


class BootOffset(NamedTuple):
    """Offset of the wall clock of a boot at a moment with a synchronized clock."""

    t_ns: int  # CLOCK_MONOTONIC of the reading
    utc_offset_ns: int  # CLOCK_REALTIME minus CLOCK_MONOTONIC
    utc_err_ns: int | None  # One-sigma error of the offset; None if the gateway does not send it

    def error_at(self, t_ns: int) -> int | None:
        """Return the one-sigma error of the UTC time at `t_ns`."""
        return None if self.utc_err_ns is None else self.utc_err_ns + abs(t_ns - self.t_ns) // DRIFT


class PlacedTime(NamedTuple):
    """UTC time of a record."""

    utc_ns: int
    is_set: bool  # False if the clock of the gateway was not set. Then `utc_ns` is only the value of that clock.
    error_ns: int | None  # One-sigma error of the clock; None if it is unknown


def boot_of(message: FleetMessage) -> BootKey:
    return BootKey(message.gateway, message.boot.partition("-")[0])


def offset_of(message: FleetMessage) -> BootOffset | None:
    """Return the clock offset in a message; None if the clock is not set."""
    if message.clock is not None:
        return clock_offset(message.clock)
    pairs = [(one.t_ns, one.utc_ns) for one in message.samples[-1:]]
    pairs += [(one.begin_t_ns, one.begin_utc_ns) for one in message.intervals[-1:]]
    for t_ns, utc_ns in pairs:
        # the sum with a time of another message must fit into 64 bits
        if utc_ns >= CLOCK_SET_NS and abs(utc_ns - t_ns) < NUMBER_MOST:
            return BootOffset(t_ns, utc_ns - t_ns, None)
    return None


def placed(utc_ns: int, t_ns: int | None, clock: GatewayClock | None, known: BootOffset | None) -> PlacedTime:
    """Return the UTC time of a record. `clock` is the clock of its message, `known` the newest offset of its boot.
    `t_ns` is None if the message does not contain it."""
    if clock is None and utc_ns >= CLOCK_SET_NS:
        return PlacedTime(utc_ns, True, None)
    if clock is not None and clock.synchronised:
        # the clock stepped between the sample and the message: use the offset of the message
        if t_ns is not None and abs(utc_ns - t_ns - clock.utc_offset_ns) > STEP_NS:
            utc_ns = t_ns + clock.utc_offset_ns
        return PlacedTime(utc_ns, True, clock.error_ns)
    if known is not None and t_ns is not None:
        return PlacedTime(t_ns + known.utc_offset_ns, True, known.error_at(t_ns))
    return PlacedTime(utc_ns, False, None)


class BootClocks:
    """Clock offsets of all boots. Synchronization: one thread."""

    def __init__(self) -> None:
        self._known: dict[BootKey, BootOffset] = {}
        self._fresh: dict[BootKey, BootOffset] = {}

    @property
    def offsets(self) -> Mapping[BootKey, BootOffset]:
        """Return the newest offset of each boot whose clock was synchronized."""
        return self._known

    def take(self, message: FleetMessage) -> BootOffset | None:
        """Store the clock offset of a message. Return the newest offset of its boot."""
        key = boot_of(message)
        self._note(key, offset_of(message))
        return self._known.get(key)

    def take_state(self, gateway: str, state: GatewayState) -> None:
        """Store the clock offset of a state."""
        if state.clock is not None:
            self._note(BootKey(gateway, state.boot), clock_offset(state.clock))

    def forget(self, boot: BootKey) -> None:
        """Remove the offset of a boot."""
        self._known.pop(boot, None)

    def take_fresh(self) -> Mapping[BootKey, BootOffset]:
        """Return the first offsets of boots since the last call."""
        fresh, self._fresh = self._fresh, {}
        return fresh

    def _note(self, key: BootKey, offset: BootOffset | None) -> None:
        if offset is None:
            return
        if key not in self._known:
            self._fresh[key] = offset
            # a dict iterates in insertion order: the first key is the oldest
            while len(self._known) >= BOOTS_MAX:
                oldest = next(iter(self._known))
                del self._known[oldest]
                self._fresh.pop(oldest, None)
        self._known[key] = offset


def clock_offset(clock: GatewayClock) -> BootOffset | None:
    """Return the offset of a wall clock; None if the clock is not set."""
    return BootOffset(clock.t_ns, clock.utc_offset_ns, clock.error_ns) if clock.synchronised else None


# Number of boots of a gateway with missing numbers that stay. A false sender can send any number of boots.
INCOMPLETE_MAX: Final = 1000


class GatewayBoots:
    """Boots of all gateways in the order of their newest message. Synchronization: one thread."""

    def __init__(self) -> None:
        self._by_gateway: dict[str, dict[BootKey, int]] = {}  # time of the newest message or state, ns

    def use(self, boot: BootKey, now_ns: int, keep: int) -> Mapping[BootKey, int]:
        """Make a boot the newest. If it is new, return the boots before the newest `keep`, oldest first, with the time
        of their newest message; otherwise an empty mapping."""
        own = self._by_gateway.pop(boot.gateway, {})
        is_new = own.pop(boot, None) is None
        own[boot] = now_ns
        self._by_gateway[boot.gateway] = own
        while len(self._by_gateway) > BOOTS_MAX:
            del self._by_gateway[next(iter(self._by_gateway))]
        return dict(islice(own.items(), max(len(own) - keep, 0))) if is_new else {}

    def forget(self, boot: BootKey) -> None:
        """Remove a boot."""
        self._by_gateway[boot.gateway].pop(boot, None)
