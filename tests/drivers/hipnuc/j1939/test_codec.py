"""J1939 messages of the manual with SI values computed by hand, and the codec that makes samples of them."""

import math
from random import Random

import msgspec
import pytest

from imud.attitude.rotation import quat_normalized
from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.contracts.script import ReplyFrame
from imud.drivers.hipnuc.j1939 import codec as messages
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Codec, HipnucJ1939Options, encode
from imud.drivers.hipnuc.j1939.driver import DRIVER
from imud.formats.j1939 import J1939Id, join
from imud.model.ledger import Ledger
from imud.model.sample import Measurement, Position, values_of
from tests.support.files import shared

MS = 1_000_000
NONE = bytes([0xFF]) * 8
UTC_NS = 1_741_964_966_535_000_000  # 2025-03-14 15:09:26.535, `date -u -d @1741964966`


def measured(pgn: int, data: str) -> Measurement:
    return messages.measurement_of([(pgn, bytes.fromhex(data))])


def make(**options: object) -> HipnucJ1939Codec:
    return HipnucJ1939Codec(Ledger(), msgspec.convert(options, HipnucJ1939Options))


def feed(codec: HipnucJ1939Codec, frames: list[tuple[int, bytes]], t_ns: int) -> list[CodecEvent]:
    events: list[CodecEvent] = []
    for place, (can_id, data) in enumerate(frames):
        events += codec.feed_frame(can_id, True, data, t_ns + place * 300_000)
        assert codec.ledger.closes()
    return events


def burst(value: int, address: int = 8, *more: tuple[int, bytes]) -> list[tuple[int, bytes]]:
    """Return the four messages of every device; `value` is roll in counts and identifies the sample."""
    rows = (
        (messages.ACCEL, bytes.fromhex("000000000008") + bytes(2)), (messages.GYRO, bytes(8)),
        (messages.ROLL_PITCH, value.to_bytes(4, "little") + bytes(4)), (messages.HEADING, bytes(8)),
    )  # fmt: skip
    return [encode(pgn, data, address) for pgn, data in (*rows, *more)]


def counts(events: list[CodecEvent]) -> list[int]:
    """Return `value` of each sample."""
    rolls = [event.euler_rad[0] for event in events if isinstance(event, Measurement) and event.euler_rad]
    return [round(math.degrees(roll) * 1000) for roll in rolls if not math.isnan(roll)]


def learned(**options: object) -> HipnucJ1939Codec:
    """Return a codec that has learned the bursts; the next burst starts at 100 ms."""
    codec = make(**options)
    for n in range(10):
        feed(codec, burst(n), n * 10 * MS)
    return codec


@pytest.mark.manual("B 6.1.1 FF34", "B 6.1.2 FF37", "B 6.1.3 FF3D", "B 6.1.5 FF4A")
def test_messages_in_si_units() -> None:
    # 2048 · 0.00048828 = 0.99999744 G · 9.8; -2048; 1 count = 0.0047851 m/s²
    accel = measured(0xFF34, "0008 00f8 0100 ffff").accel_m_s2
    assert accel == pytest.approx((9.799974912, -9.799974912, 0.004785144), abs=1e-12)
    # 1000 · 0.061035 = 61.035 °/s = 1.06526171… rad/s; -16384 → -999.99744 °/s
    gyro = measured(0xFF37, "e803 00c0 ffff 0000").gyro_rad_s
    assert gyro == pytest.approx((1.0652617, -17.4532478, -0.00106526171), abs=1e-7)
    # 8.701° and -33.058°
    assert measured(0xFF4A, "fd210000de7effff").incli_rad == pytest.approx((0.15186110, -0.57697094), abs=1e-8)
    assert measured(0xFF4A, "407e0500ffffff7f").incli_rad == pytest.approx((6.2831853, math.nan), nan_ok=True)
    assert measured(0xFF4A, "ffffff7fffffff7f").incli_rad is None
    # 1000 · 0.030517 µT
    assert measured(0xFF3A, "e80318fc01000000").mag_t == pytest.approx((3.0517e-5, -3.0517e-5, 3.0517e-8), abs=1e-15)
    air = measured(0xFF43, "c409000052c59a00")  # 2500; bytes 4 to 7 are reserved, also if they look like a pressure
    assert (air.temperature_c, air.pressure_pa) == (25.0, None)
    assert measured(0xFF43, "18fc000052c59a00").temperature_c == pytest.approx(-10.0)


