"""Modbus RTU frames, and the reply among all possible received bytes."""

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats import modbus

REQUEST = modbus.framed(5, bytes.fromhex("03 0034 0002"))
REPLY = modbus.framed(5, bytes.fromhex("03 04 11 22 33 44"))
OTHER = modbus.framed(6, bytes.fromhex("03 04 55 66 77 88"))
EXCEPTION = modbus.framed(5, b"\x83\x02")


def finder(echoes: bool | None = False, request: bytes = REQUEST, size: int = len(REPLY)) -> modbus.ReplyFinder:
    return modbus.ReplyFinder(request, size, echoes=echoes)


@pytest.mark.manual("B 4.1.3 CRC")
def test_check_value_and_frames() -> None:
    assert (modbus.crc16_modbus(b"123456789"), modbus.crc16_modbus(b"\0")) == (0x4B37, 0x40BF)
    assert modbus.crc16_modbus(b"123456789\x37\x4b") == 0
    assert (modbus.READ_HOLDING, modbus.WRITE_SINGLE, modbus.REGISTERS_MAX) == (0x03, 0x06, 125)
    assert modbus.framed(0x50, bytes.fromhex("03 0034 0018")).hex() == "50030034001809" + "8f"
    assert [modbus.is_whole(one) for one in (REPLY, REPLY[:-1], b"\xff\xff", b"")] == [True, False, False, False]
    others = (EXCEPTION[:-1] + b"\x00", modbus.framed(5, b"\x03\x02"))
    assert [modbus.is_exception(one) for one in (EXCEPTION, *others)] == [True, False, False]
    assert modbus.exception_text(2) == "exception 2: the register does not exist"
    assert modbus.exception_text(77) == "exception 77: unknown code"
    # 0 is the broadcast, 248 to 255 are reserved (Modbus over serial line V1.02, 2.2)
    assert list(modbus.SLAVES) == list(range(1, 248))
    for baud, gap_ns in ((9600, 3_645_831), (19200, 1_822_915), (38400, 1_750_000)):
        # silence: 3.5 characters of 10 bits up to 19200 baud, 1.75 ms above
        assert modbus.frame_gap_ns(baud) == pytest.approx(gap_ns, abs=2)


@given(seed=st.integers(0, 2**32), echo=st.booleans(), known=st.booleans(), exception=st.booleans())
def test_the_reply_is_found_in_any_split(seed: int, echo: bool, known: bool, exception: bool) -> None:
    random, reply = Random(seed), EXCEPTION if exception else REPLY
    stream = REQUEST * echo + reply
    found = finder(echo if known else None)
    while stream:
        size = random.randint(1, len(stream))
        assert found.missing <= len(stream)  # a lower bound: a sleep for these bytes is never too long
        got, stream = found.feed(stream[:size]), stream[size:]
        assert got == (None if stream else reply)
    assert found.strange == 0
    assert found.echo_seen is (echo if echo or not known else None)


def test_other_bytes_are_skipped_and_a_damaged_reply_is_returned_only_in_its_place() -> None:
    found = finder()
    assert found.feed(OTHER) is None
    assert found.feed(b"\x05\x03" + REPLY[:4]) is None
    assert found.feed(REPLY[4:] + b"\xaa") == REPLY
    assert (found.strange, found.rest()) == (len(OTHER) + 2, b"\xaa")
    # late reply to a previous request: imud now requests another number of registers
    old = modbus.framed(5, bytes.fromhex("03 06 11 22 33 44 55 66"))
    found = finder()
    assert found.feed(old) is None
    assert found.feed(REPLY) == REPLY
    assert found.strange == len(old)
    damaged = REPLY[:-1] + bytes([REPLY[-1] ^ 1])
    assert finder().feed(damaged) == damaged
    assert finder().feed(REPLY[:3] + EXCEPTION) is None  # registers with the bytes of an exception
    assert finder().feed(modbus.framed(6, b"\x83\x02")) is None
    late = finder()
    assert late.feed(OTHER + damaged) is None  # after unknown bytes, only a frame with a correct CRC is a reply
    assert late.feed(REPLY) == REPLY
    assert late.strange == len(OTHER) + len(damaged)
    found = finder()
    assert found.feed(b"\x45" + REPLY[1:]) is None
    assert found.looks_damaged
    assert found.rest() == b"\x45" + REPLY[1:]
    found = finder()
    assert found.feed(OTHER) is None
    assert not found.looks_damaged
    for data, sender in (
        (b"\x06" + OTHER + REPLY, 6), (REPLY + OTHER, 6), (REPLY + OTHER[:-1], None), (OTHER[:-1] + b"\0", None),
        (REPLY, None), (EXCEPTION, None), (modbus.framed(7, b"\x03\1\2"), 7), (modbus.framed(7, b"\4\1\2"), None),
    ):  # fmt: skip
        assert modbus.late_sender(data, {6, 7}) == sender


def test_confirmation_is_distinguished_from_the_echo() -> None:
    write = modbus.framed(5, bytes.fromhex("06 0006 0001"))
    found = finder(True, write, len(write))
    assert found.feed(write) is None
    assert found.feed(write) == write
    found = finder(False, write, len(write))
    assert found.feed(modbus.framed(5, bytes.fromhex("06 0007 0001"))) is None  # an earlier confirmation, sent again
    assert found.feed(write) == write
    request, reply = modbus.framed(5, bytes.fromhex("03 0234 0001")), modbus.framed(5, bytes.fromhex("03 02 11 22"))
    found = finder(None, request, len(reply))
    assert found.feed(request[: len(reply)]) is None  # the register 0x02… looks like the length of the reply
    assert found.feed(request[len(reply) :] + reply) == reply
    assert [finder(echoes).missing for echoes in (False, None, True)] == [5, 5, 13]  # an exception has five bytes
    for data, missing in ((REPLY[:2], 7), (EXCEPTION[:2], 3)):
        found = finder()
        assert (found.feed(data), found.missing) == (None, missing)
    found = finder()
    for _ in range(100):
        assert found.feed(b"\xee" * 100) is None
    assert len(found.rest()) <= 256
    assert found.strange + len(found.rest()) == 10_000
