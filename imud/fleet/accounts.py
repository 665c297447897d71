"""The ledger of a reader: every number of every stream is whole, thinned, dropped by the gateway, or missing.

    whole + thinned + dropped + missing = newest - begin + 1        duplicates are counted beside it

Numbers of a stream come in order. A message may come again, as a whole or with others (a note of what was dropped can
cover numbers whose message had come though its acknowledgement was lost): what is known already is a duplicate.
"""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import msgspec

from imud.fleet.messages import (
    FleetMessage,
    GatewayClock,
    MessageKind,
    Stream,
    check_boot,
    check_numbers,
    checked_json,
    clock_numbers,
)
from imud.model.units import NS_PER_MS, NS_PER_S

RANGES_MAX: Final = 1000
"""Ranges of missing numbers that are kept, to be filled; older ones stay missing."""
STREAMS_MAX: Final = 100_000
"""Streams of all gateways and boots; beyond it a reader raises instead of growing without end."""


class StreamKey(NamedTuple):
    """What the numbers of a stream count in."""

    gateway: str
    boot: str
    device: str
    stream: str


def key_of(message: FleetMessage, stream: Stream) -> StreamKey:
    """What the numbers of a message count in."""
    return StreamKey(message.gateway, message.boot, message.device, stream.value)


class StreamCounts(msgspec.Struct):
    """The account of one stream, in numbers: samples by `seq`, or events."""

    begin: int
    newest: int
    """The highest number that any message covered."""
    whole: int = 0
    """Came as they were; of the stream `statistics`: came in intervals as declared."""
    thinned: int = 0
    """Came as statistics because the spool had no room for more."""
    dropped: dict[str, int] = {}  # msgspec copies a mutable default
    """Dropped by the gateway, by cause."""
    missing: int = 0
    """No message has covered them."""
    duplicates: int = 0
    """Came again."""

    @property
    def balance(self) -> int:
        """0: the account closes."""
        covered = self.whole + self.thinned + sum(self.dropped.values()) + self.missing
        return self.newest - self.begin + 1 - covered


class StoredAccount(msgspec.Struct, frozen=True):
    """The account of one stream as it is kept: a reader that was restarted goes on with it."""

    counts: StreamCounts
    gaps: list[tuple[int, int]]
    """First and last of each range that is missing and may still come."""


Accounts = Mapping[StreamKey, StoredAccount]
"""Accounts as they are kept, by stream."""


class _Account:
    """The account of one stream, with the ranges that are missing."""

    def __init__(self, counts: StreamCounts, gaps: Sequence[tuple[int, int]] = ()) -> None:
        self.counts = counts
        self._gaps = list(gaps)

    def stored(self) -> StoredAccount:
        """A copy that does not change any more."""
        return StoredAccount(msgspec.structs.replace(self.counts, dropped=dict(self.counts.dropped)), list(self._gaps))

    def take(self, message: FleetMessage, stream: Stream) -> list[tuple[int, int]]:
        """Enter a message; return the ranges of numbers that are new."""
        counts = self.counts
        fresh = self._filled(message.first, min(message.last, counts.newest))
        if message.last > counts.newest:
            first = max(message.first, counts.newest + 1)
            if first > counts.newest + 1:
                self._gaps.append((counts.newest + 1, first - 1))
                counts.missing += first - 1 - counts.newest
                del self._gaps[:-RANGES_MAX]
            fresh.append((first, message.last))
            counts.newest = message.last
        number = sum([last - first + 1 for first, last in fresh])
        counts.duplicates += message.last - message.first + 1 - number
        if message.kind is MessageKind.DROPPED:
            cause = message.cause.value if message.cause is not None else "unknown"
            counts.dropped[cause] = counts.dropped.get(cause, 0) + number
        elif message.kind is MessageKind.INTERVALS and stream is Stream.SAMPLES:
            counts.thinned += number
        else:
            counts.whole += number
        return fresh

    def _filled(self, first: int, last: int) -> list[tuple[int, int]]:
        """Take what is in a range out of what is missing; return it."""
        found, left = [], []
        for begin, end in self._gaps:
            low, high = max(begin, first), min(end, last)
            if low > high:
                left.append((begin, end))
                continue
            found.append((low, high))
            self.counts.missing -= high - low + 1
            left += [one for one in ((begin, low - 1), (high + 1, end)) if one[0] <= one[1]]
        self._gaps = left
        return found


class FleetLedger:
    """The accounts of all streams that a reader sees. Synchronization: one thread."""

    def __init__(self, *, from_begin: bool = False) -> None:
        """`from_begin`: numbers before the first message that comes are missing; without, the account begins there."""
        self._from_begin = from_begin
        self._accounts: dict[StreamKey, _Account] = {}

    @property
    def counts(self) -> Mapping[StreamKey, StreamCounts]:
        """The account of each stream."""
        return {key: account.counts for key, account in self._accounts.items()}

    def stored(self, key: StreamKey) -> StoredAccount:
        """The account of a stream, to be kept. Raises KeyError for one of which nothing came."""
        return self._accounts[key].stored()

    def restore(self, key: StreamKey, account: StoredAccount) -> None:
        """Go on with an account that was kept. Raises OverflowError beyond STREAMS_MAX streams."""
        if key not in self._accounts and len(self._accounts) >= STREAMS_MAX:
            raise OverflowError(f"expected at most {STREAMS_MAX} streams, got one more: {key}")
        self._accounts[key] = _Account(account.counts, account.gaps)

    def take(self, message: FleetMessage, stream: Stream) -> FleetMessage | None:
        """Enter a message; return what of it is new, None for nothing. Raises OverflowError beyond STREAMS_MAX streams.

        Statistics that are partly new are returned as they are.
        """
        key = key_of(message, stream)
        account = self._accounts.get(key)
        if account is None:
            if len(self._accounts) >= STREAMS_MAX:
                raise OverflowError(f"expected at most {STREAMS_MAX} streams, got one more: {key}")
            begin = message.begin if self._from_begin else message.first
            account = self._accounts[key] = _Account(StreamCounts(begin, begin - 1))
        fresh = account.take(message, stream)
        if not fresh:
            return None
        if fresh == [(message.first, message.last)] or not message.samples:
            return message
        samples = [one for one in message.samples if any(first <= one.seq <= last for first, last in fresh)]
        return msgspec.structs.replace(message, samples=samples)


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