@pytest.mark.manual("B 6.1.3 FF3D")
def test_attitude() -> None:
    # roll 10.5°, pitch -20.25°; heading 90° clockwise is yaw -90°
    both = [(0xFF3D, bytes.fromhex("04290000e6b0ffff")), (0xFF41, bytes.fromhex("905f010000000000"))]
    found = messages.measurement_of(both)
    assert found.euler_rad == pytest.approx((0.1832595715, -0.3534291735, -1.5707963268), abs=1e-9)
    # by hand: z ⊗ x = (0.696095, -0.124306, 0.124306, -0.696095), and that ⊗ (0.995805, 0, 0.091502, 0)
    assert found.quat_wxyz == pytest.approx((0.681801, -0.060091, 0.187479, -0.704549), abs=2e-6)
    assert (found.size_bytes, found.dev_ticks) == (16, None)
    sent = measured(0xFF46, "881300008813f01b")  # 0.5, 0, 0.5, 0.7152: length 1.0055
    assert sent.quat_wxyz == pytest.approx((0.5, 0.0, 0.5, 0.7152))
    assert sent.euler_rad is None
    # the quaternion of the device has priority over the computed quaternion
    three = [(0xFF3D, bytes(8)), (0xFF41, bytes(8)), (0xFF46, bytes.fromhex("0000102700000000"))]
    assert messages.measurement_of(three).quat_wxyz == pytest.approx((0, 1, 0, 0))
    assert messages.measurement_of(three[:2]).quat_wxyz == (1, 0, 0, 0)
    assert messages.measurement_of(three[:1]).quat_wxyz is None  # no heading, no attitude


@pytest.mark.parametrize(
    ("clockwise", "yaw_deg"),
    [(0, 0.0), (1, -0.001), (90_000, -90.0), (180_000, -180.0), (180_001, 179.999), (270_000, 90.0), (359_999, 0.001),
     (360_000, 0.0)],
)  # fmt: skip
@pytest.mark.manual("B 6.1.4 FF41")
def test_heading_is_clockwise_and_yaw_is_not(clockwise: int, yaw_deg: float) -> None:
    for second in (0, -1, 12345):  # the codec ignores the other bytes
        data = clockwise.to_bytes(4, "little") + second.to_bytes(4, "little", signed=True)
        found = messages.measurement_of([(0xFF41, data)]).euler_rad
        assert found is not None
        assert found[2] == pytest.approx(math.radians(yaw_deg), abs=1e-12)
        assert all(map(math.isnan, found[:2]))


def test_packing_gives_the_golden_messages_and_clips_them() -> None:
    for yaw_deg in (-179.5, -90, -0.001, 0, 45.25, 179.999):
        data = messages.pack_heading(math.radians(yaw_deg))
        assert int.from_bytes(data[:4], "little") == round(-yaw_deg * 1000) % 360_000
        assert int.from_bytes(data[4:], "little", signed=True) == round(yaw_deg * 1000)
        assert messages.pack_heading(math.radians(yaw_deg), twice=False) == data[:4] + bytes(4)
    assert messages.pack_accel((9.8, -9.8, 0.0048)) == bytes.fromhex("000800f801000000")
    assert messages.pack_gyro((math.radians(61.035), -1e9, 1e9)).hex() == "e8030080ff7f0000"
    assert messages.pack_roll_pitch(math.radians(10.5), math.radians(-20.25)).hex() == "04290000e6b0ffff"
    assert messages.pack_temperature(25.0).hex() == "c4090000e7030000"
    packed = (
        messages.pack_roll_pitch(1e9, -1e9),
        messages.pack_temperature(1e9),
        messages.pack_quaternion((9, -9, 0, 0)),
    )
    assert [data[:8].hex() for data in packed] == ["ffffff7f00000080", "ff7f0000e7030000", "ff7f008000000000"]
    assert messages.pack_utc(UTC_NS).hex() == "19030e0f091a1702"


