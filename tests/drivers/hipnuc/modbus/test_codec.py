"""Replies of the manual with values by hand, and the scales that the codec decides."""

import struct
from math import radians
from typing import Any

import pytest

from imud.contracts.codec import BadFrame, BadReason, Vanished
from imud.contracts.script import Transfer, run_transfer_script
from imud.contracts.setting import combined
from imud.drivers.hipnuc.common import QUAT_PER_LSB
from imud.drivers.hipnuc.modbus import codec as modbus
from imud.drivers.hipnuc.modbus.codec import READ_BLOCK, HipnucModbusCodec, HipnucModbusOptions
from imud.drivers.hipnuc.modbus.commands import probe, read_settings
from imud.drivers.hipnuc.modbus.driver import DRIVER
from imud.drivers.hipnuc.modbus.registers import QUAT_OLD_PER_LSB, registers_reply
from imud.formats.modbus import framed
from imud.model.errors import DeviceRefused
from imud.model.ledger import Ledger
from imud.model.sample import Measurement

IDENTITY = bytes.fromhex(
    "50 03 28 48 49 31 34 52 32 4E 2D 34 38 35 2D 30 30 30 00 00 98 00 6B" + "00" * 10
    + "04 7D 95 5F 8D 2A 17 08 00 00 4D 0C"
)  # fmt: skip
"""Section 4.4, with the three zeros that the print omits, according to the CRC."""
SENSORS = bytes.fromhex(
    "50 03 30 FF 01 03 B0 06 50 FC C9 FF 7C 00 91 01 D5 FD DB FD 27 00 00 21 FF 00 00 7F F6 FF FD 73 E7" + "00" * 6
    + "10 A6 0D 59 DD 4E 86 A8 06 30 17 82 1E CE"
)  # fmt: skip
"""Section 4.5, with the zero that the print omits."""
EXCEPTION = framed(0x50, b"\x83\x02")


def codec(**options: object) -> HipnucModbusCodec:
    return HipnucModbusCodec(Ledger(), HipnucModbusOptions(**options))  # type: ignore[arg-type]  # passed on


def short(**options: object) -> HipnucModbusCodec:
    """Return a codec that already uses the block without UPTIME."""
    made = codec(**options)
    made.decode(0, EXCEPTION)
    made.reset()
    return made


def block(
    *, quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0), per_lsb: float = QUAT_PER_LSB,
    incli: tuple[int, int] = (0, 0), pitch_deg: float = 0.0, uptime_ms: int = 5,
    mag_t: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> bytes:  # fmt: skip
    data = modbus.pack_block(
        accel_m_s2=(0, 0, 9.8), gyro_rad_s=(0, 0, 0), mag_t=mag_t, euler_rad=(0, radians(pitch_deg), 0),
        quat_wxyz=quat, temperature_c=0, pressure_pa=0, uptime_ms=uptime_ms, incli_counts=incli, quat_per_lsb=per_lsb,
    )  # fmt: skip
    return framed(9, registers_reply(data))


def measured(made: HipnucModbusCodec, data: bytes) -> Measurement:
    (event,) = made.decode(0, data)
    assert isinstance(event, Measurement)
    assert made.ledger.closes()
    return event


