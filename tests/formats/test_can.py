"""Length of frames on the wire, and frames as bytes."""

import io
import struct
from collections.abc import Callable, Sequence
from random import Random

import pytest

from imud.formats import can
from imud.model.errors import BadArgument
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.support.files import candump_line


def test_length_of_a_frame_and_layout_of_the_kernel() -> None:
    # start 1, identifier 11, RTR, IDE, r0, DLC 4, data, CRC 15 + 1, ACK 2, end 7, pause 3; SRR, r1 and 18 bits more
    bits = {(False, 8): 111, (False, 6): 95, (False, 0): 47, (True, 8): 131, (True, 0): 67}
    assert {one: can.frame_bits(*one) for one in bits} == bits
    assert can.RAW_FRAME.unpack(can.pack_frame(0x7FF, False, b"ab")) == (0x7FF, 2, b"ab" + bytes(6))
    assert can.RAW_FRAME.unpack(can.pack_frame(0, True, bytes(range(8)))) == (0x8000_0000, 8, bytes(range(8)))
    assert (can.EXTENDED_FLAG, can.REMOTE_FLAG, can.ERROR_FLAG) == (1 << 31, 1 << 30, 1 << 29)  # linux/can.h
    fast = can.pack_frame(0x18FF5B08, True, bytes(range(12)))  # identifier, length, BRS and FDF, padding, data
    assert fast == struct.pack("=IBBH", 0x98FF5B08, 12, 5, 0) + bytes(range(12)).ljust(64, b"\0")
    wrong = [(0x800, False, b""), (-1, False, b""), (0x2000_0000, True, b""), (1, True, bytes(9)), (1, True, bytes(65))]
    for can_id, extended, data in wrong:
        with pytest.raises(ValueError, match="invalid CAN frame"):
            can.pack_frame(can_id, extended, data)


def test_filters_overlap_if_one_frame_passes_both() -> None:
    for one, other, expected in (
        (can.CanFilter(0x180, 0x7F0, False), can.CanFilter(0x185, 0x7FF, False), True),
        (can.CanFilter(0x180, 0x7FF, False), can.CanFilter(0x185, 0x7FF, False), False),
        (can.CanFilter(0x180, 0x7F0, False), can.CanFilter(0x185, 0x7FF, True), False),
        (can.CanFilter(0, 0, True), can.CanFilter(0x1FFF_FFFF, 0x1FFF_FFFF, True), True),
    ):
        assert one.overlaps(other) == other.overlaps(one) == one.matches(other.can_id, other.extended) == expected
        if expected:  # the identifier with all bits of both masks
            can_id = (one.can_id & one.mask) | (other.can_id & other.mask)
            assert one.matches(can_id, one.extended)
            assert other.matches(can_id, other.extended)


US = 1000
LOG = b"""\
(1436509052.249713) can1 044#2A366C2B
(1436509053.6507) can1 18FEE9AA#0102030405060708 R
(1436509053.650700) can1 7FF# T

(1436509053.700000) can1 123#R8
(1436509053.700001) can1 123##5001122
(1436509053.700001) can1 18FF5B08##1000102030405060708090A0B
(1436509053.700001) can1 123##1000000000000000000
(1436509053.700002) can1 20000040#0000000000000000
(1436509053.700003) can1 1A2#1122334455667788_9
"""


def read(data: bytes) -> tuple[list[can.CanFrame], can.CandumpReader]:
    reader = can.CandumpReader(io.BytesIO(data))
    return list(reader), reader


def test_lines_of_candump() -> None:
    frames, reader = read(LOG)
    assert frames == [
        can.CanFrame(0x44, False, b"\x2a\x36\x6c\x2b", 1436509052_249713_000),
        can.CanFrame(0x18FEE9AA, True, bytes(range(1, 9)), 1436509053_650700_000),
        can.CanFrame(0x7FF, False, b"", 1436509053_650700_000),
        can.CanFrame(0x123, False, b"\x00\x11\x22", 1436509053_700001_000),
        can.CanFrame(0x18FF5B08, True, bytes(range(12)), 1436509053_700001_000),
        can.CanFrame(0x1A2, False, bytes.fromhex("1122334455667788"), 1436509053_700003_000),
    ]
    assert (reader.passed_over, reader.bad_lines, reader.first_bad) == (2, 1, 8)  # no CAN FD frame has nine bytes