def test_absent_is_not_zero_and_one_negative_count_is_a_value() -> None:
    for pgn, data, field in (
        (0xFF34, NONE, "accel_m_s2"), (0xFF37, NONE, "gyro_rad_s"), (0xFF3A, NONE, "mag_t"),
        (0xFF3A, bytes(8), "mag_t"), (0xFF3D, bytes.fromhex("ffffff7fffffff7f"), "euler_rad"),
        (0xFF3D, bytes.fromhex("0000008000000080"), "euler_rad"), (0xFF41, NONE, "euler_rad"),
        (0xFF41, bytes.fromhex("000000fe00000000"), "euler_rad"),
        (0xFF41, bytes.fromhex("417e050000000000"), "euler_rad"),  # 360.001°
        (0xFF3A, bytes.fromhex("ffffffffffff0000"), "mag_t"), (0xFF3A, bytes.fromhex("ff7fff7fff7f0000"), "mag_t"),
        (0xFF34, b"\x7f" * 8, "accel_m_s2"), (0xFF37, bytes.fromhex("0080008000800000"), "gyro_rad_s"),
        (0xFF3D, NONE, "euler_rad"), (0xFF4A, NONE, "incli_rad"),
        (0xFF43, NONE, "temperature_c"), (0xFF43, NONE, "pressure_pa"), (0xFF43, bytes(8), "temperature_c"),
        (0xFF43, bytes(8), "pressure_pa"), (0xFF43, bytes.fromhex("ff7f000000000000"), "temperature_c"),
        (0xFF46, NONE, "quat_wxyz"), (0xFF46, bytes(8), "quat_wxyz"),
        (0xFF46, bytes.fromhex("ff7f000000000000"), "quat_wxyz"),
    ):  # fmt: skip
        assert getattr(messages.measurement_of([(pgn, data)]), field) is None
    assert measured(0xFF37, "ffffffffffff0000").gyro_rad_s == pytest.approx((-0.00106526,) * 3, abs=1e-8)
    assert measured(0xFF34, "ffffffffffff0000").accel_m_s2 == pytest.approx((-0.00478514,) * 3, abs=1e-8)
    assert measured(0xFF3D, "ffffffff00000000").euler_rad == pytest.approx((-1.74532925e-5, 0, math.nan), nan_ok=True)
    assert measured(0xFF3D, "407e0500c081faff").euler_rad == pytest.approx((math.tau, -math.tau, math.nan), nan_ok=True)
    assert measured(0xFF3D, "00000000ffffff7f").euler_rad == pytest.approx((0, math.nan, math.nan), nan_ok=True)
    assert measured(0xFF43, "00000000e7030000").temperature_c == 0.0  # with the placeholder it is 0 °C
    # counts of 0.01 °C up to 150 °C
    assert [measured(0xFF43, f"{counts}000000000000").temperature_c for counts in ("983a", "993a")] == [150.0, None]


SIGNALS = {"Acc": ("accel_m_s2", 9.8), "Gyr": ("gyro_rad_s", math.pi / 180), "Mag": ("mag_t", 1e-6)}


def test_the_vendors_signal_definitions_agree() -> None:
    cantools = pytest.importorskip("cantools")
    database = cantools.database.load_file(shared("hipnuc-j1939.dbc"))
    random, compared = Random(6), 0
    for pgn in messages.MEASURED:
        definition = database.get_message_by_frame_id(encode(pgn, b"")[0])
        for _ in range(50):
            data = some_payload(pgn, random)
            theirs = definition.decode(data)
            ours = messages.measurement_of([(pgn, data)])
            compared += compare(ours, theirs)
    # all signals without the pressure, which newer definitions replace by reserved bytes
    assert compared == 50 * (3 + 3 + 3 + 2 + 1 + 1 + 4 + 2)
    theirs = database.decode_message(encode(messages.UTC, b"")[0], messages.pack_utc(UTC_NS))
    expected = {"Year": 25, "Month": 3, "Day": 14, "Hour": 15, "Minute": 9, "Second": 26, "Millisecond": 535}
    assert theirs == {f"UTC_{name}": value for name, value in expected.items()}


