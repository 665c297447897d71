"""I2C bursts of the IMU61x: bytes by hand, and replies of another device or with another setting."""

import struct

import pytest

from imud.contracts.codec import BadFrame, BadReason, Vanished
from imud.contracts.script import Transfer, run_transfer_script
from imud.contracts.setting import words_of
from imud.drivers.imu61x.i2c import Imu61xI2cCodec, probe, set_up
from imud.drivers.imu61x.registers import RegisterOptions
from imud.model.errors import DeviceRefused
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.imu61x.registers import Imu61xRegisters
from tests.drivers.imu61x.test_spi import RAD_S, G, slow_crc
from tests.support.simulated_modules import over_i2c

VALUES = bytes.fromhex("00000000 0000003f 0000803f 0000803f 00000000 000080bf 0000c841".replace(" ", ""))
"""Accel 0, 0.5, 1 g; gyro 1, 0, -1 °/s; 25 °C: f32, low byte first."""
GOLDEN = VALUES + struct.pack("<I", slow_crc(VALUES))


def codec(**settings: int) -> Imu61xI2cCodec:
    return Imu61xI2cCodec(Ledger(), RegisterOptions(**settings))


@pytest.mark.manual("A 3.3.1 reading", "A 3.3.1 order")
def test_burst_in_si() -> None:
    made = codec()
    assert (made.polls[0].transfer.sends, made.polls[0].transfer.read_bytes) == ((b"\x12",), 32)
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


@pytest.mark.parametrize(
    ("last", "product"), [("2", "IMU612"), ("4", "IMU614"), ("8", "IMU618"), ("A", "IMU6132A"), ("B", "IMU6132B")]
)
@pytest.mark.manual("A 3.3.3 ID")
def test_probe_names_every_product(last: str, product: str) -> None:
    script = probe(RegisterOptions())
    assert next(script) == Transfer((b"\x6a",), 8)
    with pytest.raises(StopIteration) as end:
        script.send(b"\x00\x00IMU61" + last.encode())
    assert end.value.value.product == product


@pytest.mark.manual("A 3.3.2 filters")
def test_set_up_writes_reads_back_and_leaves_alone() -> None:
    device, log = Imu61xRegisters(lambda: 0), list[Transfer]()

    def transfer(one: Transfer) -> bytes:
        log.append(one)
        return over_i2c(device, one)

    words = words_of(run_transfer_script(set_up(RegisterOptions(accel_filter=4)), transfer))
    assert words == {"accel_filter": "10 Hz", "gyro_filter": "47 Hz"}
    assert [(one.sends[0].hex(), one.read_bytes) for one in log] == [("06", 1), ("064b", 0), ("06", 1)]
    log.clear()
    run_transfer_script(set_up(RegisterOptions()), transfer)
    assert len(log) == 1
    with pytest.raises(DeviceRefused, match="expected 0x4b after the write, got 0xbb"):
        run_transfer_script(set_up(RegisterOptions(accel_filter=4)), lambda one: b"\xbb" * one.read_bytes)
