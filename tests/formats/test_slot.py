import struct
import zlib
from functools import reduce
from operator import or_
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.formats import slot as slot_format
from imud.formats.slot import CRC_OFFSET, PRESENT_BITS, SLOT_BYTES, decode_slot, encode_slot, encode_slots
from imud.model.sample import Position, Sample, Sync
from tests.support.rings import check_layout

FULL = Sample(
    "imu0", 258, 1_000_000_001, 250_000, Sync.EDGE, 1_000_400_000, 0x17A1_B2C3_D4E5_F607,
    t_dev_ns=-2, accel_m_s2=(1.0, -2.0, 0.5), gyro_rad_s=(4.0, 8.0, 16.0), mag_t=(-1.0, 0.25, 0.125),
    quat_wxyz=(1.0, 0.0, 0.0, -1.0), euler_rad=(2.0, 1.0, -0.5), temperature_c=32.0, pressure_pa=65536.0,
    incli_rad=(-4.0, 0.0625), status=0x8001_0203, pps_age_ms=999, edge_seq=7, velocity_enu_m_s=(8.0, -16.0, 0.25),
    position=Position(0.5, -2.0, 64.0, 4, 17), heave_m=-0.125, gnss_utc_ns=0x1881_0203_0405_0607,
)  # fmt: skip
BARE = Sample("imu0", 1, 2, 3, Sync.ARRIVAL, 4, 5)

INTEGERS = ("t_dev_ns", "status", "pps_age_ms", "edge_seq", "gnss_utc_ns")

GOLDEN = (
    "0201000000000000"  # seq 258 = 0x102
    "01ca9a3b00000000"  # t_ns 1 000 000 001 = 0x3b9aca01
    "80e4a03b00000000"  # t_rx_ns 1 000 400 000 = 0x3ba0e480
    "07f6e5d4c3b2a117"  # utc_ns
    "feffffffffffffff"  # t_dev_ns -2
    "0700000000000000"  # edge_seq
    "90d00300"  # t_err_ns 250 000 = 0x3d090
    "ffff0000"  # present: all sixteen bits
    "03020180"  # status
    "3412"  # device_id 0x1234
    "02"  # sync edge
    "00"
    "000000000000f03f" "00000000000000c0" "000000000000e03f"  # 1, -2, 0.5
    "0000000000001040" "0000000000002040" "0000000000003040"  # 4, 8, 16
    "000000000000f0bf" "000000000000d03f" "000000000000c03f"  # -1, 1/4, 1/8
    "000000000000f03f" "0000000000000000" "0000000000000000" "000000000000f0bf"  # 1, 0, 0, -1
    "0000000000000040" "000000000000f03f" "000000000000e0bf"  # 2, 1, -0.5
    "0000000000004040"  # 32
    "000000000000f040"  # 65536
    "00000000000010c0" "000000000000b03f"  # -4, 1/16
    "e7030000"  # 999
    "04" "11" "0000"  # quality 4, 17 satellites
    "0706050403028118"  # gnss_utc_ns
    "000000000000c0bf"  # -1/8
    "00000000"
)  # fmt: skip
MORE = (
    "0000000000002040" "00000000000030c0" "000000000000d03f"  # 8, -16, 1/4
    "000000000000e03f" "00000000000000c0" "0000000000005040"  # 1/2, -2, 64
    + "00" * 16
)  # fmt: skip
"""Written by hand: a power of two 2**n as f64 has only the exponent bits 1023 + n."""


def crc32_bit_by_bit(data: bytes) -> int:
    crc = 0xFFFF_FFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xEDB8_8320 if crc & 1 else 0)
    return crc ^ 0xFFFF_FFFF


def test_golden_bytes() -> None:
    slot = encode_slot(FULL, 0x1234)
    assert slot[:CRC_OFFSET].hex(" ", 8) == bytes.fromhex(GOLDEN).hex(" ", 8)
    assert slot[CRC_OFFSET + 4 :].hex(" ", 8) == bytes.fromhex(MORE).hex(" ", 8)
    assert slot[CRC_OFFSET : CRC_OFFSET + 4] == crc32_bit_by_bit(bytes.fromhex(GOLDEN + MORE)).to_bytes(4, "little")
    assert crc32_bit_by_bit(b"123456789") == 0xCBF4_3926  # the published check value of CRC-32
    raw, more = bytes.fromhex(GOLDEN), bytes.fromhex(MORE)
    assert decode_slot(raw + zlib.crc32(raw + more).to_bytes(4, "little") + more, "imu0") == FULL
    short = encode_slot(
        msgspec.structs.replace(FULL, velocity_enu_m_s=None, position=None), 1
    )  # the CRC ends before MORE
    assert short[CRC_OFFSET:] == crc32_bit_by_bit(short[:CRC_OFFSET]).to_bytes(4, "little") + bytes(64)
    check_layout(slot_format.SLOT_FIELDS, SLOT_BYTES)


