"""The complete participant of DDS: for any datagrams, writes and ticks, the participant raises no exception, its state
and its replies are bounded, and it sends only to hosts of its networks that have sent a datagram.

An input is a list of steps. A step is its kind, an index, a length (u16), and data. See `Bench.take`.
"""

import struct
from collections.abc import Sequence
from typing import Final

from imud.formats import rtps
from imud.formats.rtps import Locator
from imud.publishers.ros2.network import INPUT_LIMITS
from imud.publishers.ros2.participant import RtpsParticipant
from imud.publishers.ros2.peers import ADDRESS_READERS_MAX, PEERS_MAX, READERS_MAX, WINDOW
from imud.publishers.ros2.writer import ADDRESS_DESTINATIONS_MAX, DEPTH, DESTINATIONS_MAX, RtpsWriter
from tests.fuzz.target import Target, check_printable
from tests.support.rtps import (
    PREFIX,
    READER,
    ROBOT,
    TOPIC,
    TYPE,
    FakeNetwork,
    announcement,
    end_of_reader,
    interface,
    request,
    subscription,
    subscriptions_heartbeat,
)

STEP: Final = struct.Struct("<BBH")  # kind, index, length
SUBMESSAGES, DATAGRAM, WRITE, TICK, ADD, REMOVE, MOVE = range(7)  # kinds of steps
SOURCES: Final = (ROBOT.address, "192.0.2.10", "192.0.2.255", "127.0.0.1", "198.51.100.1", "198.51.100.9", "10.0.0.1")
PREFIXES: Final = (PREFIX, b"another one!", b"robot number")
ADDRESSES: Final = ("192.0.2.1/24", "198.51.100.7/24", "192.0.2.9/32", "127.0.0.1/8")
TICK_NS: Final = 100_000_000  # time of one unit of a tick, ns
WRITERS_MAX: Final = 20
DATAGRAM_BYTES_MAX: Final = 65_507
INPUT_BYTES: Final = 8192


def names() -> Sequence[str]:
    return ["participant"]


def make(_name: str) -> Target:
    return Target(run, seeds, words=words, bytes_max=INPUT_BYTES)


def run(data: bytes) -> None:
    bench = Bench()
    offset = 0
    while offset + STEP.size <= len(data):
        kind, index, size = STEP.unpack_from(data, offset)
        offset += STEP.size
        bench.take(kind % 7, index, data[offset : offset + size])
        offset += size
        bench.check()
    bench.participant.close()


