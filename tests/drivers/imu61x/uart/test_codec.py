"""Golden frames with SI values by hand, false lengths, impossible content, and the ledger of every byte."""

import struct
from math import inf, nan, pi, sqrt
from random import Random

import pytest

from imud.attitude.rotation import matrix_from_quat, quat_from_euler_zyx
from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.contracts.script import ReplyFrame
from imud.drivers.imu61x.common import crc32
from imud.drivers.imu61x.uart import codec as uart_codec
from imud.drivers.imu61x.uart.commands import Imu61xUartOptions
from imud.drivers.imu61x.uart.driver import DRIVER
from imud.model.ledger import Ledger
from imud.model.sample import Measurement

AHRS_HEX = (
    "AA55 0200 2C00"
    "78563412"  # timer 0x12345678 µs
    "0000F041 000034C2 0000B442"  # pitch 30°, roll -45°, yaw 90°
    "0000803F 000000BF 00000040"  # accel 1, -0.5, 2 g
    "00003443 0000B4C2 0000803F"  # gyro 180, -90, 1 °/s
    "00001242"  # 36.5 °C
)


def with_crc(text: str) -> bytes:
    body = bytes.fromhex(text)
    return body + crc32(body).to_bytes(4, "little")


GOLDEN = with_crc(AHRS_HEX)


def codec() -> uart_codec.Imu61xCodec:
    return uart_codec.Imu61xCodec(Ledger())


def only(events: object) -> Measurement:
    assert isinstance(events, list | tuple)
    (event,) = events
    assert isinstance(event, Measurement)
    return event


@pytest.mark.manual(
    "A 1.2 headers", "A 1.3 frame", "A 1.3 pitch", "A 1.3 roll", "A 1.3 yaw", "A 1.3 acceleration",
    "A 1.3 angular rate", "A 1.3 temperature", "A 1.3 timer",
)  # fmt: skip
def test_golden_ahrs_frame() -> None:
    """Directions of the body axes at roll -45°, pitch 30°, yaw 90°, by hand: Rz(90°) Ry(30°) Rx(-45°)."""
    measurement = only(codec().feed(GOLDEN))
    assert measurement.size_bytes == len(GOLDEN) == 54
    assert (measurement.trailing_bytes, measurement.dev_ticks) == (0, 0x12345678)
    assert measurement.accel_m_s2 == pytest.approx((9.80665, -4.903325, 19.6133), abs=1e-12)
    assert measurement.gyro_rad_s == pytest.approx((pi, -pi / 2, 0.017453292519943295), abs=1e-15)
    assert measurement.euler_rad == pytest.approx((-pi / 4, pi / 6, pi / 2), abs=1e-15)  # roll, pitch, yaw
    assert measurement.temperature_c == 36.5
    absent = (measurement.mag_t, measurement.pressure_pa, measurement.status, measurement.pps_age_ms)
    assert absent == (None, None, None, None)
    assert (DRIVER.tick_ns, DRIVER.tick_modulus) == (1000, 2**32)
    assert "assumed" in DRIVER.euler_convention
    assert (
        uart_codec.encode_ahrs(
            timer_us=0x12345678 + 2**32, accel_m_s2=(9.80665, -4.903325, 19.6133), gyro_rad_s=(pi, -pi / 2, pi / 180),
            euler_rad=(-pi / 4, pi / 6, pi / 2), temperature_c=36.5,
        )
        == GOLDEN
    )  # fmt: skip
    quat = measurement.quat_wxyz
    assert quat is not None
    x, y, z = zip(*matrix_from_quat(quat), strict=True)
    root = sqrt(0.5)
    assert x == pytest.approx((0, sqrt(0.75), -0.5), abs=1e-12)  # forward points to y and 30° down
    assert z == pytest.approx((-root, root * 0.5, root * sqrt(0.75)), abs=1e-12)
    assert y == pytest.approx((-root, -root * 0.5, -root * sqrt(0.75)), abs=1e-12)
    assert sum(q * q for q in quat) == pytest.approx(1)