@pytest.mark.parametrize("name", PRESENT_BITS)
def test_presence_bit_of_each_field(name: str) -> None:
    value = getattr(FULL, name)
    slot = encode_slot(msgspec.structs.replace(BARE, **{name: value}), 0)
    assert struct.unpack_from("<I", slot, 52)[0] == PRESENT_BITS[name]
    decoded = decode_slot(slot, "imu0")
    assert getattr(decoded, name) == value
    assert all(getattr(decoded, other) is None for other in PRESENT_BITS if other != name)
    zero: Any = tuple(0.0 for _ in value) if isinstance(value, tuple) else 0  # zero differs from absent
    if isinstance(value, Position):
        zero = Position(0.0, 0.0, 0.0, 0, 0)
        fullest = Position(0.0, 0.0, None, 300, -1)  # clipped
        decoded = decode_slot(encode_slot(msgspec.structs.replace(BARE, position=fullest), 0), "imu0")
        assert decoded.position == Position(0.0, 0.0, None, 254, 0)
        place = Position(1.0, 2.0)
        assert decode_slot(encode_slot(msgspec.structs.replace(BARE, position=place), 0), "imu0").position == place
    decoded = decode_slot(encode_slot(msgspec.structs.replace(BARE, **{name: zero}), 0), "imu0")
    assert getattr(decoded, name) == zero


def test_sync_codes_are_in_order_of_quality() -> None:
    assert list(map(slot_format.SYNC_CODES.get, (Sync.ARRIVAL, Sync.REGRESSION, Sync.EDGE, Sync.UTC))) == [0, 1, 2, 3]
    for sync in Sync:
        assert decode_slot(encode_slot(msgspec.structs.replace(BARE, sync=sync), 0), "imu0").sync is sync


def test_any_flipped_bit_and_the_sync_of_a_newer_layout_are_found() -> None:
    for at in range(SLOT_BYTES):
        slot = bytearray(encode_slot(FULL, 1))
        slot[at] ^= 1 << at % 8
        assert not slot_format.slot_is_whole(bytes(slot)), at
        with pytest.raises(ValueError, match="during the copy"):
            decode_slot(bytes(slot), "imu0")
    raw = bytearray(encode_slot(BARE, 1))
    raw[62] = 4
    raw[CRC_OFFSET : CRC_OFFSET + 4] = zlib.crc32(raw[:CRC_OFFSET]).to_bytes(4, "little")
    with pytest.raises(ValueError, match="sync 4"):
        decode_slot(bytes(raw), "imu0")


@pytest.mark.parametrize("slot", [b"", bytes(SLOT_BYTES), encode_slot(FULL, 1)[:-1], b"\xff" * SLOT_BYTES])
def test_bytes_that_are_not_a_slot(slot: bytes) -> None:
    assert not slot_format.slot_is_whole(slot)
    assert slot_format.SEQ_INVALID == 0xFFFF_FFFF_FFFF_FFFF


@pytest.mark.parametrize(
    ("field", "value", "stored"),
    [
        ("t_err_ns", 1 << 32, 0xFFFF_FFFF),  # 4.3 s is clipped to the maximum
        ("t_err_ns", -1, 0), ("status", 0x1_8000_0001, 0x8000_0001), ("status", -1, 0xFFFF_FFFF),
        ("pps_age_ms", 1 << 32, 0xFFFF_FFFF), ("pps_age_ms", -5, 0), ("edge_seq", -1, 0),
        ("edge_seq", 1 << 64, (1 << 64) - 1), ("seq", -1, 0), ("t_dev_ns", -5, -5),
        ("t_dev_ns", 1 << 63, (1 << 63) - 1), ("t_dev_ns", -(1 << 63) - 1, -(1 << 63)),
        ("t_ns", 1 << 63, (1 << 63) - 1), ("t_rx_ns", 1 << 63, (1 << 63) - 1), ("utc_ns", 1 << 63, (1 << 63) - 1),
    ],
)  # fmt: skip
def test_values_that_do_not_fit_are_clipped_or_cut(field: str, value: int, stored: int) -> None:
    expected = msgspec.structs.replace(FULL, **{field: stored})
    assert decode_slot(encode_slot(msgspec.structs.replace(FULL, **{field: value}), 1), "imu0") == expected
    assert encode_slot(FULL, 0x1_0002) == encode_slot(FULL, 2)


