"""DDS participant with writers only: it finds the readers of other participants, and sends them samples with UDP.

    every 3 s: SPDP, multicast 239.255.0.1 ──▶ participants ──▶ SEDP, unicast: our writers, their readers
    write ──▶ one datagram per destination: INFO_TS, DATA, HEARTBEAT ──▶ ACKNACK of a reliable reader ──▶ DATA again

All sockets are nonblocking and belong to the thread of the event loop. A writer keeps its newest DEPTH samples for
readers that request them again. Nothing waits for a reader.
"""

import asyncio
import logging
import os
import socket
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Final

from imud.formats import rtps
from imud.formats.rtps import FoundParticipant, FoundReader, Locator, ReceivedAckNack, ReceivedData
from imud.host.network import multicast_addresses, open_socket
from imud.model.errors import ServerError, reason_of
from imud.model.units import NS_PER_S
from imud.publishers.ros2.options import PORT_BASE, PORT_STEP

log = logging.getLogger(__name__)

UNICAST_PORT: Final = 10  # first unicast port after the multicast port; two ports for each participant of a host
PARTICIPANTS_MAX: Final = 100  # participants of one host with a well-known port, as in the default of Fast DDS
GROUP: Final = "239.255.0.1"
ANNOUNCE_NS: Final = 3 * NS_PER_S  # time between two announcements of this participant, as in Fast DDS
LEASE_S: Final = 20  # time without an announcement after which others forget this participant, as in Fast DDS
DEPTH: Final = 10  # samples for retransmission, the depth of the sensor data of ROS 2
PEERS_MAX: Final = 256  # maximum number of other participants: the processes of a large robot
READERS_MAX: Final = 4096  # maximum number of readers of all participants
DATAGRAM_BYTES: Final = 65536
READS_PER_TURN: Final = 32  # maximum number of datagrams that one turn of the event loop reads
SEND_BUFFER_BYTES: Final = 1 << 20


@dataclass(slots=True)
class MatchedReader:
    """Reader that receives the samples of a writer."""

    guid: bytes
    where: Locator
    is_reliable: bool
    start: int  # first sequence number for this reader
    acked: int  # the reader has all samples up to this sequence number


@dataclass(slots=True)
class RtpsPeer:
    """Another participant."""

    found: FoundParticipant
    source: str  # IP address of its announcement
    until_ns: int  # time at which its lease ends
    readers: dict[bytes, FoundReader] = field(default_factory=dict)
    next_seq: int = 1  # all descriptions of readers below this sequence number have arrived
    arrived: set[int] = field(default_factory=set)
    counts: int = 0  # ACKNACK messages so far

    def best(self, locators: Iterable[Locator]) -> Locator:
        """Return the address in the network of its announcements, otherwise the first address."""
        known = list(locators) or list(self.found.default)
        return next((one for one in known if one.address == self.source), known[0])

    def arrive(self, seq: int) -> None:
        """Note a description, or a gap."""
        if seq >= self.next_seq and len(self.arrived) < READERS_MAX:
            self.arrived.add(seq)
        while self.next_seq in self.arrived:
            self.arrived.remove(self.next_seq)
            self.next_seq += 1