@pytest.mark.manual(
    "B 4.2 identity", "B 4.4 example", "B 4.2 acceleration", "B 4.2 angular rate", "B 4.2 magnetic field",
    "B 4.2 angles", "B 4.5 example", "B 4.2 temperature and pressure", "B 4 defaults",
)  # fmt: skip
def test_identity_sensors_and_the_block_of_newer_firmware() -> None:
    """26 registers by hand: uptime 0x00012345 ms is 74.565 s, 2512 is 25.12 °C, 10132500 is 101325 Pa."""
    identity = run_transfer_script(probe(HipnucModbusOptions()), lambda _: IDENTITY)
    assert (identity.product, identity.firmware) == ("HI14R2N-485-000", "1.5.2")
    assert (identity.serial_number, identity.details) == ("047D955F8D2A1708", {"BL_VERSION": "107"})

    m = measured(short(), SENSORS)
    assert m.size_bytes == 53
    assert m.dev_ticks is None
    assert m.accel_m_s2 == pytest.approx((-1.220212, 4.517176, 7.732793), abs=1e-6)
    assert m.gyro_rad_s == pytest.approx((-0.876711, -0.140614, 0.154463), abs=1e-6)
    assert m.mag_t == pytest.approx((14.312473e-6, -16.753833e-6, -22.246893e-6), abs=1e-12)
    assert m.euler_rad == pytest.approx((0.151896, 0.571735, -2.913600), abs=1e-6)
    assert m.quat_wxyz == pytest.approx((0.1300659, 0.1042786, -0.2710571, -0.9479980), abs=1e-7)
    assert m.incli_rad == pytest.approx((0.151864, 0.576969), abs=1e-6)
    assert m.temperature_c is None
    assert m.pressure_pa is None

    values: dict[str, Any] = {name: getattr(m, name) for name in ("accel_m_s2", "gyro_rad_s", "mag_t", "euler_rad")}
    values |= {"quat_wxyz": m.quat_wxyz, "quat_per_lsb": QUAT_OLD_PER_LSB, "temperature_c": 0, "pressure_pa": 0}
    incli = struct.unpack(">2h", SENSORS[-6:-2])
    assert modbus.pack_block(uptime_ms=None, incli_counts=incli, **values) == SENSORS[3:-2]
    words = "0000 0000 0800 0000 0000 0000 0000 0000 0000" + "0000 0000" * 3 + "09D0 009A9C14" + "2710 0000 0000 0000"
    m = measured(codec(), framed(1, registers_reply(bytes.fromhex(words + "0000 0000 0001 2345"))))
    assert (m.size_bytes, m.dev_ticks) == (57, 74_565)
    assert m.accel_m_s2 == pytest.approx((0, 0, 9.799975), abs=1e-6)
    assert m.temperature_c == pytest.approx(25.12)
    assert m.pressure_pa == pytest.approx(101_325.0)
    values["pressure_pa"] = 101_325
    assert modbus.pack_block(uptime_ms=None, **values)[32:36].hex() == "009a9c14"
    assert m.quat_wxyz == (1, 0, 0, 0)
    assert m.mag_t is None
    assert m.incli_rad is None
    data = block()
    for inner in (b"\x04" + data[2:-2], b"\x03\x33" + data[3:-2]):
        (event,) = codec().decode(0, framed(9, inner))
        assert isinstance(event, BadFrame)
        assert event.reason is BadReason.CONTENT
    assert (DRIVER.targets[0], sorted(DRIVER.targets)) == (0x50, list(range(1, 248)))


def test_a_device_without_barometer_has_no_pressure() -> None:
    """99,900 counts of 0.01 Pa are the placeholder 999 in Pa."""
    for counts, pressure_pa in ((0, None), (99_900, None), (100_000, 1_000), (12_000_000, 120_000), (12_000_001, None)):
        words = "0000" * 9 + "0000 0000" * 3 + "09D0" + counts.to_bytes(4, "big").hex() + "2710 0000 0000 0000"
        m = measured(codec(), framed(1, registers_reply(bytes.fromhex(words + "0000 0000 0001 2345"))))
        assert m.temperature_c == pytest.approx(25.12)
        assert m.pressure_pa == pressure_pa


@pytest.mark.parametrize("filler", ["00", "ff", "7f", "7fff", "8000"])
def test_filler_bytes_are_no_values(filler: str) -> None:
    data = bytearray(block()[3:-2])
    for start, end in ((12, 18), (30, 48)):  # field, then temperature to inclinometer
        data[start:end] = (bytes.fromhex(filler) * 18)[: end - start]
    m = next(one for one in codec().decode(0, framed(9, registers_reply(bytes(data)))) if isinstance(one, Measurement))
    assert (m.mag_t, m.temperature_c, m.pressure_pa, m.quat_wxyz, m.incli_rad) == (None,) * 5
    made = codec()
    made.decode(2, framed(9, b"\x03\x02" + (bytes.fromhex(filler) * 2)[:2]))
    assert measured(made, block()).status == (0 if filler == "00" else None)