_INTEGERS = st.integers(-(1 << 70), 1 << 70)
_FLOATS = st.floats(allow_nan=False)


@given(st.fixed_dictionaries(dict.fromkeys(("t_ns", "t_err_ns", "t_rx_ns", "utc_ns", *INTEGERS), _INTEGERS)),
       st.tuples(_FLOATS, _FLOATS, _FLOATS))  # fmt: skip
def test_no_sample_can_stop_the_daemon(values: dict[str, int], accel: tuple[float, float, float]) -> None:
    sample = msgspec.structs.replace(BARE, accel_m_s2=accel, **values)
    decoded = decode_slot(encode_slot(sample, 3), "imu0")
    assert decoded.accel_m_s2 == accel
    assert all(getattr(decoded, name) is not None for name in INTEGERS)


def test_a_batch_is_its_samples_one_by_one_also_where_one_does_not_fit() -> None:
    unfit = msgspec.structs.replace(FULL, t_err_ns=1 << 40, status=1 << 33)
    for batch in ([FULL, BARE, FULL], [BARE, unfit, FULL], [unfit]):
        slots = encode_slots(batch, 9)
        assert slots == [encode_slot(sample, 9) for sample in batch]
        decoded, packed = [decode_slot(slot, "imu0") for slot in slots], b"".join(slots)
        assert [one.seq for one in decoded] == [sample.seq for sample in batch]
        assert slot_format.decode_slots(packed, "imu0") == decoded
        assert slot_format.slot_seqs(packed) == (decoded[0].seq, decoded[-1].seq)
        assert slot_format.slot_times_ns(packed) == [one.t_ns for one in decoded]
        assert [slot for (slot,) in slot_format.slots_in(packed)] == slots
        pieces = slot_format.EqualPieces(packed, SLOT_BYTES)
        assert (len(pieces), list(pieces), pieces[-1], pieces[:2]) == (len(slots), slots, slots[-1], slots[:2])
        assert [slot_format.slot_quality(slot) for slot in slots] == [(one.sync, one.t_err_ns) for one in decoded]
        assert slot_format.slot_status_bits(packed) == reduce(or_, [one.status or 0 for one in decoded])


HI91: dict[str, Any] = {
    "t_dev_ns": 12, "accel_m_s2": (0.25, -1.0, 9.75), "gyro_rad_s": (1.5, 2.5, 3.5), "mag_t": (1e-5, 2e-5, 3e-5),
    "quat_wxyz": (0.5, -0.5, 0.5, -0.5), "euler_rad": (0.125, 0.25, 0.375), "temperature_c": -31,
    "pressure_pa": 101_325, "pps_age_ms": 17,
}  # fmt: skip
OTHERS: dict[str, Any] = {"incli_rad": (0.5, 0.25), "status": 5, "edge_seq": 3}


@pytest.mark.parametrize("at", [0, 2])
@pytest.mark.parametrize("name", PRESENT_BITS)
def test_a_batch_of_hi91_messages_is_its_samples_one_by_one_also_where_one_has_other_values(name: str, at: int) -> None:
    batch = [msgspec.structs.replace(BARE, seq=10 + n, t_ns=20 + n, sync=Sync.REGRESSION, **HI91) for n in range(3)]
    assert encode_slots(batch, 9) == [encode_slot(sample, 9) for sample in batch]
    batch[at] = msgspec.structs.replace(batch[at], **{name: OTHERS.get(name)})
    slots = encode_slots(batch, 9)
    assert slots == [encode_slot(sample, 9) for sample in batch]
    assert getattr(decode_slot(slots[at], "imu0"), name) == OTHERS.get(name)
