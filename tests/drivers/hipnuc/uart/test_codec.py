"""HiPNUC frames: the manual's example, an HI92 by hand, both meanings of HI91 bytes 1-2, damage by kind, text."""

import math
import struct
from binascii import crc_hqx
from collections.abc import Sequence
from dataclasses import replace
from random import Random
from typing import Any

import msgspec
import pytest

from imud.attitude.rotation import euler312_from_quat
from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.contracts.driver import Identity
from imud.contracts.script import TextLine
from imud.drivers.hipnuc.uart import codec as uart_codec
from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.testing.invariants import feed_stream

# Manual V1.5.9 section 3.5. Its text contains CRC 0x516C, its table 0xBB14; 0xBB14 is correct.
MANUAL_HI91 = bytes.fromhex(
    "5A A5 4C 00 14 BB 91 08 15 23 09 A2 C4 47 08 15 1C 00 CC E8 61 BE 9A 35 56 3E 65 EA 72 3F 31 D0 7C BD 75 DD C5 BB"
    "6B D7 24 BC 89 88 FC 40 01 00 6A 41 AB 2A 70 C2 96 D4 50 41 ED 03 43 41 41 F4 F4 C2 CC CA F8 BE 73 6A 19 BE"
    "F0 00 1C 3D 8D 37 5C 3F"
)
# made by hand from the table of section 3.3.2
HI92_PAYLOAD = bytes.fromhex(
    "92  34 12  FB  E8 03  D0 07  00 00"  # status 0x1234, -5 °C, 1000 ms, 100000 + 2000 Pa, reserved
    "E8 03  18 FC  F4 01"  # gyro 1000, -1000, 500
    "00 08  00 F8  D0 07"  # accel 2048, -2048, 2000
    "E8 03  18 FC  00 00"  # mag 1000, -1000, 0
    "90 5F 01 00  38 50 FF FF  20 BF 02 00"  # roll 90°, pitch -45°, yaw 180°
    "C1 21  00 00  78 EC  01 00"  # quaternion 8641, 0, -5000, 1
)
# SI value of one unit of the device: 1 g (manual B: 9.8 m/s²), 1 °/s, 1 µT, 1 °
SI_PER_UNIT = {"accel_m_s2": 9.8, "gyro_rad_s": math.pi / 180, "mag_t": 1e-6, "euler_rad": math.pi / 180}
LEVEL: dict[str, Any] = {
    "accel_m_s2": (0.0, 0.0, 9.8), "gyro_rad_s": (0.0, 0.0, 0.0), "mag_t": (30.517e-6, 0.0, 0.0),
    "euler_rad": (0.0, 0.0, 0.0), "quat_wxyz": (1.0, 0.0, 0.0, 0.0), "temperature_c": 25.0, "pressure_pa": 101325.0,
}  # fmt: skip


