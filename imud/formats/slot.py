"""One `Sample` as 320 bytes, little-endian: slot of the shared-memory ring and of the binary socket encoding.

`SLOT_FIELDS` is the only table of the layout. The encoder and the check of the C header use it.

     0        8      16       24      32        40        48        52       56     60         62    63
    +--------+------+--------+-------+---------+---------+---------+--------+------+----------+-----+---+
    | seq    | t_ns | t_rx_ns| utc_ns| t_dev_ns| edge_seq| t_err_ns| present|status| device_id| sync| 0 |
    +--------+------+--------+-------+---------+---------+---------+--------+------+----------+-----+---+
    | 64: accel, gyro, mag 3×f64 each | 136: quat 4×f64 | 168: euler 3×f64 | temperature, pressure, incli           |
    +----------+-----------+--------------+---+-----------------+------------+---+------------+-------+-----------+
    | 224: pps | quality   | satellites   | 0 | 232: gnss_utc_ns| 240: heave | 0 | 252: crc   |
    +----------+-----------+--------------+---+-----------------+------------+---+------------+
    | 256: velocity 3×f64  | 280: latitude, longitude, height f64 each       | 0…             |
    +----------------------+-------------------------------------------------+----------------+

The CRC-32 (IEEE 802.3, as zlib.crc32) covers bytes 0…251 with the sequence number. Bytes 256…319 follow in the CRC if
`present` contains the velocity or the position. Most samples have neither, so that the additional bytes cost little.
"""

import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isnan, nan
from typing import Any, Final
from zlib import crc32

import msgspec

from imud.model.sample import Pair, Position, Quaternion, Sample, Sync, Vector3

SLOT_BYTES: Final = 320
SLOT_BYTES_V1: Final = 256  # size in layout version 1: the first bytes of a slot without later fields
SLOT_LAYOUT_VERSION: Final = 2
SEQ_INVALID: Final = 0xFFFF_FFFF_FFFF_FFFF  # value of `seq` while the daemon writes a slot in shared memory
CRC_OFFSET: Final = 252
MORE_OFFSET: Final = 256  # bytes that the CRC contains only if `present` has a bit of HAS_MORE


@dataclass(frozen=True, slots=True)
class SlotField:
    """Field of the slot: name in C, `struct` code, number of elements, offset."""

    name: str
    code: str
    count: int
    offset: int


SLOT_FIELDS: Final = (
    SlotField("seq", "Q", 1, 0),
    SlotField("t_ns", "q", 1, 8),
    SlotField("t_rx_ns", "q", 1, 16),
    SlotField("utc_ns", "q", 1, 24),
    SlotField("t_dev_ns", "q", 1, 32),
    SlotField("edge_seq", "Q", 1, 40),
    SlotField("t_err_ns", "I", 1, 48),
    SlotField("present", "I", 1, 52),
    SlotField("status", "I", 1, 56),
    SlotField("device_id", "H", 1, 60),
    SlotField("sync", "B", 1, 62),
    SlotField("reserved0", "B", 1, 63),
    SlotField("accel_m_s2", "d", 3, 64),
    SlotField("gyro_rad_s", "d", 3, 88),
    SlotField("mag_t", "d", 3, 112),
    SlotField("quat_wxyz", "d", 4, 136),
    SlotField("euler_rad", "d", 3, 168),
    SlotField("temperature_c", "d", 1, 192),
    SlotField("pressure_pa", "d", 1, 200),
    SlotField("incli_rad", "d", 2, 208),
    SlotField("pps_age_ms", "I", 1, 224),
    SlotField("position_quality", "B", 1, 228),  # NO_COUNT: absent
    SlotField("position_satellites", "B", 1, 229),  # NO_COUNT: absent
    SlotField("reserved1", "B", 2, 230),
    SlotField("gnss_utc_ns", "q", 1, 232),
    SlotField("heave_m", "d", 1, 240),
    SlotField("reserved2", "B", 4, 248),
    SlotField("crc32", "I", 1, CRC_OFFSET),
    SlotField("velocity_enu_m_s", "d", 3, MORE_OFFSET),
    SlotField("latitude_rad", "d", 1, 280),
    SlotField("longitude_rad", "d", 1, 288),
    SlotField("height_m", "d", 1, 296),  # NaN: absent
    SlotField("reserved3", "B", 16, 304),
)

