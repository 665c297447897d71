"""Addresses of other participants: imud follows a GUID, and sends only to hosts that send to it."""

import pytest

from imud.formats import rtps
from imud.formats.rtps import Locator
from imud.publishers.ros2.participant import RtpsParticipant
from imud.publishers.ros2.peers import ADDRESS_PEERS_MAX, LEASE_MAX_S, PEERS_MAX
from imud.publishers.ros2.writer import RtpsWriter
from tests.support.rtps import (
    PREFIX,
    READER,
    ROBOT,
    TOPIC,
    TYPE,
    FakeNetwork,
    announcement,
    interface,
    request,
    subscription,
)

S = 1_000_000_000
MOVED = Locator("192.0.2.10", 7413)
VICTIM = Locator("192.0.2.77", 5555)
PAYLOAD = b"\0\1\0\0PAYLOAD!"


class Bench:
    """A participant with one topic."""

    def __init__(self, network: FakeNetwork | None = None) -> None:
        self.now_ns = 0
        self.network = network or FakeNetwork()
        self.participant = RtpsParticipant(0, None, "imud", lambda: self.now_ns, network=self.network)
        self.writer: RtpsWriter = self.participant.add(TOPIC, TYPE, "RIHS01_0")

    def receive(self, datagram: bytes, source: str, now_ns: int = 0) -> None:
        self.now_ns = now_ns
        self.participant.received(datagram, source, now_ns)

    def destinations(self) -> list[Locator]:
        """Write a sample. Return its destinations."""
        self.network.take()
        self.writer.write(PAYLOAD, 0)
        return [where for _, where in self.network.sent]


def subscribed(prefix: bytes = PREFIX, *, is_reliable: bool = False) -> bytes:
    return rtps.header(prefix) + subscription(prefix=prefix, is_reliable=is_reliable)


@pytest.mark.parametrize("is_reliable", [True, False])
def test_robot_moves(is_reliable: bool) -> None:
    """The robot announces the same GUID with another address, for example after DHCP."""
    bench = Bench()
    bench.receive(announcement(), ROBOT.address)
    bench.receive(subscribed(is_reliable=is_reliable), ROBOT.address)
    assert bench.destinations() == [ROBOT]
    bench.receive(announcement(locators=[MOVED]), MOVED.address, S)
    bench.participant.tick(S)
    assert any(where == MOVED for _, where in bench.network.sent), "imud announces the topics at the new address"
    assert bench.destinations() == [MOVED]
    assert (bench.writer.sent, bench.writer.dropped) == (2, 0)
    reader = bench.writer.readers[PREFIX + READER]
    assert reader.start == 1, "a reliable reader can still request earlier samples"
    bench.receive(rtps.header(PREFIX) + request(bench.writer.entity, 1, [1, 2]), MOVED.address, S)
    assert any(where == MOVED for _, where in bench.network.sent) is True


def test_robot_sends_from_another_address_than_it_announces() -> None:
    """Fast DDS 2097: after a change of the address the participant announces the old locators for ever."""
    bench = Bench()
    bench.receive(announcement(), ROBOT.address)
    bench.receive(subscribed(), ROBOT.address)
    for now_ns in (3 * S, 6 * S):
        bench.receive(announcement(), MOVED.address, now_ns)
    assert bench.destinations() == [Locator(MOVED.address, ROBOT.port)]


def test_robot_with_two_networks_keeps_its_address() -> None:
    """It announces both addresses, and sends each announcement from both. imud changes only if one is silent."""
    bench = Bench()
    both = [ROBOT, MOVED]
    bench.receive(announcement(locators=both), ROBOT.address)
    bench.receive(subscribed(), MOVED.address)
    for now_ns in range(0, 30 * S, 3 * S):
        for source in (ROBOT.address, MOVED.address):
            bench.receive(announcement(locators=both), source, now_ns)
            assert bench.destinations() == [ROBOT]
    bench.receive(announcement(locators=both), MOVED.address, 35 * S)
    assert bench.destinations() == [MOVED]


def test_port_of_the_announced_address_is_used() -> None:
    """The first locator belongs to a network that imud cannot reach, such as the bridge of Docker."""
    bench = Bench()
    bench.receive(announcement(locators=[Locator("172.17.0.1", 7415), ROBOT]), ROBOT.address)
    bench.receive(subscribed(), ROBOT.address)
    assert bench.destinations() == [ROBOT]


def test_nothing_is_sent_to_an_announced_third_host() -> None:
    """Inside and outside the network of imud: samples and discovery go to the sender of the announcement."""
    for victim in (VICTIM, Locator("198.51.100.1", 5555), Locator("127.0.0.1", 53), Locator("192.0.2.255", 1)):
        bench = Bench()
        bench.receive(announcement(locators=[victim]), ROBOT.address)
        bench.receive(rtps.header(PREFIX) + subscription(locators=[victim]), ROBOT.address)
        for now_ns in range(0, 60 * S, S):
            bench.participant.tick(now_ns)
            bench.writer.write(PAYLOAD, 0)
        assert {where.address for _, where in bench.network.sent} == {ROBOT.address}


@pytest.mark.parametrize("source", ["198.51.100.1", "10.0.0.1", "192.0.3.1", "192.0.2.0", "192.0.2.255", "127.0.0.1"])
def test_a_host_of_another_network_gets_nothing(source: str) -> None:
    bench = Bench()
    bench.receive(announcement(locators=[Locator(source, 7411)]) + subscription(), source)
    assert bench.network.take() == []
    assert not bench.writer.readers
    assert bench.participant.discarded == 1
    if source != "127.0.0.1":
        assert f"the participant at {source}" in bench.participant.problem
        assert "192.0.2.0/24" in bench.participant.problem
    bench.participant.close()


