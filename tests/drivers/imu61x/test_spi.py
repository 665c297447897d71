"""SPI frames of the IMU61x: words by hand, every burst, every invalid reply; scripts with the simulated device."""

import struct
from collections.abc import Sequence
from math import nan
from typing import Literal

import pytest

from imud.contracts.codec import BadFrame, BadReason, PolledEvent, Vanished
from imud.contracts.script import Transfer, run_transfer_script
from imud.contracts.setting import combined
from imud.drivers.imu61x import spi
from imud.drivers.imu61x.registers import temperature_c
from imud.drivers.imu61x.spi import READ_STATE, BurstKind, SpiDeviceOptions, burst_problem, probe, set_up
from imud.model.errors import DeviceRefused, TransferError, Trouble
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.imu61x.uart import REGISTER_VARIANTS, RegisterBehaviour
from tests.support.simulated_modules import over_spi

PIPELINE = b"\xde\xad\xbe\xef"
GOLDEN = bytes.fromhex("8000 003e 0000 0000 8000 ffc1  0000 0000 0000 fffb 0000 0005  ffff 0002".replace(" ", ""))
"""Gyro 1, 0, -1 °/s: 4096000 = 0x003E8000, 0, 0xFFC18000. Accel 0, -1, 1 g: 0, 0xFFFB0000, 327680 = 0x00050000.

Sum: 8000 + 003E + 8000 + FFC1 + FFFB + 0005 = 0x2FFFF.
"""
RAD_S = 0.017453292519943295
G = 9.80665


def codec(burst: str = "standard", **more: object) -> spi.Imu61xSpiCodec:
    return spi.Imu61xSpiCodec(Ledger(), SpiDeviceOptions(burst=burst, **more))  # type: ignore[arg-type]  # passed on as given


def u16_words(data: bytes) -> tuple[int, ...]:
    return struct.unpack(f">{len(data) // 2}H", data)


def with_sum(values: bytes, total: int | None = None) -> bytes:
    total = sum(u16_words(values)) if total is None else total
    return values + struct.pack(">HH", total & 0xFFFF, total >> 16)


def one(events: Sequence[PolledEvent]) -> Measurement:
    (event,) = events
    assert isinstance(event, Measurement)
    return event


@pytest.mark.manual(
    "A 2.4 BURST", "A 2.4.1 order", "A 2.4.1 scale of the gyroscope", "A 2.4.1 scale of the accelerometer",
    "A 2.4.1 checksum",
)  # fmt: skip
def test_standard_burst_in_si() -> None:
    made = codec()
    m = one(made.decode(0, PIPELINE + GOLDEN))
    assert m.gyro_rad_s == pytest.approx((RAD_S, 0, -RAD_S), rel=1e-12)
    assert m.accel_m_s2 == pytest.approx((0, -G, G), rel=1e-12)
    assert m.temperature_c is None
    assert made.ledger.snapshot() == Ledger().snapshot() | {
        "bytes_in": 28, "bytes_in_good_frames": 28, "frames_good": 1, "frames_in_samples": 1
    }  # fmt: skip

    wrong_high, wrong_low = with_sum(GOLDEN[:24], 0x1FFFF), with_sum(GOLDEN[:24], 0x2FFFE)
    assert codec().decode(0, PIPELINE + wrong_high) == (BadFrame(BadReason.CRC, wrong_high),)
    one(codec(checksum_bits=16).decode(0, PIPELINE + wrong_high))
    for made in (codec(), codec(checksum_bits=16)):
        assert made.decode(0, PIPELINE + wrong_low) == (BadFrame(BadReason.CRC, wrong_low),)
        assert made.ledger.frames_bad_crc == 1
        assert made.ledger.closes()

    made = codec()
    one(made.decode(0, PIPELINE + GOLDEN))
    assert made.decode(0, b"\0\0\0\0" + GOLDEN) == ()
    assert (made.stale, made.ledger.frames_ignored, made.ledger.frames_good) == (1, 1, 2)
    made.reset()
    one(made.decode(0, PIPELINE + GOLDEN))
    assert made.stale == 1


def slow_crc(data: bytes) -> int:
    """Return the CRC-32 bit by bit: reflected 0xEDB88320, start value 1, no final XOR."""
    register = 1
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ 0xEDB88320 * (register & 1)
    return register