def test_the_short_block_is_read_from_older_firmware() -> None:
    made = codec()
    assert made.polls[0].transfer == READ_BLOCK
    (event,) = made.decode(0, EXCEPTION)
    assert isinstance(event, Vanished)
    assert made.polls[0].transfer == modbus.READ_SHORT_BLOCK
    made.reset()
    assert made.polls[0].transfer == modbus.READ_SHORT_BLOCK
    assert measured(made, SENSORS)
    assert made.decode(0, SENSORS) == ()
    assert made.stale == 1
    (bad,) = made.decode(0, EXCEPTION)
    assert isinstance(bad, BadFrame)
    assert made.ledger.closes()

    made = codec()
    assert made.on_silence(0) == made.on_silence(1) == ()
    (event,) = made.on_silence(0)
    assert isinstance(event, Vanished)
    made.reset()
    assert made.polls[0].transfer == modbus.READ_SHORT_BLOCK
    assert [made.on_silence(0) for _ in range(5)] == [()] * 5
    made.reset()
    assert made.polls[0].transfer == READ_BLOCK

    made = codec()
    measured(made, block())
    busy = framed(0x50, b"\x83\x06")
    assert list(made.decode(0, busy)) == [BadFrame(BadReason.CONTENT, busy)]
    assert [made.on_silence(0) for _ in range(5)] == [()] * 5
    assert (made.polls[0].transfer, made.ledger.frames_bad_content) == (READ_BLOCK, 1)

    made = codec()
    made.decode(0, EXCEPTION)
    made.reset()
    first, second = (framed(9, registers_reply(bytes([n] * 8))) for n in (1, 2))
    made.decode(1, first)
    assert made.polls[0].transfer == modbus.READ_SHORT_BLOCK
    (event,) = made.decode(1, second)
    assert isinstance(event, Vanished)
    made.reset()
    assert made.polls[0].transfer == READ_BLOCK


def test_any_exception_to_the_first_reading_leads_to_the_block_of_the_manual() -> None:
    for code in (1, 3, 4, 6, 0x0A):
        made = codec()
        (event,) = made.decode(0, framed(0x50, bytes([0x83, code])))
        assert isinstance(event, Vanished)
        assert "up to 0x4B" in event.why
        made.reset()
        assert made.polls[0].transfer == modbus.READ_SHORT_BLOCK
        assert measured(made, SENSORS).dev_ticks is None
        made.reset()  # identified again: the device may have been busy before
        assert made.polls[0].transfer == READ_BLOCK
        assert made.ledger.closes()


@pytest.mark.parametrize("per_lsb", [QUAT_OLD_PER_LSB, QUAT_PER_LSB])
@pytest.mark.manual("B 4.2 quaternion")
def test_scale_of_the_quaternion_is_decided_once(per_lsb: float) -> None:
    made = codec()
    assert measured(made, block(quat=(0, 0, 0, 0), per_lsb=per_lsb)).quat_wxyz is None
    half = (0.5, -0.5, 0.5, -0.5)
    assert measured(made, block(quat=half, per_lsb=per_lsb)).quat_wxyz == pytest.approx(half, abs=1e-4)
    for _ in range(2):  # with a known scale, without a scale
        assert measured(made, block(quat=(0.25, 0.0, 0.0, 0.0), per_lsb=per_lsb)).quat_wxyz is None
        made.reset()


@pytest.mark.manual("B 4.2 inclinometer")
def test_axes_of_the_inclinometer_are_found_kept_or_configured() -> None:
    for incli, pitch_deg, degrees_read in (
        ((0, 0), 20.0, None),  # a product without inclinometer
        ((1584, 6018), 33.0, (8.7012, 33.0579)),  # two axes, as in the manual
        ((-16384, 0), 0.0, (-90.0, 0.0)),  # one axis has no negative angle
        ((16384, 0), 5.0, (180.0, 0.0)),  # Y would be 5 degrees with two axes
        ((16384, 0), 0.2, None),  # undecided while the device is level
    ):
        m = measured(codec(), block(incli=incli, pitch_deg=pitch_deg))
        assert m.incli_rad == (
            None if degrees_read is None else pytest.approx(tuple(map(radians, degrees_read)), abs=1e-6)
        )
    # MAIN_STATUS, register 0x09: bits 3 and 9 are 0x0208
    made = codec()
    measured(made, block(incli=(-100, 1)))
    assert measured(made, block(incli=(16384, 0), pitch_deg=5, uptime_ms=6)).incli_rad == (radians(90), 0)
    assert measured(codec(inclinometer="single"), block(incli=(8192, 0))).incli_rad == (radians(90), 0)
    assert measured(codec(inclinometer="dual"), block(incli=(0, 0))).incli_rad == (0, 0)
    for mag_t in ((3e-5, 0.0, 0.0), (0.0, 3e-5, 0.0), (0.0, 0.0, 3e-5)):  # one non-zero axis means a magnetic field
        assert measured(codec(), block(mag_t=mag_t)).mag_t == pytest.approx(mag_t, abs=2e-8)

    made = codec()
    assert [poll.transfer.sends[0].hex() for poll in made.polls] == [
        "030034001a", "03007f0004", "0300090001", "03004e0006",
    ]  # fmt: skip
    assert made.polls[2].every_ns == 1_000_000_000
    assert measured(made, block()).status is None
    assert made.decode(2, framed(9, registers_reply(b"\x02\x08"))) == ()
    assert measured(made, block(uptime_ms=6)).status == 0x0208
    assert made.decode(2, EXCEPTION) == made.decode(2, b"") == ()
    assert measured(made, block(uptime_ms=7)).status == 0x0208
    made.reset()
    assert measured(made, block(uptime_ms=8)).status is None
    made.decode(0, EXCEPTION)
    assert len(made.polls) == 2  # firmware without UPTIME has no MAIN_STATUS
    assert made.ledger.closes()