@pytest.mark.parametrize(
    ("times_s", "expected_s", "words"),
    [
        ((5, 4.9995, 6), (5, 5, 6), "line 2: the time changes by -0.000500 s (lines in another order, or"),
        ((*range(10), 9.996, *range(11, 15)), (*range(10), 9.996, *range(11, 15)), ""),  # one late frame before
        ((*range(10), *(t - 0.004 for t in range(10, 15))), (*range(10), *(t - 0.004 for t in range(10, 15))),
         "line 11: the time shifts by -0.004 s (a step of the clock, or another phase of the sender)"),
        ((*range(10), *(t - 0.9 for t in range(10, 15))), (*range(10), *(t - 0.9 for t in range(10, 15))),
         "line 11: the time shifts by -0.900 s (a step"),
        ((*range(9), *(8 + t / 2 for t in range(1, 12))), (*range(9), *(8 + t / 2 for t in range(1, 12))), ""),  # rate
        (shifted := (*range(10), *(t + 0.0011 for t in range(10, 15))), shifted, "line 11: the time shifts by +0.001"),
        (shifted := (*range(10), *range(20, 25)), shifted, "line 11: the time changes by +11.000 s (a pause or a step"),
        (shifted := (*range(10), *range(15, 20)), shifted, "line 11: the time shifts by +5.000 s (lost frames, a"),
        ((5, 5.01, 4, 4.01), (5, 5.01, 5.02, 5.03), "line 3: the time changes by -1.010 s (a step of"),
        ((5, 5.01, 3605.01, 3605.11), (5, 5.01, 5.02, 5.12), "line 3: the time changes by +3600.000 s (a step of"),
        ((5, 14.999, 24.999), (5, 14.999, 24.999), "line 3: the time changes by +10.000 s (a pause or a step"),
        *((still := (*range(5, 305), *(400,) * count), still, words) for count, words in (
            (255, "line 301: the time changes by +96.000 s (a pause or a step of the clock)"),
            (256, "line 556: the last 256 frames have the same time (the clock stopped)"),
        )),
        ((5, 3604), (5, 3604), "line 2: the time changes by +3599.000 s (a pause or a step"),
        ((0, 2, *range(3, 19), 0), (0, *range(2, 20)), "line 19: the time changes by -18.000 s (a step of"),
        ((9, 8, 7, 6, 5, 4, 3, 2), (9,) * 8, "s (a step of the clock, removed by imud); 2 more steps"),
    ],
)  # fmt: skip
def test_steps_of_the_clock(times_s: Sequence[float], expected_s: Sequence[float], words: str) -> None:
    frames, reader = read("".join(f"({t_s:.6f}) a 001#\n" for t_s in times_s).encode())
    assert [frame.t_rx_ns for frame in frames] == [round(t_s * 1e9) for t_s in expected_s]
    assert words in reader.problem
    assert bool(words) == bool(reader.problem)
    assert sum(frame.after_loss for frame in frames) == reader.problem.count("removed") + 2 * ("2 more" in words)


def test_interfaces() -> None:
    log = b"(1.0) can1 001#\n(2.0) can0 002#\n(3.0) can1 003#\n"
    assert read(b"(1.0) can0 123#R8\n")[1].problem.startswith("found no data frame, and 1 error frames")
    for times, words in (
        ("0 .01 .02 .01 .02 .01 .02 .01", "line 8: .*got time differences"),
        ("1" * 16, "got 16 succ"),
    ):
        with pytest.raises(BadArgument, match=words):
            read("".join(f"({float(t):.6f}) a 001#\n" for t in (times.split() if " " in times else times)).encode())
    for name, ids in (("can0", [2]), ("can1", [1, 3])):
        assert [frame.can_id for frame in can.CandumpReader(io.BytesIO(log), name)] == ids
    with pytest.raises(BadArgument, match="interfaces can1 and can0: select one"):
        read(log)
    with pytest.raises(BadArgument, match="interface x: expected can1 or can0"):
        list(can.CandumpReader(io.BytesIO(log), "x"))
    piped = io.BytesIO(log)
    piped.seekable = lambda: False  # type: ignore[method-assign]
    with pytest.raises(BadArgument, match="interfaces can1 and can0: select one"):
        list(can.CandumpReader(piped))
    with pytest.raises(BadArgument, match=r"interfaces can0, .*can14 and can15: select one"):
        read(b"".join(b"(1.0) can%d 001#\n" % number for number in range(20)))
    escapes = io.BytesIO(b"(1.0) can0 123#\n(2.0) v\x1b[2J 123#\n")
    with pytest.raises(BadArgument, match=r"frames of the interfaces can0 and 'v\\x1b\[2J': select one"):
        list(can.CandumpReader(escapes))