def extended(*values: float, status: int = 0x01020304) -> bytes:
    memory = struct.pack("<10fI", *values, status)
    memory += struct.pack("<I", slow_crc(memory))
    return b"".join(memory[at : at + 2][::-1] for at in range(0, 48, 2))


@pytest.mark.manual("A 2.4.1 extended burst")
def test_extended_burst_in_si() -> None:
    data = extended(1, 0, -1, 0, 0.5, 1, 25, 90, 0, -45)
    assert u16_words(data)[:6] == (0x0000, 0x3F80, 0, 0, 0x0000, 0xBF80)  # 1.0 = 0x3F800000, low word first
    m = one(codec("extended").decode(0, PIPELINE + data))
    assert m.gyro_rad_s == pytest.approx((RAD_S, 0, -RAD_S))
    assert m.accel_m_s2 == pytest.approx((0, G / 2, G))
    assert m.temperature_c == 25.0
    assert m.euler_rad == pytest.approx((1.5707963267948966, 0, -0.7853981633974483))
    assert m.status == 0x01020304
    assert m.quat_wxyz == pytest.approx((0.65328148, 0.65328148, -0.27059805, -0.27059805))

    # bit 31 of a sample's status belongs to imud: an active ALARM line, which this device does not have
    m = one(codec("extended").decode(0, PIPELINE + extended(1, 0, -1, 0, 0.5, 1, 25, 90, 0, -45, status=0xC0000001)))
    assert m.status == 0x40000001

    bad, event = codec("extended").decode(0, PIPELINE + extended(1, nan, 0, 0, 0, 1, 25, 0, 0, 0))
    assert isinstance(bad, BadFrame)
    assert bad.reason is BadReason.NOT_FINITE
    rest = one([event])
    assert rest.gyro_rad_s is None
    assert rest.accel_m_s2 == pytest.approx((0, 0, G))

    good = extended(1, 0, -1, 0, 0.5, 1, 25, 90, 0, -45)
    for at in range(48):
        damaged = good[:at] + bytes([good[at] ^ 1]) + good[at + 1 :]
        assert codec("extended").decode(0, PIPELINE + damaged) == (BadFrame(BadReason.CRC, damaged),)


@pytest.mark.manual("A 2.4 single registers", "A 2.4.1 scale of the accelerometer")
def test_single_registers_in_si() -> None:
    """TEMP 2634 · 65536 is 25 °C; gyro high word 1 is 0.016 °/s; accel 327680000 = 0x13880000 is 1 g."""
    data = bytes.fromhex("0a4a0000 00010000 00000000 ffff0000 00000000 ec780000 13880000".replace(" ", ""))
    m = one(codec("registers").decode(0, PIPELINE + data))
    assert m.temperature_c == 25.0
    assert m.gyro_rad_s == pytest.approx((0.016 * RAD_S, 0, -0.016 * RAD_S))
    assert m.accel_m_s2 == pytest.approx((0, -G, G))


@pytest.mark.manual("A 2.4.1 scale of the temperature")
def test_temperature_read_between_bursts_is_in_the_samples_after_it() -> None:
    for counts, celsius in ((172621824, 25.0), (0, 35.0), (172621824 - 17262182, 26.0)):
        assert temperature_c(counts) == pytest.approx(celsius, abs=1e-6)
    made = codec()
    made.decode(2, PIPELINE + bytes.fromhex("0a4a0000"))
    assert one(made.decode(0, PIPELINE + GOLDEN)).temperature_c == 25.0
    made.decode(2, PIPELINE + bytes.fromhex("fff00000"))  # counts are negative above 35 °C
    other = with_sum(bytes.fromhex("0001") + GOLDEN[2:24])
    assert one(made.decode(0, PIPELINE + other)).temperature_c == pytest.approx(35 + 16 / 263.4)
    made.decode(2, PIPELINE + b"\xff" * 4)
    assert one(made.decode(0, PIPELINE + GOLDEN)).temperature_c is None
    assert made.ledger.closes()


def decode_state(**changes: int | bytes) -> list[PolledEvent]:
    device, made = Imu61xRegisters(lambda: 0), codec(gyro_filter=0xB)
    for name, value in changes.items():
        setattr(device.faults if name == "product_id" else device, name, value)
    events = made.decode(1, over_spi(device, READ_STATE))
    assert made.ledger.closes()
    return list(events)


