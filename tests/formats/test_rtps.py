"""RTPS messages: bytes by hand from the specification, and any input."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats import rtps
from imud.formats.rtps import Locator

PREFIX, OTHER = bytes(range(12)), bytes(range(20, 32))
HEAD = rtps.header(OTHER)


def messages(reader: rtps.RtpsReader, datagram: bytes) -> list[rtps.Submessage]:
    """Return the submessages that imud processes."""
    return [submessage for submessage in reader.read(datagram)[1] if submessage is not None]


def test_submessages_have_the_bytes_of_the_specification() -> None:
    """OMG formal/2014-09-01, sections 9.4.5.3 (DATA), 9.4.5.6 (HEARTBEAT), 9.4.5.2 (ACKNACK) and 9.4.5.4 (GAP)."""
    writer, reader = b"\0\0\1\3", b"\0\0\2\4"
    assert HEAD == b"RTPS\x02\x02\0\0" + OTHER
    assert rtps.info_ts(1_500_000_000) == bytes.fromhex("09010800 01000000 00000080")
    made = rtps.data(writer, 5, b"\0\1\0\0abc")
    assert made == bytes.fromhex("15051c00 0000 1000 00000000 00000103 00000000 05000000") + b"\0\1\0\0abc\0"
    made = rtps.heartbeat(writer, 2, 5, 9, final=True)
    assert made == bytes.fromhex("07031c00 00000000 00000103 00000000 02000000 00000000 05000000 09000000")
    made = rtps.acknack(reader, writer, 4, [4, 6], 1)
    assert made == bytes.fromhex("06011c00 00000204 00000103 00000000 04000000 03000000 000000a0 01000000")
    made = rtps.gap(writer, reader, [7])
    assert made == bytes.fromhex("08011c00 00000204 00000103 00000000 07000000 00000000 08000000 00000000")
    made = rtps.gap(writer, reader, [7, 8, 10])
    assert made == bytes.fromhex("08012000 00000204 00000103 00000000 07000000 00000000 08000000 03000000 000000a0")


def test_requests_come_back() -> None:
    found = rtps.RtpsReader(PREFIX)
    missing = [3, 40, 200]
    datagram = HEAD + rtps.info_dst(PREFIX) + rtps.acknack(b"\0\0\2\4", b"\0\0\1\3", 3, missing, 1)
    (one,) = messages(found, datagram)
    assert isinstance(one, rtps.ReceivedAckNack)
    assert (one.base, list(one.missing), one.is_final) == (3, missing, False)
    assert messages(found, HEAD + rtps.info_dst(bytes(range(1, 13))) + datagram[36:]) == [], "for another participant"
    assert messages(found, rtps.header(PREFIX) + datagram[20:]) == [], "its own message"
    assert found.invalid == 0


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_participant_in_both_byte_orders(order: str) -> None:
    def parameter(number: int, value: bytes) -> bytes:
        return struct.pack(order + "HH", number, len(value)) + value

    locator = struct.pack(order + "iI", 1, 7410) + bytes(12) + bytes([192, 0, 2, 9])
    payload = (b"\0\3\0\0" if order == "<" else b"\0\2\0\0") + b"".join([
        parameter(0x50, OTHER + rtps.PARTICIPANT), parameter(0x02, struct.pack(order + "iI", 20, 0)),
        parameter(0x8007, b"vendor.."), parameter(0x32, locator), parameter(0x01, b""),
    ])  # fmt: skip
    body = struct.pack(order + "HH4s4siI", 0, 16, bytes(4), rtps.PARTICIPANT_WRITER, 0, 1) + payload
    datagram = HEAD + struct.pack(order + "BBH", 0x15, 4 + (order == "<"), len(body)) + body
    (one,) = messages(rtps.RtpsReader(PREFIX), datagram)
    assert isinstance(one, rtps.ReceivedData)
    found = rtps.participant_of(one)
    assert found is not None
    assert (found.guid, found.lease_s, found.meta) == (OTHER + rtps.PARTICIPANT, 20, [Locator("192.0.2.9", 7410)])
    assert found.default == found.meta
    assert rtps.reader_of(one) is None, "it has no topic"


VALID = HEAD + rtps.data(
    rtps.SUBSCRIPTIONS_WRITER, 1,
    rtps.PL_CDR_LE + rtps.parameters([
        (rtps.P_ENDPOINT_GUID, OTHER + b"\0\0\1\4"), (rtps.P_TOPIC, rtps.text("rt/a")), (rtps.P_TYPE, rtps.text("b")),
        (rtps.P_LIVELINESS, b"\0\0\0\0\xff\xff\xff\x7f\xff\xff\xff\xff"),
        (rtps.P_UNICAST, rtps.locator(Locator("192.0.2.9", 1))),
    ]), key=OTHER + b"\0\0\1\4",
)  # fmt: skip


@given(st.binary(max_size=200), st.integers(0, len(VALID)), st.binary(max_size=8))
def test_any_datagram_is_read_or_counted(noise: bytes, at: int, patch: bytes) -> None:
    found = rtps.RtpsReader(PREFIX)
    for datagram in (noise, HEAD + noise, VALID[:at], VALID[:at] + patch + VALID[at + len(patch) :]):
        before = found.invalid
        for one in messages(found, datagram):
            if isinstance(one, rtps.ReceivedData):
                rtps.participant_of(one), rtps.reader_of(one), rtps.guid_in(one)
        assert found.invalid - before in (0, 1)


TOP = 2**63 - 1
SUBSCRIPTIONS = rtps.SUBSCRIPTIONS_WRITER


def number(value: int) -> bytes:
    """Return a sequence number, also outside the range of sequence numbers."""
    return struct.pack("<iI", value >> 32, value & 0xFFFF_FFFF)


def submessage(kind: int, body: bytes) -> bytes:
    return struct.pack("<BBH", kind, 5 if kind == rtps.DATA else 1, len(body)) + body


def heartbeat_of(first: int, last: int) -> bytes:
    return submessage(rtps.HEARTBEAT, bytes(4) + SUBSCRIPTIONS + number(first) + number(last) + bytes(4))


def gap_of(start: int, base: int) -> bytes:
    return submessage(rtps.GAP, bytes(4) + SUBSCRIPTIONS + number(start) + number(base) + bytes(4))


def acknack_of(base: int, count: int = 0) -> bytes:
    return submessage(rtps.ACKNACK, bytes(8) + number(base) + struct.pack("<I", count) + bytes(40))


def data_of(seq: int) -> bytes:
    head = struct.pack("<HH", 0, 16) + bytes(4) + SUBSCRIPTIONS + number(seq)
    return submessage(rtps.DATA, head + rtps.PL_CDR_LE + rtps.parameters([]))


@pytest.mark.parametrize(
    "made",
    [
        heartbeat_of(TOP, TOP), heartbeat_of(1, TOP), heartbeat_of(-1, 1), heartbeat_of(5, 3), heartbeat_of(1, -1),
        heartbeat_of(-(2**63), 1), gap_of(0, 1), gap_of(-1, 1), gap_of(5, 4), gap_of(1, TOP), gap_of(TOP, TOP),
        acknack_of(-1), acknack_of(TOP), acknack_of(1, 257), acknack_of(1, 0xFFFF_FFFF), data_of(0), data_of(-1),
        data_of(TOP), data_of(-(2**63)),
    ],
)  # fmt: skip
def test_sequence_numbers_out_of_range(made: bytes) -> None:
    """Section 8.3.7: a submessage with an invalid number is invalid. Numbers near 2^63 overflowed in a receipt."""
    reader = rtps.RtpsReader(PREFIX)
    assert messages(reader, HEAD + made) == []
    assert reader.invalid == 1


@pytest.mark.parametrize(
    "made", [heartbeat_of(1, 0), heartbeat_of(0, 0), heartbeat_of(rtps.SEQ_MAX, rtps.SEQ_MAX), gap_of(1, 1),
             acknack_of(0), acknack_of(rtps.SEQ_MAX, 256), data_of(1), data_of(rtps.SEQ_MAX)],
)  # fmt: skip
def test_sequence_numbers_at_the_limits(made: bytes) -> None:
    reader = rtps.RtpsReader(PREFIX)
    assert len(messages(reader, HEAD + made)) == 1
    assert reader.invalid == 0


@pytest.mark.parametrize(("count", "invalid"), [(rtps.PARAMETERS_MAX - 2, 0), (rtps.PARAMETERS_MAX, 1), (15_000, 1)])
def test_number_of_parameters_is_limited(count: int, invalid: int) -> None:
    """15,000 empty parameters in one submessage cost 10 ms."""
    payload = rtps.PL_CDR_LE + rtps.parameters([(rtps.P_USER_DATA, b"")] * count)
    reader = rtps.RtpsReader(PREFIX)
    assert len(messages(reader, HEAD + rtps.data(rtps.SUBSCRIPTIONS_WRITER, 1, payload))) == 1 - invalid
    assert reader.invalid == invalid


def described(*values: tuple[int, bytes]) -> rtps.ReceivedData:
    payload = rtps.PL_CDR_LE + rtps.parameters(values)
    (received,) = messages(rtps.RtpsReader(PREFIX), HEAD + rtps.data(rtps.SUBSCRIPTIONS_WRITER, 1, payload))
    assert isinstance(received, rtps.ReceivedData)
    return received


def test_stored_values_of_a_reader_are_limited() -> None:
    """A topic of 60 kB in each of 4096 readers is 240 MB."""
    guid = (rtps.P_ENDPOINT_GUID, OTHER + b"\0\0\1\4")
    type_name = (rtps.P_TYPE, rtps.text("b"))
    assert rtps.reader_of(described(guid, type_name, (rtps.P_TOPIC, rtps.text("t" * 256)))) is not None
    assert rtps.reader_of(described(guid, type_name, (rtps.P_TOPIC, rtps.text("t" * 257)))) is None
    topic = (rtps.P_TOPIC, rtps.text("t"))
    assert rtps.reader_of(described(guid, topic, (rtps.P_TYPE, rtps.text("b" * 60_000)))) is None
    locators = [(rtps.P_UNICAST, rtps.locator(Locator("192.0.2.9", port))) for port in range(1, 100)]
    reader = rtps.reader_of(described(guid, topic, type_name, *locators))
    assert reader is not None
    assert len(reader.locators) == rtps.LOCATORS_MAX


def test_values_of_a_participant_out_of_range() -> None:
    guid = (rtps.P_PARTICIPANT_GUID, OTHER + rtps.PARTICIPANT)
    locator = (rtps.P_META_UNICAST, rtps.locator(Locator("192.0.2.9", 1)))
    for port in (0, 65_536, 0xFFFF_FFFF):
        wrong = (rtps.P_META_UNICAST, struct.pack("<iI12x4s", rtps.UDP_V4, port, b"\xc0\0\2\x09"))
        assert rtps.participant_of(described(guid, wrong)) is None
    for lease, expected in ((-1, 1), (0, 1), (-(2**31), 1), (2**31 - 1, rtps.INFINITE_S)):
        found = rtps.participant_of(described(guid, locator, (rtps.P_LEASE, struct.pack("<iI", lease, 0xFFFF_FFFF))))
        assert found is not None
        assert found.lease_s == expected