def test_fast_dds_on_this_host() -> None:
    """Its announcement has the address of the interface as source, its other datagrams the loopback address."""
    own = Locator("192.0.2.1", 7413)
    bench = Bench()
    bench.receive(announcement(locators=[own]), "127.0.0.1")
    bench.receive(announcement(locators=[own]), own.address)
    bench.receive(subscribed(), "127.0.0.1")
    assert bench.destinations() == [own]


@pytest.mark.parametrize("lease_s", [2**31 - 1, 61, -1, 0, 1])
def test_a_lease_has_a_maximum(lease_s: int) -> None:
    bench = Bench()
    bench.receive(announcement(lease_s=lease_s), ROBOT.address)
    bench.receive(subscribed(), ROBOT.address)
    end_ns = max(1, min(lease_s, LEASE_MAX_S)) * S
    bench.participant.tick(end_ns - 1)
    assert bench.destinations() == [ROBOT]
    bench.participant.tick(end_ns)
    assert bench.destinations() == []


def test_each_datagram_renews_the_lease() -> None:
    bench = Bench()
    bench.receive(announcement(lease_s=10), ROBOT.address)
    bench.receive(subscribed(), ROBOT.address)
    bench.receive(rtps.header(PREFIX) + request(bench.writer.entity, 1, []), ROBOT.address, 9 * S)
    bench.participant.tick(15 * S)
    assert bench.destinations() == [ROBOT]
    bench.receive(rtps.header(PREFIX) + request(bench.writer.entity, 1, []), VICTIM.address, 18 * S)
    bench.participant.tick(19 * S)
    assert bench.destinations() == [], "a datagram of another host is not a receipt"


def robots(bench: Bench, count: int, address: str, first: int = 0, now_ns: int = 0) -> list[bytes]:
    """Announce participants of one address with a lease of 68 years. Return their prefixes."""
    prefixes = [b"robot" + number.to_bytes(7, "big") for number in range(first, first + count)]
    for prefix in prefixes:
        bench.receive(announcement(prefix, [Locator(address, 9)], lease_s=2**31 - 1), address, now_ns)
    return prefixes


def test_false_participants_make_room() -> None:
    """300 announcements of one host, then a real robot: it is accepted, also from the same address."""
    for address in (VICTIM.address, ROBOT.address):
        bench = Bench()
        robots(bench, 300, VICTIM.address)
        assert f"at most {ADDRESS_PEERS_MAX} participants of one address" in bench.participant.problem
        assert VICTIM.address in bench.participant.problem
        assert bench.participant.refused == 300 - ADDRESS_PEERS_MAX
        bench.receive(announcement(locators=[Locator(address, 7411)]) + subscription(), address)
        assert bench.destinations() == [Locator(address, 7411)]


def test_false_participants_of_many_addresses_make_room() -> None:
    bench = Bench()
    for number in range(5):
        robots(bench, 100, f"192.0.2.{100 + number}", 1000 * number)
    assert f"at most {PEERS_MAX} participants, got more" in bench.participant.problem
    bench.receive(announcement() + subscription(), ROBOT.address)
    assert bench.destinations() == [ROBOT]


def test_confirmed_participants_stay() -> None:
    """A robot that has acknowledged messages of imud stays while it sends; it makes room after 20 s without one."""
    bench = Bench()
    bench.receive(announcement() + subscription(), ROBOT.address)
    receipt = rtps.header(PREFIX) + request(rtps.PUBLICATIONS_WRITER, 2, [], rtps.PUBLICATIONS_READER)
    bench.receive(receipt, ROBOT.address)
    for number in range(5):
        robots(bench, 100, f"192.0.2.{100 + number}", 1000 * number, 19 * S)
    assert bench.destinations() == [ROBOT]


def test_all_confirmed_participants_refuse_a_new_one() -> None:
    bench = Bench()
    for prefix in robots(bench, ADDRESS_PEERS_MAX, ROBOT.address):
        receipt = request(rtps.PUBLICATIONS_WRITER, 2, [], rtps.PUBLICATIONS_READER)
        bench.receive(rtps.header(prefix) + receipt, ROBOT.address)
    bench.receive(announcement() + subscription(), ROBOT.address, S)
    assert bench.destinations() == []
    assert bench.participant.refused == 1
    bench.receive(announcement(lease_s=60) + subscription(), ROBOT.address, 21 * S)
    assert bench.destinations() == [ROBOT], "the oldest of them is silent"


def test_another_address_of_this_host() -> None:
    """After a change of the address: imud announces the new address immediately, and sends in the new network."""
    bench = Bench()
    bench.receive(announcement() + subscription(), ROBOT.address)
    bench.participant.tick(0)
    bench.network.take()
    bench.participant.tick(S)
    assert not any(rtps.PARTICIPANT_WRITER in message for message in bench.network.take()), "announced 1 s ago"
    bench.network.interfaces = [interface("198.51.100.7/24")]
    bench.participant.tick(2 * S)
    (message,) = [message for message in bench.network.take() if rtps.PARTICIPANT_WRITER in message]
    assert rtps.locator(Locator("198.51.100.7", 7410)) in message
    assert bench.destinations() == [], "the robot is in the old network"
    moved = Locator("198.51.100.9", 7411)
    bench.receive(announcement(locators=[moved]) + subscription(), moved.address, 3 * S)
    assert bench.destinations() == [moved]
    assert bench.participant.problem == ""