def test_a_damaged_frame_does_not_affect_the_frames_beside_it() -> None:
    damaged = bytearray(GOLDEN)
    damaged[20] ^= 1
    hot = with_crc(AHRS_HEX.replace("00001242", "0000C07F"))  # NaN °C
    for bad in (bytes(damaged), hot):
        stream = GOLDEN * 3 + bad + GOLDEN * 2
        run = codec()
        events = list(run.feed(stream))
        trailing = [event.trailing_bytes for event in events if isinstance(event, Measurement)]
        assert trailing == [left for left in range(270, -1, -54) if bad is hot or left != 108]
        assert sum(isinstance(event, BadFrame) for event in events) == 1
        assert run.ledger.closes()

    split = codec()
    events = [*split.feed(GOLDEN[:20]), *split.feed(GOLDEN[20:] + GOLDEN + GOLDEN[:9]), *split.feed(GOLDEN[9:])]
    assert [event.trailing_bytes for event in events if isinstance(event, Measurement)] == [63, 9, 0]
    assert len(events) == 3
    ledger = split.ledger
    assert (ledger.frames_good, ledger.frames_in_samples, ledger.bytes_in_good_frames) == (3, 3, 162)
    assert ledger.closes()


def test_quaternions_to_the_last_bit_and_a_frame_with_nan() -> None:
    random = Random(5)
    frames = [
        uart_codec.encode_ahrs(
            timer_us=number, accel_m_s2=(0, 0, 9.8), gyro_rad_s=(0, 0, 0), temperature_c=20,
            euler_rad=(random.uniform(-pi, pi), random.uniform(-pi / 2, pi / 2), random.uniform(-pi, pi)),
        )
        for number in range(100)
    ]  # fmt: skip
    for event in codec().feed(b"".join(frames)):
        assert isinstance(event, Measurement)
        assert event.euler_rad is not None
        assert event.quat_wxyz == quat_from_euler_zyx(event.euler_rad)

    broken = uart_codec.encode_frame(
        uart_codec.DEVICE_SYNC, uart_codec.AHRS_FRAME, GOLDEN[6:46] + struct.pack("<f", nan)
    )
    _, measurement = codec().feed(broken)
    whole = only(codec().feed(GOLDEN))
    assert isinstance(measurement, Measurement)
    assert measurement.temperature_c is None
    for name in ("dev_ticks", "size_bytes", "accel_m_s2", "gyro_rad_s", "euler_rad"):
        assert getattr(measurement, name) == getattr(whole, name)
    assert measurement.quat_wxyz == pytest.approx(whole.quat_wxyz, abs=1e-15)


@pytest.mark.parametrize("value", [nan, inf, -inf, 131072.0, -3e38])
@pytest.mark.parametrize(
    ("place", "missing"),
    [
        (0, {"euler_rad", "quat_wxyz"}), (2, {"euler_rad", "quat_wxyz"}), (3, {"accel_m_s2"}), (8, {"gyro_rad_s"}),
        (5, {"accel_m_s2"}), (6, {"gyro_rad_s"}), (9, {"temperature_c"}),
    ],
)  # fmt: skip
def test_groups_that_are_not_finite_are_removed_and_reported(place: int, missing: set[str], value: float) -> None:
    values = [1.0] * 10
    values[place] = value
    frame = uart_codec.encode_frame(uart_codec.DEVICE_SYNC, uart_codec.AHRS_FRAME, struct.pack("<I10f", 5, *values))
    tested = codec()
    bad, measurement = tested.feed(frame)
    assert bad == BadFrame(BadReason.NOT_FINITE, frame)
    assert isinstance(measurement, Measurement)
    there = {"accel_m_s2", "gyro_rad_s", "euler_rad", "quat_wxyz", "temperature_c"}
    assert {name for name in there if getattr(measurement, name) is None} == missing
    ledger = tested.ledger
    assert (ledger.frames_not_finite, ledger.frames_good, ledger.frames_bad()) == (1, 1, 0)
    assert ledger.closes()


