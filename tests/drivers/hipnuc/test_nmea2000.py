"""PGNs 127250, 127251 and 127257: values by hand, invalid values, an independent library in both directions, and
SIDs.
"""

import math
import struct
from itertools import product
from random import Random

import msgspec
import pytest

from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.drivers.hipnuc import nmea2000 as messages
from imud.drivers.hipnuc.nmea2000 import encode
from imud.formats.nmea2000 import ATTITUDE, HEADING, RATE_OF_TURN, Reference
from imud.model.ledger import Ledger
from imud.model.sample import Measurement

MS = 1_000_000
Frame = tuple[int, bytes]


def measured(*rows: tuple[int, str]) -> Measurement:
    return messages.measurement_of([(pgn, bytes.fromhex(data)) for pgn, data in rows])


def make(**options: object) -> messages.HipnucNmea2000Codec:
    return messages.HipnucNmea2000Codec(Ledger(), msgspec.convert(options, messages.HipnucNmea2000Options))


def burst(
    value: int, source: int = 35, *, sids: tuple[int, int, int] | None = None, reference: Reference = Reference.TRUE
) -> list[Frame]:
    """Return the three messages; `value` is roll in counts and identifies the sample."""
    a, b, c = sids or (value % 253,) * 3
    return [
        encode(HEADING, messages.pack_heading(a, 0.5, reference), source),
        encode(RATE_OF_TURN, messages.pack_rate_of_turn(b, 0.1), source),
        encode(ATTITUDE, messages.pack_attitude(c, (value * 1e-4, 0.0, -1.0)), source),
    ]


def feed(codec: messages.HipnucNmea2000Codec, frames: list[Frame], t_ns: int) -> list[int]:
    events: list[CodecEvent] = []
    for place, (can_id, data) in enumerate(frames):
        events += codec.feed_frame(can_id, True, data, t_ns + place * MS // 2)
        assert codec.ledger.closes()
    rolls = [event.euler_rad[0] for event in events if isinstance(event, Measurement) and event.euler_rad]
    return [round(roll * 1e4) for roll in rolls if not math.isnan(roll)]


def learned(**options: object) -> messages.HipnucNmea2000Codec:
    """Return a codec that has learned the bursts; the next burst starts at 1 s."""
    codec = make(**options)
    for n in range(-5, 10):
        feed(codec, burst(n), n * 100 * MS)
    return codec


def test_heading_clockwise_from_north_rate_of_turn_and_attitude() -> None:
    for counts, yaw_rad in (
        (0, 0.0), (1, -0.0001), (15708, -1.5708), (31415, -3.1415), (31416, 3.141585307), (62831, 0.000085307),
    ):  # fmt: skip
        data = struct.pack("<BHhhB", 1, counts, 0x7FFF, 0x7FFF, 0xFD)
        found = messages.measurement_of([(HEADING, data)])
        assert found.euler_rad == pytest.approx((math.nan, math.nan, yaw_rad), nan_ok=True, abs=1e-9)
        assert (found.quat_wxyz, found.gyro_rad_s) == (None, None)
    # The y axis of the sensor is the bow: heading 90° and pitch 30° point it east and up
    # 3200000 · 3.125e-8 = 0.1 rad/s to starboard
    found = measured((RATE_OF_TURN, "05 00d43000 ffffff"))
    assert found.gyro_rad_s == pytest.approx((math.nan, math.nan, -0.1), nan_ok=True)
    assert found.euler_rad is None
    # yaw 1 rad clockwise, pitch -0.02 (bow down), roll 0.03 (starboard down)
    found = measured((ATTITUDE, "05 1027 38ff 2c01 ff"))
    assert found.euler_rad == pytest.approx((0.03, -0.02, -1.0))
    # half angles 0.015, -0.01, -0.5: z ⊗ x = (0.877539, -0.008775, 0.004794, -0.479402)
    assert found.quat_wxyz == pytest.approx((0.877368, -0.001584, 0.017956, -0.479480), abs=3e-6)
    assert found.size_bytes == 8

    rows = [(HEADING, messages.pack_heading(0, -math.pi / 2, Reference.TRUE)),
            (ATTITUDE, messages.pack_attitude(0, (0.0, math.pi / 6, 0.0)))]  # fmt: skip
    w, x, y, z = messages.measurement_of(rows).quat_wxyz or (0, 0, 0, 0)
    bow = (2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x))
    assert bow == pytest.approx((math.cos(math.pi / 6), 0, 0.5), abs=1e-4)