def test_a_changed_state_is_noticed_and_a_missing_device_is_not_damage() -> None:
    assert decode_state() == []
    for (event,) in (decode_state(filter=0xB0), decode_state(product_id=b"\x00\x00ICM206")):
        assert isinstance(event, Vanished)
    assert isinstance(codec().decode(1, b"")[0], Vanished)
    assert decode_state(extended=1) == []
    device, made = Imu61xRegisters(lambda: 0, behaviour=RegisterBehaviour(window_bits=0xA5FE)), codec()
    assert made.decode(1, over_spi(device, READ_STATE)) == ()
    stuck = over_spi(device, READ_STATE)
    assert stuck[-2:] == b"\xa5\xfe"
    (event,) = made.decode(1, stuck[:-1] + b"\xff")
    assert event == Vanished("expected WIN_CTRL 0, got 1")
    # The checksum of zeros would match
    for data in (b"\xff" * 28, b"\x00" * 28, b"", GOLDEN[:-1]):
        made = codec()
        (event,) = made.decode(0, PIPELINE + data)
        assert isinstance(event, Vanished)
        assert made.ledger.bytes_skipped == made.ledger.bytes_in == len(data)


@pytest.mark.manual("A 2.3 read and write", "A 2.4.1 reading", "A 2.4.2 write and read")
def test_words_of_the_manual_their_answers_and_transfers_on_the_wire() -> None:
    """2.4.4: 0xFE01 opens window 1. 2.4.2: 0x8644 sets both filters to 10 Hz, 0x0600 reads them back."""
    assert (spi.OPEN, spi.write(0x06, 0x44), spi.read(0x06), spi.MODES) == (0xFE01, 0x8644, 0x0600, (0, 3))
    assert [one.hex() for one in spi.READ_STATE.sends] == [
        "fe01", "6a00", "6c00", "6e00", "7000", "0600", "0c00", "0d00", "fe00", "7e00", "7e00", "7e00"
    ]  # fmt: skip
    assert spi.answers(bytes.fromhex("aaaa bbbb 0001 fffe")) == (1, 0xFFFE)
    assert spi.answers(b"\x01\x02\x03\x04\x05") == ()
    assert spi.READ_STANDARD.sends == (b"\x80\x00" + bytes(30),)
    assert spi.READ_EXTENDED.sends == (b"\x80\x00" + bytes(50),)
    assert [one.hex() for one in spi.READ_TEMPERATURE.sends] == ["0e00", "1000", "7e00", "7e00"]
    assert [spi.READ_REGISTERS.sends[n].hex() for n in (0, 13)] == ["0e00", "2800"]


STANDARD = spi.encode_standard(accel_m_s2=(0.1, -0.2, 9.8), gyro_rad_s=(0.1, 0.2, 0.3))
EXTENDED = spi.encode_extended(
    accel_m_s2=(0.1, -0.2, 9.8), gyro_rad_s=(0.1, 0.2, 0.3), temperature_c=25.0, euler_rad=(0.1, 0.2, 0.3)
)


@pytest.mark.parametrize(
    ("kind", "frame", "why"),
    [
        ("standard", STANDARD, ""), ("extended", EXTENDED, ""), ("standard", EXTENDED[:28], "wrong check value"),
        ("extended", STANDARD + bytes(20), "wrong check value"), ("standard", bytes(28), "received only 0x00"),
        ("extended", b"\xff" * 48, "received only 0xFF"), ("standard", STANDARD[:-1], "expected 28 bytes, got 27"),
        ("extended", b"", "expected 48 bytes, got 0"),
    ],
)  # fmt: skip
def test_which_bytes_are_a_burst_of_a_kind(kind: BurstKind, frame: bytes, why: str) -> None:
    found = burst_problem(kind, PIPELINE + frame, 32)
    assert found.startswith(why)
    assert bool(found) is bool(why)


class Wire:
    """Simulated device with a failure at one of its transfers."""

    def __init__(self, *, fail_at: int = -1, deaf: bool = False, behaviour: RegisterBehaviour | None = None) -> None:
        self.device = Imu61xRegisters(lambda: 0, behaviour=behaviour)
        self.sent: list[str] = []
        self._fail_at = fail_at
        self._deaf = deaf

    def transfer(self, transfer: Transfer) -> bytes:
        number = len(self.sent)
        self.sent.append(" ".join(item.hex() for item in transfer.sends))
        if number == self._fail_at:
            self.device.spi(transfer.sends[:3])  # the transfer fails in window 1
            raise TransferError(Trouble.DISTURBED, "by the test")
        data = over_spi(self.device, transfer)
        if self._deaf:
            self.device.filter, self.device.extended = 0xBB, 0
        return data


