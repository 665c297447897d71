"""Collector: writes the messages of all gateways into a store and acknowledges them after the write.

    session ──deliveries──▶ store.write (one transaction with the ledger, in a thread) ──▶ acknowledge

A transaction contains the messages of COMMIT_S, at most BATCHES_MAX messages or TURN_BYTES. imud receives the next
messages during the write. The store decides where the ledger is: a database contains its ledger, so that any collector
recognizes duplicates. For other stores, `LedgerStore` keeps the ledger in memory. A collector ends if its store fails.
The broker sends messages without an acknowledgement to the next collector.
"""

import asyncio
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from threading import Lock
from typing import Final, NamedTuple, Protocol, TextIO

import msgspec

from imud.fleet.accounts import BootKey, BootOffset, PlacedTime
from imud.fleet.connection import RECEIVE_MAX, FleetDelivery
from imud.fleet.messages import Interval, MessageKind
from imud.fleet.reader import WHOLE, Fleet, FleetBatch, FleetSession, Share
from imud.host.log import printable_json
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
    """Destination of the messages. Synchronization: one thread at a time."""

    def write(self, deliveries: Sequence[FleetDelivery]) -> None:
        """Store messages. The sequence can be empty. Raises ServerError or OSError."""
        ...

    def close(self) -> None:
        """Close the store. A second call does nothing."""
        ...


class BatchStore(Protocol):
    """Destination without a ledger. Synchronization: one thread at a time."""

    def write(self, batches: Sequence[FleetBatch], offsets: Offsets) -> None:
        """Store batches, then new clock offsets. Raises ServerError or OSError."""
        ...

    def close(self) -> None:
        """Close the store. A second call does nothing."""
        ...


class LedgerStore:
    """Store that keeps the ledger in the memory of a reader. Synchronization: see `FleetStore`."""

    def __init__(self, fleet: Fleet, to: BatchStore) -> None:
        self._fleet, self.to = fleet, to

    def write(self, deliveries: Sequence[FleetDelivery]) -> None:
        """Add messages to the ledger and write their new parts. Raises ServerError or OSError."""
        batches = [batch for one in deliveries if (batch := self._fleet.take(one)) is not None]
        offsets = self._fleet.clocks.take_fresh()
        if batches or offsets:
            self.to.write(batches, offsets)

    def close(self) -> None:
        """Close the destination. A second call does nothing."""
        self.to.close()


class Selection(NamedTuple):
    """Selected gateways; None selects all."""

    site: str | None = None
    gateway: str | None = None
    device: str | None = None


EVERYTHING: Final = Selection()


def session_of(fleet: Fleet, selection: Selection, share: Share) -> FleetSession:
    """Return the session of a share. Raises BadArgument if a name or the share is invalid."""
    site, gateway, device = selection
    return FleetSession(fleet, site=site, gateway=gateway, device=device, share=share)


class TransactionTimes:
    """Histogram of the durations of transactions. Synchronization: none required."""

    BOUNDS_S: Final = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)  # upper bounds of the buckets, s

    def __init__(self) -> None:
        self._lock = Lock()
        self._counts = [0] * (len(self.BOUNDS_S) + 1)
        self._sum_s = 0.0

    def add(self, seconds: float) -> None:
        """Count a completed transaction with its duration, s."""
        with self._lock:
            self._counts[bisect_left(self.BOUNDS_S, seconds)] += 1
            self._sum_s += seconds

    def read(self) -> tuple[list[int], float]:
        """Return the number of transactions in each bucket, and the sum of the durations, s."""
        with self._lock:
            return list(self._counts), self._sum_s


class FleetCollector:
    """One run of the collector. Synchronization: one event loop, also for `stop`."""

    def __init__(
        self, fleet: Fleet, store: FleetStore, selection: Selection = EVERYTHING, share: Share = WHOLE,
        times: TransactionTimes | None = None,
    ) -> None:  # fmt: skip
        """`times` receives the durations of transactions. Raises BadArgument if a name of the selection or the share
        is invalid."""
        self.session = session_of(fleet, selection, share)
        self.write_start_ns: int | None = None  # start of the present transaction; None without one
        self.is_drained = False  # True after `run` of a surplus share that received all waiting messages
        self._store, self._now_ns, self._times = store, fleet.now_ns, times or TransactionTimes()
        self._stopped = False

    def stop(self) -> None:
        """End after the present message. `run` stores the received messages first."""
        self._stopped = True

    async def run(self, *, stop_after_s: float | None = None) -> None:
        """Collect until `stop`, or for `stop_after_s`. Raises ServerError or OSError if the store fails."""
        end_ns = None if stop_after_s is None else self._now_ns() + round(stop_after_s * NS_PER_S)
        async with self.session as session:
            writing: asyncio.Future[None] | None = None
            try:
                while not (self._stopped or self.is_drained) and (end_ns is None or self._now_ns() < end_ns):
                    turn = await self._take(session)
                    if writing is not None:
                        # a cancelled `run` must not stop the write that is running
                        await asyncio.shield(writing)
                    writing = asyncio.ensure_future(self._write(session, turn))
                    self.is_drained = session.is_drained
            finally:
                if writing is not None:
                    await writing

    async def _take(self, session: FleetSession) -> list[FleetDelivery]:
        """Receive messages for COMMIT_S."""
        turn: list[FleetDelivery] = []
        due_ns = self._now_ns() + round(COMMIT_S * NS_PER_S)
        size = 0
        while len(turn) < BATCHES_MAX and size < TURN_BYTES and not self._stopped:
            left_ns = due_ns - self._now_ns()
            if left_ns <= 0:
                break
            delivery = await session.next(left_ns / NS_PER_S)
            if delivery is not None:
                size += len(delivery.payload)
                turn.append(delivery)
        return turn

    async def _write(self, session: FleetSession, turn: Sequence[FleetDelivery]) -> None:
        """Store the messages of a turn and acknowledge them."""
        begin_ns = self._now_ns()
        self.write_start_ns = begin_ns
        try:
            await asyncio.to_thread(self._store.write, turn)
        finally:
            self.write_start_ns = None
        if turn:
            self._times.add((self._now_ns() - begin_ns) / NS_PER_S)
        for delivery in turn:
            session.acknowledge(delivery)


NOT_SET: Final = {"utc": "not set"}


class JsonLines:
    """Store that prints lines of JSON. Synchronization: see `BatchStore`."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def write(self, batches: Sequence[FleetBatch], offsets: Offsets) -> None:
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
    return printable_json(members)
