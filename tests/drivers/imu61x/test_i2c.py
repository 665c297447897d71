"""I2C bursts of the IMU61x: bytes by hand, and replies of another device or with another setting."""

import struct

import pytest

from imud.contracts.codec import BadFrame, BadReason, Vanished
from imud.drivers.imu61x.i2c import Imu61xI2cCodec
from imud.drivers.imu61x.registers import RegisterOptions
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from tests.drivers.imu61x.test_spi import RAD_S, G, slow_crc

VALUES = bytes.fromhex("00000000 0000003f 0000803f 0000803f 00000000 000080bf 0000c841".replace(" ", ""))
"""Accel 0, 0.5, 1 g; gyro 1, 0, -1 °/s; 25 °C: f32, low byte first."""
GOLDEN = VALUES + struct.pack("<I", slow_crc(VALUES))


def codec(**settings: int) -> Imu61xI2cCodec:
    return Imu61xI2cCodec(Ledger(), RegisterOptions(**settings))


@pytest.mark.manual("A 3.3.1 reading", "A 3.3.1 order")
def test_burst_in_si() -> None:
    made = codec()
    (m,) = made.decode(0, GOLDEN)
    assert isinstance(m, Measurement)
    assert m.accel_m_s2 == pytest.approx((0, G / 2, G))
    assert m.gyro_rad_s == pytest.approx((RAD_S, 0, -RAD_S))
    assert m.temperature_c == 25.0
    assert m.size_bytes == made.ledger.bytes_in_good_frames == 32


@pytest.mark.manual("A 3.3.1 CRC")
def test_damaged_stale_absent_and_foreign_bytes() -> None:
    for at in range(32):
        damaged = GOLDEN[:at] + bytes([GOLDEN[at] ^ 0x80]) + GOLDEN[at + 1 :]
        made = codec()
        assert made.decode(0, damaged) == (BadFrame(BadReason.CRC, damaged),)
        assert made.ledger.closes()

    made = codec()
    made.decode(0, GOLDEN)
    assert made.decode(0, GOLDEN) == ()
    assert made.stale == 1
    for data in (b"\xff" * 32, b"\x00" * 32, b"", GOLDEN[:31]):
        assert isinstance(made.decode(0, data)[0], Vanished)
    assert made.ledger.closes()

    made = codec(gyro_filter=3)
    assert made.decode(1, b"\x00\x00IMU612") == ()
    assert made.decode(2, b"\xb3") == ()
    assert made.ledger.frames_in_replies == 2
    for poll, data in ((1, b"\x00\x00IMU61C"), (2, b"\xbb"), (1, b""), (2, b"")):
        assert isinstance(made.decode(poll, data)[0], Vanished)
    assert made.ledger.closes()


def test_infinite_values_are_removed_and_reported() -> None:
    values = struct.pack("<7f", 0, 0, 1, float("inf"), 0, 0, 25)
    bad, m = codec().decode(0, values + struct.pack("<I", slow_crc(values)))
    assert isinstance(bad, BadFrame)
    assert bad.reason is BadReason.NOT_FINITE
    assert isinstance(m, Measurement)
    assert m.gyro_rad_s is None
    assert m.accel_m_s2 == (0, 0, G)