HAS_T_DEV: Final = 1 << 0
HAS_ACCEL: Final = 1 << 1
HAS_GYRO: Final = 1 << 2
HAS_MAG: Final = 1 << 3
HAS_QUAT: Final = 1 << 4
HAS_EULER: Final = 1 << 5
HAS_TEMPERATURE: Final = 1 << 6
HAS_PRESSURE: Final = 1 << 7
HAS_INCLI: Final = 1 << 8
HAS_STATUS: Final = 1 << 9
HAS_PPS_AGE: Final = 1 << 10
HAS_EDGE: Final = 1 << 11
HAS_VELOCITY: Final = 1 << 12
HAS_POSITION: Final = 1 << 13
HAS_HEAVE: Final = 1 << 14
HAS_GNSS_UTC: Final = 1 << 15
HAS_MORE: Final = HAS_VELOCITY | HAS_POSITION
NO_COUNT: Final = 0xFF  # value of an absent quality or number of satellites

# Bit of `present` for each field: the field has a value. A missing value is not zero.
PRESENT_BITS: Final = {
    "t_dev_ns": HAS_T_DEV,
    "accel_m_s2": HAS_ACCEL,
    "gyro_rad_s": HAS_GYRO,
    "mag_t": HAS_MAG,
    "quat_wxyz": HAS_QUAT,
    "euler_rad": HAS_EULER,
    "temperature_c": HAS_TEMPERATURE,
    "pressure_pa": HAS_PRESSURE,
    "incli_rad": HAS_INCLI,
    "status": HAS_STATUS,
    "pps_age_ms": HAS_PPS_AGE,
    "edge_seq": HAS_EDGE,
    "velocity_enu_m_s": HAS_VELOCITY,
    "position": HAS_POSITION,
    "heave_m": HAS_HEAVE,
    "gnss_utc_ns": HAS_GNSS_UTC,
}

# Code of `sync` in the slot: 0 arrival, 1 regression, 2 edge, 3 utc
SYNC_CODES: Final = {sync: code for code, sync in enumerate(Sync)}
SYNC_BY_CODE: Final = tuple(Sync)

# all fields are aligned: the native layout is equal, and `struct` packs it twice as fast
_NATIVE: Final = "@" if sys.byteorder == "little" else "<"
# fields before the first vector. Two parts, because a call with more than 30 arguments makes a list
_HEAD_FIELDS: Final = 12
_VALUE_FIELDS: Final = 21  # fields of layout version 1 before the CRC
_HEAD = struct.Struct(_NATIVE + "".join(f"{f.count}{f.code}" for f in SLOT_FIELDS[:_HEAD_FIELDS]))
_VALUES = struct.Struct(
    _NATIVE + "".join(f"{f.count}{f.code}" for f in SLOT_FIELDS[_HEAD_FIELDS:_VALUE_FIELDS]) + "24x"
)
_BODY = struct.Struct(_NATIVE + "".join(f"{f.count}{f.code}" for f in SLOT_FIELDS[:_VALUE_FIELDS]))
_LATER = struct.Struct("<BB2xqd4x")  # position_quality … reserved2
_MORE = struct.Struct("<6d16x")  # velocity_enu_m_s … reserved3
_LATER_OFFSET: Final = 228
_CRC = struct.Struct("<I")
_SEAL = struct.Struct("<I64x")  # the CRC, and zeros in place of `_MORE`
_SLOT = struct.Struct(f"{SLOT_BYTES}s")
_SEQ = struct.Struct("<Q")
_T_NS = struct.Struct("<8xq304x")
_PRESENT = struct.Struct("<I")
_PRESENT_OFFSET: Final = 52
_STATUS = struct.Struct("<56xI260x")
_QUALITY = struct.Struct("<48xI10xB257x")
_SYNC_OFFSET: Final = next(field.offset for field in SLOT_FIELDS if field.name == "sync")
DEVICE_ID_MOST: Final = 0xFFFF  # maximum number of a device in a slot
_U32_MAX: Final = 0xFFFF_FFFF
_U64_MAX: Final = 0xFFFF_FFFF_FFFF_FFFF
_I64_MIN: Final = -(1 << 63)
_I64_MAX: Final = (1 << 63) - 1
_ALL_PRESENT: Final = HAS_VELOCITY - 1  # all fields of layout version 1
_ZERO3: Vector3 = (0.0, 0.0, 0.0)
_ZERO4: Quaternion = (0.0, 0.0, 0.0, 0.0)
_ZERO2: Pair = (0.0, 0.0)