@pytest.mark.manual("A 1.2 ID and length", "A 1.2 headers")
def test_frames_of_other_kinds_and_lengths() -> None:
    tested = codec()
    status = uart_codec.encode_status(uart_codec.Status(1, 2, 3, (4, 5, 6)))
    stream = (
        GOLDEN
        + status
        + uart_codec.encode_parameter(21, 100.0)
        + uart_codec.encode_acknowledgement(14, 0, frame_id=0x4242)
    )
    kinds = [type(event) for event in tested.feed(stream)]
    assert kinds == [Measurement, ReplyFrame, ReplyFrame, ReplyFrame]
    assert (tested.ledger.frames_in_samples, tested.ledger.frames_in_replies) == (1, 3)
    assert tested.ledger.bytes_in_good_frames == len(stream)

    for frame_id in (2, 6, 14, 0xFF, 0xFFFF):
        (event,) = codec().feed(uart_codec.encode_acknowledgement(3, 0, frame_id=frame_id))
        assert event == ReplyFrame(frame_id, b"\x03\x00\x00\x00")

    for size in (1, 30, uart_codec.PAYLOAD_BYTES_MAX):
        tested = codec()
        assert tested.feed(uart_codec.encode_frame(uart_codec.DEVICE_SYNC, 0x0123, bytes(size))) == []
        assert (tested.ledger.frames_ignored, tested.ledger.frames_good, tested.unknown) == (1, 1, {0x0123: 1})
        assert tested.ledger.bytes_in_good_frames == 10 + size
        assert tested.ledger.closes()
    names = ["navigation (identifier 0x0166)", "identifier 0x0123"]
    assert [*map(uart_codec.frame_name, (0x0166, 0x0123))] == names

    longer = uart_codec.encode_frame(uart_codec.DEVICE_SYNC, uart_codec.AHRS_FRAME, GOLDEN[6:-4] + bytes(8))
    measurement = only(codec().feed(longer))
    assert (measurement.temperature_c, measurement.size_bytes) == (36.5, 62)

    tested = codec()
    command = bytes.fromhex("55AA 0300 1800 0000803F") + bytes(20) + bytes.fromhex("52D88EE8")
    assert (tested.feed(command), tested.ledger.bytes_skipped) == ([], len(command))

    for size in (0, uart_codec.PAYLOAD_BYTES_MAX + 1):
        with pytest.raises(ValueError, match="payload"):
            uart_codec.encode_frame(uart_codec.DEVICE_SYNC, 1, bytes(size))


@pytest.mark.parametrize("split", [1, 7, 1000])
def test_frame_of_56_bytes_contains_the_magnetic_field(split: int) -> None:
    whole = with_crc(AHRS_HEX.replace("0200 2C00", "0200 3800") + "00004842 0000A0C1 0000003F")  # 50, -20, 0.5 µT
    tested, stream = codec(), whole + GOLDEN + whole
    events = [event for at in range(0, len(stream), split) for event in tested.feed(stream[at : at + split])]
    first, short, last = events
    assert isinstance(first, Measurement)
    assert isinstance(short, Measurement)
    assert isinstance(last, Measurement)
    assert first.mag_t == last.mag_t == pytest.approx((50e-6, -20e-6, 0.5e-6), rel=1e-12)
    assert (first.size_bytes, first.temperature_c, short.mag_t) == (66, 36.5, None)
    assert first.accel_m_s2 == short.accel_m_s2
    assert (tested.ledger.frames_in_samples, tested.ledger.closes()) == (3, True)
    assert uart_codec.encode_ahrs(
        timer_us=0x12345678, accel_m_s2=first.accel_m_s2 or (0, 0, 0), gyro_rad_s=first.gyro_rad_s or (0, 0, 0),
        euler_rad=first.euler_rad or (0, 0, 0), temperature_c=36.5, mag_t=(50e-6, -20e-6, 0.5e-6),
    ) == whole  # fmt: skip
    in_mgauss = uart_codec.Imu61xCodec(Ledger(), Imu61xUartOptions(mag_unit="mgauss"))
    assert only(in_mgauss.feed(whole)).mag_t == pytest.approx((5e-6, -2e-6, 0.05e-6), rel=1e-12)
    assert only(codec().feed(with_crc(AHRS_HEX.replace("2C00", "3800") + "00" * 12))).mag_t is None
    for bad in ("0000C07F", "0000807F", "00008045"):  # NaN, infinity, 4096 µT
        frame = with_crc(AHRS_HEX.replace("2C00", "3800") + "00004842" + bad + "0000003F")
        tested = codec()
        reason, measurement = tested.feed(frame)
        assert reason == BadFrame(BadReason.NOT_FINITE, frame)
        assert isinstance(measurement, Measurement)
        assert (measurement.mag_t, measurement.temperature_c) == (None, 36.5)
        assert (tested.ledger.frames_not_finite, tested.ledger.closes()) == (1, True)


