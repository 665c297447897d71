"""IMU61x frames on CAN, computed by hand, and the rules that make a sample of five frames."""

import math
import struct

import msgspec
import pytest

from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.drivers.imu61x.can import DRIVER, Imu61xCanCodec, Imu61xCanOptions, encode_set
from imud.model.ledger import Ledger
from imud.model.sample import Measurement

F1_5, F_M2, F_90, F_10, F_M20, F_0_5, F_1, F_0_25, F_M1 = (
    bytes.fromhex(text)
    for text in (
        "0000c03f", "000000c0", "0000b442", "00002041", "0000a0c1", "0000003f", "0000803f", "0000803e", "000080bf",
    )
)  # fmt: skip
GOLDEN = [
    (101, F1_5 + F_M2),  # roll 1.5°, pitch -2°
    (102, F_90 + F_10),  # yaw 90°, gyro x 10 °/s
    (103, F_M20 + F_0_5),  # gyro y -20 °/s, z 0.5 °/s
    (104, F_1 + F_0_25),  # accel x 1 g, y 0.25 g
    (105, F_M1 + bytes.fromhex("c409ffff")),  # accel z -1 g, 0x09C4 = 2500 = 25 °C, INDEX 65535
]


def make(base_id: int = 101) -> Imu61xCanCodec:
    return Imu61xCanCodec(Ledger(), Imu61xCanOptions(base_id=base_id))


def feed(codec: Imu61xCanCodec, frames: list[tuple[int, bytes]]) -> list[CodecEvent]:
    events = [event for can_id, data in frames for event in codec.feed_frame(can_id, False, data, 0)]
    assert codec.ledger.closes()
    return events


def sample(index: int, value: float = 1.0) -> list[tuple[int, bytes]]:
    return encode_set(
        index=index, accel_m_s2=(value,) * 3, gyro_rad_s=(value,) * 3, euler_rad=(0.1, 0.1, value / 10),
        temperature_c=25,
    )  # fmt: skip


def indices(events: list[CodecEvent]) -> list[int | None]:
    return [event.dev_ticks for event in events if isinstance(event, Measurement)]