def test_heave_extends_the_block_by_hand() -> None:
    """-1.23 m is FF85, 0.50 m 0032, 0 m 0000; 0.12 Hz is 000C, 655.35 Hz FFFF."""
    made, words = codec(), "ff85 0032 0000 000c 0000 ffff"
    for nothing in ("0000" * 6, "ffff" * 6):  # a product without heave
        assert made.decode(3, framed(9, registers_reply(bytes.fromhex(nothing)))) == ()
    heave = framed(9, registers_reply(bytes.fromhex(words)))
    assert made.decode(3, EXCEPTION) == made.decode(3, heave[:-1]) == made.decode(3, heave[:-1] + b"\0") == ()
    assert measured(made, block()).heave_m is None
    assert made.decode(3, heave) == (Vanished("the device measures heave; imud reads up to 0x53"),)
    assert [poll.transfer.sends[0].hex() for poll in made.polls] == ["0300340020", "03007f0004", "0300090001"]
    made.reset()
    long = framed(9, registers_reply(block(uptime_ms=9)[3:-2] + bytes.fromhex(words)))
    found = measured(made, long)
    assert found.heave_m == pytest.approx(-1.23)
    assert (found.dev_ticks, found.size_bytes) == (9, 69)
    (event,) = made.decode(0, block())  # another device without the registers can reply with a shorter block
    assert isinstance(event, Vanished)
    (event,) = made.decode(0, EXCEPTION)
    assert "; imud reads up to 0x4D, without heave" in str(event)
    assert made.polls[0].transfer == READ_BLOCK
    assert measured(made, block(uptime_ms=10)).dev_ticks == 10
    packed = modbus.pack_block(
        accel_m_s2=(0, 0, 0), gyro_rad_s=(0, 0, 0), mag_t=(0, 0, 0), euler_rad=(0, 0, 0), quat_wxyz=(1, 0, 0, 0),
        temperature_c=0, pressure_pa=0, uptime_ms=0, heave_m=(-1.23, 0.5, 0), heave_hz=(0.12, 0, 655.35),
    )  # fmt: skip
    assert packed[52:].hex(" ", 2) == words
    assert made.ledger.closes()


def test_identity_is_watched_and_settings_are_read() -> None:
    made = codec()
    first, second = (framed(9, registers_reply(bytes([n] * 8))) for n in (1, 2))
    assert made.polls[1].transfer == modbus.READ_SERIAL
    assert made.decode(1, first) == made.decode(1, first) == ()
    assert made.decode(1, EXCEPTION) == made.decode(1, first[:-1] + b"\x00") == made.decode(1, b"") == ()
    (event,) = made.decode(1, second)
    assert event == Vanished("another device: serial number 0202020202020202, was 0101010101010101")
    made.reset()
    assert made.decode(1, second) == ()
    assert made.ledger.closes()
    for name in (b"\x00" * 16, b"\xff" * 16, b"AB\x01" + b"\x00" * 13):
        reply = framed(3, registers_reply(name + bytes(24)))
        with pytest.raises(DeviceRefused, match="product name"):
            run_transfer_script(probe(HipnucModbusOptions()), lambda _, reply=reply: reply)  # type: ignore[misc]  # bound now
    asked: list[Transfer] = []

    def answer(transfer: Transfer) -> bytes:
        asked.append(transfer)
        return framed(7, registers_reply(bytes.fromhex("0008 0007 0001")))

    found = combined(run_transfer_script(read_settings(), answer)).words
    assert found == {"baud": "921600", "id": "7", "heading_mode": "nine axes"}
    assert [transfer.sends[0][0] for transfer in asked] == [3]
