"""Writer of one topic: its newest samples, its readers, and the samples that readers request again.

    write ──▶ one datagram per destination: INFO_TS, DATA, HEARTBEAT ──▶ ACKNACK of a reliable reader ──▶ DATA again

A writer keeps its newest DEPTH samples for readers that request them again. Nothing waits for a reader.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from imud.formats import rtps
from imud.formats.rtps import Locator, ReceivedAckNack
from imud.publishers.ros2.network import RtpsNetwork

DEPTH: Final = 10  # samples for retransmission, the depth of the sensor data of ROS 2
DESTINATIONS_MAX: Final = 64  # maximum number of addresses and ports to which a writer sends each sample
ADDRESS_DESTINATIONS_MAX: Final = 16  # maximum number of ports of one address: programs of one host that read a topic
REPEAT_BYTES: Final = 1400  # maximum size of a datagram with several repeated samples, below the MTU of Ethernet


@dataclass(slots=True)
class MatchedReader:
    """Reader that receives the samples of a writer."""

    guid: bytes
    where: Locator
    is_reliable: bool
    start: int = 1  # first sequence number for this reader
    acked: int = 0  # the reader has all samples up to this sequence number
    counted: int = 0  # requested samples up to this sequence number are counted as dropped if they are gone
    turn: int = 0  # turn of `repeated`
    repeated: set[int] = field(default_factory=set)  # sequence numbers that the reader got again in this turn
    is_announced: bool = False  # whether the reader got a reply without samples in this turn


class RtpsWriter:
    """Writer of one topic."""

    def __init__(self, network: RtpsNetwork, entity: bytes, topic: str, type_name: str, *, is_kept: bool) -> None:
        """`is_kept`: later readers also receive the kept samples (TRANSIENT_LOCAL), otherwise only new samples."""
        self._network = network
        self.entity, self.topic, self.type_name, self.is_kept = entity, topic, type_name, is_kept
        self.depth: int | None = 1 if is_kept else DEPTH  # None: samples of a key replace each other
        self.kept: dict[int, bytes] = {}  # DATA submessages by sequence number
        self.last = 0  # newest sequence number
        self.sent = self.dropped = 0
        self.readers: dict[bytes, MatchedReader] = {}
        self.destinations_max = DESTINATIONS_MAX
        self.ports_max = ADDRESS_DESTINATIONS_MAX
        self._destinations: dict[Locator, int] = {}  # with the number of readers
        self._count = 0

    def write(self, payload: bytes, utc_ns: int) -> None:
        """Send a sample to all readers."""
        if len(payload) > rtps.PAYLOAD_MAX:
            self.dropped += len(self.readers)
            return
        message = rtps.info_ts(utc_ns) + self.keep(payload)
        first, self._count = next(iter(self.kept)), self._count + 1
        message += rtps.heartbeat(self.entity, first, self.last, self._count, final=True)
        for where, count in self._destinations.items():
            if self._network.send_sample(message, where):
                self.sent += count
            else:
                self.dropped += count

    def keep(self, payload: bytes, key: bytes = b"", *, ended: bool = False) -> bytes:
        """Add a sample and return its DATA."""
        self.last += 1
        made = self.kept[self.last] = rtps.data(self.entity, self.last, payload, key=key, ended=ended)
        if self.depth is not None and len(self.kept) > self.depth:
            del self.kept[next(iter(self.kept))]
        return made

    def match(self, reader: MatchedReader) -> bool:
        """Add a reader, or change the address of a reader. Return False above the limit of destinations.

        A new reliable reader gets the available sequence numbers now. After a change of the address, the next sample or
        tick sends them: a participant can have many readers.
        """
        previous = self.readers.get(reader.guid)
        if previous is not None and previous.where == reader.where:
            return True
        if previous is not None:
            self._remove_destination(previous.where)
            reader.start, reader.acked, reader.counted = previous.start, previous.acked, previous.counted
        else:
            reader.start = min(self.kept, default=1) if self.is_kept else self.last + 1
            reader.acked = reader.start - 1
        if not self._add_destination(reader.where):
            self.readers.pop(reader.guid, None)
            return False
        self.readers[reader.guid] = reader
        if reader.is_reliable and previous is None:
            self._announce(reader)
        return True

    def forget(self, guid: bytes) -> None:
        """Remove a reader. Do nothing if the reader is unknown."""
        reader = self.readers.pop(guid, None)
        if reader is not None:
            self._remove_destination(reader.where)

    def tick(self, count: int) -> int:
        """Ask reliable readers that did not acknowledge the newest sample for a receipt, at most `count`. Return the
        remaining number."""
        silent = [reader for reader in self.readers.values() if reader.is_reliable and reader.acked < self.last]
        for reader in silent[:count]:
            self._network.send(self._announcement(reader), reader.where)
            if len(silent) > count:  # the other readers are first in the next tick
                self.readers[reader.guid] = self.readers.pop(reader.guid)
        return count - min(count, len(silent))

    def acknowledge(self, guid: bytes, received: ReceivedAckNack) -> bool:
        """Process a receipt: send the requested samples again, each at most once per turn, and count the requested
        samples that are gone. Return False if the reader is unknown."""
        reader = self.readers.get(guid)
        if reader is None or not reader.is_reliable:
            return False
        if reader.turn != self._network.turn:
            reader.turn = self._network.turn
            reader.repeated.clear()
            reader.is_announced = False
        reader.acked = max(reader.acked, min(received.base - 1, self.last))
        requested = [seq for seq in received.missing if 0 < seq <= self.last and seq not in reader.repeated]
        if requested:
            reader.repeated.update(requested)
            self._repeat(reader, requested)
        elif not received.missing and not received.is_final and not reader.is_announced:
            reader.is_announced = True
            self._announce(reader)
        return True

    def _repeat(self, reader: MatchedReader, requested: Sequence[int]) -> None:
        """Send the requested samples in few datagrams, and one GAP for all samples that are gone."""
        message = b""
        gone = [seq for seq in requested if seq < reader.start or seq not in self.kept]
        if gone:
            message = rtps.gap(self.entity, reader.guid[rtps.PREFIX_BYTES :], gone)
            if self.depth is not None:
                self.dropped += sum(seq >= reader.start and seq > reader.counted for seq in gone)
                reader.counted = max(reader.counted, gone[-1])
        for seq in requested:
            made = self.kept.get(seq) if seq >= reader.start else None
            if made is None:
                continue
            if message and len(message) + len(made) > REPEAT_BYTES:
                self._reply(reader, message)
                message = b""
            message += made
        self._reply(reader, message)

    def _announce(self, reader: MatchedReader) -> None:
        """Send the available sequence numbers, if the budget of the participant permits a reply."""
        if self._network.budget.take_reply(reader.where.address):
            self._network.send(self._announcement(reader), reader.where)

    def _announcement(self, reader: MatchedReader) -> bytes:
        """Return the available sequence numbers for a reader."""
        self._count += 1
        first = max(reader.start, next(iter(self.kept), self.last + 1))
        entity = reader.guid[rtps.PREFIX_BYTES :]
        heartbeat = rtps.heartbeat(self.entity, first, self.last, self._count, reader=entity)
        return rtps.info_dst(reader.guid[: rtps.PREFIX_BYTES]) + heartbeat

    def _reply(self, reader: MatchedReader, submessages: bytes) -> None:
        self._network.reply(rtps.info_dst(reader.guid[: rtps.PREFIX_BYTES]) + submessages, reader.where)

    def _add_destination(self, where: Locator) -> bool:
        count = self._destinations.get(where, 0)
        if count == 0:
            ports = sum(other.address == where.address for other in self._destinations)
            if ports >= self.ports_max or len(self._destinations) >= self.destinations_max:
                return False
        self._destinations[where] = count + 1
        return True

    def _remove_destination(self, where: Locator) -> None:
        count = self._destinations[where] - 1
        if count:
            self._destinations[where] = count
        else:
            del self._destinations[where]
