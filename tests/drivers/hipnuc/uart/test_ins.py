"""HI81 and HI83: frames by hand, values by bit, frames that do not match their bitmap, filler and impossible values."""

import math
import struct
from collections.abc import Mapping
from random import Random
from typing import Any

import msgspec
import pytest

from imud.attitude.rotation import euler312_from_quat
from imud.contracts.codec import BadFrame, BadReason
from imud.drivers.hipnuc.uart import ins
from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.drivers.value_limits import HEAVE_LIMIT_M, HEIGHT_LIMIT_M, VELOCITY_LIMIT_M_S
from imud.model.sample import Measurement, Position
from tests.drivers.hipnuc.uart.test_codec import HI92_PAYLOAD, MANUAL_HI91, framed, make, one, reasons

# made by hand from the table of the fields
HI81 = bytes.fromhex(
    "81  00 02  03  65 09  15 CD 5B 07  00 00"  # status 0x0200, navigating, week 2405, 123 456 789 ms
    "E8 03  18 FC  F4 01"  # gyro 1000, -1000, 500
    "00 08  00 F8  D0 07"  # accel 2048, -2048, 2000
    "E8 03  18 FC  00 00"  # mag 1000, -1000, 0
    "2D 05  00 00  FB"  # 1325 Pa, odometer, -5 °C
    "1A 0B 1C 17 3B  5B EA"  # 2026-11-28 23:59, 59 995 ms
    "28 23  6C EE  8C 6E"  # roll 90°, pitch -45°, heading 283°
    "C1 21  00 00  78 EC  01 00"  # quaternion 8641, 0, -5000, 1
    "80 96 98 00  00 CF 12 E9  06 DC FF FF"  # longitude 1°, latitude -38.4643328°, height -9.210 m
    "0F 09  04 11 00 00  03  00 00 00"  # PDOP, HDOP, quality 4, 17 satellites, heading, age, geoid, antenna
    "96 00  6A FF  00 00"  # velocity 150, -150, 0
    "00 00 00 00 00 00" + "00" * 14
)
FLOATS = struct.Struct("<3f")
PARTS: dict[int, tuple[bytes, str, Any]] = {
    0: (FLOATS.pack(1.5, -2.5, 9.75), "accel_m_s2", (1.5, -2.5, 9.75)),
    1: (FLOATS.pack(0.5, -0.25, 4.0), "gyro_rad_s", (0.5, -0.25, 4.0)),
    2: (FLOATS.pack(50.0, -20.0, 0.5), "mag_t", (50e-6, -20e-6, 0.5e-6)),
    3: (FLOATS.pack(90.0, -45.0, 180.0), "euler_rad", (math.pi / 2, -math.pi / 4, math.pi)),
    4: (struct.pack("<4f", 0.5, -0.5, 0.5, -0.5), "quat_wxyz", (0.5, -0.5, 0.5, -0.5)),
    5: (struct.pack("<Q", 0x0001_0000_1234_5678), "dev_ticks", 281_475_282_130 & 0xFFFF_FFFF),
    6: (bytes.fromhex("1A 0B 1C 17 3B 5B EA 00"), "gnss_utc_ns", 1_795_910_399_995_000_000),
    7: (struct.pack("<f", 101_325.0), "pressure_pa", 101_325.0), 8: (struct.pack("<f", -12.5), "temperature_c", -12.5),
    9: (FLOATS.pack(1, 2, 3), "", None), 10: (FLOATS.pack(-0.75, 7, 7), "heave_m", -0.75),
    11: (FLOATS.pack(1, 2, 3), "", None), 12: (FLOATS.pack(1.5, -2.5, 0.25), "velocity_enu_m_s", (1.5, -2.5, 0.25)),
    13: (FLOATS.pack(1, 2, 3), "", None),
    14: (struct.pack("<3d", 11.25, -48.5, 520.125), "position",
         Position(-48.5 * math.pi / 180, 11.25 * math.pi / 180, 520.125)),
    15: (bytes((5, 21, 1, 2)), "", None), 16: (bytes(4), "", None), 17: (bytes(4), "", None), 18: (bytes(4), "", None),
    19: (b"\x08\0\0\0", "", None), 30: (struct.pack("<3d", 1, 2, 3), "", None), 31: (FLOATS.pack(1, 2, 3), "", None),
}  # fmt: skip
"""Field, name and value of each bit of HI83, by hand."""
SIZES = {0: 12, 1: 12, 2: 12, 3: 12, 4: 16, 5: 8, 6: 8, 7: 4, 8: 4, 9: 12, 10: 12, 11: 12, 12: 12, 13: 12, 14: 24,
         15: 4, 16: 4, 17: 4, 18: 4, 19: 4, 30: 24, 31: 12}  # fmt: skip
