"""DDS participant with writers only: it finds the readers of other participants, and sends them samples with UDP.

    every 3 s: SPDP, multicast 239.255.0.1 ──▶ participants ──▶ SEDP, unicast: our writers, their readers
    datagram ──budget of its sender──▶ submessage ──budget──▶ submessage … ──▶ replies, with a budget

All sockets are nonblocking and belong to the thread of the event loop. Nothing waits for a reader.
"""

import asyncio
import socket
import time
from collections.abc import Callable, Collection, Iterable
from ipaddress import IPv4Address
from typing import Final

from imud.formats import rtps
from imud.formats.rtps import FoundReader, ReceivedAckNack, ReceivedData, ReceivedGap, ReceivedHeartbeat
from imud.model.units import NS_PER_S
from imud.publishers.ros2.network import RtpsNetwork
from imud.publishers.ros2.peers import LEASE_MAX_S, PEERS_MAX, WINDOW, PeerTable, RtpsPeer
from imud.publishers.ros2.writer import MatchedReader, RtpsWriter

ANNOUNCE_NS: Final = 3 * NS_PER_S  # time between two announcements of this participant, as in Fast DDS
NETWORK_NS: Final = NS_PER_S  # time between two reads of the addresses of this host
LEASE_S: Final = 20  # time without an announcement after which others forget this participant, as in Fast DDS
DATAGRAM_BYTES: Final = 65536
READS_PER_TURN: Final = 32  # maximum number of datagrams of one socket in one turn of the event loop
HEARTBEATS_PER_TICK: Final = 64  # maximum number of requests for receipts in one tick, 0.1 to 0.5 s
# Time for which the status shows refused participants and readers: as long as the lease of others can last
REFUSED_NS: Final = LEASE_MAX_S * NS_PER_S


