"""The ledger of a reader: every number of every stream is whole, thinned, dropped by the gateway, or missing.

    whole + thinned + dropped + missing = newest - begin + 1        duplicates are counted beside it

Numbers of a stream come in order. A message may come again, as a whole or with others (a note of what was dropped can
cover numbers whose message had come though its acknowledgement was lost): what is known already is a duplicate.
"""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import msgspec

from imud.formats.fleet.messages import FleetMessage, MessageKind
from imud.formats.fleet.topics import Stream

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