def some_payload(pgn: int, random: Random) -> bytes:
    """Return random counts within the valid range."""
    if pgn in (messages.ROLL_PITCH, messages.INCLINOMETER):
        return messages.TWO_ANGLES.pack(random.randint(-360_000, 360_000), random.randint(-360_000, 360_000))
    if pgn == messages.HEADING:
        return random.randint(0, 360_000).to_bytes(4, "little") + random.randbytes(4)
    if pgn == messages.TEMPERATURE:
        return messages.TEMPERATURE_LAYOUT.pack(random.randint(-9000, 9000), 7, random.randint(10**5, 12 * 10**6))
    if pgn == messages.QUATERNION:
        w, x, y, z = quat_normalized((random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1), 0.1))
        return messages.pack_quaternion((w, x, y, z))
    return random.randbytes(8)


def compare(ours: Measurement, theirs: dict[str, float]) -> int:
    """Check that all signals are equal. Return their number."""
    values: dict[str, float] = {}
    for prefix, (field, factor) in SIGNALS.items():
        if (vector := getattr(ours, field)) is not None:
            values |= {f"{prefix}_{axis}": value / factor for axis, value in zip("XYZ", vector, strict=True)}
    if ours.euler_rad is not None:
        roll, pitch, yaw = map(math.degrees, ours.euler_rad)
        values |= {"Roll": roll, "Pitch": pitch} if math.isfinite(roll) else {"Yaw_360": -yaw % 360}
    if ours.incli_rad is not None:
        values |= {"Incli_X": math.degrees(ours.incli_rad[0]), "Incli_Y": math.degrees(ours.incli_rad[1])}
    if ours.quat_wxyz is not None:
        values |= {f"Quat_{axis}": value for axis, value in zip("WXYZ", ours.quat_wxyz, strict=True)}
    if ours.temperature_c is not None:
        values |= {"Temperature": ours.temperature_c}
    for name, value in values.items():
        there = theirs[name] % 360 if name == "Yaw_360" else theirs[name]
        assert value == pytest.approx(there, rel=1e-9, abs=1e-9), name
    return len(values)


@pytest.mark.manual("B 6 identifiers")
def test_a_burst_of_any_priority_makes_a_sample() -> None:
    codec = learned()
    (sample,) = feed(codec, burst(1234), 100 * MS)
    assert isinstance(sample, Measurement)
    assert sample.accel_m_s2 == pytest.approx((0, 0, 9.799974912))
    assert sample.gyro_rad_s == (0, 0, 0)
    assert (counts([sample]), sample.size_bytes) == ([1234], 32)
    codec = learned()
    frames = [(can_id & 0x03FFFFFF | priority << 26, data) for priority, (can_id, data) in enumerate(burst(77), 4)]
    assert counts(feed(codec, frames, 100 * MS)) == [77]
    pgns = (0xFF34, 0xFF37, 0xFF3D, 0xFF41, 0xFF4A)
    assert [encode(pgn, b"")[0] for pgn in pgns] == [0x0CFF3408, 0x0CFF3708, 0x0CFF3D08, 0x0CFF4108, 0x0CFF4A08]
    codec = learned()
    utc = encode(messages.UTC, messages.pack_utc(UTC_NS))
    (sample,) = feed(codec, [utc, *burst(5)], 100 * MS)
    assert isinstance(sample, Measurement)
    assert (counts([sample]), sample.gnss_utc_ns, codec.ledger.frames_ignored) == ([5], UTC_NS, 0)
    # another FF2F replaces the first one; a sample 3 ms later is from another instant
    for frames, start_ms in (([utc, utc], 107), ([utc], 117)):
        feed(codec, frames, start_ms * MS)
        (sample,) = feed(codec, burst(6), (start_ms + 3) * MS)
        assert isinstance(sample, Measurement)
        assert sample.gnss_utc_ns is None
    codec.reset()
    assert (codec.ledger.frames_ignored, codec.ledger.frames_pending) == (3, 0)