class RtpsWriter:
    """Writer of one topic."""

    def __init__(self, network: "RtpsNetwork", entity: bytes, topic: str, type_name: str, *, is_kept: bool) -> None:
        """`is_kept`: later readers also receive the kept samples (TRANSIENT_LOCAL), otherwise only new samples."""
        self._network = network
        self.entity, self.topic, self.type_name, self.is_kept = entity, topic, type_name, is_kept
        self.depth: int | None = 1 if is_kept else DEPTH  # None: samples of a key replace each other
        self.kept: dict[int, bytes] = {}  # DATA submessages by sequence number
        self.last = 0  # newest sequence number
        self.sent = self.dropped = 0
        self.readers: dict[bytes, MatchedReader] = {}
        self._destinations: list[tuple[Locator, int]] = []  # with the number of readers
        self._count = 0

    def write(self, payload: bytes, utc_ns: int) -> None:
        """Send a sample to all readers."""
        if len(payload) > rtps.PAYLOAD_MAX:
            self.dropped += len(self.readers)
            return
        made = rtps.info_ts(utc_ns) + self.keep(payload)
        first, self._count = next(iter(self.kept)), self._count + 1
        made += rtps.heartbeat(self.entity, first, self.last, self._count, final=True)
        for where, count in self._destinations:
            if self._network.send(made, where):
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

    def match(self, reader: MatchedReader) -> None:
        """Add or replace a reader."""
        known = self.readers.get(reader.guid)
        if known is not None and known.where == reader.where:
            return
        first = min(self.kept, default=1) if self.is_kept else self.last + 1
        reader.start, reader.acked = first, first - 1
        self.readers[reader.guid] = reader
        self._changed()
        if reader.is_reliable:
            self.announce(reader)

    def forget(self, guids: Iterable[bytes]) -> None:
        """Remove readers."""
        for guid in guids:
            self.readers.pop(guid, None)
        self._changed()

    def tick(self) -> None:
        """Ask each reliable reader for a receipt if it did not acknowledge the newest sample."""
        for reader in self.readers.values():
            if reader.is_reliable and reader.acked < self.last:
                self.announce(reader)

    def announce(self, reader: MatchedReader) -> None:
        """Send the available sequence numbers to a reader."""
        self._count += 1
        first = max(reader.start, next(iter(self.kept), self.last + 1))
        entity = reader.guid[rtps.PREFIX_BYTES :]
        self._send_to(reader, rtps.heartbeat(self.entity, first, self.last, self._count, reader=entity))

    def acknowledge(self, guid: bytes, received: ReceivedAckNack) -> None:
        """Process a receipt: send the requested samples again, and count the requested samples that are gone."""
        reader = self.readers.get(guid)
        if reader is None:
            return
        reader.acked = max(reader.acked, min(received.base - 1, self.last))
        for seq in received.missing:
            if seq > self.last:
                break
            made = self.kept.get(seq) if seq >= reader.start else None
            if made is None:
                self.dropped += seq >= reader.start and self.depth is not None
                made = rtps.gap(self.entity, guid[rtps.PREFIX_BYTES :], seq)
            self._send_to(reader, made)
        if not received.is_final and not received.missing:
            self.announce(reader)

    def _send_to(self, reader: MatchedReader, made: bytes) -> None:
        self._network.send(rtps.info_dst(reader.guid[: rtps.PREFIX_BYTES]) + made, reader.where)

    def _changed(self) -> None:
        counts: dict[Locator, int] = {}
        for reader in self.readers.values():
            counts[reader.where] = counts.get(reader.where, 0) + 1
        self._destinations = list(counts.items())


class RtpsNetwork:
    """Sockets of a participant."""

    def __init__(self, domain: int, address: str | None) -> None:
        self._wanted = address
        self._group = (GROUP, PORT_BASE + PORT_STEP * domain)
        self._unicast: socket.socket | None = None
        self._multicast: socket.socket | None = None
        self.prefix = rtps.VENDOR + os.urandom(rtps.PREFIX_BYTES - len(rtps.VENDOR))
        self._header = rtps.header(self.prefix)
        self._joined: list[str] = []
        self.port = 0
        self.problem = ""  # reason why imud cannot announce itself, one sentence

    @property
    def locators(self) -> list[Locator]:
        """Addresses of this participant."""
        return [Locator(address, self.port) for address in self._joined]

    def open(self) -> tuple[socket.socket, socket.socket]:
        """Open both sockets and return them. Raises ServerError."""
        try:
            self._multicast = shared = open_socket("0.0.0.0", socket.SOCK_DGRAM)
            shared.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            shared.bind(("", self._group[1]))
            self._unicast = own = open_socket("0.0.0.0", socket.SOCK_DGRAM)
            own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
            self.port = self._bind(own)
        except OSError as error:
            self.close()
            raise ServerError(f"ros2: cannot use the UDP port {self._group[1]}: {reason_of(error)}") from error
        return shared, own

    def _bind(self, own: socket.socket) -> int:
        host = self._wanted or ""
        for number in range(PARTICIPANTS_MAX):
            try:
                own.bind((host, self._group[1] + UNICAST_PORT + 2 * number))
                break
            except OSError:  # another participant of this host has this port
                continue
        else:
            own.bind((host, 0))
        return int(own.getsockname()[1])

    def refresh(self) -> bool:
        """Join the multicast group on new interfaces. Return whether the addresses changed."""
        before, self._joined = self._joined, []
        self.problem = ""
        for address in [self._wanted] if self._wanted is not None else multicast_addresses():
            member = socket.inet_aton(GROUP) + socket.inet_aton(address)
            try:
                if address not in before and self._multicast is not None:
                    self._multicast.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            except OSError as error:
                self.problem = f"cannot receive multicast at {address}: {reason_of(error)}"
                continue
            self._joined.append(address)
        if not self._joined and not self.problem:
            self.problem = "expected a network interface with an IPv4 address, got none; connect a network"
        return self._joined != before

    def send(self, made: bytes, where: Locator) -> bool:
        """Send submessages. Return False if the kernel does not accept the datagram now."""
        if self._unicast is None:
            return False
        try:
            self._unicast.sendto(self._header + made, where)
        except OSError:
            return False
        return True

    def multicast(self, made: bytes) -> None:
        """Send submessages to all participants of the domain, on each interface."""
        for address in self._joined:
            if self._unicast is not None:
                try:
                    self._unicast.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
                    self._unicast.sendto(self._header + made, self._group)
                except OSError as error:
                    self.problem = f"cannot send multicast at {address}: {reason_of(error)}"

    def close(self) -> None:
        """Close both sockets. A second call does nothing."""
        for one in (self._unicast, self._multicast):
            if one is not None:
                one.close()
        self._unicast = self._multicast = None
        self._joined = []