def crc_bit_by_bit(data: bytes) -> int:
    """Return CRC-16 as in section 3.4 (C code), independent of the codec."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def framed(payload: bytes, length: int | None = None) -> bytes:
    head = b"\x5a\xa5" + struct.pack("<H", len(payload) if length is None else length)
    return head + struct.pack("<H", crc_bit_by_bit(head + payload)) + payload


def make(**settings: Any) -> uart_codec.HipnucCodec:
    return uart_codec.HipnucCodec(Ledger(), uart_codec.HipnucOptions(**settings))


def one(events: Sequence[CodecEvent]) -> Measurement:
    assert len(events) == 1
    assert isinstance(events[0], Measurement)
    return events[0]


def reasons(events: Sequence[CodecEvent]) -> list[BadReason]:
    return [event.reason for event in events if isinstance(event, BadFrame)]


def hi91(system_time_ms: int = 0, **values: Any) -> bytes:
    return uart_codec.encode_hi91(system_time_ms=system_time_ms, **(LEVEL | values))


def check_manual_values(m: Measurement) -> None:
    assert (m.dev_ticks, str(m.temperature_c)) == (1840392, "35.0"), "a float, as in a slot"
    assert m.pressure_pa == pytest.approx(100676, abs=0.5)
    # -0.220615, 0.209189, 0.948889 G at 9.8 m/s²
    assert m.accel_m_s2 == pytest.approx((-2.162027, 2.050052, 9.299112), abs=1e-5)
    # -0.061722, -0.00603836, -0.0100611 °/s
    assert m.gyro_rad_s == pytest.approx((-1.077252e-3, -1.053893e-4, -1.755993e-4), rel=1e-5)
    # 7.89167, 14.625, -60.0417 µT
    assert m.mag_t == pytest.approx((7.89167e-6, 14.625e-6, -60.0417e-6), rel=1e-5)
    # 13.0519°, 12.1885°, -122.477°
    assert m.euler_rad == pytest.approx((0.2277986, 0.2127295, -2.137627), abs=1e-5)
    assert m.quat_wxyz == pytest.approx((-0.485922, -0.14982, 0.0380868, 0.860223), abs=1e-6)
    assert (m.size_bytes, m.trailing_bytes) == (82, 0)


@pytest.mark.manual(
    "B 3.1 header", "B 3.3.1 pps_sync_stamp", "B 3.3.1 temperature", "B 3.3.1 air_pressure", "B 3.3.1 system_time",
    "B 3.3.1 acceleration", "B 3.3.1 angular rate", "B 3.3.1 magnetic field", "B 3.3.1 angles", "B 3.3.1 quaternion",
    "B 3.5 example", "B 3.6 check of an example",
)  # fmt: skip
def test_manual_hi91() -> None:
    m = one(make().feed(MANUAL_HI91))
    check_manual_values(m)
    assert (m.pps_age_ms, m.status) == (5384, None)
    assert m.quat_wxyz is not None
    run = make().feed(3 * MANUAL_HI91)
    assert run == [msgspec.structs.replace(m, trailing_bytes=frames * len(MANUAL_HI91)) for frames in (2, 1, 0)]
    assert euler312_from_quat(m.quat_wxyz) == pytest.approx(m.euler_rad, abs=2e-6)
    codec = make()
    m = one(codec.feed(framed(MANUAL_HI91[6:] + b"\x77")))
    check_manual_values(msgspec.structs.replace(m, size_bytes=m.size_bytes - 1))
    assert codec.ledger.unknown_tags == 1
    assert crc_bit_by_bit(MANUAL_HI91[:4] + MANUAL_HI91[6:]) == 0xBB14
    assert uart_codec.encode_frame(MANUAL_HI91[6:]) == MANUAL_HI91
    m = one(make().feed(MANUAL_HI91))
    values = {name: getattr(m, name) for name in LEVEL}
    assert uart_codec.encode_hi91(system_time_ms=1840392, word_1_2=5384, **values) == MANUAL_HI91


@pytest.mark.manual(
    "B 3.3.2 status", "B 3.3.2 temperature", "B 3.3.2 pps_sync_stamp", "B 3.3.2 air_pressure", "B 3.3.2 angular rate",
    "B 3.3.2 acceleration", "B 3.3.2 magnetic field", "B 3.3.2 angles", "B 3.3.2 quaternion",
)  # fmt: skip
def test_hand_made_hi92() -> None:
    m = one(make().feed(framed(HI92_PAYLOAD)))
    assert m.dev_ticks is None
    assert m.status is None  # section 3.3.2: reserved
    assert (m.pps_age_ms, m.temperature_c, m.pressure_pa) == (1000, -5, 102000)
    assert m.gyro_rad_s == pytest.approx((1.0, -1.0, 0.5), rel=1e-12)
    assert m.accel_m_s2 == pytest.approx((9.9999744, -9.9999744, 9.7656), rel=1e-12)
    assert m.mag_t == pytest.approx((30.517e-6, -30.517e-6, 0.0), rel=1e-12)
    assert m.euler_rad == pytest.approx((math.pi / 2, -math.pi / 4, math.pi), rel=1e-12)
    assert m.quat_wxyz == pytest.approx((0.8641, 0.0, -0.5, 0.0001), rel=1e-12)
    assert m.size_bytes == 54
    values = {name: getattr(m, name) for name in LEVEL}
    assert uart_codec.encode_hi92(pps_stamp_ms=1000, status=0x1234, **values) == framed(HI92_PAYLOAD)


@pytest.mark.manual("B 3.1 sub-packets")
def test_the_word_that_a_version_or_the_configuration_selects_and_sub_packets() -> None:
    codec = make()
    frame = hi91(word_1_2=0x0208)
    assert one(codec.feed(frame)).pps_age_ms == 0x0208
    DRIVER.apply_identity(codec, Identity(details={"APP_VER": "168"}))
    assert one(codec.feed(frame)).status is None
    DRIVER.apply_identity(codec, Identity(details={"APP_VER": "169"}))
    m = one(codec.feed(frame))
    assert (m.status, m.pps_age_ms) == (0x0208, None)
    DRIVER.apply_identity(codec, Identity(details={"APP_VER": "unreadable"}))
    DRIVER.apply_identity(codec, Identity())
    assert one(codec.feed(frame)).status == 0x0208

    codec = make()
    frame = framed(MANUAL_HI91[6:] + HI92_PAYLOAD)
    first, second = codec.feed(frame + b"\x00\x00\x00")
    assert isinstance(first, Measurement)
    assert isinstance(second, Measurement)
    assert (first.dev_ticks, second.pps_age_ms) == (1840392, 1000)
    assert [(m.size_bytes, m.trailing_bytes) for m in (first, second)] == [(130, 3)] * 2
    assert codec.ledger.frames_good == codec.ledger.frames_in_samples == 1
    codec = make()
    assert codec.feed(framed(b"\x77" + MANUAL_HI91[6:])) == []
    assert (codec.ledger.unknown_tags, codec.ledger.frames_ignored, codec.ledger.frames_bad()) == (1, 1, 0)
    assert codec.ledger.closes()
    for word, version in (("pps", "200"), ("status", "100")):
        codec = make(hi91_word=word)
        DRIVER.apply_identity(codec, Identity(details={"APP_VER": version}))
        for frame in (hi91(word_1_2=7), framed(hi91(word_1_2=7)[6:] + b"\x77")):
            m = one(codec.feed(frame))
            assert (m.status, m.pps_age_ms) == ((None, 7) if word == "pps" else (7, None))


@pytest.mark.manual("B 3.1 length", "B 3.4 CRC")
def test_lengths_of_frames_and_payloads_and_every_single_bit_error() -> None:
    for length in (0, 513, 0xFFFF):
        codec = make()
        header = uart_codec.HEADER.pack(b"\x5a\xa5", length, 0)
        events = codec.feed(header[:4] + MANUAL_HI91)
        assert events[0] == BadFrame(BadReason.LENGTH, header[:4])
        assert isinstance(events[1], Measurement)
        assert codec.ledger.bytes_in_bad_frames == 4
    for cut_off in (MANUAL_HI91[6:-1], HI92_PAYLOAD[:-1], HI92_PAYLOAD + b"\x91"):  # a sub-packet is incomplete
        codec, frame = make(), framed(cut_off)
        assert codec.feed(frame) == [BadFrame(BadReason.CONTENT, frame)]
        assert (codec.ledger.frames_bad_content, codec.ledger.bytes_in_bad_frames) == (1, len(frame))
        assert codec.ledger.closes()
    for payload in (b"", bytes(513)):
        with pytest.raises(ValueError, match=r"expected 1 … 512"):
            uart_codec.encode_frame(payload)
    for length in (1, 512):
        codec = make()
        assert (codec.feed(framed(b"\x77" * length)), codec.ledger.frames_ignored) == ([], 1)
    for bit in range(0, 8 * len(MANUAL_HI91), 3):
        damaged = bytearray(MANUAL_HI91)
        damaged[bit // 8] ^= 1 << bit % 8
        codec = make()
        events = codec.feed(MANUAL_HI91 + bytes(damaged) + MANUAL_HI91 + bytes(600))
        assert sum(isinstance(event, Measurement) for event in events) == 2, bit
        assert codec.ledger.closes()


def test_bytes_of_damaged_frames_count_as_bad() -> None:
    codec = make()
    damaged = MANUAL_HI91[:-1] + b"\x00"
    events = codec.feed(b"\x01\x02" + damaged + b"\x03" + MANUAL_HI91)
    assert events[0] == BadFrame(BadReason.CRC, damaged)
    ledger = codec.ledger
    assert (ledger.bytes_in_bad_frames, ledger.bytes_skipped, ledger.bytes_in_good_frames) == (82, 3, 82)

    codec = make()
    false = uart_codec.HEADER.pack(b"\x5a\xa5", 200, 0x1234)
    assert (codec.feed(false + MANUAL_HI91), codec.ledger.bytes_pending) == ([], 88)
    events = codec.feed(bytes(117) + b"\x01\x02")
    assert reasons(events) == [BadReason.CRC]
    assert isinstance(events[1], Measurement)
    ledger = codec.ledger
    # the length field claims 206 bytes (82 of them valid); one more byte arrived
    assert (ledger.bytes_in_bad_frames, ledger.bytes_in_good_frames, ledger.bytes_skipped) == (124, 82, 1)

    codec = make()
    assert codec.feed(uart_codec.HEADER.pack(b"\x5a\xa5", 200, 0x1234) + b"\x00APP_VER=156\r\nOK\r\n") == []
    events = codec.flush()
    assert reasons(events) == [BadReason.CRC]
    assert events[1:] == [TextLine("APP_VER=156"), TextLine("OK")]
    assert codec.ledger.closes()
    assert codec.flush() == []

    codec = make()
    codec.feed(uart_codec.HEADER.pack(b"\x5a\xa5", 200, 0x1234) + b"\x00APP_VER=156\r\nOK\r\n")
    codec.flush()
    assert codec.feed(b"ATT_MODE: 0\r\nOK\r\n") == [TextLine("ATT_MODE: 0"), TextLine("OK")]
    assert codec.ledger.closes()

    codec = make()
    inner = uart_codec.HEADER.pack(b"\x5a\xa5", 30, 0x1234)
    events = codec.feed(uart_codec.HEADER.pack(b"\x5a\xa5", 20, 0x1234) + inner + bytes(14))
    assert reasons(events) == [BadReason.CRC]
    codec.feed(bytes(16) + b"\x01\x02\x03")
    ledger = codec.ledger
    assert (ledger.bytes_in_bad_frames, ledger.bytes_skipped, ledger.bytes_pending) == (6 + 36, 3, 0)

    codec = make()
    codec.feed(uart_codec.HEADER.pack(b"\x5a\xa5", 100, 0x1234) + MANUAL_HI91)
    assert isinstance(codec.flush()[-1], Measurement)
    codec.feed(bytes(20))  # 106 bytes claimed: these 18 bytes belong to them
    assert (codec.ledger.bytes_in_bad_frames, codec.ledger.bytes_skipped) == (6 + 18, 2)
    codec = make()
    codec.feed(uart_codec.HEADER.pack(b"\x5a\xa5", 3, 0x1234) + b"\x00\x00Z")
    assert codec.ledger.bytes_pending == 1
    codec.feed(b"\x00")
    assert (codec.ledger.bytes_in_bad_frames, codec.ledger.bytes_skipped) == (9, 1)


def test_impossible_values_are_removed_and_reported() -> None:
    names = ("accel_m_s2", "gyro_rad_s", "mag_t", "euler_rad", "quat_wxyz", "pressure_pa")
    for name in names:
        good = LEVEL[name]
        limit = {"accel_m_s2": 40, "euler_rad": 361}.get(name, 4000) * SI_PER_UNIT.get(name, 1)
        for bad in (math.nan, math.inf, -math.inf, *((limit, -3e38) if name in SI_PER_UNIT else ())):
            frame = hi91(5, **{name: (*good[:-1], bad) if isinstance(good, tuple) else bad})
            codec = make()
            events = codec.feed(MANUAL_HI91 + frame + MANUAL_HI91)
            assert events[1] == BadFrame(BadReason.NOT_FINITE, frame)
            assert isinstance(m := events[2], Measurement)
            assert [field for field in names if getattr(m, field) is None] == [name]
            assert (m.dev_ticks, len(events)) == (5, 4)
            assert (codec.ledger.frames_good, codec.ledger.frames_not_finite, codec.ledger.frames_bad()) == (3, 1, 0)
            assert codec.ledger.closes()
            assert make().feed(frame)[1] == msgspec.structs.replace(m, trailing_bytes=0)
        if name in SI_PER_UNIT:
            most = {name: (*good[:-1], -(math.tau if name == "euler_rad" else limit * (1 - 1e-6)))}
            for event in make().feed(hi91(5, **most) * 2):
                assert getattr(event, name) == pytest.approx(most[name])

    for top in (0x7F, 0xFF):
        assert one(make().feed(hi91(top << 24))).dev_ticks == top << 24
    body = OLD_MANUAL[6:].ljust(76, b"\0")
    m = one(make().feed(framed(body)))
    assert (m.temperature_c, m.pressure_pa) == (None, None)
    assert m.dev_ticks == 0x0004BBBD


OLD_MANUAL = bytes.fromhex("5AA54C006C519100A03B01A80297BDBB04009CA0653EA226453FF2C53D3FDDA9CDBC54A6D5BC5E4CBEBD")
"""Start of a frame in the vendor's older manual; bytes 7 … 13: reserved, 0x3B, -4.2e-25 as a float."""


