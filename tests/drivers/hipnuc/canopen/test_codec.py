"""TPDOs of the manual with SI values computed by hand, and the handling of all other frames."""

import math
import struct
from math import pi
from random import Random

import cantools
import msgspec
import pytest

from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.contracts.script import ReplyFrame
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenCodec, HipnucCanopenOptions, encode_tpdos
from imud.drivers.hipnuc.canopen.driver import DRIVER
from imud.drivers.hipnuc.common import random_quaternion
from imud.formats.can import CyclicFrame
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from tests.support.files import shared

MS = 1_000_000
GOLDEN = {
    1: "4A 00 1F 00 C8 03",  # manual 5.2: 74, 31 (printed 731, ERRATA B17), 968 mG
    2: "15 00 14 01 34 00",  # manual 5.2: 2.1, 27.6, 5.2 °/s
    3: "94 11 78 EC B0 B9",  # 0x1194 = 4500, 0xEC78 = -5000, 0xB9B0 = -18000: 45°, -50°, -180°
    4: "88 13 78 EC 88 13 88 13",  # 5000, -5000, 5000, 5000
    6: "CD 8B 01 00",  # 0x18BCD = 101325 Pa
    7: "2E FB FF FF A0 8C 00 00",  # -1234 = -12.34°, 36000 = 360°
}
FUNCTIONS = {1: 0x180, 2: 0x280, 3: 0x380, 4: 0x480, 6: 0x680, 7: 0x780}


def make(**settings: object) -> HipnucCanopenCodec:
    return HipnucCanopenCodec(Ledger(), msgspec.convert(settings, HipnucCanopenOptions))


def feed_bursts(codec: HipnucCanopenCodec, numbers: list[int], bursts: int = 6, node: int = 8) -> list[CodecEvent]:
    events: list[CodecEvent] = []
    for burst in range(bursts):
        for place, number in enumerate(numbers):
            t_ns = burst * 10 * MS + place * MS // 4
            events += codec.feed_frame(FUNCTIONS[number] + node, False, bytes.fromhex(GOLDEN[number]), t_ns)
            assert codec.ledger.closes()
    return events


def measured(numbers: list[int]) -> Measurement:
    event = feed_bursts(make(), numbers)[-1]
    assert isinstance(event, Measurement)
    return event


@pytest.mark.manual("B 5.2 TPDO1", "B 5.2 TPDO2", "B 5.2 TPDO3", "B 5.2 TPDO4", "B 5.2 TPDO6", "B 5.2 TPDO7")
def test_all_tpdos_in_si_units() -> None:
    event = measured([1, 2, 3, 4, 6, 7])
    # 74 · 0.0098, 31 · 0.0098, 968 · 0.0098 m/s²
    assert event.accel_m_s2 == pytest.approx((0.7252, 0.3038, 9.4864), abs=1e-12)
    # 2.1 · π/180 and so on
    assert event.gyro_rad_s == pytest.approx((0.0366519143, 0.4817108736, 0.0907571211), abs=1e-9)
    assert event.euler_rad == pytest.approx((pi / 4, -0.8726646260, -pi), abs=1e-9)
    assert event.quat_wxyz == pytest.approx((0.5, -0.5, 0.5, 0.5), abs=1e-12)
    assert event.pressure_pa == 101325
    assert event.incli_rad == pytest.approx((-0.2153736296, 2 * pi), abs=1e-9)
    assert event.size_bytes == 38
    assert event.dev_ticks is None
    assert (event.mag_t, event.temperature_c, event.status) == (None, None, None)
    made = encode_tpdos(
        accel_m_s2=event.accel_m_s2, gyro_rad_s=event.gyro_rad_s, euler_rad=event.euler_rad, quat_wxyz=event.quat_wxyz,
        pressure_pa=event.pressure_pa, incli_rad=event.incli_rad,
    )  # fmt: skip
    assert made == {number: bytes.fromhex(text) for number, text in GOLDEN.items()}
    # half angles: roll 22.5° (cos 0.92388, sin 0.38268), pitch -25° (0.90631, -0.42262), yaw -90° (0, -1)
    assert measured([3]).quat_wxyz == pytest.approx((-0.161729, 0.346830, 0.390450, -0.837321), abs=2e-6)
    event = measured([1, 2])
    assert event.accel_m_s2 is not None
    assert (event.euler_rad, event.quat_wxyz, event.pressure_pa, event.incli_rad) == (None,) * 4
    assert measured([3]).accel_m_s2 is None