class RtpsParticipant:
    """Participant of a domain. Synchronization: the event loop's thread only."""

    def __init__(self, domain: int, address: str | None, name: str, now_ns: Callable[[], int]) -> None:
        self._domain, self._name, self._now_ns = domain, name, now_ns
        self._network = RtpsNetwork(domain, address)
        self._reader = rtps.RtpsReader(self._network.prefix)
        self._peers: dict[bytes, RtpsPeer] = {}
        self._writers: dict[bytes, RtpsWriter] = {}
        self._hashes: dict[bytes, str] = {}
        self._publications = RtpsWriter(self._network, rtps.PUBLICATIONS_WRITER, "", "", is_kept=True)
        self._publications.depth = None
        self._described: dict[bytes, int] = {}  # sequence number of the description of each writer
        self._entities = 0
        self._announce_ns = 0
        self._announced = 0
        self._sockets: tuple[socket.socket, ...] = ()
        self._retired = [0, 0]  # sent and dropped of removed writers
        self.refused = 0  # number of participants and readers above the limits

    @property
    def guid(self) -> bytes:
        return self._network.prefix + rtps.PARTICIPANT

    @property
    def writers(self) -> Iterable[RtpsWriter]:
        return self._writers.values()

    @property
    def problem(self) -> str:
        return self._network.problem

    @property
    def discarded(self) -> int:
        """Number of invalid datagrams, and of descriptions of participants and readers above the limits."""
        return self._reader.invalid + self.refused

    @property
    def totals(self) -> tuple[int, int]:
        """Messages sent and dropped, the sum over all readers, without the description of the node."""
        made = [one for one in self._writers.values() if not one.is_kept]
        return (
            self._retired[0] + sum(one.sent for one in made),
            self._retired[1] + sum(one.dropped for one in made),
        )

    def open(self) -> None:
        """Open the sockets and start to read. Raises ServerError."""
        loop = asyncio.get_running_loop()
        self._sockets = self._network.open()
        for one in self._sockets:
            loop.add_reader(one.fileno(), self._read, one)

    def add(self, topic: str, type_name: str, type_hash: str, *, is_kept: bool = False) -> RtpsWriter:
        """Add a writer, announce it, and match it with the known readers."""
        self._entities += 1
        entity = self._entities.to_bytes(3, "big") + bytes([rtps.KIND_WRITER_NO_KEY])
        made = self._writers[entity] = RtpsWriter(self._network, entity, topic, type_name, is_kept=is_kept)
        self._hashes[entity] = type_hash
        self._describe(made)
        for peer in self._peers.values():
            for reader in peer.readers.values():
                self._match(peer, reader, [made])
        return made

    def remove(self, writer: RtpsWriter) -> None:
        """Remove a writer and announce it."""
        del self._writers[writer.entity]
        self._retired[0] += writer.sent
        self._retired[1] += writer.dropped
        guid = self._network.prefix + writer.entity
        self._publications.kept.pop(self._described.pop(writer.entity), None)
        self._publications.keep(rtps.key_of(guid, is_participant=False), guid, ended=True)
        self._publications.tick()

    def tick(self, now_ns: int) -> None:
        """Announce this participant if it is due, remove silent participants, and ask readers for receipts."""
        if now_ns >= self._announce_ns:
            self._announce_ns = now_ns + ANNOUNCE_NS
            self._network.refresh()
            self._network.multicast(self._announcement())
        for prefix in [prefix for prefix, peer in self._peers.items() if now_ns >= peer.until_ns]:
            self._forget(prefix)
        self._publications.tick()
        for writer in self._writers.values():
            writer.tick()

    def received(self, datagram: bytes, source: str, now_ns: int) -> None:
        """Process a datagram."""
        prefix, found = self._reader.read(datagram)
        for one in found:
            if isinstance(one, ReceivedAckNack):
                self._acknowledged(prefix, one)
            elif isinstance(one, ReceivedData) and one.writer == rtps.PARTICIPANT_WRITER:
                self._participant(one, source, now_ns)
            elif (peer := self._peers.get(prefix)) is not None and one.writer == rtps.SUBSCRIPTIONS_WRITER:
                self._subscription(prefix, peer, one)

    def close(self) -> None:
        """Announce the end of this participant and close the sockets. A second call does nothing."""
        if self._sockets:
            self._announced += 1
            key = rtps.key_of(self.guid, is_participant=True)
            made = rtps.data(rtps.PARTICIPANT_WRITER, self._announced, key, key=self.guid, ended=True)
            self._network.multicast(made)
            for peer in self._peers.values():
                self._network.send(made, peer.best(peer.found.meta))
            loop = asyncio.get_running_loop()
            for one in self._sockets:
                loop.remove_reader(one.fileno())
        self._sockets = ()
        self._network.close()

    def _read(self, one: socket.socket) -> None:
        now_ns = self._now_ns()
        for _ in range(READS_PER_TURN):
            try:
                datagram, (source, _port) = one.recvfrom(DATAGRAM_BYTES)
            except OSError:  # no data, or an ICMP error of an earlier datagram
                return
            self.received(datagram, source, now_ns)

    def _announcement(self) -> bytes:
        self._announced += 1
        locators = [rtps.locator(one) for one in self._network.locators]
        payload = rtps.PL_CDR_LE + rtps.parameters([
            (rtps.P_VERSION, rtps.MAGIC[4:]), (rtps.P_VENDOR, rtps.VENDOR), (rtps.P_DOMAIN, _u32(self._domain)),
            (rtps.P_PARTICIPANT_GUID, self.guid),
            *((rtps.P_META_UNICAST, one) for one in locators), *((rtps.P_DEFAULT_UNICAST, one) for one in locators),
            (rtps.P_LEASE, _u32(LEASE_S) + _u32(0)), (rtps.P_BUILTIN, _u32(rtps.BUILTIN_ENDPOINTS)),
            (rtps.P_USER_DATA, rtps.octets(b"enclave=/;")), (rtps.P_ENTITY_NAME, rtps.text(self._name)),
        ])  # fmt: skip
        return rtps.data(
            rtps.PARTICIPANT_WRITER, self._announced, payload, reader=rtps.PARTICIPANT_READER, key=self.guid
        )

    def _describe(self, writer: RtpsWriter) -> None:
        guid = self._network.prefix + writer.entity
        durability = rtps.TRANSIENT_LOCAL if writer.is_kept else rtps.VOLATILE
        user = [(rtps.P_USER_DATA, rtps.octets(f"typehash={self._hashes[writer.entity]};".encode()))]
        payload = rtps.PL_CDR_LE + rtps.parameters([
            (rtps.P_ENDPOINT_GUID, guid), (rtps.P_PARTICIPANT_GUID, self.guid), (rtps.P_TOPIC, rtps.text(writer.topic)),
            (rtps.P_TYPE, rtps.text(writer.type_name)),
            # 0.1 s maximum blocking time, the default of DDS
            (rtps.P_RELIABILITY, _u32(rtps.RELIABLE) + _u32(0) + _u32((1 << 32) // 10)),
            (rtps.P_DURABILITY, _u32(durability)), *user,
        ])  # fmt: skip
        self._publications.keep(payload, guid)
        self._described[writer.entity] = self._publications.last
        self._publications.tick()

    def _participant(self, received: ReceivedData, source: str, now_ns: int) -> None:
        if received.ended:
            guid = received.key or rtps.guid_in(received)
            self._forget(guid[: rtps.PREFIX_BYTES])
            return
        found = rtps.participant_of(received)
        if found is None:
            return
        prefix = found.guid[: rtps.PREFIX_BYTES]
        until_ns = now_ns + found.lease_s * NS_PER_S
        known = self._peers.get(prefix)
        if known is not None:
            known.until_ns, known.found = until_ns, found
            return
        if len(self._peers) >= PEERS_MAX:
            self.refused += 1
            return
        peer = self._peers[prefix] = RtpsPeer(found, source, until_ns)
        where = peer.best(found.meta)
        self._network.send(self._announcement(), where)
        self._publications.match(
            MatchedReader(prefix + rtps.PUBLICATIONS_READER, where, is_reliable=True, start=1, acked=0)
        )

    def _subscription(self, prefix: bytes, peer: RtpsPeer, one: rtps.Submessage) -> None:
        if isinstance(one, rtps.ReceivedHeartbeat):
            peer.next_seq = max(peer.next_seq, one.first)
            peer.arrived = {seq for seq in peer.arrived if seq >= peer.next_seq}
            peer.arrive(0)
            last = min(one.last, peer.next_seq + rtps.BITS_MAX - 1)
            missing = [seq for seq in range(peer.next_seq, last + 1) if seq not in peer.arrived]
            if missing or not one.is_final:
                peer.counts += 1
                receipt = rtps.acknack(
                    rtps.SUBSCRIPTIONS_READER, rtps.SUBSCRIPTIONS_WRITER, peer.next_seq, missing, peer.counts
                )
                self._network.send(rtps.info_dst(prefix) + receipt, peer.best(peer.found.meta))
        elif isinstance(one, rtps.ReceivedGap):
            for seq in range(one.start, min(one.end, one.start + rtps.BITS_MAX)):
                peer.arrive(seq)
        elif isinstance(one, ReceivedData):
            peer.arrive(one.seq)
            if one.ended:
                self._forget_readers(peer, [one.key or rtps.guid_in(one)])
            elif (reader := rtps.reader_of(one)) is not None and reader.guid.startswith(prefix):
                self._add_reader(peer, reader)

    def _add_reader(self, peer: RtpsPeer, reader: FoundReader) -> None:
        if reader.guid not in peer.readers and sum(len(one.readers) for one in self._peers.values()) >= READERS_MAX:
            self.refused += 1
            return
        peer.readers[reader.guid] = reader
        self._match(peer, reader, self._writers.values())

    def _match(self, peer: RtpsPeer, reader: FoundReader, writers: Iterable[RtpsWriter]) -> None:
        for writer in writers:
            durability = rtps.TRANSIENT_LOCAL if writer.is_kept else rtps.VOLATILE
            if (
                (reader.topic, reader.type_name) == (writer.topic, writer.type_name)
                and reader.fits
                and reader.durability <= durability
            ):
                where = peer.best(reader.locators)
                writer.match(MatchedReader(reader.guid, where, reader.is_reliable, start=1, acked=0))

    def _acknowledged(self, prefix: bytes, received: ReceivedAckNack) -> None:
        guid = prefix + received.reader
        if received.writer == rtps.PUBLICATIONS_WRITER:
            self._publications.acknowledge(guid, received)
        elif (writer := self._writers.get(received.writer)) is not None:
            writer.acknowledge(guid, received)

    def _forget(self, prefix: bytes) -> None:
        peer = self._peers.pop(prefix, None)
        if peer is not None:
            self._publications.forget([prefix + rtps.PUBLICATIONS_READER])
            self._forget_readers(peer, list(peer.readers))

    def _forget_readers(self, peer: RtpsPeer, guids: list[bytes]) -> None:
        for guid in guids:
            peer.readers.pop(guid, None)
        for writer in self._writers.values():
            writer.forget(guids)


def _u32(value: int) -> bytes:
    return value.to_bytes(4, "little")