@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize(
    ("pressure_pa", "temperature_c", "expected"),
    [
        (101_325.0, 21, (21, 101_325.0)),
        (0.0, 21, (21, None)),  # firmware without a barometer
        (999.0, 21, (21, None)),
        (-4.2e-25, 59, (None, None)),  # old content of the buffer
        (999.9, 59, (None, None)), (1000.0, 21, (21, 1000.0)), (120_000.0, 21, (21, 120_000.0)),
        (120_001.0, 59, (None, None)),
    ],
)  # fmt: skip
@pytest.mark.manual("B 3.3.1 air_pressure")
def test_no_barometer_no_pressure(
    pressure_pa: float, temperature_c: int, expected: tuple[float | None, float | None], frames: int
) -> None:
    """Alone, in a run of frames, and before an unknown tag: three decoders."""
    frame = hi91(5, pressure_pa=pressure_pa, temperature_c=temperature_c)
    events = make().feed(frame * frames)
    assert len(events) == frames
    for event in (*events, *make().feed(framed(frame[6:] + b"\x00"))):
        assert isinstance(event, Measurement)
        assert (event.temperature_c, event.pressure_pa) == expected


def texts(data: bytes) -> list[str]:
    return [event.text for event in make().feed(data) if isinstance(event, TextLine)]


