"""The participant without a network: matching, limits and receipts."""

import struct

import pytest

from imud.formats import rtps
from imud.formats.rtps import Locator
from imud.publishers.ros2 import peers as limits
from imud.publishers.ros2.participant import RtpsParticipant
from tests.support.rtps import PREFIX, READER, ROBOT, TOPIC, TYPE, FakeNetwork, announcement, request, subscription

GUID = PREFIX + READER
S = 1_000_000_000


def participant(network: FakeNetwork | None = None) -> tuple[RtpsParticipant, FakeNetwork]:
    network = network or FakeNetwork()
    return RtpsParticipant(0, None, "imud", lambda: 0, network=network), network


def described(**changes: bytes) -> bytes:
    """Return the datagram of a reader with these parameters."""
    guid = PREFIX + READER
    values = [(rtps.P_ENDPOINT_GUID, guid), (rtps.P_TYPE, rtps.text(TYPE))]
    values += [(int(name[1:], 16), value) for name, value in changes.items()]
    payload = rtps.PL_CDR_LE + rtps.parameters(values)
    return rtps.header(PREFIX) + rtps.data(rtps.SUBSCRIPTIONS_WRITER, 1, payload, key=guid)


IN_TOPIC = {"p05": rtps.text(TOPIC)}


@pytest.mark.parametrize(
    ("changes", "fits"),
    [
        (IN_TOPIC, True), ({"p05": rtps.text("rt/other")}, False), (IN_TOPIC | {"p07": rtps.text("c")}, True),
        (IN_TOPIC | {"p1d": b"\1\0\0\0"}, False), (IN_TOPIC | {"p23": b"\1\0\0\0\0\0\0\0"}, False),
        (IN_TOPIC | {"p29": b"\1\0\0\0\2\0\0\0x\0"}, False), (IN_TOPIC | {"p1b": b"\1\0\0\0"}, False),
        (IN_TOPIC | {"p1f": b"\1\0\0\0"}, False),
    ],
)  # fmt: skip
def test_only_readers_with_the_same_topic_and_qos_match(changes: dict[str, bytes], fits: bool) -> None:
    daemon, _ = participant()
    writer = daemon.add(TOPIC, TYPE, "RIHS01_0")
    daemon.received(announcement(lease_s=2), ROBOT.address, 0)
    daemon.received(described(**changes), ROBOT.address, 0)
    assert len(writer.readers) == fits
    later = daemon.add(TOPIC, TYPE, "RIHS01_0")
    assert len(later.readers) == fits
    daemon.received(described(p05=rtps.text("rt/changed")), ROBOT.address, 0)
    assert not writer.readers, "the reader has another topic now"
    daemon.received(described(**changes), ROBOT.address, 0)
    assert len(writer.readers) == fits
    daemon.tick(2 * S)  # the lease has ended
    assert not writer.readers


def test_readers_of_other_types_are_not_stored() -> None:
    """A robot has hundreds of readers of services and parameters."""
    daemon, _ = participant()
    daemon.accepted_types = {"other"}
    daemon.received(announcement() + subscription(), ROBOT.address, 0)
    daemon.accepted_types = None
    assert not daemon.add(TOPIC, TYPE, "RIHS01_0").readers


def entity(number: int) -> bytes:
    return number.to_bytes(3, "big") + b"\4"


@pytest.mark.parametrize(
    ("name", "limit"),
    [("PEER_READERS_MAX", 3), ("ADDRESS_READERS_MAX", 3), ("READERS_MAX", 3)],
)
def test_readers_above_a_limit_are_refused(monkeypatch: pytest.MonkeyPatch, name: str, limit: int) -> None:
    monkeypatch.setattr(limits, name, limit)
    daemon, _ = participant()
    writer = daemon.add(TOPIC, TYPE, "RIHS01_0")
    daemon.received(announcement(), ROBOT.address, 0)
    for number in range(limit + 2):
        daemon.received(rtps.header(PREFIX) + subscription(entity(number), number + 1), ROBOT.address, 0)
    assert (len(writer.readers), daemon.discarded) == (limit, 2)
    assert f"at most {limit} readers" in daemon.problem
    assert ROBOT.address in daemon.problem
    daemon.received(announcement(ended=True), ROBOT.address, 0)
    daemon.received(announcement() + subscription(), ROBOT.address, 0)
    assert len(writer.readers) == 1, "the end of a participant makes room"
    daemon.received(b"RTPX", ROBOT.address, 0)
    assert daemon.discarded == 3