PUBLISHED = [name for _, name, _ in PARTS.values() if name]


def hi83(*bits: int, status: int = 0x0210, changed: Mapping[int, bytes] = {}) -> bytes:
    fields = b"".join(changed.get(bit, PARTS[bit][0]) for bit in sorted(bits))
    return struct.pack("<BHBI", 0x83, status, 6, sum(1 << bit for bit in bits)) + fields


def test_hand_made_hi81() -> None:
    m = one(make().feed(framed(HI81)))
    assert (len(HI81), m.size_bytes, m.status) == (104, 110, 0x0003_0200)
    assert m.dev_ticks is None  # GPS time is another counter than `system_time` of HI91
    assert m.gyro_rad_s == pytest.approx((1.0, -1.0, 0.5), rel=1e-12)
    assert m.accel_m_s2 == pytest.approx((9.9999744, -9.9999744, 9.7656), rel=1e-12)
    assert m.mag_t == pytest.approx((30.517e-6, -30.517e-6, 0.0), rel=1e-12)
    assert (m.pressure_pa, m.temperature_c, m.heave_m, m.incli_rad) == (101_325.0, -5.0, None, None)
    assert m.euler_rad == pytest.approx((math.pi / 2, -math.pi / 4, math.radians(77)), rel=1e-12)
    assert m.quat_wxyz == pytest.approx((0.8641, 0.0, -0.5, 0.0001), rel=1e-12)
    assert m.gnss_utc_ns == 1_795_910_399_995_000_000  # date -d '2026-11-28 23:59:59.995Z' +%s%N
    assert m.velocity_enu_m_s == (1.5, -1.5, 0.0)
    assert m.position is not None
    assert (m.position.quality, m.position.satellites) == (4, 17)
    assert m.position.height_m == pytest.approx(-9.210)
    places = m.position.latitude_rad, m.position.longitude_rad
    assert places == pytest.approx((math.radians(-38.4643328), math.radians(1)), rel=1e-12)
    packed = ins.pack_hi81(m, main_status=0x0200, ins_status=3, week=2405, tow_ms=123_456_789)
    assert packed[:68] == HI81[:68]
    assert packed[70:72] + packed[78:90] == HI81[70:72] + HI81[78:90]


@pytest.mark.parametrize(("heading", "yaw_deg"), [(0, 0), (9000, -90), (18000, -180), (18001, 179.99), (36000, 0)])
def test_heading_becomes_counter_clockwise(heading: int, yaw_deg: float) -> None:
    m = one(make().feed(framed(HI81[:46] + struct.pack("<H", heading) + HI81[48:])))
    assert m.euler_rad is not None
    assert m.euler_rad[2] == pytest.approx(math.radians(yaw_deg), abs=1e-12)
    # quaternion and angles of the vendor's example have the order and the signs of HI91
    assert euler312_from_quat((0.8224, 0.4155, 0.1049, -0.3739)) == pytest.approx(
        tuple(map(math.radians, (37.38, 37.22, -61.90))), abs=5e-4
    )


@pytest.mark.parametrize("bit", PARTS)
def test_each_field_of_hi83_alone_and_at_its_place(bit: int) -> None:
    for bits in ((bit,), tuple(PARTS), tuple(other for other in PARTS if other != bit)):
        payload = hi83(*bits)
        assert len(payload) == 8 + sum(SIZES[one_bit] for one_bit in bits)
        m = one(make().feed(framed(payload)))
        assert m.status == 0x0006_0210
        for other, (_, name, value) in PARTS.items():
            if name and name != "position":
                expected = value if other in bits else None
                assert getattr(m, name) == (None if expected is None else pytest.approx(expected, rel=1e-12)), name
        place = PARTS[14][2]
        if 14 in bits:
            counts = {"quality": 5, "satellites": 21} if 15 in bits else {}
            assert m.position == msgspec.structs.replace(place, **counts)
        else:
            assert m.position is None
        # a field of another size than its bit: the payload is not 8 + sizes
        for wrong in (payload[:-1], payload + b"\0", payload + HI92_PAYLOAD):
            codec, frame = make(), framed(wrong)
            assert codec.feed(frame) == [BadFrame(BadReason.CONTENT, frame)]
            assert (codec.ledger.frames_bad_content, codec.ledger.bytes_in_bad_frames) == (1, len(frame))
            assert codec.ledger.closes()


@pytest.mark.parametrize("bit", [*range(20, 30)])
def test_internal_and_unknown_bits_are_rejected(bit: int) -> None:
    for size in (0, 4, 12, 24):
        payload = struct.pack("<BHBI", 0x83, 0, 0, 1 << bit | 1) + bytes(12 + size)
        codec = make()
        assert reasons(codec.feed(framed(payload))) == [BadReason.CONTENT]
        assert codec.ledger.closes()
    assert ins.hi83_size(0xFFFF_FFFF) == 8 + sum(SIZES.values())