def test_other_lines_are_reported() -> None:
    for line in (
        b"no log at all", b"(1.0) can0 900#00", b"(1.0) can0 123#0", b"(1.0) can0 123#001122334455667788",
        b"(1.0) can0 1234#00", b"can0  123  [2]  11 22", b"\x00\xff" * 400, b"(1.0) %s 123#00" % (b"c" * 500),
    ):  # fmt: skip  # 0x900 is above 11 bits
        frames, reader = read(b"(1.0) can0 001#00\n" + line + b"\n(2.0) can0 002#00\n")
        assert ([frame.can_id for frame in frames], reader.bad_lines >= 1) == ([1, 2], True), line
        assert "line 2" in reader.problem, line


def test_what_is_written_is_read() -> None:
    random = Random(3)
    frames = []
    for number in range(50):
        extended = random.random() < 0.5
        can_id = random.randrange((can.EXTENDED_ID_MAX if extended else can.STANDARD_ID_MAX) + 1)
        frames.append(can.CanFrame(can_id, extended, random.randbytes(random.randint(0, 8)), number * US))
    again, reader = read("".join(candump_line(frame, "can3") for frame in frames).encode("ascii"))
    expected = [frame for frame in frames if not (frame.extended and frame.can_id >> 29)]
    assert again == expected
    assert reader.problem == ""
    assert candump_line(can.CanFrame(0x65, False, b"\xab", 1_500_000_000)) == "(0000000001.500000) can0 065#AB\n"
    with pytest.raises(ValueError, match="invalid CAN frame"):
        candump_line(can.CanFrame(0x800, False, b"", 0))


def _log(ahead_s: Callable[[int], float], samples: int = 300) -> list[can.CanFrame]:
    """Return the frames of a log: four frames each 10 ms. `ahead_s` is the error of the times of a sample."""
    lines = [
        f"({10_000 + sample * 0.01 + ahead_s(sample) + place * 0.0003:.6f}) can0 1{place:02X}#00"
        for sample in range(samples)
        for place in range(4)
    ]
    return list(can.CandumpReader(io.BytesIO("\n".join(lines).encode())))


@pytest.mark.parametrize("ahead_s", [6.0, 0.05, -6.0, -0.05, 4000.0, -4000.0])
@pytest.mark.parametrize("every", [10, 100, 299])
def test_times_of_disagreeing_clocks(ahead_s: float, every: int) -> None:
    frames = _log(lambda sample: ahead_s * (sample % every == every // 2))
    true_ns = [frame.t_rx_ns for frame in _log(lambda _sample: 0.0)]
    assert not any(frame.after_loss for frame in frames)
    assert max(abs(frame.t_rx_ns - t_ns) for frame, t_ns in zip(frames, true_ns, strict=True)) <= NS_PER_MS


def test_excursion_is_reported() -> None:
    lines = [f"({1000 + count * 0.01 + 6 * (count == 50):.6f}) can0 101#00" for count in range(100)]
    reader = can.CandumpReader(io.BytesIO("\n".join(lines).encode()))
    assert len(list(reader)) == 100
    assert reader.problem == (
        "line 51: the times of 1 frames differ by +6.000 s (clocks that disagree, corrected by imud)"
    )


@pytest.mark.parametrize("rise_s", [0.5, 6.0])
def test_pause_is_kept(rise_s: float) -> None:
    """A pause and lost frames have no return of the times."""
    frames = _log(lambda sample: rise_s * (sample >= 100))
    span_ns = frames[-1].t_rx_ns - frames[0].t_rx_ns
    assert span_ns == round((2.99 + 0.0009 + rise_s) * NS_PER_S)


@pytest.mark.parametrize("step_s", [-0.015, -0.05, -0.07, -6.0])
def test_step_to_the_past_is_no_excursion(step_s: float) -> None:
    """After a short step, the times soon reach the times before, but without a step back."""
    lines = [
        f"({1000 + sample * 0.01 + step_s * (sample >= 100) + place * 0.0003:.6f}) can0 1{place:02X}#00"
        for sample in range(300)
        for place in range(4)
    ]
    reader = can.CandumpReader(io.BytesIO("\n".join(lines).encode()))
    frames = list(reader)
    fall_s = step_s + 0.01 - 3 * 0.0003
    assert reader.problem.startswith(f"line 401: the time changes by {fall_s:+.3f} s (a step of the clock")
    assert [frame.after_loss for frame in frames].count(True) == 1
    assert abs(frames[-1].t_rx_ns - frames[0].t_rx_ns - round(2.9909 * NS_PER_S)) <= 10 * NS_PER_MS
