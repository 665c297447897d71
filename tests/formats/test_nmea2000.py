"""Golden messages, computed by hand from the public field definitions, and the package `nmea2000` as reader."""

import math
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nmea2000 import NMEA2000Decoder

from imud.formats import nmea2000
from imud.formats.j1939 import J1939Id, join
from imud.formats.nmea2000 import Reference
from imud.model.units import NS_PER_S

NAME = nmea2000.pack_name(0x12345, 3)


@pytest.mark.parametrize(
    ("made", "golden"),
    [
        # 90° = 1.5708 rad = 15708 counts = 0x3D5C; variation 3° = 0.05236 rad = 524 counts = 0x020C
        (nmea2000.pack_heading(7, math.pi / 2, Reference.MAGNETIC, math.radians(3)), "07 5c3d ff7f 0c02 fd"),
        (nmea2000.pack_heading(252, -math.pi / 2, Reference.TRUE), "fc 14b8 ff7f ff7f fc"),  # 270° = 47124 counts
        (nmea2000.pack_heading(0, None, Reference.UNKNOWN), "00 ffff ff7f ff7f ff"),
        (nmea2000.pack_rate_of_turn(1, 0.1), "01 00d43000 ffffff"),  # 0.1 rad/s = 3,200,000 counts
        (nmea2000.pack_rate_of_turn(1, -0.1), "01 002ccfff ffffff"),
        (nmea2000.pack_rate_of_turn(1, None), "01 ffffff7f ffffff"),
        (nmea2000.pack_rate_of_turn(1, 1e9), "01 fcffff7f ffffff"),  # limited to the maximum value
        (nmea2000.pack_attitude(2, 0.1, -0.2), "02 ff7f 30f8 e803 ff"),  # pitch -2000, roll 1000 counts
        (nmea2000.pack_attitude(2, None, None), "02 ff7f ff7f ff7f ff"),
        (nmea2000.pack_attitude(2, 4.0, -4.0, 1.0), "02 1027 0480 fc7f ff"),
        # unique 0x12345, manufacturer 2046 << 21; instance 3, function 140, class 60 << 1; industry 4, arbitrary
        (NAME.to_bytes(8, "little"), "4523c1ff 03 8c 78 c0"),
        (nmea2000.pack_nack(9, 127508), "01 ffffff 09 14f201"),
        (nmea2000.pack_heartbeat(60 * NS_PER_S, 5), "7017 05 cc ffffffff"),  # 60 s = 6000 counts of 0.01 s
        # 359.9999° = 6.283184 rad = 62831.84 counts: 62832 counts would be above a full turn
        (nmea2000.pack_heading(0, math.radians(359.9999), Reference.TRUE), "00 0000 ff7f ff7f fc"),
        (nmea2000.pack_configuration("bow", "", "ü"), "0501626f77 0201 03013f"),
        (nmea2000.pack_pgn_list(False, (127250, 127257)), "00 12f101 19f101"),
        (b"".join(nmea2000.fast_packet(9, bytes(range(8)))), "20 08 000102030405 21 0607 ffffffffff"),
    ],
)
def test_golden_messages(made: bytes, golden: str) -> None:
    assert made.hex() == bytes.fromhex(golden).hex()


def decoded(pgn: int, *frames: bytes) -> dict[str, Any]:
    decoder, found = NMEA2000Decoder(), None
    for data in frames:
        found = decoder.decode(can.Message(arbitration_id=join(J1939Id(6, pgn, 35)), is_extended_id=True, data=data))
    assert found is not None
    return {field.id: field.value for field in found.fields}


def test_the_package_nmea2000_reads_the_messages_of_a_node() -> None:
    product = decoded(126996, *nmea2000.fast_packet(0, nmea2000.pack_product("imud", "1.2", "0ABC")))
    assert [product[key] for key in ("modelId", "softwareVersionCode", "modelSerialCode")] == ["imud", "1.2", "0ABC"]
    claim = decoded(60928, NAME.to_bytes(8, "little"))
    assert (claim["uniqueNumber"], claim["deviceInstanceLower"]) == (0x12345, 3), claim
    configuration = decoded(126998, *nmea2000.fast_packet(0, nmea2000.pack_configuration("bow", "", "imud")))
    assert {"bow", "imud"} <= set(configuration.values())
    assert decoded(126993, nmea2000.pack_heartbeat(60_000, 5))["sequenceCounter"] == 5


@given(st.binary(min_size=1, max_size=nmea2000.FAST_BYTES_MAX), st.integers(0, 100))
def test_a_fast_packet_contains_its_data(data: bytes, counter: int) -> None:
    first, *others = nmea2000.fast_packet(counter, data)
    assert first[:2] == bytes((counter % 8 << 5, len(data)))
    assert [frame[0] for frame in others] == [counter % 8 << 5 | number for number in range(1, len(others) + 1)]
    assert (first[2:] + b"".join(frame[1:] for frame in others)).startswith(data)
    assert {len(first), *map(len, others)} == {8}