def test_lines_of_text() -> None:
    assert (texts(b"OK\r\nERR\nA\tB\r\n"), texts(b"\r\n\n\r\n")) == (["OK", "ERR", "A\tB"], [])
    assert (texts(b"a\rb\r\n"), texts(b"a\x00b\xffc\n")) == (["b"], ["c"])
    assert texts(b"x" * 255 + b"\r\n" + b"x" * 256 + b"\r\nOK\n") == ["x" * 255, "OK"]
    assert texts(b"x" * 300 + b"\ry\nz\n") == ["y", "z"]

    codec = make()
    assert (codec.feed(b"QUIZ"), codec.feed(b"\r\n")) == ([], [TextLine("QUIZ")])
    assert codec.feed(b"Z") == []
    assert isinstance(codec.feed(MANUAL_HI91[1:])[0], Measurement)
    assert codec.ledger.bytes_skipped == 0

    codec = make()
    codec.feed(b"PNAME=HI14R3\r\nOK\r\nhal")
    ledger = codec.ledger
    assert (ledger.frames_good, ledger.frames_in_replies) == (2, 2)
    assert (ledger.bytes_in_good_frames, ledger.bytes_pending) == (18, 3)
    assert ledger.closes()

    for end in (b"\ry\nz\n", b"\x00y\nz\n"):
        codec = make()
        codec.feed(b"x" * 300)
        assert codec.ledger.bytes_pending == 0
        events = [event for byte in end for event in codec.feed(bytes([byte]))]
        assert events == [TextLine("y"), TextLine("z")]
        assert codec.ledger.closes()