@pytest.mark.parametrize(
    ("can_id", "data", "values"),
    [
        (0x688, struct.pack("<i", sent), (pressure_pa, None))
        for sent, pressure_pa in ((0, None), (999, None), (1000, 1000), (120_000, 120_000), (-5, None))
    ]
    + [
        (0x488, struct.pack("<4h", *sent), (None, quat))
        for sent, quat in (((0,) * 4, None), ((32767, 0, 0, 0), None), ((-10_000, 0, 0, 0), (-1.0, 0.0, 0.0, 0.0)))
    ],
)
@pytest.mark.manual("B 5.2 TPDO6", "B 5.2 TPDO4")
def test_impossible_values_are_omitted(
    can_id: int, data: bytes, values: tuple[float | None, tuple[float, ...] | None]
) -> None:
    """A node without barometer sends any pressure."""
    codec = make()
    for burst in range(10):
        events = codec.feed_frame(can_id, False, data, burst * 50 * MS)
    (event,) = events
    assert isinstance(event, Measurement)
    assert (event.pressure_pa, event.quat_wxyz) == values


@pytest.mark.manual("B 5 frames")
def test_which_frames_count() -> None:
    for number, text in GOLDEN.items():
        codec, data = make(), bytes.fromhex(text)[:-1]
        assert codec.feed_frame(FUNCTIONS[number] + 8, False, data, 0) == (
            BadFrame(BadReason.LENGTH, data, FUNCTIONS[number] + 8),
        )
        assert (codec.ledger.frames_bad_length, codec.ledger.bytes_in_bad_frames) == (1, len(data))
        assert codec.ledger.closes()
    codec = make()
    assert not codec.feed_frame(0x188, True, bytes(6), 0)
    assert not codec.feed_frame(0x588, True, bytes(8), 0)
    assert codec.ledger.bytes_skipped == 14
    codec = make()
    assert codec.feed_frame(0x088, False, bytes(8), 0) == ()
    assert codec.ledger.frames_ignored == codec.ledger.frames_good == 1
    assert codec.ledger.closes()
    codec, data = make(), bytes.fromhex("60 00 20 00 00 00 00 00")
    assert codec.feed_frame(0x588, False, data, 0) == (ReplyFrame(0x588, data),)
    assert codec.feed_frame(0x588, False, data[:7], 0) == (BadFrame(BadReason.LENGTH, data[:7], 0x588),)
    assert codec.feed_frame(0x608, False, data, 0) == ()  # from another master
    for can_id, extended in ((0x508, False), (0x508, False), (0x508, True), (0x509, False), (0x088, False)):
        assert codec.feed_frame(can_id, extended, data, 0) == ()
    assert (codec.unknown, codec.ledger.frames_in_replies) == ({0x508: 2}, 1)
    assert codec.ledger.closes()
    codec = make(node=9)
    assert feed_bursts(codec, [1, 2]) == []
    assert codec.ledger.bytes_skipped == codec.ledger.bytes_in == 72
    assert len(feed_bursts(codec, [1, 2], node=9)) == 5
    event = feed_bursts(make(tpdos=[1, 4]), [1, 2, 3, 4])[-1]
    assert isinstance(event, Measurement)
    assert event.accel_m_s2 is not None
    assert (event.gyro_rad_s, event.euler_rad) == (None, None)


def test_heartbeats_are_news_when_the_state_changes_or_is_not_operational() -> None:
    codec = make()
    states = [5, 5, 0x7F, 0x7F, 5, 5, 4, 0, 5]
    told = [state for state in states if codec.feed_frame(0x708, False, bytes([state]), 0)]
    assert (told, codec.ledger.frames_ignored) == ([0x7F, 0x7F, 5, 4, 0, 5], 3)
    assert codec.feed_frame(0x708, False, b"", 0) == (BadFrame(BadReason.LENGTH, b"", 0x708),)
    assert codec.ledger.closes()
    codec = make()
    feed_bursts(codec, [1, 2, 3])
    codec.feed_frame(0x188, False, bytes(6), 60 * MS)
    assert codec.ledger.frames_pending == 1
    assert codec.feed_frame(0x708, False, b"\0", 60 * MS)
    assert codec.ledger.frames_pending == 0
    assert not codec.flush()


