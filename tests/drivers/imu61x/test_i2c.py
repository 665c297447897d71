"""The filter action on I2C and SPI with the simulated device. I2C bursts: bytes by hand, and replies of another device
or with another setting. Check value, product ids and filter codes, compared with the manual."""

import struct
from collections.abc import Callable, Mapping

import msgspec
import pytest

from imud.contracts.codec import BadFrame, BadReason, Vanished
from imud.contracts.command import Target
from imud.contracts.driver import PolledDriver
from imud.contracts.script import Transfer, run_transfer_script
from imud.contracts.setting import combined
from imud.drivers.imu61x import common
from imud.drivers.imu61x.i2c import DRIVER as I2C
from imud.drivers.imu61x.i2c import Imu61xI2cCodec, probe, set_up
from imud.drivers.imu61x.registers import RegisterOptions
from imud.drivers.imu61x.spi import DRIVER as SPI
from imud.drivers.imu61x.spi import SpiDeviceOptions
from imud.model.errors import BadArgument, DeviceRefused
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.imu61x.registers import Imu61xRegisters
from tests.drivers.imu61x.test_spi import RAD_S, G, slow_crc
from tests.support.old_spellings import script_of
from tests.support.simulated_modules import over_i2c, over_spi


class Wires:
    """One device on both buses."""

    def __init__(self) -> None:
        self.device = Imu61xRegisters(lambda: 0)
        self.transfers = 0

    def act(self, driver: PolledDriver, settings: RegisterOptions, **given: object) -> object:
        return run_transfer_script(script_of(driver, Target(settings, 0), "filter", given), self.over(driver))

    def over(self, driver: PolledDriver) -> Callable[[Transfer], bytes]:
        """Make transfers on the bus of the driver."""

        def transfer(one: Transfer) -> bytes:
            self.transfers += 1
            return (over_i2c if driver is I2C else over_spi)(self.device, one)

        return transfer


BUSES = [(I2C, RegisterOptions()), (SPI, SpiDeviceOptions())]


@pytest.mark.parametrize(("driver", "settings"), BUSES)
def test_filters_are_set_and_answered_and_each_is_a_setting_of_its_own(
    driver: PolledDriver, settings: RegisterOptions
) -> None:
    wires = Wires()
    wires.act(driver, settings, accel_filter=4)
    assert wires.device.filter == 0x4B
    wires.act(driver, settings, gyro_filter=0)
    assert wires.device.filter == 0x40
    wires, target = Wires(), Target(settings, 0)
    table = driver.device_settings
    assert table is not None
    before = read_table(wires, driver, target)
    assert (before["accel_filter"], before["gyro_filter"]) == ("47 Hz", "47 Hz")
    assert (table.save, table.restart) == (None, None)
    for name, value, control in (("accel_filter", "10 Hz", 0x4B), ("gyro_filter", 3, 0x43)):
        one = table.table[name]
        assert one.write is not None
        run_transfer_script(one.write(target, value), wires.over(driver))
        assert wires.device.filter == control
        assert one.agrees(value, read_table(wires, driver, target)[name])
    assert not table.table["gyro_filter"].agrees("10 Hz", "5 Hz")
    wires = Wires()
    wires.device.filter, wires.device.extended = 0x12, 1
    found = read_table(wires, driver, Target(settings, 0))
    assert found == {"accel_filter": "1 Hz", "gyro_filter": "2 Hz"} | ({"burst": "extended"} if driver is SPI else {})
    assert (wires.device.filter, wires.device.extended, wires.device.window) == (0x12, 1, 0)


@pytest.mark.parametrize("driver", [I2C, SPI])
def test_configured_filters_stay(driver: PolledDriver) -> None:
    """The daemon writes the options again, so another value would last at most ten seconds."""
    settings = driver.settings(gyro_filter=3)
    wires = Wires()
    with pytest.raises(
        BadArgument, match=r"gyro_filter: expected 5 Hz \(code 3\) from `options.gyro_filter`, got 10 Hz"
    ):
        wires.act(driver, settings, gyro_filter=4)  # type: ignore[arg-type]  # the driver's own settings
    assert wires.transfers == 0
    wires.act(driver, settings, gyro_filter=3, accel_filter=4)  # type: ignore[arg-type]  # the same
    assert wires.device.filter == 0x43
    settings = msgspec.convert({"gyro_filter": "5 Hz"}, driver.settings)
    wires = Wires()
    wires.act(driver, settings, gyro_filter=3, accel_filter="average 16")  # type: ignore[arg-type]  # the driver's own
    assert wires.device.filter == 0xD3


def test_filters_that_there_are_not_are_answered_with_the_table() -> None:
    for code in (-1, 16, "48 Hz", "47", 1.5):
        names = (
            r'one of "0\.2 Hz", "1 Hz", "2 Hz", .*"47 Hz", "average 4", "average 16", .* or a whole number from 0 to 15'
        )
        with pytest.raises(BadArgument, match=f"accel_filter.*{names}"):
            script_of(I2C, Target(RegisterOptions(), 0), "filter", {"accel_filter": code})


def read_table(wires: Wires, driver: PolledDriver, target: Target) -> Mapping[str, object]:
    assert driver.device_settings is not None
    return combined(run_transfer_script(driver.device_settings.read(target, None), wires.over(driver))).values