def test_the_heading_has_priority_over_the_yaw_of_the_attitude() -> None:
    attitude = (ATTITUDE, "05 1027 0000 0000 ff")
    for order in ((0, 1), (1, 0)):
        rows = [attitude, (HEADING, "05 983a ff7f ff7f fd")]  # 1.5 rad
        found = measured(*(rows[place] for place in order)).euler_rad
        assert found == pytest.approx((0, 0, -1.5))
    rows = [attitude, (HEADING, "05 ffff ff7f ff7f fd")]
    assert measured(*rows).euler_rad == pytest.approx((0, 0, math.nan), nan_ok=True)
    data = bytes.fromhex(attitude[1])
    elsewhere = messages.measurement_of([(ATTITUDE, data)], heading_elsewhere=True).euler_rad
    assert elsewhere == pytest.approx((0, 0, math.nan), nan_ok=True)


def test_the_three_highest_values_are_absent_and_the_next_lower_values_are_values() -> None:
    for last in ("ff", "fe", "fd"):
        assert measured((HEADING, f"05 {last}ff ff7f ff7f fd")).euler_rad is None
        assert measured((RATE_OF_TURN, f"05 {last}ffff7f ffffff")).gyro_rad_s is None
        assert measured((ATTITUDE, f"05 {last}7f {last}7f {last}7f ff")).euler_rad is None
        only_roll = measured((ATTITUDE, f"05 {last}7f {last}7f 2c01 ff"))
        assert only_roll.euler_rad == pytest.approx((0.03, math.nan, math.nan), nan_ok=True)
        assert only_roll.quat_wxyz is None
    assert measured((HEADING, "05 70f5 ff7f ff7f fd")).euler_rad is not None
    assert measured((HEADING, "05 71f5 ff7f ff7f fd")).euler_rad is None  # beyond a full turn
    gyro = measured((RATE_OF_TURN, "05 fcffff7f ffffff")).gyro_rad_s
    assert gyro is not None
    assert gyro[2] == pytest.approx(-67.108864, abs=1e-6)
    euler = measured((ATTITUDE, "05 fc7f fc7f 0080 ff")).euler_rad
    assert euler == pytest.approx((-3.2768, 3.2764, -3.2764 + math.tau))
    assert measured((HEADING, "05 983a ff7f ff7f fe")).euler_rad is None


@pytest.mark.manual("B 7 NMEA 2000")
def test_the_library_decodes_our_messages() -> None:
    pgns = pytest.importorskip("nmea2000.pgns")
    random = Random(1)
    for _ in range(25):
        sid, rate = random.randrange(253), random.uniform(-3, 3)
        yaw, pitch, roll = random.uniform(-3, 3), random.uniform(-1.5, 1.5), random.uniform(-3, 3)
        rows = (
            (pgns.decode_pgn_127250, messages.pack_heading(sid, yaw, Reference.MAGNETIC)),
            (pgns.decode_pgn_127251, messages.pack_rate_of_turn(sid, rate)),
            (pgns.decode_pgn_127257, messages.pack_attitude(sid, (roll, pitch, yaw))),
        )
        fields: dict[str, object] = {}
        for decode, data in rows:
            fields |= {field.id: field.value for field in decode(int.from_bytes(data, "little"), 64).fields}
        assert fields["sid"] == sid
        assert fields["heading"] == pytest.approx(-yaw % math.tau, abs=5.1e-5)
        assert fields["reference"] == "Magnetic"
        assert fields["deviation"] is fields["variation"] is None
        assert fields["rate"] == pytest.approx(-rate, abs=1.6e-8)
        assert fields["yaw"] == pytest.approx(-yaw, abs=5.1e-5)
        assert fields["pitch"] == pytest.approx(pitch, abs=5.1e-5)
        assert fields["roll"] == pytest.approx(roll, abs=5.1e-5)


