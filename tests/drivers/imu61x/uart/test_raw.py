"""Raw frames: golden frames of each type by hand, impossible layouts and values, and one stream of samples."""

import struct
from math import inf, nan, pi
from typing import Any

import msgspec
import pytest

from imud.contracts.codec import BadFrame, BadReason
from imud.drivers.imu61x.uart import codec as uart_codec
from imud.drivers.imu61x.uart.commands import Imu61xUartOptions
from imud.drivers.imu61x.uart.driver import DRIVER
from imud.drivers.imu61x.uart.raw import RawCodec, RawFrame, make_codec, pack_raw
from imud.model.ledger import Ledger
from imud.model.options import wrong_values
from imud.model.sample import Measurement
from tests.drivers.imu61x.uart.test_codec import GOLDEN
from tests.support.documented import check_schema

F32: dict[str, Any] = {"type": "f32", "accel_at": 4, "gyro_at": 16, "accel_g_per_lsb": 1, "gyro_deg_s_per_lsb": 1}
LAYOUT = msgspec.convert(F32 | {"timer_at": 0}, RawFrame)
# 1, -0.5, 2 g and 180, -90, 1 °/s in each layout
GOLDEN_PAYLOADS = [
    (F32 | {"timer_at": 0}, "78563412 0000803F000000BF00000040 000034430000B4C20000803F", 0x12345678),
    (F32, "FFFFFFFF 0000803F000000BF00000040 000034430000B4C20000803F", None),
    (  # 2048 LSB/g and 16 LSB/(°/s), without timer
        {"type": "i16", "accel_at": 6, "gyro_at": 0, "accel_g_per_lsb": 1 / 2048, "gyro_deg_s_per_lsb": 1 / 16},
        "400B60FA1000 000800FC0010",
        None,
    ),
    (  # 1000 LSB/g and 100 LSB/(°/s), with other bytes before and behind the fields
        {"type": "i32", "accel_at": 2, "gyro_at": 14, "timer_at": 26, "accel_g_per_lsb": 0.001,
         "gyro_deg_s_per_lsb": 0.01},
        "FFFF E80300000CFEFFFFD0070000 50460000D8DCFFFF64000000 FEFFFFFF EEEEEE",
        0xFFFFFFFE,
    ),
]  # fmt: skip


def raw_frame(payload: bytes) -> bytes:
    return uart_codec.encode_frame(uart_codec.DEVICE_SYNC, 0x0666, payload)


@pytest.mark.manual("C 7 frame 0x0666")
@pytest.mark.parametrize(("layout", "payload", "ticks"), GOLDEN_PAYLOADS, ids=["f32", "no timer", "i16", "i32"])
def test_golden_frames_of_each_type(layout: dict[str, Any], payload: str, ticks: int | None) -> None:
    frame, options = raw_frame(bytes.fromhex(payload)), msgspec.convert({"raw_frame": layout}, Imu61xUartOptions)
    assert frame.startswith(b"\xaa\x55\x66\x06")
    tested = DRIVER.make_codec(Ledger(), options)
    (m,) = tested.feed(frame)
    assert isinstance(m, Measurement)
    assert (m.size_bytes, m.trailing_bytes, m.dev_ticks) == (len(frame), 0, ticks)
    assert m.accel_m_s2 == pytest.approx((9.80665, -4.903325, 19.6133), rel=1e-12)
    assert m.gyro_rad_s == pytest.approx((pi, -pi / 2, pi / 180), rel=1e-12)
    assert (m.quat_wxyz, m.euler_rad, m.mag_t, m.temperature_c) == (None,) * 4
    assert (tested.ledger.frames_in_samples, tested.ledger.closes()) == (1, True)
    made = options.raw_frame
    assert made is not None
    assert m.accel_m_s2 is not None
    assert m.gyro_rad_s is not None
    (again,) = make_codec(Ledger(), options).feed(
        raw_frame(pack_raw(made, timer_us=ticks or 0, accel_m_s2=m.accel_m_s2, gyro_rad_s=m.gyro_rad_s))
    )
    assert again == msgspec.structs.replace(m, size_bytes=uart_codec.OVERHEAD_BYTES + made.size_bytes)


def test_a_device_has_one_stream_of_samples() -> None:
    """Samples are from AHRS frames, and with `raw_frame` from raw frames. imud counts and names other frames."""
    raw = raw_frame(bytes.fromhex(GOLDEN_PAYLOADS[0][1]))
    k1 = uart_codec.encode_acknowledgement(14, 0)
    for layout, size, ignored in ((None, len(GOLDEN), 0x0666), (LAYOUT, len(raw), 0x0002)):
        tested = make_codec(Ledger(), Imu61xUartOptions(raw_frame=layout))
        assert bool(tested.usual_frames(GOLDEN)) == (layout is None)  # bytes for the kernel
        events = tested.feed(GOLDEN + raw + k1 + GOLDEN + raw)
        assert [event.size_bytes for event in events if isinstance(event, Measurement)] == [size] * 2
        assert tested.unknown == {ignored: 2}
        assert (tested.ledger.frames_ignored, tested.ledger.frames_in_replies, tested.ledger.closes()) == (2, 1, True)
    step = "set options.raw_frame to the layout in the documents of the device, docs/buses.md"
    names = [f"raw data (identifier 0x0666, {step})"]
    names += ["AHRS (identifier 0x0002, ignored because options.raw_frame is set)"]
    assert [uart_codec.frame_name(one) for one in (0x0666, 0x0002)] == names