GGA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"  # checksum of the NMEA 0183 standard


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_nmea_sentences_between_the_lines_of_a_reply_are_ignored_frames(size: int) -> None:
    codec = make()
    data = b"COORD=4\r\n" + GGA + GGA[:-4] + b"48\r\n" + b"$GNSXT,1*4B\r\n" + GGA + b"$odd\r\nOK\r\n"
    events = feed_stream(codec, [data[at : at + size] for at in range(0, len(data), size)])
    assert [event for event in events if isinstance(event, TextLine)] == [*map(TextLine, ("COORD=4", "$odd", "OK"))]
    assert (reasons(events), codec.ledger.frames_bad_crc) == ([BadReason.CRC], 1)
    assert {uart_codec.tag_name(one): count for one, count in codec.unknown.items()} == {
        "NMEA sentence GGA": 2, "NMEA sentence SXT": 1,
    }  # fmt: skip
    ledger = codec.ledger
    assert (ledger.frames_ignored, ledger.frames_in_replies, ledger.unknown_tags) == (3, 3, 0)
    assert (ledger.bytes_in_bad_frames, ledger.bytes_skipped) == (len(GGA), 0)


@pytest.mark.manual("B 3.4 CRC")
def test_clipping_the_check_value_and_a_driver_of_other_settings() -> None:
    far: dict[str, Any] = LEVEL | {
        "accel_m_s2": (1e9, -1e9, 0.0), "gyro_rad_s": (1e3, -1e3, 0.0), "temperature_c": 300.0, "pressure_pa": 1e6,
    }  # fmt: skip
    m = one(make().feed(uart_codec.encode_hi92(pps_stamp_ms=-1, **far)))
    assert m.accel_m_s2 == pytest.approx((159.994, -159.9996, 0.0), abs=1e-2)
    assert m.gyro_rad_s == pytest.approx((32.767, -32.768, 0.0))
    assert (m.temperature_c, m.pressure_pa, m.pps_age_ms) == (None, None, 0)  # ends of the ranges
    bad, last = make().feed(
        uart_codec.encode_hi91(system_time_ms=2**32 + 7, **(far | {"accel_m_s2": (1e300, 0.0, 0.0)}))
    )
    assert isinstance(bad, BadFrame)
    assert isinstance(last, Measurement)
    assert last.dev_ticks == 7
    assert (last.temperature_c, last.pressure_pa) == (None, None)  # 1e6 Pa: bytes that the firmware did not write
    assert struct.unpack_from("<f", bad.raw, 6 + 12)[0] == pytest.approx(3.4028e38, rel=1e-4)
    assert (crc_hqx(b"123456789", 0), crc_hqx(b"6789", crc_hqx(b"12345", 0))) == (0x31C3, 0x31C3)
    codec = replace(DRIVER, name="other").make_codec(Ledger(), uart_codec.HipnucOptions(hi91_word="status"))
    assert one(codec.feed(hi91(word_1_2=3))).status == 3
    assert DRIVER.example_frame(Random(0))