@pytest.mark.manual("B 7 NMEA 2000")
def test_we_decode_messages_of_the_library() -> None:
    pgns = pytest.importorskip("nmea2000.pgns")
    random = Random(2)
    for _ in range(25):
        heading, rate = random.uniform(0, 6.28), random.uniform(-3, 3)
        yaw, pitch, roll = random.uniform(-3, 3), random.uniform(-1.5, 1.5), random.uniform(-3, 3)
        rows = []
        for pgn, template, values in (
            (HEADING, messages.pack_heading(7, 0.0, Reference.TRUE), {"heading": heading}),
            (RATE_OF_TURN, messages.pack_rate_of_turn(7, 0.0), {"rate": rate}),
            (ATTITUDE, messages.pack_attitude(7, (0.0, 0.0, 0.0)), {"yaw": yaw, "pitch": pitch, "roll": roll}),
        ):
            message = getattr(pgns, f"decode_pgn_{pgn}")(int.from_bytes(template, "little"), 64)
            for name, value in values.items():
                field = message.get_field_by_id(name)
                field.value, field.raw_value = value, None
            rows.append((pgn, getattr(pgns, f"encode_pgn_{pgn}")(message)))
        assert all(len(data) == 8 for _, data in rows)
        found = messages.measurement_of(rows)
        expected = -heading if heading <= math.pi else math.tau - heading
        assert found.euler_rad == pytest.approx((roll, pitch, expected), abs=1.1e-4)
        assert found.gyro_rad_s == pytest.approx((math.nan, math.nan, -rate), nan_ok=True, abs=5e-8)
        alone = messages.measurement_of(rows[2:]).euler_rad
        assert alone == pytest.approx((roll, pitch, -yaw), abs=1.1e-4)


def test_the_library_and_we_agree_on_absent_values() -> None:
    pgns = pytest.importorskip("nmea2000.pgns")
    for pgn, filler in product((HEADING, RATE_OF_TURN, ATTITUDE), (b"\xff", b"\x7f")):
        found = messages.measurement_of([(pgn, b"\x01" + filler * 7)])
        assert (found.euler_rad, found.gyro_rad_s, found.quat_wxyz) == (None, None, None)
    for last in range(0xF8, 0x100):
        heading = bytes([1, last, 0xFF, 0xFF, 0x7F, 0xFF, 0x7F, 0xFD])
        rate = bytes([1, last, 0xFF, 0xFF, 0x7F, 0xFF, 0xFF, 0xFF])
        attitude = bytes([1, last, 0x7F, last, 0x7F, last, 0x7F, 0xFF])
        for pgn, data, name, field in (
            (HEADING, heading, "heading", "euler_rad"),
            (RATE_OF_TURN, rate, "rate", "gyro_rad_s"),
            (ATTITUDE, attitude, "roll", "euler_rad"),
        ):
            message = getattr(pgns, f"decode_pgn_{pgn}")(int.from_bytes(data, "little"), 64)
            theirs = message.get_field_by_id(name).value
            ours = getattr(messages.measurement_of([(pgn, data)]), field)
            # these headings are beyond a full turn
            assert (theirs is None or pgn == HEADING) is (ours is None), (pgn, hex(last))


def test_a_burst_makes_a_sample_and_other_frames_do_not() -> None:
    assert feed(learned(), burst(42), 1000 * MS) == [42]
    assert [can_id for can_id, _ in burst(0)] == [0x09F11223, 0x09F11323, 0x0DF11923]
    codec = make()
    assert codec.feed_frame(0x09F11223, True, b"\1", 0) == (BadFrame(BadReason.LENGTH, b"\1", 0x09F11223),)
    skipped = [(0x09F11423, True), (0x11223, False), (0x09F112FE, True), (0x08F11223, True)]
    for can_id, extended in skipped:
        assert not codec.feed_frame(can_id, extended, bytes(8), 0)
    assert (codec.ledger.bytes_skipped, codec.unknown) == (32, {0x1F114: 1, 0xF112: 1})
    assert codec.ledger.closes()
    assert messages.DRIVER.node_of(0x0DF11905, True, bytes(8)) == 5
    for can_id, extended, size in [(0x0DF11905, False, 8), (0x0DF11905, True, 7), (0x0DF119FF, True, 8)]:
        assert messages.DRIVER.node_of(can_id, extended, bytes(size)) is None
    assert messages.DRIVER.node_settings(5) == messages.HipnucNmea2000Options(source=5)
    assert messages.DRIVER.node_title(5) == "source 5"