@pytest.mark.manual("B 5.4.2 SYNC", "B 5.1 defaults")
def test_filters_sync_nodes_and_options_of_the_row() -> None:
    filters = DRIVER.filters(HipnucCanopenOptions(node=1))
    taken = [can_id for can_id in range(0x800) if any(wanted.matches(can_id, False) for wanted in filters)]
    assert taken == [0x081, 0x181, 0x281, 0x381, 0x481, 0x581, 0x681, 0x701, 0x781]
    assert DRIVER.cyclic(HipnucCanopenOptions()) == []
    assert DRIVER.cyclic(HipnucCanopenOptions(sync_hz=150)) == [CyclicFrame(0x80, False, b"", 6_667_000)]
    assert DRIVER.cyclic(HipnucCanopenOptions(sync_hz=0.01)) == [CyclicFrame(0x80, False, b"", 100_000_000_000)]
    assert DRIVER.node_settings(12) == HipnucCanopenOptions(node=12)
    assert DRIVER.node_title(12) == "node 12"
    for can_id, size, node in (
        (0x188, 6, 8), (0x1FF, 6, 127), (0x180, 6, None), (0x188, 8, None), (0x688, 4, 8), (0x788, 8, 8),
        (0x588, 8, None),
    ):  # fmt: skip
        assert DRIVER.node_of(can_id, False, bytes(size)) == node
        assert DRIVER.node_of(can_id, True, bytes(size)) is None
    for bad in ({"node": 0}, {"node": 128}, {"tpdos": [5]}, {"tpdos": "all"}, {"sync_hz": 201}, {"sync_hz": 5e-324}):
        with pytest.raises(msgspec.ValidationError):
            make(**bad)


SIZES = {0x188: 6, 0x288: 6, 0x388: 6, 0x488: 8, 0x688: 4, 0x788: 8}
BURSTS = 60
G_M_S2 = 9.8


def scaled(values: dict[str, float], names: str, factor: float) -> list[float]:
    return [values[name] * factor for name in names.split()]


def test_random_payloads_decode_alike() -> None:
    database = cantools.database.load_file(shared("hipnuc-canopen.dbc"))
    assert isinstance(database, cantools.database.Database)
    assert {message.frame_id: message.length for message in database.messages} == SIZES
    codec, random = HipnucCanopenCodec(Ledger(), HipnucCanopenOptions()), Random(7)
    compared = 0
    for burst in range(BURSTS):
        values: dict[str, float] = {}
        for place, (can_id, size) in enumerate(SIZES.items()):
            data = random.randbytes(size)
            if can_id == 0x488:
                data = struct.pack("<4h", *(round(10_000 * part) for part in random_quaternion(random)))
            if can_id == 0x788:  # inside a full turn
                data = struct.pack("<2i", random.randint(-36_000, 36_000), random.randint(-36_000, 36_000))
            decoded = database.decode_message(can_id, data)
            assert isinstance(decoded, dict)
            for name, value in decoded.items():
                assert isinstance(value, int | float)
                values[name] = value
            events = codec.feed_frame(can_id, False, data, burst * 10_000_000 + place * 250_000)
        for m in events:
            assert isinstance(m, Measurement)
            assert m.accel_m_s2 == pytest.approx(scaled(values, "Acc_X Acc_Y Acc_Z", G_M_S2), rel=1e-12)
            assert m.gyro_rad_s == pytest.approx(scaled(values, "Gyr_X Gyr_Y Gyr_Z", math.pi / 180), rel=1e-12)
            assert m.euler_rad == pytest.approx(scaled(values, "Roll Pitch Yaw", math.pi / 180), rel=1e-12)
            assert m.quat_wxyz == pytest.approx(scaled(values, "Quat_W Quat_X Quat_Y Quat_Z", 1), rel=1e-12)
            is_pressure = 1_000 <= values["Pressure"] <= 120_000
            assert m.pressure_pa == (values["Pressure"] if is_pressure else None)
            assert m.incli_rad == pytest.approx(scaled(values, "Incli_X Incli_Y", math.pi / 180), rel=1e-12)
            compared += len(values)
    assert len(values) == 16
    assert compared == 16 * (BURSTS - 8)  # imud learns during the other bursts