CLOCK_SET_NS: Final = 1_577_836_800 * NS_PER_S
"""2020: of a message that does not speak of the clock, because it was made by an earlier version, a `utc_ns` before it
is of a clock that is not set."""
STEP_NS: Final = NS_PER_MS
"""A `utc_ns` that is further from the offset in its message was made before the clock was stepped: offsets are read
within microseconds."""
DRIFT: Final = 2000
"""500 ppm: the kernel's own bound of how far a clock that nothing keeps is off in frequency (adjtimex(2))."""
BOOTS_MAX: Final = 100_000
"""Boots whose offset is kept; the oldest go first. As many as there may be streams."""


class BootKey(NamedTuple):
    """A start of the daemon of a gateway."""

    gateway: str
    boot: str
    """Without the number of a device that was made anew."""


class BootOffset(NamedTuple):
    """The wall clock of a boot, from a moment at which it was synchronised."""

    t_ns: int
    """CLOCK_MONOTONIC of that moment."""
    utc_offset_ns: int
    """CLOCK_REALTIME less CLOCK_MONOTONIC."""
    utc_err_ns: int | None
    """One-sigma error of it; None where the gateway does not say."""

    def error_at(self, t_ns: int) -> int | None:
        """The error of a time that is placed by it."""
        return None if self.utc_err_ns is None else self.utc_err_ns + abs(t_ns - self.t_ns) // DRIFT


class PlacedTime(NamedTuple):
    """Where a record lies on UTC."""

    utc_ns: int
    is_set: bool
    """Whether that is so; otherwise it is only what a clock said that nothing had set."""
    error_ns: int | None
    """One-sigma error of the clock; None where it is not known."""


def boot_of(message: FleetMessage) -> BootKey:
    """The boot of a message."""
    return BootKey(message.gateway, message.boot.partition("-")[0])


def offset_of(message: FleetMessage) -> BootOffset | None:
    """What a message says of the wall clock of its boot; None while the clock is not set."""
    if message.clock is not None:
        return _offset(message.clock)
    pairs = [(one.t_ns, one.utc_ns) for one in message.samples[-1:]]
    pairs += [(one.begin_t_ns, one.begin_utc_ns) for one in message.intervals[-1:]]
    for t_ns, utc_ns in pairs:
        if utc_ns >= CLOCK_SET_NS:
            return BootOffset(t_ns, utc_ns - t_ns, None)
    return None


def placed(utc_ns: int, t_ns: int | None, clock: GatewayClock | None, known: BootOffset | None) -> PlacedTime:
    """Where a record of a message lies. `clock` is that of the message, `known` what is known of the boot now.

    `t_ns` is None where the message does not say it.
    """
    if clock is None and utc_ns >= CLOCK_SET_NS:
        return PlacedTime(utc_ns, True, None)
    if clock is not None and clock.synchronised:
        if t_ns is not None and abs(utc_ns - t_ns - clock.utc_offset_ns) > STEP_NS:
            utc_ns = t_ns + clock.utc_offset_ns
        return PlacedTime(utc_ns, True, clock.error_ns)
    if known is not None and t_ns is not None:
        return PlacedTime(t_ns + known.utc_offset_ns, True, known.error_at(t_ns))
    return PlacedTime(utc_ns, False, None)


class BootClocks:
    """What is known of the wall clocks of all boots. Synchronization: one thread."""

    def __init__(self) -> None:
        self._known: dict[BootKey, BootOffset] = {}
        self._fresh: dict[BootKey, BootOffset] = {}

    @property
    def offsets(self) -> Mapping[BootKey, BootOffset]:
        """The newest offset of each boot whose clock was synchronised."""
        return self._known

    def take(self, message: FleetMessage) -> BootOffset | None:
        """Note what a message says; return what is known of its boot."""
        key = boot_of(message)
        self._note(key, offset_of(message))
        return self._known.get(key)

    def take_state(self, gateway: str, state: GatewayState) -> None:
        """Note what a state says."""
        if state.clock is not None:
            self._note(BootKey(gateway, state.boot), _offset(state.clock))

    def take_fresh(self) -> Mapping[BootKey, BootOffset]:
        """Offsets of boots of which none was known the last time."""
        fresh, self._fresh = self._fresh, {}
        return fresh

    def _note(self, key: BootKey, offset: BootOffset | None) -> None:
        if offset is None:
            return
        if key not in self._known:
            self._fresh[key] = offset
            while len(self._known) >= BOOTS_MAX:
                oldest = next(iter(self._known))
                del self._known[oldest]
                self._fresh.pop(oldest, None)
        self._known[key] = offset


def _offset(clock: GatewayClock) -> BootOffset | None:
    return BootOffset(clock.t_ns, clock.utc_offset_ns, clock.error_ns) if clock.synchronised else None
