"""Collector: writes the batches of all gateways into a store and acknowledges them after the write.

    session ──delivery──▶ ledger ──batch──▶ store.write (one transaction, in a thread) ──▶ acknowledge

A transaction contains the messages of COMMIT_S, at most BATCHES_MAX messages or TURN_BYTES. imud receives the next
messages during the write. A store can keep the ledger, so that a collector recognizes duplicates after a restart. A
collector ends if its store fails. The broker sends messages without an acknowledgement to the next collector.
"""

import asyncio
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple, Protocol, TextIO

import msgspec

from imud.fleet.accounts import Accounts, BootKey, BootOffset, FleetLedger, PlacedTime, StreamKey
from imud.fleet.messages import Interval, MessageKind
from imud.fleet.reader import RECEIVE_MAX, Fleet, FleetBatch, FleetDelivery, FleetSession
from imud.model.units import NS_PER_S

COMMIT_S: Final = 0.5
# Maximum number of messages in one transaction. The broker can send the same number during the transaction.
BATCHES_MAX: Final = RECEIVE_MAX // 2
# Maximum size of the messages in one transaction, bytes. Two transactions are in memory at a time.
TURN_BYTES: Final = 8 << 20
# Number of allocations between two runs of the garbage collector. A transaction of large messages allocates this
# number.
GC_ALLOCATIONS: Final = 100_000


Offsets = Mapping[BootKey, BootOffset]  # clock offsets of boots whose clock is known now


class FleetStore(Protocol):
    """Destination of the batches. Synchronization: one thread at a time."""

    def restore(self, ledger: FleetLedger) -> None:
        """Add the stored ledgers to `ledger`. Raises ServerError."""
        ...

    def write(self, batches: Sequence[FleetBatch], accounts: Accounts, offsets: Offsets) -> None:
        """Store batches, changed ledgers and clock offsets in one transaction. Remove the ledgers that are None. Raises
        ServerError or OSError. Records without UTC time of a boot in `offsets` get their UTC time."""
        ...

    def close(self) -> None:
        """Close the store. A second call does nothing."""
        ...


class _Turn(NamedTuple):
    """Content of one transaction."""

    deliveries: list[FleetDelivery]
    batches: list[FleetBatch]
    accounts: Accounts
    offsets: Offsets


class Selection(NamedTuple):
    """Selected gateways; None selects all."""

    site: str | None = None
    gateway: str | None = None
    device: str | None = None


EVERYTHING: Final = Selection()


class FleetCollector:
    """One run of the collector. Synchronization: one event loop, also for `stop`."""

    def __init__(
        self, fleet: Fleet, store: FleetStore, selection: Selection = EVERYTHING,
    ) -> None:  # fmt: skip
        self.written = 0  # number of stored messages
        self._fleet, self._store, self._selection, self._now_ns = fleet, store, selection, fleet.now_ns
        self._stopped = False

    def stop(self) -> None:
        """End after the present message. `run` stores the received messages first."""
        self._stopped = True

    async def run(self, *, stop_after_s: float | None = None) -> None:
        """Collect until `stop`, or for `stop_after_s`. Raises ServerError or OSError if the store fails."""
        self._store.restore(self._fleet.ledger)
        end_ns = None if stop_after_s is None else self._now_ns() + round(stop_after_s * NS_PER_S)
        site, gateway, device = self._selection
        async with FleetSession(self._fleet, site=site, gateway=gateway, device=device) as session:
            writing: asyncio.Future[None] | None = None
            try:
                while not self._stopped and (end_ns is None or self._now_ns() < end_ns):
                    turn = await self._take(session)
                    if writing is not None:
                        # a cancelled `run` must not stop the write that is running
                        await asyncio.shield(writing)
                    writing = asyncio.ensure_future(self._write(session, turn))
            finally:
                if writing is not None:
                    await writing

    async def _take(self, session: FleetSession) -> _Turn:
        """Receive messages for COMMIT_S."""
        turn = _Turn([], [], {}, {})
        changed: set[StreamKey] = set()
        due_ns = self._now_ns() + round(COMMIT_S * NS_PER_S)
        size = 0
        while len(turn.deliveries) < BATCHES_MAX and size < TURN_BYTES and not self._stopped:
            left_ns = due_ns - self._now_ns()
            if left_ns <= 0:
                break
            delivery = await session.next(left_ns / NS_PER_S)
            if delivery is None:
                continue
            size += len(delivery.payload)
            turn.deliveries.append(delivery)
            batch = self._fleet.take(delivery, changed)
            # None for a state, or a message with duplicates only
            if batch is not None:
                turn.batches.append(batch)
        accounts = {key: self._fleet.ledger.stored(key) for key in sorted(changed)}
        return turn._replace(accounts=accounts, offsets=self._fleet.clocks.take_fresh())

    async def _write(self, session: FleetSession, turn: _Turn) -> None:
        """Store the messages of a turn and acknowledge them."""
        if turn.batches or turn.accounts or turn.offsets:
            await asyncio.to_thread(self._store.write, turn.batches, turn.accounts, turn.offsets)
            self.written += len(turn.batches)
        for delivery in turn.deliveries:
            session.acknowledge(delivery)


