"""The participant without a network: matching, repeats, limits and the ledger of a reader."""

import pytest

from imud.formats import rtps
from imud.formats.rtps import Locator, ReceivedAckNack
from imud.publishers.ros2 import participant as module
from imud.publishers.ros2.participant import MatchedReader, RtpsNetwork, RtpsParticipant, RtpsWriter

WHERE = Locator("192.0.2.9", 7411)
GUID = bytes(range(12)) + b"\0\0\1\4"


class Wire(RtpsNetwork):
    """Network that keeps the messages, and refuses them while `is_full`."""

    def __init__(self) -> None:
        super().__init__(0, "127.0.0.1")
        self.made: list[bytes] = []
        self.is_full = False

    def send(self, made: bytes, where: Locator) -> bool:
        self.made.append(made)
        return not self.is_full


def request(base: int, *missing: int, final: bool = True) -> ReceivedAckNack:
    return ReceivedAckNack(GUID[12:], b"\0\0\1\3", base, missing, final)


def test_a_writer_repeats_kept_samples_and_counts_the_others() -> None:
    wire = Wire()
    writer = RtpsWriter(wire, b"\0\0\1\3", "rt/a", "b", is_kept=False)
    writer.write(b"\0\1\0\0old.", 0)
    writer.match(MatchedReader(GUID, WHERE, is_reliable=True, start=1, acked=0))
    writer.acknowledge(GUID, request(1, 1))
    assert wire.made[-1].endswith(rtps.gap(writer.entity, GUID[12:], 1)), "kept, but before its start"
    for number in range(14):
        wire.is_full = number == 3
        writer.write(b"\0\1\0\0" + bytes([number] * 4), 0)
    assert (writer.sent, writer.dropped, writer.last, list(writer.kept)) == (13, 1, 15, list(range(6, 16)))
    wire.made.clear()
    writer.acknowledge(GUID, request(2, 1, 2, 6, 16))
    assert [rtps.gap(writer.entity, GUID[12:], 1) in one for one in wire.made] == [True, False, False], (
        "before its start"
    )
    assert wire.made[2].endswith(bytes([4] * 4))
    assert writer.dropped == 2, "sample 2 is gone"
    wire.made.clear()
    writer.tick()
    assert len(wire.made) == 1, "it asks for a receipt"
    writer.acknowledge(GUID, request(16))
    writer.tick()
    assert len(wire.made) == 1
    writer.write(bytes(rtps.PAYLOAD_MAX + 1), 0)
    assert (writer.dropped, writer.sent) == (3, 13)
    writer.forget([GUID])
    writer.write(b"\0\1\0\0none", 0)
    assert (writer.dropped, writer.sent) == (3, 13)


def described(number: int, **changes: bytes) -> bytes:
    """Return the message of a participant, and with `topic` of a reader of it."""
    prefix = bytes(8) + number.to_bytes(4, "big")
    guid = prefix + rtps.PARTICIPANT
    values = [
        (rtps.P_PARTICIPANT_GUID, guid),
        (rtps.P_META_UNICAST, rtps.locator(WHERE)),
        (rtps.P_LEASE, b"\2\0\0\0\0\0\0\0"),
    ]
    writer = rtps.PARTICIPANT_WRITER
    if changes:
        writer, guid = rtps.SUBSCRIPTIONS_WRITER, prefix + b"\0\0\1\4"
        values = [
            (rtps.P_ENDPOINT_GUID, guid),
            (rtps.P_TYPE, rtps.text("b")),
            *((int(k[1:], 16), v) for k, v in changes.items()),
        ]
    return rtps.header(prefix) + rtps.data(writer, 1, rtps.PL_CDR_LE + rtps.parameters(values), key=guid)


TOPIC = {"p05": rtps.text("rt/a")}


@pytest.mark.parametrize(
    ("changes", "fits"),
    [
        (TOPIC, True), ({"p05": rtps.text("rt/other")}, False), (TOPIC | {"p07": rtps.text("c")}, True),
        (TOPIC | {"p1d": b"\1\0\0\0"}, False), (TOPIC | {"p23": b"\1\0\0\0\0\0\0\0"}, False),
        (TOPIC | {"p29": b"\1\0\0\0\2\0\0\0x\0"}, False), (TOPIC | {"p1b": b"\1\0\0\0"}, False),
        (TOPIC | {"p1f": b"\1\0\0\0"}, False),
    ],
)  # fmt: skip
def test_only_readers_with_the_same_topic_and_qos_match(changes: dict[str, bytes], fits: bool) -> None:
    one = RtpsParticipant(0, "127.0.0.1", "imud", lambda: 0)
    writer = one.add("rt/a", "b", "RIHS01_0")
    one.received(described(1), WHERE.address, 0)
    one.received(described(1, **changes), WHERE.address, 0)
    assert len(writer.readers) == fits
    later = one.add("rt/a", "b", "RIHS01_0")
    assert len(later.readers) == fits
    one.tick(2_000_000_000)  # the lease has ended
    assert not writer.readers


@pytest.mark.parametrize(("peers", "readers", "expected"), [(3, 10, (3, 2)), (10, 2, (2, 3))])
def test_participants_and_readers_above_the_limit_are_refused(
    monkeypatch: pytest.MonkeyPatch, peers: int, readers: int, expected: tuple[int, int]
) -> None:
    monkeypatch.setattr(module, "PEERS_MAX", peers)
    monkeypatch.setattr(module, "READERS_MAX", readers)
    one = RtpsParticipant(0, "127.0.0.1", "imud", lambda: 0)
    writer = one.add("rt/a", "b", "RIHS01_0")
    for number in range(5):
        one.received(described(number), WHERE.address, 0)
        one.received(described(number, **TOPIC), WHERE.address, 0)
    assert (len(writer.readers), one.discarded) == expected
    one.received(b"RTPX", WHERE.address, 0)
    assert one.discarded == expected[1] + 1