def test_short_frames_are_bad_and_impossible_values_are_removed() -> None:
    whole = bytes.fromhex(GOLDEN_PAYLOADS[0][1])
    for payload in (whole[:-1], whole[:5], b"\x00"):
        tested, frame = RawCodec(Ledger(), LAYOUT), raw_frame(payload)
        assert tested.feed(frame) == [BadFrame(BadReason.CONTENT, frame)]
        assert (tested.ledger.frames_bad_content, tested.ledger.closes()) == (1, True)
    short_ahrs = uart_codec.encode_frame(uart_codec.DEVICE_SYNC, uart_codec.AHRS_FRAME, bytes(43))
    assert RawCodec(Ledger(), LAYOUT).feed(short_ahrs) == [BadFrame(BadReason.CONTENT, short_ahrs)]
    for place, value in ((0, nan), (2, inf), (1, 40.0), (3, -inf), (4, 4000.0), (5, nan)):
        values = [1.0] * 6
        values[place] = value
        tested, frame = RawCodec(Ledger(), LAYOUT), raw_frame(struct.pack("<I6f", 5, *values))
        bad, m = tested.feed(frame)
        assert bad == BadFrame(BadReason.NOT_FINITE, frame)
        assert isinstance(m, Measurement)
        assert (m.accel_m_s2 is None, m.gyro_rad_s is None, m.dev_ticks) == (place < 3, place >= 3, 5)
        assert (tested.ledger.frames_not_finite, tested.ledger.closes()) == (1, True)
    scaled = msgspec.structs.replace(LAYOUT, accel_g_per_lsb=0.5)  # 80 · 0.5 g is beyond the limit
    (m,) = RawCodec(Ledger(), scaled).feed(raw_frame(struct.pack("<I6f", 5, 79, 0, 0, 0, 0, 0)))
    assert isinstance(m, Measurement)
    assert m.accel_m_s2 == pytest.approx((39.5 * 9.80665, 0, 0))
    assert len(RawCodec(Ledger(), scaled).feed(raw_frame(struct.pack("<I6f", 5, 80, 0, 0, 0, 0, 0)))) == 2


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"gyro_at": 15}, "gyro_at: expected 16 or more, the end of the field at accel_at, got 15"),
        ({"gyro_at": 4}, "gyro_at: expected 16 or more, the end of the field at accel_at, got 4"),
        ({"timer_at": 3}, "accel_at: expected 7 or more, the end of the field at timer_at, got 4"),
        ({"timer_at": 27}, "timer_at: expected 28 or more, the end of the field at gyro_at, got 27"),
        ({"gyro_at": 245}, "gyro_at: expected a field that ends in a payload of 256 bytes, got 257"),
        ({"timer_at": 253}, "timer_at: expected a field that ends in a payload of 256 bytes, got 257"),
        ({"timer_at": 256}, "timer_at: expected a whole number from 0 to 255, or null, got 256"),
        ({"accel_at": -1}, "accel_at: expected a whole number from 0 to 255, got -1"),
        ({"accel_at": None}, "accel_at: expected a whole number from 0 to 255, got nothing"),
        ({"type": "u16"}, 'type: expected one of "f32", "i16", "i32", got "u16"'),
        ({"accel_g_per_lsb": 0}, "accel_g_per_lsb: expected a number to 40 above 0, got 0"),
        ({"accel_g_per_lsb": nan}, "accel_g_per_lsb: expected a number to 40 above 0, got nan"),
        ({"gyro_deg_s_per_lsb": inf}, "gyro_deg_s_per_lsb: expected a number to 4000 above 0, got inf"),
        ({"scale": 1}, 'expected a key that imud knows, got "scale"'),
    ],
)
def test_impossible_layouts_are_rejected(given: dict[str, Any], message: str) -> None:
    (wrong,) = wrong_values(Imu61xUartOptions, {"raw_frame": F32 | given})
    assert wrong.name == "raw_frame"
    assert wrong.message.startswith(message)
    for end in ({"gyro_at": 244}, {"timer_at": 252}, {"timer_at": 28}, {"timer_at": None}):
        assert wrong_values(Imu61xUartOptions, {"raw_frame": F32 | end}) == []
    assert check_schema("Option `raw_frame`", RawFrame) == 6
    (missing,) = wrong_values(Imu61xUartOptions, {"raw_frame": {"type": "i16"}})
    assert "the key accel_at (a whole number from 0 to 255), got none" in missing.message
