"""Bursts of the Forsense IMU61x on SPI: transfers, layouts and check values. Manual, section 2.4.1, tables 17 and 18.

    MOSI   0x8000   0x0000   0x0000   0x0000   …                burst: chip select is held low through all of it
    MISO    any      any     word 1   word 2   …   word n

    standard, 14 words   gyro 3, accel 3, all i32, low word first | sum of these twelve words, low word first
    extended, 24 words   gyro 3 °/s | accel 3 g | temperature °C | roll pitch yaw ° | status u32 | CRC-32, all f32 else

The manual prints 13 words for the standard burst, with a checksum of 16 bits; devices send 14, with one of 32 bits
(`checksum_bits: 16` looks at the low word only). The extended burst, which the manual mentions and does not define, is
as the vendor's own program reads it; the order of its angles is assumed.
"""

import struct
from typing import Final, Literal

from imud.contracts.polling import Transfer
from imud.devices.imu61x.common.family import M_S2_PER_G, RAD_S_PER_DEG_S, crc32
from imud.devices.imu61x.common.registers import (
    BURST,
    M_S2_PER_COUNT,
    RAD_S_PER_COUNT,
    TEMP_HIGH,
    ZACCEL_LOW,
)
from imud.devices.imu61x.spi.words import PIPELINE_BYTES, PIPELINE_WORDS, message, read, write
from imud.devices.polled_frames import absence
from imud.sample import Vector3
from imud.units import RAD_PER_DEG

BurstKind = Literal["standard", "extended"]
"""What the device sends for 0x8000."""
STANDARD_WORDS: Final = 14
EXTENDED_WORDS: Final = 24
REGISTER_WORDS: Final = (ZACCEL_LOW - TEMP_HIGH) // 2 + 1
STANDARD: Final = struct.Struct(">14H")
EXTENDED: Final = struct.Struct("<10fII")
"""gyro 3 °/s, accel 3 g, temperature °C, roll pitch yaw °, status, CRC-32 of the 44 bytes before."""
CRC_OFFSET: Final = 44


def _burst(words: int) -> Transfer:
    """0x8000 and as many zeros as bring `words` words through the pipeline, in one selection."""
    return Transfer((write(BURST, 0).to_bytes(2, "big") + bytes(2 * (PIPELINE_WORDS + words - 1)),))


READ_STANDARD: Final = _burst(STANDARD_WORDS)
READ_EXTENDED: Final = _burst(EXTENDED_WORDS)
READ_REGISTERS: Final = message(*(read(address) for address in range(TEMP_HIGH, ZACCEL_LOW + 1, 2)))
READ_TEMPERATURE: Final = message(read(TEMP_HIGH), read(TEMP_HIGH + 2))
BURSTS: Final[dict[BurstKind, Transfer]] = {"standard": READ_STANDARD, "extended": READ_EXTENDED}
"""The transfer that reads each kind of burst."""


def sum_matches(frame: bytes, checksum_bits: int) -> bool:
    """Whether the checksum of a standard burst is right."""
    *words, low, high = STANDARD.unpack(frame)
    total = sum(words)
    return low == total & 0xFFFF and (checksum_bits == 16 or high == total >> 16)


def little_endian(frame: bytes) -> bytes:
    """The words of an extended burst as they lie in the memory of a little-endian host."""
    return struct.pack("<24H", *struct.unpack(">24H", frame))


def crc_matches(memory: bytes) -> bool:
    """Whether the CRC of an extended burst, as `little_endian` returns it, is right."""
    return bool(crc32(memory[:CRC_OFFSET]) == EXTENDED.unpack(memory)[11])


def burst_problem(kind: BurstKind, data: bytes, checksum_bits: int) -> str:
    """Return why bytes that were read are no burst of this kind, pipeline included; empty if they are one."""
    frame = data[PIPELINE_BYTES:]
    words = STANDARD_WORDS if kind == "standard" else EXTENDED_WORDS
    if len(frame) != 2 * words:
        return f"expected {2 * words} bytes, got {len(frame)}"
    if why := absence(frame):
        return why
    good = sum_matches(frame, checksum_bits) if kind == "standard" else crc_matches(little_endian(frame))
    return "" if good else f"its check value does not match: {frame[:8].hex(' ')} …"


# --- the device's side ------------------------------------------------------------------------------------------------


def encode_standard(*, accel_m_s2: Vector3, gyro_rad_s: Vector3) -> bytes:
    """The 14 words of a standard burst from SI values; values beyond 32 bits are cut off."""
    counts = [*(round(w / RAD_S_PER_COUNT) for w in gyro_rad_s), *(round(a / M_S2_PER_COUNT) for a in accel_m_s2)]
    words = [word for count in counts for word in (count & 0xFFFF, count >> 16 & 0xFFFF)]
    total = sum(words)
    return STANDARD.pack(*words, total & 0xFFFF, total >> 16)


def encode_extended(
    *, accel_m_s2: Vector3, gyro_rad_s: Vector3, temperature_c: float, euler_rad: Vector3, status: int = 0
) -> bytes:
    """The 24 words of an extended burst from SI values. Raises OverflowError beyond f32."""
    memory = struct.pack(
        "<10fI",
        *(w / RAD_S_PER_DEG_S for w in gyro_rad_s),
        *(a / M_S2_PER_G for a in accel_m_s2),
        temperature_c,
        *(angle / RAD_PER_DEG for angle in euler_rad),
        status,
    )
    memory += struct.pack("<I", crc32(memory))
    return struct.pack(">24H", *struct.unpack("<24H", memory))