@pytest.mark.parametrize(
    ("pairs", "is_found"),
    [([(65530 + n, 5000 + n) for n in range(17)], True), ([(n, n) for n in range(40)], True),  # same power switch
     ([(n, n + 1) for n in range(40)], True), ([(2 * n, 2 * n + 1, 500 + n) for n in range(40)], True),  # half the rate
     ([(65400 + n, n, 600 + n) for n in range(40)], True), ([(n, n, n) for n in range(40)], True),
     ([(n, 300 + n, 600 + n, 900 + n)[: 3 + (n % 7 > 0)] for n in range(40)], True),  # the fourth loses samples
     ([(n, 5000 + n)[: 33 - 2 * n] for n in range(17)], False), ([(n + n // 5,) for n in range(90)], False),
     ([(16 * n, 5000 + n) for n in range(40)], True), ([(17 * n, 5000 + n) for n in range(40)], False),
     ([(7, 7)] * 40, False), ([(n * n,) for n in range(90)], False), ([(n,) for n in range(90)], False)],
)  # fmt: skip
def test_two_devices_with_one_base_id_are_found(pairs: list[tuple[int, ...]], *, is_found: bool) -> None:
    codec = make()
    for pair in pairs:
        for device, index in enumerate(pair):
            feed(codec, sample(index, 0.5 * device + index / 1000))
    newest, found = pairs[-1][0] + 1, [codec.problem]
    for index in range(newest, newest + 257):  # one device was removed
        feed(codec, sample(index))
        found.append(codec.problem)
    assert ([bool(one) for one in found[:256]], found[-1]) == ([is_found] * 256, "")


@pytest.mark.manual(
    "A 4.2 frame 101", "A 4.2 frame 102", "A 4.2 frame 103", "A 4.2 frame 104", "A 4.2 frame 105", "A 4.1 frames",
    "A 4.2 temperature",
)  # fmt: skip
def test_golden_set_in_si_units_and_back_with_the_temperature_in_hundredths() -> None:
    (measured,) = feed(make(), GOLDEN)
    assert isinstance(measured, Measurement)
    assert measured.euler_rad == pytest.approx((0.0261799388, -0.0349065850, 1.5707963268), abs=1e-9)
    assert measured.gyro_rad_s == pytest.approx((0.1745329252, -0.3490658504, 0.0087266463), abs=1e-9)
    assert measured.accel_m_s2 == pytest.approx((9.80665, 2.4516625, -9.80665), abs=1e-12)
    assert measured.temperature_c == pytest.approx(25.0)
    assert (measured.dev_ticks, measured.size_bytes) == (65535, 40)
    # half angles 0.75°, -1°, 45°: w = 0.70710678 (0.99984770 · 0.99991433 - 0.01745241 · 0.01308960) and so on
    assert measured.quat_wxyz == pytest.approx((0.7067770, 0.0215940, -0.0030853, 0.7071000), abs=1e-7)
    made = encode_set(
        index=65535, accel_m_s2=(9.80665, 2.4516625, -9.80665),
        gyro_rad_s=(math.radians(10), math.radians(-20), math.radians(0.5)),
        euler_rad=(math.radians(1.5), math.radians(-2), math.radians(90)), temperature_c=25.0,
    )  # fmt: skip
    assert made == GOLDEN
    codec = make()
    for can_id, data in GOLDEN:
        assert not codec.feed_frame(can_id, True, data, 0)
    assert (codec.ledger.bytes_skipped, codec.unknown) == (40, {})
    codec = make()
    found = [indices(feed(codec, [sample(index)[n] for n in (2, 0, 3, 1, 4)])) for index in range(65534, 65538)]
    assert found == [[], [65535], [0], [1]]  # the order counts only without the previous INDEX

    moved = [(can_id - 101 + 600, data) for can_id, data in GOLDEN]
    codec = make(600)
    assert (indices(feed(codec, moved)), feed(codec, GOLDEN)) == ([65535], [])
    assert codec.unknown == dict.fromkeys(range(101, 106), 1)
    nodes = [DRIVER.node_of(can_id, False, bytes(8)) for can_id in range(100, 107)]
    assert nodes == [None, *[Imu61xCanOptions().base_id] * 5, None] == [None, *[101] * 5, None]
    assert (DRIVER.node_of(101, True, bytes(8)), DRIVER.node_of(101, False, bytes(7))) == (None, None)
    wanted = DRIVER.filters(Imu61xCanOptions(base_id=600))
    assert [f.can_id for f in wanted] == [600, 601, 602, 603, 604]
    assert not any(f.matches(605, False) or f.matches(600, True) for f in wanted)
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"base_id": 2044}, Imu61xCanOptions)

    for raw, expected in (("0000", 0.0), ("9cff", -1.0), ("983a", 150.0), ("01ce", -127.99)):
        (measured,) = feed(make(), [*GOLDEN[:4], (105, F_M1 + bytes.fromhex(raw) + b"\0\0")])
        assert isinstance(measured, Measurement)
        assert measured.temperature_c == pytest.approx(expected)
    for raw in ("00ce", "0080", "993a"):  # -128 °C, -327.68 °C, 150.01 °C
        bad, measured = feed(make(), [*GOLDEN[:4], (105, F_M1 + bytes.fromhex(raw) + b"\0\0")])
        assert isinstance(bad, BadFrame)
        assert isinstance(measured, Measurement)
        assert measured.temperature_c is None


def test_incomplete_mixed_and_disordered_sets() -> None:
    for missing in range(5):
        codec = make()
        frames = sample(7)
        del frames[missing]
        assert indices(feed(codec, frames + sample(8, 2.0))) == [8]
        assert (codec.ledger.frames_ignored, codec.ledger.frames_in_samples) == (4, 5)

    codec = make()
    first, second = sample(1, 1.0), sample(2, 2.0)
    events = feed(codec, first[:4] + second[1:])  # lost: 105 of the first sample and 101 of the second sample
    assert events == []
    late = sample(9, 3.0)
    events = feed(codec, second[2:4] + late[:2] + late[4:])  # imud starts inside a set; then 105, 103 and 104 are lost
    assert events == []

    codec = make()
    mixed = [sample(4)[n] for n in (2, 0, 3, 1, 4)]
    assert indices(feed(codec, mixed)) == []  # no INDEX is known before
    mixed = [sample(5)[n] for n in (2, 0, 3, 1, 4)]
    assert indices(feed(codec, mixed)) == [5]
    mixed = [sample(7)[n] for n in (2, 0, 3, 1, 4)]
    assert (indices(feed(codec, mixed)), codec.ledger.frames_ignored) == ([], 10)


PERIOD_NS = 10_000_000
FRAME_NS = 250_000


def timed(
    codec: Imu61xCanCodec, index: int, places: str = "12345", *, late_ns: int = 0, period_ns: int = PERIOD_NS
) -> list[int | None]:
    """Feed some frames of a sample back to back, at the time of its INDEX."""
    events: list[CodecEvent] = []
    for place, (can_id, data) in enumerate(sample(index, float(index % 100))):
        if str(place + 1) in places:
            t_ns = index * period_ns + place * FRAME_NS + late_ns
            events += codec.feed_frame(can_id, False, data, t_ns)
    assert codec.ledger.closes()
    return indices(events)


def learned(period_ns: int = PERIOD_NS) -> Imu61xCanCodec:
    """Return a codec after samples up to INDEX 9, the minimum that it needs."""
    codec = make()
    assert [timed(codec, index, period_ns=period_ns) for index in range(1, 10)] == [[index] for index in range(1, 10)]
    return codec


def test_time_separates_frames_of_two_samples() -> None:
    """Frames 1 … `cut` of one sample and the rest of another sample. The frames between them are lost: no sample."""
    for cut in range(1, 5):
        codec = learned()
        first, rest = "12345"[:cut], "12345"[cut:]
        assert timed(codec, 10, first) + timed(codec, 11, rest) == []
        assert (codec.ledger.frames_ignored, timed(codec, 12)) == (5, [12])
        assert (timed(codec, 60, first) + timed(codec, 77, rest), timed(codec, 78)) == ([], [78])


def test_time_separates_complete_and_mixed_sets() -> None:
    """At 100 Hz, on a nearly full bus, before the period is known, after a pause and at another rate."""
    codec = learned()
    assert [timed(codec, index) for index in (17, 18, 400, 401)] == [[17], [18], [400], [401]]
    # the last frame is 5 ms late: 6 ms is 1 ms + half of 10 ms
    assert timed(codec, 410, "1234") + timed(codec, 410, "5", late_ns=5_000_000) == [410]
    assert timed(codec, 420, "1234") + timed(codec, 420, "5", late_ns=5_000_001) == []
    codec = learned()
    timed(codec, 10, late_ns=10**9)  # counts as a period of 20 ms, which increases the mean by 10 ms / 16
    assert timed(codec, 112, "1234") + timed(codec, 112, "5", late_ns=5_312_500) == [112]
    assert timed(codec, 114, "1234") + timed(codec, 114, "5", late_ns=5_312_501) == []

    period_ns = 1_250_000
    codec = learned(period_ns)
    assert timed(codec, 15, period_ns=period_ns) == [15]
    assert timed(codec, 16, "123", period_ns=period_ns) + timed(codec, 17, "45", period_ns=period_ns) == []
    assert timed(codec, 19, period_ns=period_ns) == [19]

    codec = make()
    assert timed(codec, 1, "123") + timed(codec, 2, "45") == [2]
    assert [timed(codec, index) for index in range(3, 10)] == [[index] for index in range(3, 10)]
    assert timed(codec, 10, "123") + timed(codec, 12, "45") == [12]  # after seven sets without a jump of INDEX
    timed(codec, 13)
    assert timed(codec, 14, "123") + timed(codec, 15, "45") == []

    codec = make()
    for index in range(1, 20):
        timed(codec, index)
    assert timed(codec, 20, late_ns=10**9) == [20]  # one second late; the following sets are on time
    assert timed(codec, 121, "123") + timed(codec, 122, "45") == []
    codec.reset()
    begin, fast_ns = 1000, 2_500_000
    for index in range(begin, begin + 8):
        assert timed(codec, index, period_ns=fast_ns) == [index]
    later = begin + 20
    assert timed(codec, later, "12", period_ns=fast_ns) + timed(codec, later + 1, "345", period_ns=fast_ns) == []


def test_wrong_length_is_a_bad_frame() -> None:
    codec = make()
    events = feed(codec, [*sample(1)[:2], (103, b"\1\2\3")])
    assert events == [BadFrame(BadReason.LENGTH, b"\1\2\3", 103)]
    assert (codec.flush(), codec.ledger.frames_ignored, codec.ledger.frames_pending) == ((), 2, 0)
    assert (codec.ledger.frames_bad_length, codec.ledger.bytes_in_bad_frames) == (1, 3)

    frames = sample(1)
    frames[1] = (102, struct.pack("<2f", math.nan, 1.0))
    frames[4] = (105, struct.pack("<fhH", math.inf, 2500, 1))
    codec = make()
    events = feed(codec, frames)
    assert [e.raw for e in events if isinstance(e, BadFrame)] == [frames[1][1], frames[4][1]]
    measured = events[-1]
    assert isinstance(measured, Measurement)
    assert (measured.euler_rad, measured.quat_wxyz, measured.accel_m_s2) == (None, None, None)
    assert measured.gyro_rad_s is not None
    assert (codec.ledger.frames_not_finite, codec.ledger.frames_in_samples) == (2, 5)
    for place in range(9):
        values = [360.0] * 3 + [3999.0] * 3 + [39.0] * 3
        values[place] = math.inf
        data = struct.pack("<9fhH", *values, 10000, 1)
        bad, measured = feed(make(), [(101 + slot, data[8 * slot : 8 * slot + 8]) for slot in range(5)])
        assert isinstance(bad, BadFrame)
        assert bad.raw == data[place // 2 * 8 :][:8]
