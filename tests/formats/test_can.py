"""Length of frames on the wire, and frames as bytes."""

import pytest

from imud.formats.can import EXTENDED_FLAG, RAW_FRAME, CanFilter, frame_bits, pack_frame


@pytest.mark.parametrize(
    ("extended", "data_bytes", "bits"),
    # start 1, identifier 11, RTR, IDE, r0, DLC 4, data, CRC 15 + 1, ACK 2, end 7, pause 3; SRR, r1 and 18 bits more
    [(False, 8, 111), (False, 6, 95), (False, 0, 47), (True, 8, 131), (True, 0, 67)],
)
def test_length_of_a_frame(extended: bool, data_bytes: int, bits: int) -> None:
    assert frame_bits(extended, data_bytes) == bits


def test_frames_in_the_layout_of_the_kernel() -> None:
    assert RAW_FRAME.unpack(pack_frame(0x7FF, False, b"ab")) == (0x7FF, 2, b"ab" + bytes(6))
    assert RAW_FRAME.unpack(pack_frame(0x1FFF_FFFF, True, b"")) == (0x1FFF_FFFF | EXTENDED_FLAG, 0, bytes(8))
    wrong = [(0x800, False, b""), (-1, False, b""), (0x2000_0000, True, b""), (1, True, bytes(9))]
    for can_id, extended, data in wrong:
        with pytest.raises(ValueError, match="invalid CAN frame"):
            pack_frame(can_id, extended, data)


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        (CanFilter(0x180, 0x7F0, False), CanFilter(0x185, 0x7FF, False), True),
        (CanFilter(0x180, 0x7FF, False), CanFilter(0x185, 0x7FF, False), False),
        (CanFilter(0x180, 0x7F0, False), CanFilter(0x185, 0x7FF, True), False),
        (CanFilter(0, 0, True), CanFilter(0x1FFF_FFFF, 0x1FFF_FFFF, True), True),
    ],
)
def test_filters_overlap_if_one_frame_passes_both(one: CanFilter, other: CanFilter, expected: bool) -> None:
    assert one.overlaps(other) == other.overlaps(one) == expected
    if expected:  # the identifier with all bits of both masks
        can_id = (one.can_id & one.mask) | (other.can_id & other.mask)
        assert one.matches(can_id, one.extended)
        assert other.matches(can_id, other.extended)