FILLER = [
    ("pps_age_ms", {"word_1_2": 8193}, {"pps_stamp_ms": 8193}),
    ("pps_age_ms", {"word_1_2": 0x2323}, {"pps_stamp_ms": 0x2323}),
    *(("mag_t", {"mag_t": (0.0, 0.0, 0.0)}, {"mag_t": (tesla,) * 3}) for tesla in (0.0, -3.05e-8, 1.0, -1.0)),
    *(("temperature_c", {"temperature_c": celsius}, {"temperature_c": celsius}) for celsius in (127, -128)),
    *(("pressure_pa", {"pressure_pa": 0.0}, {"pressure_pa": pa}) for pa in (100_000.0, 99_999.0, 0.0, 1e6)),
    *(
        ("quat_wxyz", {"quat_wxyz": quat}, {"quat_wxyz": quat})
        for quat in ((0, 0, 0, 0), (0.5, 0.5, 0.5, 0), (3.2767,) * 4)
    ),
]


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize(("field", "hi91_values", "hi92_values"), FILLER)
def test_filler_bytes_are_no_values(
    field: str, hi91_values: dict[str, Any], hi92_values: dict[str, Any], count: int
) -> None:
    """Alone, back to back, and in a frame with NaN. The values next to the filler bytes stay."""
    floats = hi91(**hi91_values)
    integers = uart_codec.encode_hi92(**({"pps_stamp_ms": 8192, "status": 0x2323} | LEVEL | hi92_values))
    with_nan = hi91(**({"gyro_rad_s": (0.0, math.nan, 0.0)} | hi91_values))
    for data in (floats * count, integers * count, with_nan * count):
        events = [event for event in make().feed(data) if isinstance(event, Measurement)]
        assert len(events) == count
        for one_event in events:
            assert getattr(one_event, field) is None
            assert one_event.status is None
            assert one_event.accel_m_s2 == pytest.approx((0, 0, 9.8), abs=1e-3)
            assert (one_event.mag_t is None) == (field == "mag_t")
    newer = uart_codec.HipnucCodec(Ledger(), uart_codec.HipnucOptions(hi91_word="status"))
    for word, status in ((0x2323, None), (0xFFFF, None), (0x1FFF, 0x1FFF)):
        assert [one.status for one in newer.feed(hi91(word_1_2=word) * count)] == [status] * count  # type: ignore[union-attr]