def test_a_time_without_a_date_is_the_uptime_and_neither_utc_nor_a_loss() -> None:
    """Newer firmware without GNSS sends the uptime modulo 24 h. The last day ends after 50 of 100 samples."""
    codec, found = learned(), list[Measurement]()
    for n in range(100):
        uptime = encode(messages.UTC, messages.pack_uptime(86_400_000 - 500 + 10 * n))
        found += [one for one in feed(codec, [uptime, *burst(n)], (100 + 10 * n) * MS) if isinstance(one, Measurement)]
    assert messages.pack_uptime(86_400_000 - 1).hex() == "000000173b3be703"
    assert messages.pack_uptime(86_400_000) == bytes(8)
    assert counts(list(found)) == list(range(100))
    assert all(one.gnss_utc_ns is None for one in found)
    assert (codec.ledger.lost(), codec.ledger.frames_ignored) == (0, 100)
    for data in ("000000173b3be703", "0000000000000000", "190d0e0f091a1702", "19030e18091a1702",
                 "19030e0f091ae803", "19030e0f093d1702", "ffffffffffffffff"):  # fmt: skip
        assert messages.utc_of(bytes.fromhex(data)) is None
    assert messages.utc_of(bytes.fromhex("19030e0f091a1702")) == UTC_NS


def parts(position: Position | None) -> tuple[object, ...]:
    """Return the values of a position, its angles rounded to 0.6 m."""
    assert position is not None
    return round(position.latitude_rad, 7), round(position.longitude_rad, 7), *values_of(position)[2:]


def test_position_and_velocity_by_hand() -> None:
    """-33.5° and 151.25°, 520.25 m, quality 4 with 17 satellites; 1.50, -0.25 and 0.05 m/s."""
    place, height = (0xFF10, bytes.fromhex("404e08ec20eb265a")), (0xFF14, bytes.fromhex("39cb0000d7119600"))
    state, velocity = (0xFF18, bytes.fromhex("0405110f03ffffff")), (0xFF26, bytes.fromhex("9600e7ff05009800"))
    found = messages.measurement_of([place, height, state, velocity])
    assert parts(found.position) == (-0.5846853, 2.6398105, 520.25, 4, 17)
    assert found.velocity_enu_m_s == pytest.approx((1.5, -0.25, 0.05))
    assert parts(messages.measurement_of([place]).position) == (-0.5846853, 2.6398105, None, None, None)
    for counts_of_place, is_valid in (
        ((900_000_000, 1), True), ((900_000_001, 1), False), ((1, -1_800_000_000), True), ((1, -1_800_000_001), False),
        ((0, 0), False), ((-1, -1), False),  # no position; not available
    ):  # fmt: skip
        data = messages.TWO_ANGLES.pack(*counts_of_place)
        assert (messages.measurement_of([(0xFF10, data), state]).position is not None) == is_valid
    assert messages.measurement_of([height, state]).position is None
    for height_data in (NONE, bytes.fromhex("8096980000000000")):  # not available, 100 km
        position = messages.measurement_of([place, (0xFF14, height_data), (0xFF18, NONE)]).position
        assert parts(position) == (-0.5846853, 2.6398105, None, None, None)
    for data in (NONE, bytes.fromhex("ff7fff7fff7f0000")):
        assert messages.measurement_of([(0xFF26, data)]).velocity_enu_m_s is None
    known = Position(math.radians(-33.5), math.radians(151.25), 520.25, 4, 17)
    assert messages.pack_place(known) == place[1]
    assert messages.pack_height(known)[:4] == height[1][:4]
    assert messages.pack_gnss(known).hex() == "0400110003000000"
    assert messages.pack_velocity((1.5, -0.25, 0.05)) == velocity[1]