class Bench:
    """A participant, the hosts that have sent a datagram to it, and a CPU clock that advances with each reading."""

    def __init__(self) -> None:
        self.now_ns = 0
        self.cpu_ns = 0
        self.network = FakeNetwork(self.read_cpu)
        self.participant = RtpsParticipant(0, None, "imud", lambda: self.now_ns, network=self.network)
        self.writers: list[RtpsWriter] = [self.participant.add(TOPIC, TYPE, "RIHS01_0")]
        self.participant.add("graph", TYPE, "RIHS01_1", is_kept=True).write(b"\0\1\0\0", 0)
        self.senders: set[str] = set()
        self.limit = 0  # maximum number of datagrams in the present step
        self.discarded = 0

    def read_cpu(self) -> int:
        self.cpu_ns += 20_000
        return self.cpu_ns

    def take(self, kind: int, index: int, data: bytes) -> None:
        """Do a step. `index` selects the source and prefix, the topic, the time or the address of imud."""
        self.network.take()
        self.limit = INPUT_LIMITS.turn_replies
        if kind in (SUBMESSAGES, DATAGRAM):
            source = SOURCES[index % len(SOURCES)]
            prefix = PREFIXES[index // len(SOURCES) % len(PREFIXES)]
            self.senders.add(source)
            datagram = rtps.header(prefix) + data if kind == SUBMESSAGES else data
            self.participant.received(datagram[:DATAGRAM_BYTES_MAX], source, self.now_ns)
        elif kind == WRITE and self.writers:
            self.limit = DESTINATIONS_MAX
            self.writers[index % len(self.writers)].write(b"\0\1\0\0" + data, self.now_ns - TICK_NS)
        elif kind == TICK:
            self.limit = PEERS_MAX
            self.now_ns += index * TICK_NS
            self.participant.tick(self.now_ns)
        elif kind == ADD and len(self.writers) < WRITERS_MAX:
            self.limit = PEERS_MAX + READERS_MAX
            self.writers.append(self.participant.add(f"{TOPIC}{index % 4}", TYPE, "RIHS01_0"))
        elif kind == REMOVE and self.writers:
            self.participant.remove(self.writers.pop(index % len(self.writers)))
        elif kind == MOVE:
            self.network.interfaces = [interface(ADDRESSES[index % len(ADDRESSES)])]

    def check(self) -> None:
        """Raise AssertionError if the state or the datagrams of the step exceed a limit."""
        participant = self.participant
        sent = self.network.sent
        assert len(sent) <= self.limit
        for datagram, where in sent:
            assert len(datagram) <= DATAGRAM_BYTES_MAX
            assert self.network.is_reachable(where.address)
            assert where.address in self.senders
            assert 0 < where.port < 1 << 16
        peers = list(participant._peers)
        readers = [reader for peer in peers for reader in peer.readers]
        assert len(peers) <= PEERS_MAX
        assert len(readers) <= min(READERS_MAX, ADDRESS_READERS_MAX * len(SOURCES))
        assert participant._peers._readers == len(readers)
        for peer in peers:
            assert peer.arrived.bit_length() <= WINDOW
            assert 0 < peer.next_seq <= rtps.SEQ_MAX + WINDOW + 1
        for writer in participant.writers:
            assert set(writer.readers) <= set(readers)
            assert sum(writer._destinations.values()) == len(writer.readers)
            assert len(writer._destinations) <= ADDRESS_DESTINATIONS_MAX * len(SOURCES)
            assert len(writer.kept) <= DEPTH
        assert participant.discarded >= self.discarded
        self.discarded = participant.discarded
        check_printable(participant.problem)


def step(kind: int, index: int = 0, data: bytes = b"") -> bytes:
    return STEP.pack(kind, index, len(data)) + data


def steps_of_robot(*submessages: bytes) -> bytes:
    """Announce a robot and its reader, then send each submessage after a sample."""
    head = step(SUBMESSAGES, 0, announcement()[rtps.HEADER_BYTES :]) + step(SUBMESSAGES, 0, subscription())
    return head + b"".join(step(WRITE) + step(SUBMESSAGES, 0, made) + step(TICK, 5) for made in submessages)


def seeds() -> list[bytes]:
    writer = b"\0\0\1\3"
    all_samples = list(range(1, 257))
    moved = Locator("192.0.2.10", 7413)
    submessages = [
        request(writer, 1, []), request(writer, 1, [1, 2, 9]), request(writer, 1, all_samples),
        request(rtps.PUBLICATIONS_WRITER, 1, [1, 2], rtps.PUBLICATIONS_READER), subscriptions_heartbeat(1, 9),
        subscriptions_heartbeat(5, 300, final=True), subscriptions_heartbeat(rtps.SEQ_MAX, rtps.SEQ_MAX),
        rtps.gap(rtps.SUBSCRIPTIONS_WRITER, rtps.SUBSCRIPTIONS_READER, [1, 2, 7]), end_of_reader(READER),
        announcement(ended=True)[rtps.HEADER_BYTES :], rtps.info_ts(1) + rtps.info_dst(bytes(12)) + subscription(),
        subscription(b"\0\0\2\4", 2, locators=[moved]), subscription(b"\0\0\3\4", rtps.SEQ_MAX, is_reliable=False),
        announcement(locators=[moved], lease_s=2**31 - 1)[rtps.HEADER_BYTES :],
    ]  # fmt: skip
    other = step(SUBMESSAGES, 8, announcement(PREFIXES[1], [moved])[rtps.HEADER_BYTES :])
    victim = step(SUBMESSAGES, 0, announcement(locators=[Locator("198.51.100.1", 53)])[rtps.HEADER_BYTES :])
    readers = [subscription(number.to_bytes(3, "big") + b"\4", number + 1) for number in range(40)]
    return [
        *(steps_of_robot(submessage) for submessage in submessages),
        steps_of_robot(*submessages[:9]),
        steps_of_robot(b"".join(submessages[:8])),
        steps_of_robot(submessages[0]) + step(SUBMESSAGES, 1, submessages[-1]) + step(WRITE) + step(TICK, 60),
        victim + step(SUBMESSAGES, 0, subscription()) + step(WRITE) + step(TICK, 255) + step(TICK, 255),
        other + steps_of_robot(submessages[1]) + step(ADD, 1) + step(REMOVE) + step(WRITE),
        steps_of_robot() + step(MOVE, 1) + step(TICK, 20) + step(WRITE) + step(MOVE, 3) + step(TICK, 20) + step(WRITE),
        steps_of_robot(b"".join(readers)) + step(WRITE, 0, bytes(100)) + step(TICK, 1),
        step(DATAGRAM, 0, announcement()) + step(DATAGRAM, 3, announcement()) + step(DATAGRAM, 6, b"RTPS"),
    ]


def words() -> list[bytes]:
    return [
        rtps.PARTICIPANT_WRITER, rtps.SUBSCRIPTIONS_WRITER, rtps.PUBLICATIONS_WRITER, rtps.PUBLICATIONS_READER,
        rtps.PARTICIPANT, READER, b"\0\0\1\3", rtps.PL_CDR_LE, rtps.text(TOPIC), rtps.text(TYPE),
        rtps.locator(ROBOT), *(bytes([kind]) for kind in (rtps.ACKNACK, rtps.HEARTBEAT, rtps.GAP, rtps.DATA)),
        b"\xff\xff\xff\x7f\xff\xff\xff\xff", b"\0\0\0\x80\0\0\0\0", b"\0\0\0\x40\0\0\0\0",
    ]  # fmt: skip