def test_damaged_frames_among_lines() -> None:
    codec = make()
    damaged = uart_codec.HEADER.pack(b"\x5a\xa5", 2, 0x1234)
    events = codec.feed(b"APP_" + damaged + b"\n\x00VER\n")
    assert [event.text for event in events if isinstance(event, TextLine)] == ["VER"]
    codec = make()
    assert codec.feed(b"ab\x5a\xa5\x20\x20cd\nef\n")[1:] == [TextLine("ef")]
    assert codec.ledger.closes()

    damaged = uart_codec.HEADER.pack(b"\x5a\xa5", 10, 0x1234) + bytes(6) + b"KERR"
    codec = make()
    events = codec.feed(damaged + b"OR\r\nOK\r\n")
    assert events[1:] == [TextLine("OK")]
    assert codec.ledger.closes()

    codec = uart_codec.HipnucCodec(Ledger(), uart_codec.HipnucOptions())
    frame = uart_codec.encode_frame(b"\x91" + b'\x01"Cs\n' + bytes(70))
    cut = frame.index(b"\n") + 1
    assert codec.feed(frame[:cut]) == []
    assert codec.flush() == []
    assert (len(codec.feed(frame[cut:])), codec.ledger.bytes_in_good_frames) == (1, len(frame))


@pytest.mark.parametrize("text", [b"AOK\r\n", b"KERR\r\n", b"OK\r\nOK\r\n", b"\nOK\r\n"])
@pytest.mark.parametrize("step", [1, 7, 1000])
def test_text_inside_a_damaged_frame_is_not_a_line(text: bytes, step: int) -> None:
    """The first characters may be bytes of the frame: `AOK` is a byte of a sample and a reply, or four bytes of a
    sample.
    """
    damaged = uart_codec.HEADER.pack(b"\x5a\xa5", 76, 0x1234) + b"\x91" + bytes(20) + text + bytes(55 - len(text))
    data = damaged + b"OK\r\n" + MANUAL_HI91
    codec = make()
    events = [event for at in range(0, len(data), step) for event in codec.feed(data[at : at + step])]
    assert reasons(events) == [BadReason.CRC]
    assert [event for event in events if isinstance(event, TextLine)] == [TextLine("OK")]
    ledger = codec.ledger
    assert (ledger.frames_in_replies, ledger.frames_in_samples) == (1, 1)
    assert (ledger.bytes_in_bad_frames, ledger.bytes_in_good_frames) == (82, 4 + 82)
    assert ledger.closes()


@pytest.mark.manual("B 3.3.1 size", "B 3.3.2 size", "B 3.3.1 pps_sync_stamp")
def test_sizes_and_the_pps_stamp_that_runs_free_up_to_its_limit() -> None:
    assert (uart_codec.HI91.size, uart_codec.HI92.size) == (76, 48)
    assert (8190 + 10) % uart_codec.PPS_STAMP_MODULUS_MS == 8
    for data in (hi91(word_1_2=8192) * 2, uart_codec.encode_hi92(pps_stamp_ms=8192, **LEVEL)):
        assert [m.pps_age_ms for m in make().feed(data) if isinstance(m, Measurement)] == [8192] * data.count(
            b"\x5a\xa5"
        )