class RtpsParticipant:
    """Participant of a domain. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        domain: int,
        address: str | None,
        name: str,
        now_ns: Callable[[], int],
        cpu_ns: Callable[[], int] = time.thread_time_ns,
        network: RtpsNetwork | None = None,
    ) -> None:
        """`now_ns` returns CLOCK_MONOTONIC, `cpu_ns` the CPU time of the event loop's thread. `network`: None for the
        network of this host."""
        self._domain, self._name, self._now_ns = domain, name, now_ns
        self._network = network or RtpsNetwork(domain, address, cpu_ns)
        self._reader = rtps.RtpsReader(self._network.prefix)
        self._peers = PeerTable()
        self._receipts: dict[bytes, RtpsPeer] = {}  # participants that get a receipt at the end of the turn
        self._writers: dict[bytes, RtpsWriter] = {}
        self._topics: dict[tuple[str, str], list[RtpsWriter]] = {}  # writers by topic and type
        # Types of the topics that this participant can have; it stores no readers of other types. None: all types.
        self.accepted_types: Collection[str] | None = None
        self._hashes: dict[bytes, str] = {}
        self._publications = RtpsWriter(self._network, rtps.PUBLICATIONS_WRITER, "", "", is_kept=True)
        self._publications.depth = None
        self._publications.destinations_max = self._publications.ports_max = PEERS_MAX
        self._described: dict[bytes, int] = {}  # sequence number of the description of each writer
        self._entities = 0
        self._announce_ns = 0
        self._network_ns = 0  # time at which this participant reads the host's addresses again
        self._announced = 0
        self._sockets: tuple[socket.socket, ...] = ()
        self._is_reading = False
        self._retired = [0, 0]  # sent and dropped of removed writers
        self.refused = 0  # number of participants, readers and datagrams that the limits refuse
        self._refusal = ""  # sentence about the newest refusal
        self._refusal_ns = 0

    @property
    def guid(self) -> bytes:
        return self._network.prefix + rtps.PARTICIPANT

    @property
    def writers(self) -> Iterable[RtpsWriter]:
        return self._writers.values()

    @property
    def problem(self) -> str:
        """Reason why participants get no samples, one sentence; empty without."""
        now_ns = self._now_ns()
        problem = self._network.problem(now_ns)
        if not problem and self._refusal and now_ns - self._refusal_ns < REFUSED_NS:
            return self._refusal
        return problem

    @property
    def discarded(self) -> int:
        """Number of invalid datagrams, of inputs above the budgets, and of refused participants and readers."""
        return self._reader.invalid + self.refused + self._network.budget.refused

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
        self._sockets = self._network.open()
        self._read_again()

    def _read_again(self) -> None:
        """Read the sockets if this participant does not read them now."""
        if self._sockets and not self._is_reading:
            self._is_reading = True
            loop = asyncio.get_running_loop()
            for udp_socket in self._sockets:
                loop.add_reader(udp_socket.fileno(), self._read, udp_socket)

    def _stop_reading(self) -> None:
        """Leave the datagrams in the kernel, which discards them if its queue is full. The next tick reads again."""
        if self._is_reading:
            self._is_reading = False
            loop = asyncio.get_running_loop()
            for udp_socket in self._sockets:
                loop.remove_reader(udp_socket.fileno())

    def add(self, topic: str, type_name: str, type_hash: str, *, is_kept: bool = False) -> RtpsWriter:
        """Add a writer, announce it, and match it with the known readers."""
        self._entities += 1
        entity = self._entities.to_bytes(3, "big") + bytes([rtps.KIND_WRITER_NO_KEY])
        made = self._writers[entity] = RtpsWriter(self._network, entity, topic, type_name, is_kept=is_kept)
        self._topics.setdefault((topic, type_name), []).append(made)
        self._hashes[entity] = type_hash
        self._describe(made)
        for peer in self._peers:
            for reader in peer.readers.values():
                if (reader.topic, reader.type_name) == (topic, type_name):
                    self._match(peer, reader, [made], self._now_ns())
        return made

    def remove(self, writer: RtpsWriter) -> None:
        """Remove a writer and announce it."""
        del self._writers[writer.entity]
        topic = (writer.topic, writer.type_name)
        self._topics[topic].remove(writer)
        if not self._topics[topic]:
            del self._topics[topic]
        self._retired[0] += writer.sent
        self._retired[1] += writer.dropped
        guid = self._network.prefix + writer.entity
        self._publications.kept.pop(self._described.pop(writer.entity), None)
        self._publications.keep(rtps.key_of(guid, is_participant=False), guid, ended=True)
        self._publications.tick(HEARTBEATS_PER_TICK)

    def tick(self, now_ns: int) -> None:
        """Announce this participant if it is due, remove silent participants, and ask readers for receipts."""
        self._network.start_turn(now_ns)
        if now_ns >= self._network_ns:
            self._network_ns = now_ns + NETWORK_NS
            if self._network.refresh():
                self._announce_ns = now_ns  # other participants must learn the new address
        if now_ns >= self._announce_ns:
            self._announce_ns = now_ns + ANNOUNCE_NS
            self._network.multicast(self._announcement())
        for peer in self._peers:
            if now_ns >= peer.until_ns or not self._network.is_reachable(peer.address):
                self._forget(peer)
        count = self._publications.tick(HEARTBEATS_PER_TICK)
        for writer in self._writers.values():
            count = writer.tick(count)
        self._read_again()

    def received(self, datagram: bytes, source: str, now_ns: int) -> None:
        """Process a datagram in a turn of its own."""
        self._network.start_turn(now_ns)
        self._process(datagram, source, now_ns)
        self._end_turn()

    def close(self) -> None:
        """Announce the end of this participant and close the sockets. A second call does nothing."""
        if self._sockets:
            self._announced += 1
            key = rtps.key_of(self.guid, is_participant=True)
            made = rtps.data(rtps.PARTICIPANT_WRITER, self._announced, key, key=self.guid, ended=True)
            self._network.multicast(made)
            for peer in self._peers:
                self._network.send(made, peer.meta)
            self._stop_reading()
        self._sockets = ()
        self._network.close()

    def _read(self, udp_socket: socket.socket) -> None:
        now_ns = self._now_ns()
        budget = self._network.budget
        self._network.start_turn(now_ns)
        for _ in range(READS_PER_TURN):
            if budget.is_turn_over:
                break
            try:
                datagram, (source, _port) = udp_socket.recvfrom(DATAGRAM_BYTES)
            except OSError:  # no data, or an ICMP error of an earlier datagram
                break
            self._process(datagram, source, now_ns)
        self._end_turn()
        if budget.is_spent:
            self._stop_reading()

    def _end_turn(self) -> None:
        """Send one receipt to each participant whose descriptions arrived in this turn."""
        for peer in self._receipts.values():
            self._send_receipt(peer)
        self._receipts.clear()
        self._network.budget.end_turn()

    def _process(self, datagram: bytes, source: str, now_ns: int) -> None:
        """Process the submessages of a datagram until the budget of its sender ends."""
        prefix, submessages = self._reader.read(datagram)
        source = self._sender_address(prefix, source)
        peer = self._peers.hear(prefix, source, now_ns)
        admit = self._network.budget.admit
        if not admit(source):
            return
        if not self._network.is_reachable(source):
            self._refuse_network(source, now_ns)
            return
        for submessage in submessages:
            if isinstance(submessage, ReceivedData) and submessage.writer == rtps.PARTICIPANT_WRITER:
                self._participant(prefix, submessage, source, now_ns)
                peer = self._peers.hear(prefix, source, now_ns)
            elif peer is not None and submessage is not None:
                self._of_peer(peer, submessage, now_ns)
            if not admit(source):
                return

    def _sender_address(self, prefix: bytes, source: str) -> str:
        """Return the address of the sender of a datagram. Fast DDS on this host announces the address of a network
        interface with multicast, and sends all other datagrams from the loopback address."""
        peer = self._peers.get(prefix)
        if peer is None or self._network.is_reachable(source) or not self._network.is_own(peer.address):
            return source
        return peer.address if IPv4Address(source).is_loopback else source

    def _of_peer(self, peer: RtpsPeer, submessage: rtps.Submessage, now_ns: int) -> None:
        """Process a submessage of a known participant."""
        if isinstance(submessage, ReceivedAckNack):
            self._acknowledge(peer, submessage)
        elif isinstance(submessage, ReceivedHeartbeat):
            peer.skip_to(submessage.first)
            peer.last = submessage.last
            if not submessage.is_final or peer.missing(peer.last):
                self._receipts[peer.prefix] = peer
        elif isinstance(submessage, ReceivedGap):
            if submessage.start <= peer.next_seq:
                peer.skip_to(submessage.end)
            peer.arrive(range(max(submessage.start, peer.next_seq), min(submessage.end, peer.next_seq + WINDOW)))
            peer.arrive(submessage.more_numbers)
        else:
            self._subscription(peer, submessage, now_ns)

    def _send_receipt(self, peer: RtpsPeer) -> None:
        """Acknowledge the descriptions of readers and request the missing descriptions."""
        peer.counts += 1
        receipt = rtps.acknack(
            rtps.SUBSCRIPTIONS_READER, rtps.SUBSCRIPTIONS_WRITER, peer.next_seq, peer.missing(peer.last), peer.counts
        )
        self._network.reply(rtps.info_dst(peer.prefix) + receipt, peer.meta)

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
        self._publications.tick(HEARTBEATS_PER_TICK)

    def _participant(self, prefix: bytes, received: ReceivedData, source: str, now_ns: int) -> None:
        """Process the announcement of a participant, or its end. Only the participant itself can announce it."""
        peer = self._peers.get(prefix)
        if received.ended:
            guid = received.key or rtps.guid_in(received)
            if peer is not None and guid[: rtps.PREFIX_BYTES] == prefix and peer.sends_from(source):
                self._forget(peer)
            return
        found = rtps.participant_of(received)
        if found is None or found.guid[: rtps.PREFIX_BYTES] != prefix:
            return
        if peer is not None:
            if self._peers.announce(peer, found, source, now_ns):
                self._connect(peer, now_ns)
            return

        limit = self._peers.find_limit(source)
        if limit:
            self._refuse(
                f"refused a participant at {source}: expected at most {limit}, got more; end programs of ROS 2 or use "
                "another domain",
                now_ns,
            )
            silent = self._peers.find_silent(source, now_ns)
            if silent is None:
                return
            self._forget(silent)

        peer = RtpsPeer(found, source, now_ns)
        self._peers.add(peer)
        self._network.reply(self._announcement(), peer.meta)
        self._connect(peer, now_ns)

    def _connect(self, peer: RtpsPeer, now_ns: int) -> None:
        """Send the descriptions of the writers and the samples to the present address of a participant."""
        self._publications.match(MatchedReader(peer.prefix + rtps.PUBLICATIONS_READER, peer.meta, is_reliable=True))
        for reader in peer.readers.values():
            self._match(peer, reader, self._writers_for(reader), now_ns)

    def _subscription(self, peer: RtpsPeer, received: ReceivedData, now_ns: int) -> None:
        """Process the description of a reader, or its end."""
        peer.arrive([received.seq])
        if received.ended:
            self._remove_reader(peer, received.key or rtps.guid_in(received))
            return
        reader = rtps.reader_of(received)
        if reader is None or reader.guid[: rtps.PREFIX_BYTES] != peer.prefix:
            return
        if self.accepted_types is not None and reader.type_name not in self.accepted_types:
            return
        previous = peer.readers.get(reader.guid)
        if previous == reader:
            return
        if previous is not None:
            self._remove_reader(peer, reader.guid)
        limit = self._peers.add_reader(peer, reader)
        if limit:
            self._refuse_reader(peer, limit, now_ns)
            return
        self._match(peer, reader, self._writers_for(reader), now_ns)

    def _refuse_network(self, source: str, now_ns: int) -> None:
        if IPv4Address(source).is_loopback:
            self.refused += 1  # Fast DDS on this host, before its announcement with multicast
            return
        self._refuse(
            f"ignored the participant at {source}: expected an address in {self._network.networks}, got another "
            "network; connect imud to the network of the robot",
            now_ns,
        )

    def _refuse_reader(self, peer: RtpsPeer, limit: str, now_ns: int) -> None:
        self._refuse(
            f"refused a reader of the participant at {peer.address}: expected at most {limit}, got more; end programs "
            "of ROS 2 or use another domain",
            now_ns,
        )

    def _refuse(self, problem: str, now_ns: int) -> None:
        """Count a refusal. The status shows the newest refusal."""
        self.refused += 1
        self._refusal = problem
        self._refusal_ns = now_ns

    def _match(self, peer: RtpsPeer, reader: FoundReader, writers: Iterable[RtpsWriter], now_ns: int) -> None:
        """Add a reader to writers of its topic, or change its address."""
        for writer in writers:
            durability = rtps.TRANSIENT_LOCAL if writer.is_kept else rtps.VOLATILE
            if (
                reader.fits
                and reader.durability <= durability
                and not writer.match(MatchedReader(reader.guid, peer.destination(reader), reader.is_reliable))
            ):
                limit = f"{writer.ports_max} ports of one address and {writer.destinations_max} destinations of a topic"
                self._refuse_reader(peer, limit, now_ns)

    def _acknowledge(self, peer: RtpsPeer, received: ReceivedAckNack) -> None:
        guid = peer.prefix + received.reader
        writer = self._writers.get(received.writer)
        if received.writer == rtps.PUBLICATIONS_WRITER:
            writer = self._publications
        if writer is not None and writer.acknowledge(guid, received):
            peer.is_confirmed = True

    def _forget(self, peer: RtpsPeer) -> None:
        """Remove a participant and its readers."""
        self._peers.remove(peer)
        self._receipts.pop(peer.prefix, None)
        self._publications.forget(peer.prefix + rtps.PUBLICATIONS_READER)
        for guid, reader in peer.readers.items():
            for writer in self._writers_for(reader):
                writer.forget(guid)

    def _remove_reader(self, peer: RtpsPeer, guid: bytes) -> None:
        """Remove a reader from its participant and from all writers."""
        reader = self._peers.remove_reader(peer, guid)
        if reader is not None:
            for writer in self._writers_for(reader):
                writer.forget(guid)

    def _writers_for(self, reader: FoundReader) -> Iterable[RtpsWriter]:
        return self._topics.get((reader.topic, reader.type_name), ())


def _u32(value: int) -> bytes:
    return value.to_bytes(4, "little")