def test_frames_inside_damaged_ones_and_false_lengths() -> None:
    damaged = GOLDEN[:20] + GOLDEN
    tested = codec()
    bad, measurement = tested.feed(damaged)
    assert isinstance(bad, BadFrame)
    assert bad.reason is BadReason.CRC
    assert isinstance(measurement, Measurement)
    ledger = tested.ledger
    assert (ledger.bytes_in_bad_frames, ledger.bytes_in_good_frames, ledger.bytes_skipped) == (20, 54, 0)

    lie = b"\xaa\x55\x02\x00" + uart_codec.PAYLOAD_BYTES_MAX.to_bytes(2, "little")
    tested = codec()
    assert [*tested.feed(lie + GOLDEN[:30]), *tested.flush(), *tested.feed(GOLDEN[30:])] == []
    bad, measurement = tested.flush()
    assert bad == BadFrame(BadReason.CRC, lie + GOLDEN)
    assert isinstance(measurement, Measurement)
    assert tested.flush() == []
    ledger = tested.ledger
    assert (ledger.bytes_in_bad_frames, ledger.bytes_in_good_frames, ledger.bytes_pending) == (6, 54, 0)
    assert ledger.closes()

    lie = b"\xaa\x55\x02\x00" + uart_codec.PAYLOAD_BYTES_MAX.to_bytes(2, "little")
    tested = codec()
    events: list[CodecEvent] = [*tested.feed(lie)]
    while not events:
        assert tested.ledger.bytes_pending < uart_codec.FRAME_BYTES_MAX
        events += tested.feed(GOLDEN)
    sent = (tested.ledger.bytes_in - len(lie)) // len(GOLDEN)
    assert (sent, sum(isinstance(event, Measurement) for event in events)) == (5, sent)
    assert tested.ledger.closes()


@pytest.mark.parametrize("end", [b"\xaa", b"\xaa\x55", b"\xaa\x55\x02\x00\x00"])
def test_bytes_where_a_damaged_frame_claimed_to_be_are_its_in_any_split(end: bytes) -> None:
    """A damaged frame ends with a possible start of another frame. If that fails later, its bytes belong to the damaged
    frame.
    """
    damaged = GOLDEN[: -len(end)] + end
    stream = damaged + bytes([0xFF] * 40)
    whole, split = codec(), codec()
    whole.feed(stream)
    for place in range(len(stream)):
        split.feed(stream[place : place + 1])
    assert whole.ledger.snapshot() == split.ledger.snapshot()
    header_bytes = 6 if len(end) > 1 else len(end)  # a complete sync word claims a header
    assert whole.ledger.bytes_in_bad_frames == len(damaged) - len(end) + header_bytes
    assert whole.ledger.closes()


@pytest.mark.manual("A 1.2 CRC", "A 1.2 ID and length")
def test_short_and_overlong_frames_are_bad_and_every_single_bit_matters() -> None:
    for frame_id, size in ((2, 43), (0xFF, 21), (6, 23), (2, 5)):
        frame, tested = uart_codec.encode_frame(uart_codec.DEVICE_SYNC, frame_id, bytes(size)), codec()
        assert tested.feed(frame) == [BadFrame(BadReason.CONTENT, frame)]
        assert (tested.ledger.frames_bad_content, tested.ledger.bytes_in_bad_frames) == (1, len(frame))
        assert tested.ledger.closes()
    for place in range(len(GOLDEN)):
        for bit in (0, 3, 7):
            flipped = bytearray(GOLDEN)
            flipped[place] ^= 1 << bit
            tested = codec()
            events = [*tested.feed(bytes(flipped)), *tested.feed(bytes(uart_codec.FRAME_BYTES_MAX))]
            assert not any(isinstance(event, Measurement) for event in events), (place, bit)
            assert tested.ledger.closes()
    for length in (0, uart_codec.PAYLOAD_BYTES_MAX + 1, 0xFFFF):
        lie = b"\xaa\x55\x02\x00" + length.to_bytes(2, "little")
        tested = codec()
        bad, measurement = tested.feed(lie + GOLDEN)
        assert bad == BadFrame(BadReason.LENGTH, lie)
        assert isinstance(measurement, Measurement)
        assert (tested.ledger.frames_bad_length, tested.ledger.bytes_in_bad_frames) == (1, len(lie))
        assert tested.ledger.closes()