@pytest.mark.manual(
    "A 2.4 PROD_ID", "A 2.4.3 reading", "A 2.4 BURST_CTRL", "A 2.4 FILTER_CTRL", "A 2.4.2 write and read"
)
def test_probe_and_set_up() -> None:
    wire = Wire()
    assert run_transfer_script(probe(SpiDeviceOptions()), wire.transfer).product == "IMU614"
    assert (wire.device.window, len(wire.sent)) == (0, 1)

    wire = Wire()
    words = combined(run_transfer_script(set_up(SpiDeviceOptions()), wire.transfer)).words
    assert words == {"accel_filter": "47 Hz", "gyro_filter": "47 Hz", "burst": "standard"}
    assert len(wire.sent) == 2  # the state and a burst
    settings = SpiDeviceOptions(accel_filter=4, gyro_filter=4, burst="extended")
    words = combined(run_transfer_script(set_up(settings), wire.transfer)).words
    assert words == {"accel_filter": "10 Hz", "gyro_filter": "10 Hz", "burst": "extended"}
    assert wire.sent[3] == "fe01 8644 fe00 7e00 7e00"  # 10 Hz in the manual's example: 0x8644
    assert (wire.sent[5], len(wire.sent)) == ("fe01 8d01 fe00 7e00 7e00", 7)
    assert (wire.device.filter, wire.device.extended, wire.device.window) == (0x44, 1, 0)

    wire = Wire()
    wire.device.extended = 1
    flips = iter([0, 0, 1, 0, 0])  # the first burst after the selection

    def transfer(one: Transfer) -> bytes:
        wire.device.faults.flips = next(flips)
        return wire.transfer(one)

    assert combined(run_transfer_script(set_up(SpiDeviceOptions()), transfer)).words["burst"] == "standard"
    assert wire.device.extended == 0


@pytest.mark.parametrize("fail_at", [0, 1, 2])
@pytest.mark.manual("A 2.4.4 windows")
def test_window_is_closed_after_a_failure(fail_at: int) -> None:
    wire = Wire(fail_at=fail_at)
    with pytest.raises(TransferError):
        run_transfer_script(set_up(SpiDeviceOptions(gyro_filter=1)), wire.transfer)
    assert (wire.sent[-1], wire.device.window) == ("fe00 7e00 7e00", 0)
    wire = Wire(fail_at=3)  # the burst that shows its kind
    with pytest.raises(TransferError):
        run_transfer_script(set_up(SpiDeviceOptions(gyro_filter=1)), wire.transfer)
    assert len(wire.sent) == 4


def test_a_setting_that_does_not_take_and_another_id_are_refused() -> None:
    with pytest.raises(DeviceRefused, match="FILTER_CTRL: expected 0xb1 after the write, got 0xbb"):
        run_transfer_script(set_up(SpiDeviceOptions(gyro_filter=1)), Wire(deaf=True).transfer)
    words = "expected a burst of the selected kind extended: wrong check value: .* is 0x0000 at 0x0C and 0x0000 at 0x0D"
    with pytest.raises(DeviceRefused, match=words):
        run_transfer_script(set_up(SpiDeviceOptions(burst="extended")), Wire(deaf=True).transfer)
    for product_id, why in (
        (b"\xff" * 8, "received only 0xFF"), (b"\x00" * 8, "received only 0x00"), (b"\x00\x00IMU61C", "SPI mode"),
    ):  # fmt: skip
        wire = Wire()
        wire.device.faults.product_id = product_id
        with pytest.raises(DeviceRefused, match=why):
            run_transfer_script(probe(SpiDeviceOptions()), wire.transfer)


@pytest.mark.parametrize("variant", REGISTER_VARIANTS)
@pytest.mark.parametrize("before", [0, 1])
@pytest.mark.parametrize("burst", ["standard", "extended", "registers"])
def test_kind_of_burst_wherever_it_reads_back(
    variant: str, before: int, burst: Literal["standard", "extended", "registers"]
) -> None:
    wire = Wire(behaviour=REGISTER_VARIANTS[variant])
    wire.device.extended = before
    words = combined(run_transfer_script(set_up(SpiDeviceOptions(burst=burst)), wire.transfer)).words
    if burst != "registers":
        assert (words["burst"], wire.device.extended) == (burst, burst == "extended")
    assert wire.device.window == 0