def slot_quality(slot: bytes) -> tuple[Sync, int]:
    """Return the fields `sync` and `t_err_ns` of one slot of this daemon."""
    t_err_ns, code = _QUALITY.unpack(slot)
    return SYNC_BY_CODE[code], t_err_ns


def encode_slots(samples: Sequence[Sample], device_id: int) -> list[bytes]:
    """Return `samples` as SLOT_BYTES bytes each, with CRC. `device_id` is the device number of the daemon, 0…65535."""
    try:
        return [_encode(sample, device_id) for sample in samples]
    except struct.error:
        return [encode_slot(sample, device_id) for sample in samples]


def encode_slot(sample: Sample, device_id: int) -> bytes:
    """Return one sample in the form of `encode_slots`."""
    try:
        return _encode(sample, device_id)
    except struct.error:
        return _encode(_fitted(sample), device_id & DEVICE_ID_MOST)


def _encode(sample: Sample, device_id: int) -> bytes:  # noqa: PLR0912 - one branch per field, faster than calls
    """Return the slot of a sample with valid values. Raises struct.error for other values."""
    present = _ALL_PRESENT
    if (t_dev := sample.t_dev_ns) is None:
        present, t_dev = present - HAS_T_DEV, 0
    if (accel := sample.accel_m_s2) is None:
        present, accel = present - HAS_ACCEL, _ZERO3
    if (gyro := sample.gyro_rad_s) is None:
        present, gyro = present - HAS_GYRO, _ZERO3
    if (mag := sample.mag_t) is None:
        present, mag = present - HAS_MAG, _ZERO3
    if (quat := sample.quat_wxyz) is None:
        present, quat = present - HAS_QUAT, _ZERO4
    if (euler := sample.euler_rad) is None:
        present, euler = present - HAS_EULER, _ZERO3
    if (temperature := sample.temperature_c) is None:
        present, temperature = present - HAS_TEMPERATURE, 0.0
    if (pressure := sample.pressure_pa) is None:
        present, pressure = present - HAS_PRESSURE, 0.0
    if (incli := sample.incli_rad) is None:
        present, incli = present - HAS_INCLI, _ZERO2
    if (status := sample.status) is None:
        present, status = present - HAS_STATUS, 0
    if (pps := sample.pps_age_ms) is None:
        present, pps = present - HAS_PPS_AGE, 0
    if (edge := sample.edge_seq) is None:
        present, edge = present - HAS_EDGE, 0
    ax, ay, az = accel
    gx, gy, gz = gyro
    mx, my, mz = mag
    qw, qx, qy, qz = quat
    roll, pitch, yaw = euler
    incli_x, incli_y = incli
    body = _HEAD.pack(
        sample.seq, sample.t_ns, sample.t_rx_ns, sample.utc_ns, t_dev, edge, sample.t_err_ns, present, status,
        device_id, SYNC_CODES[sample.sync], 0,
    ) + _VALUES.pack(
        ax, ay, az, gx, gy, gz, mx, my, mz, qw, qx, qy, qz, roll, pitch, yaw, temperature, pressure, incli_x, incli_y,
        pps,
    )  # fmt: skip
    if (
        sample.velocity_enu_m_s is None
        and sample.position is None
        and sample.heave_m is None
        and sample.gnss_utc_ns is None
    ):
        return body + _SEAL.pack(crc32(body))
    return _with_later(body, present, sample)


