"""What goes into one recording: its devices as soon as they are there, checks, events, and what was lost on the way.

    source ──begin, records, check──▶ feed.put ──▶ queue of a thread that writes them

Every recording has a feed and a queue of its own: one that is slow loses nothing of another.
"""

import platform
from collections.abc import Collection
from typing import Any, Final

from imud import __version__
from imud.contracts.control.recording import PutRecord
from imud.contracts.publisher import PublisherContext
from imud.event import Event
from imud.formats.recording import records
from imud.formats.recording.records import NO_DEVICE, EndRecord, Kind, LostRecord, SessionRecord
from imud.publishers.recorder.writer import RecordQueue
from imud.units import NS_PER_S

CHECK_NS: Final = NS_PER_S
"""The newest sample and the ledger of each device are recorded so often: a replay is compared with them."""
BEGIN_NS: Final = 2_000_000
"""Describing devices takes so long in one tick, but for the last of them; the state of one takes 0.6 ms. The others
follow in the next ticks: samples do not wait for a recording that begins."""


class RecordFeed:
    """Feed of one recording. Synchronization: the event loop's thread only."""

    def __init__(
        self, context: PublisherContext, queue: RecordQueue[Any], devices: Collection[str] | None = None
    ) -> None:
        """`devices` are the names of those that are recorded, None for all."""
        self._context = context
        self._source = context.recording
        self._queue = queue
        self._put: PutRecord = queue.put
        self._devices = devices
        self._ids: dict[str, int] = {}
        self._recorded: set[str] = set()
        self._due: set[str] = set()
        """Those of them that are still to be described again."""
        self._checked_ns = 0
        self._dropped = (0, 0)
        """Records and bytes that were dropped and stand in the recording as such."""
        self._lost_ns = 0

    # --- devices -----------------------------------------------------------------------------------------------------

    def add_device(self, name: str, device_id: int) -> None:
        """Note the device: it is recorded from the next `follow` on, when it is there."""
        self._ids[name] = device_id

    def remove_device(self, name: str) -> None:
        """Forget a device that left the configuration, or is made anew."""
        self._ids.pop(name, None)
        self._recorded.discard(name)
        self._due.discard(name)

    def follow(self) -> None:
        """Begin to record devices that are new, and describe those again that are due."""
        now_ns = self._context.now_ns
        end_ns = now_ns() + BEGIN_NS
        for name in self._source.names():
            if (name not in self._recorded or name in self._due) and self.wants(name):
                self._recorded.add(name)
                self._due.discard(name)
                self._source.begin(name, self._put)
                if now_ns() >= end_ns:
                    return

    def describe(self, *, at_once: bool) -> None:
        """Record the host's clocks and the state of each device as they are now.

        Without `at_once` devices are described by the next calls of `follow`: for a place where a replay can go on from
        what it has of them before.
        """
        self._source.begin_host(self._put)
        if not at_once:
            self._due |= self._recorded
            return
        self._due.clear()
        for name in sorted(self._recorded):
            self._source.begin(name, self._put)

    # --- records -----------------------------------------------------------------------------------------------------

    def session(self, number: int, now_ns: int) -> bytes:
        """Return the record that a file begins with."""
        context = self._context
        host = f"{platform.node()}, {platform.system()} {platform.release()} {platform.machine()}"
        utc_ns = now_ns + context.utc_offset_ns()
        python = platform.python_version()
        session = SessionRecord(
            records.VERSION, __version__, python, host, context.epoch, number, now_ns, utc_ns
        )  # fmt: skip
        return records.encode_object(Kind.SESSION, NO_DEVICE, session)

    def ending(self, reason: str) -> bytes:
        """Return the record that a file ends with."""
        now_ns = self._context.now_ns()
        end = EndRecord(now_ns, now_ns + self._context.utc_offset_ns(), reason)
        return records.encode_object(Kind.END, NO_DEVICE, end)

    def put(self, record: bytes) -> None:
        """Record something else."""
        self._put(record)

    def event(self, event: Event) -> None:
        """Record an event of a device that is recorded, or of the daemon itself."""
        if not event.device or self.wants(event.device):
            device = self._ids.get(event.device, NO_DEVICE)
            self._put(records.encode_object(Kind.EVENT, device, event))

    def check(self) -> None:
        """Record the newest sample and the ledger of each device."""
        for name in sorted(self._recorded - self._due):
            self._source.check(name, self._put)

    def check_if_due(self, now_ns: int) -> bool:
        """Record them once in CHECK_NS; return whether that was now."""
        if now_ns - self._checked_ns < CHECK_NS:
            return False
        self._checked_ns = now_ns
        self.check()
        return True

    def note_losses(self, now_ns: int) -> int:
        """Record what was dropped as soon as there is room again, and the states after it; return how many records."""
        if self._queue.dropped == self._dropped[0]:
            return 0
        self._lost_ns = self._lost_ns or now_ns
        if not self._queue.is_easy:
            return 0
        lost = self._new_losses(now_ns)
        self._put(records.encode_lost(lost))
        self.describe(at_once=True)
        return lost.records

    def finish(self, reason: str) -> bytes:
        """Record the last checks, and nothing any more; return the records that end the recording, losses included."""
        if self._queue.dropped == self._dropped[0]:
            self.check()
        self.stop()
        lost = self._new_losses(self._context.now_ns())
        return (records.encode_lost(lost) if lost.records else b"") + self.ending(reason)

    def _new_losses(self, now_ns: int) -> LostRecord:
        """Return what was dropped and does not stand in the recording, and take it for noted."""
        queue, (noted, noted_bytes) = self._queue, self._dropped
        lost = LostRecord(queue.dropped - noted, queue.dropped_bytes - noted_bytes, self._lost_ns or now_ns)
        self._dropped, self._lost_ns = (queue.dropped, queue.dropped_bytes), 0
        return lost

    def stop(self) -> None:
        """Record nothing any more; a `follow` begins again."""
        self._source.end(self._put)
        self._recorded.clear()
        self._due.clear()

    def wants(self, name: str) -> bool:
        """Whether a device is to be recorded."""
        return self._devices is None or name in self._devices