def test_samples_of_several_modules_slow_messages_and_loss() -> None:
    codecs = {address: make(address=address) for address in (8, 9, 128, 1)}
    found: dict[int, list[int]] = {address: [] for address in codecs}
    for n in range(20):
        mixed = zip(*(burst(1000 * address + n, address) for address in codecs), strict=True)
        frames = [frame for group in mixed for frame in group]
        for address, codec in codecs.items():
            found[address] += counts(feed(codec, frames, n * 20 * MS))
            assert codec.ledger.bytes_skipped == (n + 1) * 3 * 32
    for address, values in found.items():
        assert values == [1000 * address + n for n in range(20)]

    codec = make()
    slow = messages.TEMPERATURE, messages.pack_temperature(21.5)
    events: list[CodecEvent] = []
    for n in range(100):
        events += feed(codec, burst(n, 8, *([slow] if n % 10 == 0 else [])), n * 10 * MS)
    samples = [event for event in events if isinstance(event, Measurement)]
    warm = [(event.t_first_ns or 0) // (10 * MS) for event in samples if event.temperature_c is not None]
    assert warm == [10 * n for n in range(10)]
    assert all(event.accel_m_s2 for event in samples[-75:])
    assert codec.ledger.lost() == 0

    for missing in range(4):
        codec, frames = learned(), burst(50)
        del frames[missing]
        assert counts(feed(codec, frames, 100 * MS)) == []
        assert counts(feed(codec, burst(51), 110 * MS)) == [50, 51][missing == 2 :]  # the third frame has the roll
        assert codec.ledger.frames_ignored == codec.ledger.lost() == 0


def test_which_frames_count_and_options_that_mean_nothing() -> None:
    codec = make()
    assert codec.feed_frame(0x0CFF3408, True, b"\1\2\3", 0) == (BadFrame(BadReason.LENGTH, b"\1\2\3", 0x0CFF3408),)
    skipped = [(0x0CFF3508, True), (0x0CFF3409, True), (0x0CEF0855, True), (0x0DFF3408, True), (0x0CFF3408, False)]
    for can_id, extended in skipped:
        assert not codec.feed_frame(can_id, extended, bytes(8), 0)
    assert (codec.ledger.bytes_skipped, codec.ledger.frames_bad_length) == (8 * len(skipped), 1)
    assert codec.unknown == {0xFF35: 1, 0x1FF34: 1}
    assert codec.ledger.closes()
    reply = bytes.fromhex("3701060064000000")
    for options, destinations in (({}, [0x55]), ({"host_address": 0x20}, [0x55, 0x20])):
        codec = make(**options)
        for destination in destinations:
            can_id = join(J1939Id(6, 0xEF00, 8, destination))
            assert codec.feed_frame(can_id, True, reply, 0) == (ReplyFrame(can_id, reply),)
        assert codec.ledger.frames_in_replies == len(destinations)
        assert not codec.feed_frame(join(J1939Id(6, 0xEF00, 8, 0x21)), True, reply, 0)

    codec = learned(pgns=["FF34", "FF3D"])
    (sample,) = feed(codec, burst(5), 100 * MS)
    assert isinstance(sample, Measurement)
    assert (sample.gyro_rad_s, sample.size_bytes) == (None, 16)
    assert [f.can_id >> 8 for f in DRIVER.filters(HipnucJ1939Options(pgns=("FF34", "FF3D")))] == [
        0xFF2F, 0xFF34, 0xFF3D, 0xEF55,
    ]  # fmt: skip

    assert DRIVER.node_of(0x18FF3D05, True, bytes(8)) == 5
    for can_id, extended, size in [
        (0x0CFF3405, False, 8), (0x0CFF3405, True, 6), (0x0CFF2F05, True, 8), (0x0CEF5505, True, 8),
        (0x0CFF34FE, True, 8),
    ]:  # fmt: skip
        assert DRIVER.node_of(can_id, extended, bytes(size)) is None
    assert DRIVER.node_settings(5) == HipnucJ1939Options(address=5)
    assert DRIVER.node_title(5) == "address 5"
    empty: dict[str, object] = {"pgns": []}
    for wrong in ({"address": 254}, empty, {"pgns": ["FF2F"]}, {"pgns": "all"}, {"node": 8}):
        with pytest.raises(msgspec.ValidationError):
            make(**wrong)
