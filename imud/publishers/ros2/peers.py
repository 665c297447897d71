"""Other participants of the domain: their addresses, leases and readers, and the limits of their number.

    announcement from S ──▶ S announced, or the only address? ──▶ imud sends to S, at the announced port

A participant is its GUID. imud sends only to the address from which the participant itself sends: an announcement of
the address of a third host causes no datagram to that host. If a participant sends from a new address, imud follows.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

from imud.formats import rtps
from imud.formats.rtps import FoundParticipant, FoundReader, Locator
from imud.model.units import NS_PER_S

PEERS_MAX: Final = 256  # maximum number of other participants: the processes of a large robot
ADDRESS_PEERS_MAX: Final = 128  # maximum number of participants of one address: half, so that others have room
READERS_MAX: Final = 4096  # maximum number of readers of all participants
PEER_READERS_MAX: Final = 256  # maximum number of readers of one participant: a process with many nodes
ADDRESS_READERS_MAX: Final = 2048  # maximum number of readers of one address: half, so that others have room
# Maximum lease, also if a participant announces a longer lease: two announcements of RTI Connext and OpenDDS (30 s).
# Fast DDS announces itself every 3 s, Cyclone DDS every 8 s.
LEASE_MAX_S: Final = 60
SILENT_NS: Final = 20 * NS_PER_S  # time without a datagram after which a participant makes room for a new one
ADDRESS_NS: Final = 5 * NS_PER_S  # time without a datagram after which another announced address replaces an address
WINDOW: Final = rtps.BITS_MAX  # number of sequence numbers that imud notes after the first missing number: one request


@dataclass(slots=True)
class RtpsPeer:
    """Another participant."""

    description: FoundParticipant  # newest announcement
    address: str  # address from which it sends, and to which imud sends
    received_ns: int  # time of its newest datagram from this address
    readers: dict[bytes, FoundReader] = field(default_factory=dict)
    is_confirmed: bool = False  # whether it has acknowledged messages of imud
    next_seq: int = 1  # all descriptions of readers below this sequence number have arrived
    arrived: int = 0  # bit n: the description of number `next_seq` + n has arrived; WINDOW bits
    last: int = 0  # newest description, as in the newest HEARTBEAT
    counts: int = 0  # ACKNACK messages so far

    @property
    def prefix(self) -> bytes:
        return self.description.guid[: rtps.PREFIX_BYTES]

    @property
    def until_ns(self) -> int:
        """Time at which imud forgets the participant if no datagram arrives."""
        return self.received_ns + min(self.description.lease_s, LEASE_MAX_S) * NS_PER_S

    @property
    def meta(self) -> Locator:
        """Destination of discovery messages."""
        return self._destination(self.description.meta)

    def destination(self, reader: FoundReader) -> Locator:
        """Return the destination of samples for a reader."""
        return self._destination(reader.locators or self.description.default)

    def _destination(self, locators: Sequence[Locator]) -> Locator:
        """Return the announced destination at the address of the participant. If it did not announce this address (a
        network address translation, or an announcement with old addresses), use its first port."""
        for locator in locators:
            if locator.address == self.address:
                return locator
        return Locator(self.address, locators[0].port)

    def sends_from(self, source: str) -> bool:
        """Return whether the participant has this address."""
        if source == self.address:
            return True
        return any(locator.address == source for locator in (*self.description.meta, *self.description.default))

    def announce(self, description: FoundParticipant, source: str, now_ns: int) -> bool:
        """Process an announcement. Return whether the destinations changed."""
        old = (self.address, self.description.meta, self.description.default)
        self.description = description
        is_announced = any(locator.address == self.address for locator in (*description.meta, *description.default))
        is_new_announced = any(locator.address == source for locator in (*description.meta, *description.default))
        is_recent = now_ns - self.received_ns <= ADDRESS_NS
        # a host with two networks announces both addresses, and sends from both
        if source == self.address or not (is_recent and (is_announced or not is_new_announced)):
            self.address = source
            self.received_ns = now_ns
        return (self.address, description.meta, description.default) != old

    def arrive(self, numbers: Iterable[int]) -> None:
        """Note descriptions or gaps. Ignore a number after the window: imud requests it later."""
        for seq in numbers:
            if 0 <= seq - self.next_seq < WINDOW:
                self.arrived |= 1 << (seq - self.next_seq)
        # number of the lowest bits that are set
        count = (~self.arrived & (self.arrived + 1)).bit_length() - 1
        self.next_seq += count
        self.arrived >>= count

    def skip_to(self, seq: int) -> None:
        """Note that all numbers below `seq` are no longer available."""
        if seq > self.next_seq:
            self.arrived >>= min(seq - self.next_seq, WINDOW)
            self.next_seq = seq
            self.arrive(())

    def missing(self, last: int) -> list[int]:
        """Return the sequence numbers up to `last` that did not arrive, of the window."""
        count = min(last - self.next_seq + 1, WINDOW)
        return [self.next_seq + bit for bit in range(count) if not self.arrived >> bit & 1]


class PeerTable:
    """All other participants, with limits. Synchronization: the event loop's thread only."""

    def __init__(self) -> None:
        self._peers: dict[bytes, RtpsPeer] = {}
        self._readers_of: Counter[str] = Counter()  # number of readers by address
        self._readers = 0

    def __iter__(self) -> Iterator[RtpsPeer]:
        return iter(list(self._peers.values()))

    def get(self, prefix: bytes) -> RtpsPeer | None:
        return self._peers.get(prefix)

    def hear(self, prefix: bytes, source: str, now_ns: int) -> RtpsPeer | None:
        """Return the sender of a datagram, and renew its lease; None if it is unknown or has other addresses."""
        peer = self._peers.get(prefix)
        if peer is None or not peer.sends_from(source):
            return None
        if source == peer.address:
            peer.received_ns = now_ns
        return peer

    def find_limit(self, address: str) -> str:
        """Return the limit that a new participant of this address exceeds; empty if there is room."""
        if self._is_full_for(address):
            return f"{ADDRESS_PEERS_MAX} participants of one address"
        return f"{PEERS_MAX} participants" if len(self._peers) >= PEERS_MAX else ""

    def find_silent(self, address: str, now_ns: int) -> RtpsPeer | None:
        """Return the participant that makes room for a new participant of this address: the participant with the oldest
        datagram that did not confirm or is silent. None if all are active."""
        is_any_address = not self._is_full_for(address)
        peers = [
            peer
            for peer in self._peers.values()
            if (is_any_address or peer.address == address)
            and (not peer.is_confirmed or now_ns - peer.received_ns > SILENT_NS)
        ]
        return min(peers, key=lambda peer: peer.received_ns, default=None)

    def _is_full_for(self, address: str) -> bool:
        return sum(peer.address == address for peer in self._peers.values()) >= ADDRESS_PEERS_MAX

    def add(self, peer: RtpsPeer) -> None:
        self._peers[peer.prefix] = peer

    def remove(self, peer: RtpsPeer) -> None:
        """Remove a participant and its readers."""
        del self._peers[peer.prefix]
        self._count_readers(peer.address, -len(peer.readers))

    def announce(self, peer: RtpsPeer, description: FoundParticipant, source: str, now_ns: int) -> bool:
        """Process an announcement of a known participant. Return whether its destinations changed."""
        address = peer.address
        has_changed = peer.announce(description, source, now_ns)
        self._count_readers(address, -len(peer.readers))
        self._count_readers(peer.address, len(peer.readers))
        return has_changed

    def add_reader(self, peer: RtpsPeer, reader: FoundReader) -> str:
        """Add or replace a reader. Return the limit that the reader exceeds; empty if imud accepts it."""
        if reader.guid not in peer.readers:
            if len(peer.readers) >= PEER_READERS_MAX:
                return f"{PEER_READERS_MAX} readers of one participant"
            if self._readers >= READERS_MAX:
                return f"{READERS_MAX} readers"
            if self._readers_of[peer.address] >= ADDRESS_READERS_MAX:
                return f"{ADDRESS_READERS_MAX} readers of one address"
            self._count_readers(peer.address, 1)
        peer.readers[reader.guid] = reader
        return ""

    def remove_reader(self, peer: RtpsPeer, guid: bytes) -> FoundReader | None:
        """Remove and return a reader; None if the participant has no such reader."""
        reader = peer.readers.pop(guid, None)
        if reader is not None:
            self._count_readers(peer.address, -1)
        return reader

    def _count_readers(self, address: str, count: int) -> None:
        self._readers += count
        self._readers_of[address] += count
        if not self._readers_of[address]:
            del self._readers_of[address]