def test_sub_packets_in_one_frame_and_the_rest_after_an_unknown_tag() -> None:
    codec = make()
    first, second = codec.feed(framed(MANUAL_HI91[6:] + hi83(0, 12)))
    assert isinstance(first, Measurement)
    assert isinstance(second, Measurement)
    assert (first.dev_ticks, second.velocity_enu_m_s) == (1840392, (1.5, -2.5, 0.25))
    for rest in (b"\x77", b"\x05" + MANUAL_HI91[6:]):
        codec, payload = make(), HI81 + rest
        assert one(codec.feed(framed(payload))).velocity_enu_m_s == (1.5, -1.5, 0.0)
        ledger = codec.ledger
        assert (ledger.bytes_in_good_frames, ledger.bytes_skipped) == (110, len(rest))
        assert (codec.unknown, ledger.closes()) == ({rest[0]: 1}, True)


@pytest.mark.parametrize(
    ("at", "data", "name", "counted"),
    [
        (12, b"\xff\x7f" * 3, "gyro_rad_s", False), (18, b"\x00\x80" * 3, "accel_m_s2", False),
        (24, bytes(6), "mag_t", False), (30, bytes(2), "pressure_pa", False), (30, b"\xff\x7f", "pressure_pa", False),
        (34, b"\x7f", "temperature_c", False), (36, b"\x00", "gnss_utc_ns", False),
        (36, b"\x0d", "gnss_utc_ns", False), (40, b"\xff\xff", "gnss_utc_ns", False),
        (2, b"\x08", "gnss_utc_ns", False),  # the status has the bit `time not UTC`
        (2, b"\xff", "status", False), (46, b"\xa1\x8c", "euler_rad", True), (48, bytes(8), "quat_wxyz", False),
        (56, bytes(8), "position", False), (56, struct.pack("<i", 1_800_000_001), "position", True),
        (60, struct.pack("<i", -900_000_001), "position", True), (64, struct.pack("<i", 100_000_000), "position", True),
        (78, b"\x7f" * 6, "velocity_enu_m_s", False),
    ],
)  # fmt: skip
def test_filler_and_impossible_values_of_hi81(at: int, data: bytes, name: str, counted: bool) -> None:
    codec, frame = make(), framed(HI81[:at] + data + HI81[at + len(data) :])
    *bad, m = codec.feed(frame)
    assert bad == [BadFrame(BadReason.NOT_FINITE, frame)] * counted
    names = [*(other for other in PUBLISHED if other not in ("heave_m", "dev_ticks")), "status"]
    absent = {other for other in names if getattr(m, other) is None}
    assert absent == ({name, "gnss_utc_ns"} if name == "status" else {name})
    assert (codec.ledger.frames_not_finite, codec.ledger.closes()) == (counted, True)
    place = one(make().feed(framed(HI81[:70] + b"\xff\xff" + HI81[72:]))).position
    assert place is not None
    assert (place.quality, place.satellites) == (None, None)


LIMITS = {
    0: [40 * 9.81], 1: [70.0], 2: [4001.0], 3: [361.0], 10: [HEAVE_LIMIT_M], 12: [VELOCITY_LIMIT_M_S],
    14: [HEIGHT_LIMIT_M],
}  # fmt: skip


@pytest.mark.parametrize("bit", [0, 1, 2, 3, 4, 7, 8, 10, 12, 14])
def test_impossible_values_of_hi83_are_removed_and_counted(bit: int) -> None:
    name, code, count = PARTS[bit][1], "d" if bit == 14 else "f", ins.FIELDS[bit].size // (8 if bit == 14 else 4)
    worst = [math.nan, math.inf, -math.inf, *LIMITS.get(bit, [])]
    for bad in worst:
        for place in range(count if bit != 10 else 1):
            values = [1.0] * count
            values[place] = bad
            codec = make()
            frame = framed(hi83(*PARTS, changed={bit: struct.pack(f"<{count}{code}", *values)}))
            reason, m = codec.feed(frame)
            assert reason == BadFrame(BadReason.NOT_FINITE, frame)
            assert [other for other in PUBLISHED if getattr(m, other) is None] == [name]
            assert (codec.ledger.frames_not_finite, codec.ledger.frames_bad(), codec.ledger.closes()) == (1, 0, True)


@pytest.mark.parametrize("seed", range(4))
def test_encoder_and_decoder_agree(seed: int) -> None:
    random, codec = Random(seed), make()
    for _ in range(50):
        frame = DRIVER.example_frame(random)
        events = codec.feed(frame)
        assert events
        assert not reasons(events)
    assert codec.ledger.closes()