def test_destinations_of_a_writer_are_limited() -> None:
    """Readers at 4000 ports cost 4000 datagrams for each sample."""
    daemon, network = participant()
    writer = daemon.add(TOPIC, TYPE, "RIHS01_0")
    daemon.received(announcement(), ROBOT.address, 0)
    for number in range(20):
        where = Locator(ROBOT.address, 20_000 + number)
        message = rtps.header(PREFIX) + subscription(entity(number), number + 1, locators=[where])
        daemon.received(message, ROBOT.address, 0)
    network.take()
    writer.write(b"\0\1\0\0", 0)
    assert len(network.take()) == writer.sent == 16
    assert "16 ports of one address" in daemon.problem


def test_sent_samples_have_a_limit_per_second() -> None:
    daemon, network = participant()
    writer = daemon.add(TOPIC, TYPE, "RIHS01_0")
    daemon.received(announcement() + subscription(is_reliable=False), ROBOT.address, 0)
    for _ in range(10_100):
        writer.write(b"\0\1\0\0", 0)
    assert (writer.sent, writer.dropped) == (10_000, 100)
    assert "10000 datagrams per second" in daemon.problem
    network.start_turn(S // 100)
    writer.write(b"\0\1\0\0", 0)
    assert writer.sent == 10_001


def test_number_overflow_does_not_end_the_output() -> None:
    """HEARTBEAT, DATA with the number 2^63 - 1, HEARTBEAT raised struct.error (issue of an outsider)."""
    top = (0x7FFF_FFFF, 0xFFFF_FFFF)
    heartbeat = struct.pack(
        "<BBH4s4siIiIi", rtps.HEARTBEAT, 1, 28, rtps.ANY_ENTITY, rtps.SUBSCRIPTIONS_WRITER, *top, *top, 1
    )
    data = rtps.data(rtps.SUBSCRIPTIONS_WRITER, 2**63 - 1, rtps.PL_CDR_LE + rtps.parameters([]))
    daemon, _ = participant()
    for submessages in (heartbeat, data, heartbeat + data + heartbeat):
        daemon.received(announcement() + submessages, ROBOT.address, 0)
    assert daemon.discarded == 3


def test_descriptions_are_requested_in_any_order() -> None:
    """The receipt contains each missing number once, and one receipt is sent per turn."""
    daemon, network = participant()
    daemon.received(announcement(), ROBOT.address, 0)
    network.take()
    heartbeat = rtps.heartbeat(rtps.SUBSCRIPTIONS_WRITER, 1, 9, 1)
    gap = rtps.gap(rtps.SUBSCRIPTIONS_WRITER, rtps.SUBSCRIPTIONS_READER, [5, 7, 8])
    submessages = heartbeat + subscription(entity(2), 2) + heartbeat + gap + heartbeat
    daemon.received(rtps.header(PREFIX) + submessages, ROBOT.address, 0)
    (receipt,) = network.take()
    assert receipt.endswith(rtps.acknack(rtps.SUBSCRIPTIONS_READER, rtps.SUBSCRIPTIONS_WRITER, 1, [1, 3, 4, 6, 9], 1))
    submessages = b"".join(subscription(entity(number), number) for number in (1, 3, 4, 6))
    daemon.received(rtps.header(PREFIX) + submessages + heartbeat, ROBOT.address, 0)
    (receipt,) = network.take()
    assert receipt.endswith(rtps.acknack(rtps.SUBSCRIPTIONS_READER, rtps.SUBSCRIPTIONS_WRITER, 9, [9], 2))


def test_a_participant_ends_only_its_own_readers() -> None:
    other = b"another one!"
    daemon, _ = participant()
    writer = daemon.add(TOPIC, TYPE, "RIHS01_0")
    daemon.received(announcement() + subscription(), ROBOT.address, 0)
    where = Locator("192.0.2.10", 7411)
    daemon.received(announcement(other, [where]), where.address, 0)
    key = rtps.key_of(GUID, is_participant=False)
    ended = rtps.data(rtps.SUBSCRIPTIONS_WRITER, 1, key, key=GUID, ended=True)
    daemon.received(rtps.header(other) + ended, where.address, 0)
    daemon.received(rtps.header(other) + announcement(ended=True)[rtps.HEADER_BYTES :], where.address, 0)
    daemon.received(announcement(ended=True), where.address, 0)
    assert len(writer.readers) == 1
    daemon.received(rtps.header(PREFIX) + ended, ROBOT.address, 0)
    assert not writer.readers


def test_an_unknown_host_cannot_request_samples_for_a_participant() -> None:
    daemon, network = participant()
    writer = daemon.add(TOPIC, TYPE, "RIHS01_0")
    daemon.received(announcement() + subscription(), ROBOT.address, 0)
    writer.write(bytes(1000), 0)
    network.take()
    message = rtps.header(PREFIX) + request(writer.entity, 1, [1])
    daemon.received(message, "192.0.2.66", 0)
    assert network.take() == []
    daemon.received(message, ROBOT.address, 0)
    assert len(network.take()) == 1
