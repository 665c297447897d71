"""A writer: repeats, limits and the ledger of a reader."""

from imud.formats import rtps
from imud.formats.rtps import ReceivedAckNack
from imud.publishers.ros2.writer import MatchedReader, RtpsWriter
from tests.support.rtps import PREFIX, READER, ROBOT, TOPIC, TYPE, FakeNetwork

GUID = PREFIX + READER


def acknowledgement(base: int, *missing: int, final: bool = True) -> ReceivedAckNack:
    return ReceivedAckNack(READER, b"\0\0\1\3", base, missing, final)


def test_a_writer_repeats_kept_samples_and_counts_the_others() -> None:
    network = FakeNetwork()
    network.start_turn(0)
    writer = RtpsWriter(network, b"\0\0\1\3", TOPIC, TYPE, is_kept=False)
    writer.write(b"\0\1\0\0old.", 0)
    writer.match(MatchedReader(GUID, ROBOT, is_reliable=True))
    writer.acknowledge(GUID, acknowledgement(1, 1))
    assert network.take()[-1].endswith(rtps.gap(writer.entity, READER, [1])), "kept, but before its start"
    for number in range(14):
        network.socket.is_full = number == 3
        writer.write(b"\0\1\0\0" + bytes([number] * 4), 0)
    assert (writer.sent, writer.dropped, writer.last, list(writer.kept)) == (13, 1, 15, list(range(6, 16)))
    network.take()
    network.start_turn(1)
    writer.acknowledge(GUID, acknowledgement(2, 1, 2, 6, 16))
    (message,) = network.take()
    gap = rtps.gap(writer.entity, READER, [1, 2])
    assert message == rtps.info_dst(PREFIX) + gap + writer.kept[6], "one datagram: 1 is before its start, 2 is gone"
    assert writer.dropped == 2, "sample 2 is gone"
    network.start_turn(2)
    writer.acknowledge(GUID, acknowledgement(2, 2))
    assert writer.dropped == 2, "counted once, although the reader requests it again"
    network.take()
    writer.tick(1)
    assert len(network.take()) == 1, "it asks for a receipt"
    writer.acknowledge(GUID, acknowledgement(16))
    writer.tick(1)
    assert network.take() == []
    writer.write(bytes(rtps.PAYLOAD_MAX + 1), 0)
    assert (writer.dropped, writer.sent) == (3, 13)
    writer.forget(GUID)
    writer.write(b"\0\1\0\0none", 0)
    assert (writer.dropped, writer.sent) == (3, 13)


def test_repeated_samples_fill_datagrams() -> None:
    """Samples of 500 bytes: two in each datagram, below the MTU. A second request in the same turn gets nothing."""
    network = FakeNetwork()
    network.start_turn(0)
    writer = RtpsWriter(network, b"\0\0\1\3", TOPIC, TYPE, is_kept=False)
    writer.match(MatchedReader(GUID, ROBOT, is_reliable=True))
    for _ in range(6):
        writer.write(bytes(500), 0)
    network.take()
    network.start_turn(1)
    for _ in range(1000):
        writer.acknowledge(GUID, acknowledgement(1, 1, 2, 3, 4, 5, 6))
    assert [message.count(b"\x15\x05") for message in network.take()] == [2, 2, 2]
    network.start_turn(2)
    writer.acknowledge(GUID, acknowledgement(1, 2))
    assert len(network.take()) == 1


def test_heartbeats_of_a_tick_are_limited_and_rotate() -> None:
    network = FakeNetwork()
    writer = RtpsWriter(network, b"\0\0\1\3", TOPIC, TYPE, is_kept=False)
    for number in range(5):
        writer.match(MatchedReader(PREFIX + bytes([0, 0, number, 4]), ROBOT, is_reliable=True))
    writer.write(b"\0\1\0\0", 0)
    receivers = []
    for _ in range(5):
        network.take()
        assert writer.tick(2) == 0
        receivers += [message[20:24] for message in network.take()]
    assert {receivers.count(bytes([0, 0, number, 4])) for number in range(5)} == {2}