S1 = bytes.fromhex(
    "04030201"  # software 0x01020304
    "02000000"  # hardware 2
    "6602"  # model 614
    "47003200 0D513331 36373833"  # serial number
    "01000000"  # system status 1
    "7800 0300"  # CPU load 120, drop rate 3
    "01 32 02 04"  # I2C master, voltage 50, user configuration 2, calibration 4
) + bytes(range(32))
FULL = uart_codec.Status(
    0x01020304, 2, 614, (0x00320047, 0x3133510D, 0x33383736), 1, 120, 3, 1, 50, 2, 4, bytes(range(32))
)  # fmt: skip


@pytest.mark.manual("A 1.4 software version", "A 1.4 hardware version", "A 1.4 status members", "A 1.4 frame")
def test_s1_and_other_messages() -> None:
    assert (len(S1), uart_codec.parse_status(ReplyFrame(0xFF, S1))) == (0x42, FULL)
    assert uart_codec.pack_status(FULL) == S1
    frame = uart_codec.encode_status(FULL)
    assert (frame[:6], len(frame)) == (bytes.fromhex("AA55FF004200"), 76)
    (event,) = uart_codec.Imu61xCodec(Ledger()).feed(frame)
    assert isinstance(event, ReplyFrame)
    assert uart_codec.parse_status(event) == FULL
    for message in (ReplyFrame(0xFF, S1[:21]), ReplyFrame(0xFE, S1), "S1", ReplyFrame(6, bytes(24))):
        assert uart_codec.parse_status(message) is None


@pytest.mark.parametrize("size", [uart_codec.STATUS_BYTES_MIN, 25, 26, 28, 30, 31, 32, 33, 34, 65, 66, 89])
@pytest.mark.manual("A 1.4 frame")
def test_s1_of_any_length_contains_its_complete_members(size: int) -> None:
    ends = {
        "system_status": 26, "cpu_load": 28, "drop_rate": 30, "i2c_master": 31, "voltage": 32,
        "user_config_fault": 33, "calibration_fault": 34, "imu_health": 66,
    }  # fmt: skip
    status = uart_codec.parse_status(ReplyFrame(0xFF, S1.ljust(90, b"\x77")[:size]))
    assert status is not None
    assert status.serial_number == FULL.serial_number
    for name, end in ends.items():
        assert getattr(status, name) == (getattr(FULL, name) if size >= end else None)
    if size in {22, *ends.values()}:
        assert uart_codec.pack_status(status) == S1[:size]


@pytest.mark.manual("A 1.5 frame", "A 1.5 parameter 3", "A 1.7 K1")
def test_p1_k1_and_replies_by_id_and_length() -> None:
    """Parameter 3 = 921600 bit/s: 0x49610000 as a float."""
    payload = bytes.fromhex("00006149 00000000 03000000 00000000 00000000 00000000")
    assert uart_codec.parse_parameter(ReplyFrame(6, payload)) == uart_codec.ParameterValue(3, 921600.0)
    assert uart_codec.pack_parameters(921600, 3) == payload
    assert uart_codec.parse_parameter(ReplyFrame(6, payload[:23])) is None
    assert uart_codec.parse_parameter(ReplyFrame(7, payload)) is None
    assert uart_codec.parse_parameter("P1") is None
    assert [parameter.value for parameter in uart_codec.Parameter] == [3, 8, 9, 10, 16, 17, 18, 21, 27, 30, 31]
    payload = bytes.fromhex("0E00 0500")
    assert uart_codec.parse_acknowledgement(ReplyFrame(0x1234, payload)) == uart_codec.Acknowledgement(14, 5)
    assert uart_codec.pack_acknowledgement(14, 5) == payload
    assert uart_codec.parse_acknowledgement(ReplyFrame(0x1234, payload + b"\x00")) is None
    assert uart_codec.parse_acknowledgement("K1") is None
    for frame_id, size, wanted in (
        (0xFF, 22, True), (0xFF, 21, False), (6, 24, True), (6, 23, False), (9, 4, True), (2, 44, False),
        (9, 24, False),
    ):  # fmt: skip
        assert uart_codec.is_reply(frame_id, size) is wanted
