"""CDR: compared with bytes by hand, and with the reader of rosbags."""

import struct

import pytest

from imud.bridges.ros2 import ENCAPSULATION, CdrWriter, Layout


def test_numbers_and_texts_are_aligned() -> None:
    layout = Layout("B", "I", "B", "d", "H")
    assert layout.pack(ENCAPSULATION, 1, 2, 3, 1.0, 4) == bytes.fromhex(
        "00010000"  # CDR_LE
        "01 000000"  # u8, padding to 4
        "02000000"
        "03 00000000000000"  # u8 at 8, padding to 16
        "000000000000f03f"
        "0400"
    )
    layout = Layout("B", '"bow', "I")
    assert layout.texts == (bytes.fromhex("04000000 626f7700"),)
    assert layout.pack(ENCAPSULATION, 7, *layout.texts, 5) == bytes.fromhex(
        "00010000 07000000 04000000 626f7700 05000000"
    )
    layout = Layout('"ab', "2d")
    packed = layout.pack(ENCAPSULATION, *layout.texts, 1.0, 2.0)
    assert packed == bytes.fromhex("00010000 03000000 616200 00") + struct.pack("<2d", 1.0, 2.0)
    layout = Layout("B", '"boé', "q", "H")
    written = CdrWriter().number("B", 9).text("boé").number("q", -1).number("H", 3).done()
    assert written == layout.pack(ENCAPSULATION, 9, *layout.texts, -1, 3)
    assert CdrWriter().text("a\0b").done() == bytes.fromhex("00010000 03000000 616200")
    with pytest.raises(struct.error):
        CdrWriter().number("B", 256)