NOT_SET: Final = {"utc": "not set"}
_ENCODER: Final = msgspec.json.Encoder()


class JsonLines:
    """Store that prints lines of JSON. Synchronization: see `FleetStore`."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def restore(self, ledger: FleetLedger) -> None:
        """Do nothing: the output does not contain the ledger."""

    def write(self, batches: Sequence[FleetBatch], _accounts: Accounts, offsets: Offsets) -> None:
        """Print all records of the batches, then new clock offsets. Raises OSError."""
        for batch in batches:
            for line in lines_of(batch):
                self._out.write(line + "\n")
        for line in clock_lines(offsets):
            self._out.write(line + "\n")
        self._out.flush()

    def close(self) -> None:
        """Do nothing: the caller closes the output."""


def lines_of(batch: FleetBatch) -> Iterator[str]:
    """Yield the lines of a message. Values that JSON cannot represent (not a number, infinity) are null."""
    message = batch.message
    head: dict[str, object] = {
        "site": batch.site, "gateway": message.gateway, "boot": message.boot, "device": message.device,
        "stream": batch.stream.value,
    }  # fmt: skip
    if message.kind is MessageKind.DROPPED:
        dropped = {"kind": "dropped", "first": message.first, "last": message.last, "cause": message.cause}
        yield _line(head | dropped | _times(batch.time_of_newest()))
    for sample in message.samples:
        yield _line(head | {"kind": "sample"} | _members(sample) | _times(batch.time_of(sample.utc_ns, sample.t_ns)))
    for interval in message.intervals:
        yield _line(head | {"kind": "interval"} | _members(interval) | _interval_times(batch, interval))
    for event in message.events:
        members = _members(event)
        members["event"] = members.pop("kind")
        yield _line(head | {"kind": "event"} | members | _times(batch.time_of(message.utc_ns, event.t_ns)))


def clock_lines(offsets: Offsets) -> Iterator[str]:
    """Yield a line for each boot whose wall clock is known now."""
    for key, offset in sorted(offsets.items()):
        members: dict[str, object] = {"kind": "clock"}
        yield _line(members | key._asdict() | offset._asdict())


def _times(at: PlacedTime) -> dict[str, object]:
    members: dict[str, object] = {"utc_ns": at.utc_ns}
    return members | _clock(at)


def _interval_times(batch: FleetBatch, one: Interval) -> dict[str, object]:
    begin = batch.time_of(one.begin_utc_ns, one.begin_t_ns)
    end = batch.time_of(one.end_utc_ns, one.end_t_ns)
    return {"begin_utc_ns": begin.utc_ns, "end_utc_ns": end.utc_ns} | _clock(begin)


def _clock(at: PlacedTime) -> dict[str, object]:
    if not at.is_set:
        return dict(NOT_SET)
    return {} if at.error_ns is None else {"utc_err_ns": at.error_ns}


def _members(record: msgspec.Struct) -> dict[str, object]:
    """Return the members of a record that are not None."""
    values = ((name, getattr(record, name)) for name in record.__struct_fields__)
    return {name: value for name, value in values if value is not None}


def _line(members: dict[str, object]) -> str:
    return _ENCODER.encode(members).decode()