def _with_later(body: bytes, present: int, sample: Sample) -> bytes:
    """Return the slot of a sample with fields since layout version 2. `body` are its bytes before the CRC without them,
    `present` are the bits of `body`."""
    quality, satellites, places = NO_COUNT, NO_COUNT, _ZERO3
    if (velocity := sample.velocity_enu_m_s) is None:
        velocity = _ZERO3
    else:
        present |= HAS_VELOCITY
    if (position := sample.position) is not None:
        present |= HAS_POSITION
        quality, satellites = _count(position.quality), _count(position.satellites)
        height_m = nan if position.height_m is None else position.height_m
        places = (position.latitude_rad, position.longitude_rad, height_m)
    if (heave := sample.heave_m) is None:
        heave = 0.0
    else:
        present |= HAS_HEAVE
    if (gnss_utc := sample.gnss_utc_ns) is None:
        gnss_utc = 0
    else:
        present |= HAS_GNSS_UTC
    slot = bytearray(body + _SEAL.pack(0))
    _PRESENT.pack_into(slot, _PRESENT_OFFSET, present)
    _LATER.pack_into(slot, _LATER_OFFSET, quality, satellites, gnss_utc, heave)
    if present & HAS_MORE:
        _MORE.pack_into(slot, MORE_OFFSET, *velocity, *places)
    slot[CRC_OFFSET:MORE_OFFSET] = slot_crc(slot)
    return bytes(slot)


def _count(value: int | None) -> int:
    return NO_COUNT if value is None else _clipped(value, 0, NO_COUNT - 1)


def _fitted(sample: Sample) -> Sample:
    """Return `sample` with integers that fit: values clipped, status bits cut to the low 32 bits."""
    t_dev, status, pps, edge = sample.t_dev_ns, sample.status, sample.pps_age_ms, sample.edge_seq
    gnss_utc = sample.gnss_utc_ns
    return msgspec.structs.replace(
        sample,
        seq=_clipped(sample.seq, 0, _U64_MAX),
        t_ns=_clipped(sample.t_ns, _I64_MIN, _I64_MAX),
        t_err_ns=_clipped(sample.t_err_ns, 0, _U32_MAX),
        t_rx_ns=_clipped(sample.t_rx_ns, _I64_MIN, _I64_MAX),
        utc_ns=_clipped(sample.utc_ns, _I64_MIN, _I64_MAX),
        t_dev_ns=None if t_dev is None else _clipped(t_dev, _I64_MIN, _I64_MAX),
        status=None if status is None else status & _U32_MAX,
        pps_age_ms=None if pps is None else _clipped(pps, 0, _U32_MAX),
        edge_seq=None if edge is None else _clipped(edge, 0, _U64_MAX),
        gnss_utc_ns=None if gnss_utc is None else _clipped(gnss_utc, _I64_MIN, _I64_MAX),
    )


def _clipped(value: int, low: int, high: int) -> int:
    return min(max(value, low), high)


class EqualPieces(Sequence[bytes]):
    """Pieces of equal size, back to back in `whole`. The use of one piece cuts it out."""

    def __init__(self, whole: bytes, size: int) -> None:
        self.whole = whole
        self.number = len(whole) // size  # of pieces
        self._size = size

    def __len__(self) -> int:
        return self.number

    def __getitem__(self, index: Any) -> Any:
        """Return one piece, or a list of pieces for a slice."""
        whole, size = self.whole, self._size
        at = range(0, len(whole), size)[index]
        return whole[at : at + size] if isinstance(at, int) else [whole[one : one + size] for one in at]


def slots_in(packed: bytes) -> Iterator[tuple[bytes]]:
    """Return an iterator over packed slots."""
    return _SLOT.iter_unpack(packed)


def slot_seqs(packed: bytes) -> tuple[int, int]:
    """Return the sequence numbers of the first and the last of packed slots."""
    return _SEQ.unpack_from(packed)[0], _SEQ.unpack_from(packed, len(packed) - SLOT_BYTES)[0]


def slot_times_ns(packed: bytes) -> list[int]:
    """Return the time stamps `t_ns` of packed slots."""
    return [t_ns for (t_ns,) in _T_NS.iter_unpack(packed)]


