"""Bursts of the IMU61x on SPI: their transfers, and which bytes are one."""

import pytest

from imud.devices.imu61x.spi import bursts
from imud.devices.imu61x.spi.bursts import BurstKind, burst_problem

PIPELINE = b"\xde\xad\xbe\xef"


@pytest.mark.manual("A 2.3 read and write", "A 2.4.1 reading", "A 2.4.2 write and read")
def test_transfers_on_the_wire() -> None:
    assert bursts.READ_STANDARD.sends == (b"\x80\x00" + bytes(30),)
    assert bursts.READ_EXTENDED.sends == (b"\x80\x00" + bytes(50),)
    assert [one.hex() for one in bursts.READ_TEMPERATURE.sends] == ["0e00", "1000", "7e00", "7e00"]
    assert [bursts.READ_REGISTERS.sends[n].hex() for n in (0, 13)] == ["0e00", "2800"]


STANDARD = bursts.encode_standard(accel_m_s2=(0.1, -0.2, 9.8), gyro_rad_s=(0.1, 0.2, 0.3))
EXTENDED = bursts.encode_extended(
    accel_m_s2=(0.1, -0.2, 9.8), gyro_rad_s=(0.1, 0.2, 0.3), temperature_c=25.0, euler_rad=(0.1, 0.2, 0.3)
)


@pytest.mark.parametrize(
    ("kind", "frame", "why"),
    [
        ("standard", STANDARD, ""),
        ("extended", EXTENDED, ""),
        ("standard", EXTENDED[:28], "its check value does not match"),
        ("extended", STANDARD + bytes(20), "its check value does not match"),
        ("standard", bytes(28), "only 0x00"),
        ("extended", b"\xff" * 48, "only 0xFF"),
        ("standard", STANDARD[:-1], "expected 28 bytes, got 27"),
        ("extended", b"", "expected 48 bytes, got 0"),
    ],
)
def test_which_bytes_are_a_burst_of_a_kind(kind: BurstKind, frame: bytes, why: str) -> None:
    found = burst_problem(kind, PIPELINE + frame, 32)
    assert found.startswith(why)
    assert bool(found) is bool(why)