def test_sids_and_senders_are_never_mixed() -> None:
    codec = learned()
    lost_before = codec.ledger.lost()
    first, second = burst(50), burst(51)
    # the end of one instant and the start of the next are lost; the other frames are in order
    assert feed(codec, [first[0], *second[1:]], 1000 * MS) == []
    assert feed(codec, burst(52), 1100 * MS) == [51, 52]
    assert codec.ledger.lost() == lost_before
    codec = make(source=36)
    for n in range(60):
        assert feed(codec, burst(n), n * 100 * MS) == []
    assert codec.ledger.bytes_in == codec.ledger.bytes_skipped
    assert {f.can_id & 0xFF for f in messages.DRIVER.filters(messages.HipnucNmea2000Options(source=36))} == {36}
    assert all(f.mask & 0xFF == 0 for f in messages.DRIVER.filters(messages.HipnucNmea2000Options()))

    codec = learned()
    assert (feed(codec, burst(1, source=36), 1000 * MS), codec.ledger.bytes_skipped) == ([], 24)
    assert "imud uses source 35 and ignores source 36; select" in codec.problem
    found = [value for n in range(2, 42) for value in feed(codec, burst(n), n * 100 * MS + 800 * MS)]
    assert found == list(range(2, 42))
    assert feed(codec, burst(1, source=36), 4950 * MS) == []  # received 50 ms after the first sender
    assert feed(codec, burst(42), 5000 * MS) == [42]
    found = [value for n in range(12) for value in feed(codec, burst(n, source=36), 9000 * MS + n * 100 * MS)]
    assert found == list(range(12))
    assert feed(codec, burst(3), 10300 * MS) == []  # the old address now belongs to another sender


@pytest.mark.parametrize(("heading", "yaw"), [("auto", -0.2), ("true", -0.2), ("magnetic", -0.3)])
def test_a_sender_of_two_headings(heading: str, yaw: float) -> None:
    codec = make(heading=heading)
    events: list[CodecEvent] = []
    for n in range(12):
        both = [
            encode(HEADING, messages.pack_heading(n, -0.2, Reference.TRUE), 35),
            encode(HEADING, messages.pack_heading(n, -0.3, Reference.MAGNETIC), 35),
            encode(ATTITUDE, messages.pack_attitude(n, (n * 1e-4, 0.0, -1.0)), 35),
        ]
        for place, (can_id, data) in enumerate(both):
            events += codec.feed_frame(can_id, True, data, n * 100 * MS + place * MS // 2)
    yaws = [event.euler_rad[2] for event in events if isinstance(event, Measurement) and event.euler_rad]
    assert len(yaws) >= 6
    assert yaws == pytest.approx([yaw] * len(yaws))
    assert codec.ledger.lost() == 0


def test_yaw_is_not_taken_from_two_places() -> None:
    """The heading is in every second sample. In the other samples yaw is absent, not the yaw of the attitude."""
    codec = make()
    events: list[CodecEvent] = []
    for n in range(40):
        attitude = encode(ATTITUDE, messages.pack_attitude(n, (n * 1e-4, 0.0, -1.0)), 35)
        heading = encode(HEADING, messages.pack_heading(n, -0.2, Reference.TRUE), 35)
        for place, (can_id, data) in enumerate([attitude, heading][: 2 - n % 2]):
            events += codec.feed_frame(can_id, True, data, n * 50 * MS + place * MS // 2)
    yaws = [event.euler_rad[2] for event in events if isinstance(event, Measurement) and event.euler_rad][-20:]
    assert len(yaws) == 20
    assert [yaw for yaw in yaws if not math.isnan(yaw)] == pytest.approx([-0.2] * 10)