def slot_status_bits(packed: bytes) -> int:
    """Return all status bits that are set in packed slots. A slot without status has zeros."""
    bits = 0
    for (status,) in _STATUS.iter_unpack(packed):
        bits |= status
    return bits


def slot_is_whole(slot: bytes) -> bool:
    """Return whether the CRC of a slot is correct."""
    return len(slot) == SLOT_BYTES and slot[CRC_OFFSET:MORE_OFFSET] == slot_crc(slot)


def slot_crc(slot: bytes | bytearray) -> bytes:
    """Return the correct field `crc32` of a slot."""
    crc = crc32(slot[:CRC_OFFSET])
    if _PRESENT.unpack_from(slot, _PRESENT_OFFSET)[0] & HAS_MORE:
        crc = crc32(slot[MORE_OFFSET:], crc)
    return _CRC.pack(crc)


def decode_slot(slot: bytes, device: str) -> Sample:
    """Return the sample in `slot`. Raises ValueError for a wrong CRC or an unknown `sync`."""
    if not slot_is_whole(slot):
        raise ValueError(
            f"slot of {len(slot)} bytes: expected {SLOT_BYTES} bytes with a matching CRC-32; "
            "was it written during the copy?"
        )
    sync = slot[_SYNC_OFFSET]
    if sync >= len(SYNC_BY_CODE):
        raise ValueError(f"slot with sync {sync}: expected 0 to {len(SYNC_BY_CODE) - 1}; did a newer imud write it?")
    return _sample(_BODY.unpack_from(slot), slot, 0, device)


def decode_slots(packed: bytes, device: str) -> list[Sample]:
    """Return the samples of valid slots back to back, without a check of their CRC."""
    return [_sample(_BODY.unpack_from(packed, at), packed, at, device) for at in range(0, len(packed), SLOT_BYTES)]


def _sample(v: tuple[Any, ...], packed: bytes, at: int, device: str) -> Sample:
    """Return the sample at `at` with the values `v` of `_BODY`."""
    has = v[7]
    sample = Sample(
        device, v[0], v[1], v[6], SYNC_BY_CODE[v[10]], v[2], v[3],
        t_dev_ns=v[4] if has & HAS_T_DEV else None,
        accel_m_s2=v[12:15] if has & HAS_ACCEL else None,
        gyro_rad_s=v[15:18] if has & HAS_GYRO else None,
        mag_t=v[18:21] if has & HAS_MAG else None,
        quat_wxyz=v[21:25] if has & HAS_QUAT else None,
        euler_rad=v[25:28] if has & HAS_EULER else None,
        temperature_c=v[28] if has & HAS_TEMPERATURE else None,
        pressure_pa=v[29] if has & HAS_PRESSURE else None,
        incli_rad=v[30:32] if has & HAS_INCLI else None,
        status=v[8] if has & HAS_STATUS else None,
        pps_age_ms=v[32] if has & HAS_PPS_AGE else None,
        edge_seq=v[5] if has & HAS_EDGE else None,
    )  # fmt: skip
    return sample if has < HAS_VELOCITY else _later(sample, has, packed, at)


def _later(sample: Sample, has: int, packed: bytes, at: int) -> Sample:
    """Return the sample with the fields since layout version 2."""
    quality, satellites, gnss_utc_ns, heave_m = _LATER.unpack_from(packed, at + _LATER_OFFSET)
    east, north, up, latitude, longitude, height = _MORE.unpack_from(packed, at + MORE_OFFSET)
    return msgspec.structs.replace(
        sample,
        velocity_enu_m_s=(east, north, up) if has & HAS_VELOCITY else None,
        position=Position(
            latitude, longitude, None if isnan(height) else height,
            None if quality == NO_COUNT else quality, None if satellites == NO_COUNT else satellites,
        ) if has & HAS_POSITION else None,
        heave_m=heave_m if has & HAS_HEAVE else None,
        gnss_utc_ns=gnss_utc_ns if has & HAS_GNSS_UTC else None,
    )  # fmt: skip