@pytest.mark.parametrize("driver", [I2C, SPI])
def test_a_setting_that_options_fix_otherwise_is_refused_and_one_that_is_not_taken_too(driver: PolledDriver) -> None:
    wires, table = Wires(), driver.device_settings
    assert table is not None
    write = table.table["gyro_filter"].write
    assert write is not None
    fixed = Target(msgspec.convert({"gyro_filter": "5 Hz"}, driver.settings), 0)
    with pytest.raises(BadArgument, match=r"options\.gyro_filter"):
        run_transfer_script(write(fixed, "10 Hz"), wires.over(driver))
    with pytest.raises(BadArgument, match=r"gyro_filter: expected 5 Hz .*`options\.gyro_filter`.* got 10 Hz"):
        table.check(fixed, {"gyro_filter": "10 Hz"})
    table.check(fixed, {"gyro_filter": 3, "accel_filter": "10 Hz"})
    table.check(Target(driver.settings(), 0), {"gyro_filter": "10 Hz"})
    wires.device.faults.ignores_writes = True
    with pytest.raises(DeviceRefused, match="FILTER_CTRL: expected 0xb4 after the write, got 0xbb"):
        run_transfer_script(write(Target(driver.settings(), 0), "10 Hz"), wires.over(driver))


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
def test_damaged_stale_absent_foreign_and_infinite_values() -> None:
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

    values = struct.pack("<7f", 0, 0, 1, float("inf"), 0, 0, 25)
    bad, m = codec().decode(0, values + struct.pack("<I", slow_crc(values)))
    assert isinstance(bad, BadFrame)
    assert bad.reason is BadReason.NOT_FINITE
    assert isinstance(m, Measurement)
    assert m.gyro_rad_s is None
    assert m.accel_m_s2 == (0, 0, G)


@pytest.mark.manual("A 3.3.2 filters", "A 3.3.3 ID")
def test_set_up_writes_reads_back_and_leaves_alone_and_probe_names_every_product() -> None:
    device, log = Imu61xRegisters(lambda: 0), list[Transfer]()

    def transfer(one: Transfer) -> bytes:
        log.append(one)
        return over_i2c(device, one)

    words = combined(run_transfer_script(set_up(RegisterOptions(accel_filter=4)), transfer)).words
    assert words == {"accel_filter": "10 Hz", "gyro_filter": "47 Hz"}
    assert [(one.sends[0].hex(), one.read_bytes) for one in log] == [("06", 1), ("064b", 0), ("06", 1)]
    log.clear()
    run_transfer_script(set_up(RegisterOptions()), transfer)
    assert len(log) == 1
    with pytest.raises(DeviceRefused, match="expected 0x4b after the write, got 0xbb"):
        run_transfer_script(set_up(RegisterOptions(accel_filter=4)), lambda one: b"\xbb" * one.read_bytes)

    for last, product in (("2", "IMU612"), ("4", "IMU614"), ("8", "IMU618"), ("A", "IMU6132A"), ("B", "IMU6132B")):
        script = probe(RegisterOptions())
        assert next(script) == Transfer((b"\x6a",), 8)
        with pytest.raises(StopIteration) as end:
            script.send(b"\x00\x00IMU61" + last.encode())
        assert end.value.value.product == product


@pytest.mark.manual(
    "A 1.2 CRC",
    "A 1.3 acceleration",
    "A 2.4.2 codes",
    "A 2.4.2 default",
    "A 2.4.2 layout",
    "A 5 CRC-32",
    "A 2.4.3 products",
)
def test_crc_gravity_products_and_filters() -> None:
    """The manual has 0x44 for 10 Hz and 0xBB for 47 Hz, accelerometer in the high half byte."""
    assert common.crc32(bytes.fromhex("55AA 0300 1800 0000803F") + bytes(20)) == 0xE88ED852
    assert common.crc32(b"123456789") == 0x3A8639CB
    assert (common.crc32(memoryview(b"123456789")), common.M_S2_PER_G) == (0x3A8639CB, 9.80665)
    with pytest.raises(ValueError, match="IMU612"):
        common.product_id_of("IMU613")
    assert len(common.PRODUCTS) == 5
    for data in (b"", bytes(8), b"\xff" * 8, b"\x00\x00IMU613", b"\x00\x00IMU614\x00", b"IMU61400"):
        assert common.product_of(data) is None
    assert (common.FILTERS[4], common.FILTERS[0xB]) == ("10 Hz", "47 Hz")
    assert (len(common.FILTERS), common.filter_control(4, 4)) == (16, 0x44)
    assert common.filter_control(0xB, 1) == 0xB1
    assert common.filter_codes(0xB1) == (0xB, 1)
    assert common.filter_codes(0xFFB1) == (0xB, 1)
    for codes in ((-1, 0), (16, 0), (0, 16), (0, -1)):
        with pytest.raises(ValueError, match="0 … 15"):
            common.filter_control(*codes)
    for data in (b"", b"\x00", b"123456789", bytes(range(256)), b"\xff" * 44):
        assert common.crc32(data) == slow_crc(data)
    for product_id, product in (
        ("0000494D55363132", "IMU612"), ("0000494D55363134", "IMU614"), ("0000494D55363138", "IMU618"),
        ("0000494D55363141", "IMU6132A"), ("0000494D55363142", "IMU6132B"),
    ):  # fmt: skip
        assert common.product_of(bytes.fromhex(product_id)) == product
        assert common.product_id_of(product) == bytes.fromhex(product_id)
