"""RTPS messages: bytes by hand from the specification, and any input."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats import rtps
from imud.formats.rtps import Locator

PREFIX, OTHER = bytes(range(12)), bytes(range(20, 32))
HEAD = rtps.header(OTHER)


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
    made = rtps.gap(writer, reader, 7)
    assert made == bytes.fromhex("08011c00 00000204 00000103 00000000 07000000 00000000 08000000 00000000")


def test_requests_come_back() -> None:
    found = rtps.RtpsReader(PREFIX)
    missing = [3, 40, 200]
    datagram = HEAD + rtps.info_dst(PREFIX) + rtps.acknack(b"\0\0\2\4", b"\0\0\1\3", 3, missing, 1)
    _, (one,) = found.read(datagram)
    assert isinstance(one, rtps.ReceivedAckNack)
    assert (one.base, list(one.missing), one.is_final) == (3, missing, False)
    assert found.read(HEAD + rtps.info_dst(bytes(range(1, 13))) + datagram[36:])[1] == [], "for another participant"
    assert found.read(rtps.header(PREFIX) + datagram[20:])[1] == [], "its own message"
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
    _, (one,) = rtps.RtpsReader(PREFIX).read(datagram)
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
        _, messages = found.read(datagram)
        for one in messages:
            if isinstance(one, rtps.ReceivedData):
                rtps.participant_of(one), rtps.reader_of(one), rtps.guid_in(one)
        assert found.invalid - before in (0, 1)
