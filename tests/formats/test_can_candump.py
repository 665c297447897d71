"""Logs of `candump -L`: data frames are read, other valid lines are skipped, invalid lines are reported."""

import io
from random import Random

import pytest

from imud.formats.can import EXTENDED_ID_MAX, STANDARD_ID_MAX, CandumpReader, CanFrame
from tests.support.files import candump_line

US = 1000
LOG = b"""\
(1436509052.249713) vcan0 044#2A366C2B
(1436509053.6507) can1 18FEE9AA#0102030405060708 R
(1436509053.650700) can1 7FF# T

(1436509053.700000) can0 123#R8
(1436509053.700001) can0 123##1001122
(1436509053.700002) can0 20000040#0000000000000000
(1436509053.700003) can0 1A2#1122334455667788_9
"""


def read(data: bytes) -> tuple[list[CanFrame], CandumpReader]:
    reader = CandumpReader(io.BytesIO(data))
    return list(reader), reader


def test_lines_of_candump() -> None:
    frames, reader = read(LOG)
    assert frames == [
        CanFrame(0x44, False, b"\x2a\x36\x6c\x2b", 1436509052_249713_000),
        CanFrame(0x18FEE9AA, True, bytes(range(1, 9)), 1436509053_650700_000),
        CanFrame(0x7FF, False, b"", 1436509053_650700_000),
        CanFrame(0x1A2, False, bytes.fromhex("1122334455667788"), 1436509053_700003_000),
    ]
    assert reader.passed_over == 3
    assert reader.problem == ""
    frames, _ = read(b"(5.0) a 001#\n(4.0) a 001#\n(6.5) a 001#\n")
    assert [frame.t_rx_ns for frame in frames] == [5_000_000_000, 5_000_000_000, 6_500_000_000]


@pytest.mark.parametrize(
    "line",
    [
        b"no log at all", b"(1.0) can0 900#00", b"(1.0) can0 123#0", b"(1.0) can0 123#001122334455667788",
        b"(1.0) can0 1234#00", b"can0  123  [2]  11 22", b"\x00\xff" * 400,
    ],
)  # fmt: skip  # 0x900 is above 11 bits
def test_other_lines_are_reported(line: bytes) -> None:
    frames, reader = read(b"(1.0) a 001#00\n" + line + b"\n(2.0) a 002#00\n")
    assert [frame.can_id for frame in frames] == [1, 2]
    assert reader.bad_lines >= 1
    assert "line 2" in reader.problem


def test_what_is_written_is_read() -> None:
    random = Random(3)
    frames = []
    for number in range(50):
        extended = random.random() < 0.5
        can_id = random.randrange((EXTENDED_ID_MAX if extended else STANDARD_ID_MAX) + 1)
        frames.append(CanFrame(can_id, extended, random.randbytes(random.randint(0, 8)), number * US))
    again, reader = read("".join(candump_line(frame, "can3") for frame in frames).encode("ascii"))
    expected = [frame for frame in frames if not (frame.extended and frame.can_id >> 29)]
    assert again == expected
    assert reader.problem == ""
    assert candump_line(CanFrame(0x65, False, b"\xab", 1_500_000_000)) == "(0000000001.500000) can0 065#AB\n"
    with pytest.raises(ValueError, match="no classical CAN frame"):
        candump_line(CanFrame(0x800, False, b"", 0))
