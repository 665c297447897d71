"""CAN FD frames of newer HiPNUC firmware with values by hand, and the losses that their sequence number proves."""

from random import Random

import pytest

from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.drivers.hipnuc import canfd
from imud.drivers.hipnuc.canfd import DRIVER, HipnucCanfdCodec, HipnucCanfdOptions
from imud.drivers.hipnuc.uart import ins
from imud.formats.can import FD_LENGTHS
from imud.formats.j1939 import J1939Id, join
from imud.model.ledger import Ledger
from imud.model.sample import Measurement

MS = 1_000_000
FAST_ID, OLD_ID = (join(J1939Id(3, pgn, 8)) for pgn in (0xFF5B, 0xFF5A))
ACCEL, GYRO, QUAT, TIME = (
    "0000803f000020c000001d41",
    "0000003f000080be00000040",
    "0000003f000000bf" * 2,
    "88c57104" + "00" * 4,
)


def make() -> HipnucCanfdCodec:
    return HipnucCanfdCodec(Ledger(), HipnucCanfdOptions())


def feed(codec: HipnucCanfdCodec, can_id: int, data: str, t_ns: int = 0) -> list[CodecEvent]:
    events = list(codec.feed_frame(can_id, True, bytes.fromhex(data), t_ns))
    assert codec.ledger.closes()
    return events


def test_the_newer_frame_by_hand() -> None:
    """1, -2.5, 9.8125 m/s²; 0.5, -0.25, 2 rad/s; 74.565 s; status 0x0208, INS status 3, sequence 7."""
    (found,) = feed(make(), FAST_ID, "33000000 0802 03 07" + ACCEL + GYRO + QUAT + TIME + "aa" * 8, 5 * MS)
    assert isinstance(found, Measurement)
    assert (found.accel_m_s2, found.gyro_rad_s) == ((1, -2.5, 9.8125), (0.5, -0.25, 2))
    assert found.quat_wxyz == (0.5, -0.5, 0.5, -0.5)
    assert (found.dev_ticks, found.status, found.size_bytes, found.t_first_ns) == (74_565, 0x030208, 64, 5 * MS)
    assert (found.mag_t, found.euler_rad, found.temperature_c) == (None, None, None)
    # 20, -40, 10 µT; 10.5°, -20.25°, 90°; 2025-03-14 15:09:26.535; 21.5 °C: 12 + 12 + 8 + 4 + 8 bytes are 44 of 48
    rest = "0000a041000020c200002041" + "000028410000a2c10000b442" + "19030e0f09 a767 00" + "0000ac41" + "00" * 4
    (found,) = feed(make(), FAST_ID, "4c010000 0000 00 00" + rest)
    assert isinstance(found, Measurement)
    assert found.mag_t == pytest.approx((2e-5, -4e-5, 1e-5))
    assert found.euler_rad == pytest.approx((0.1832595715, -0.3534291735, 1.5707963268))
    assert (found.temperature_c, found.gnss_utc_ns, found.dev_ticks) == (21.5, 1_741_964_966_535_000_000, None)
    data = canfd.pack_fast(found, 0x14C, 256)
    assert data.hex() == ("4c010000 0000 00 00" + rest).replace(" ", "")
    with pytest.raises(ValueError, match="expected at most 64 bytes, got 92"):
        canfd.pack_fast(found, 0x17F, 0)


def test_the_older_frame_by_hand() -> None:
    """2048 · 0.00048828 G = 9.799974912 m/s²; 1000 · 0.061035 °/s; 1000 · 0.030517 µT; 25.12 °C; uptime 0x12345 ms."""
    vectors = (
        "000800f80100" + "e80300c0ffff" + "e80318fc0100" + "04290000e6b0ffff70a0feff" + "881378ec881378ec" + "d009"
    )
    old = "0802 0000 45230100" + vectors + "00" * 16
    (found,) = feed(make(), OLD_ID, old, 5 * MS)
    assert isinstance(found, Measurement)
    assert found.accel_m_s2 == pytest.approx((9.799974912, -9.799974912, 0.004785144))
    assert found.gyro_rad_s == pytest.approx((1.0652617, -17.4532478, -0.00106526171), abs=1e-7)
    assert found.mag_t == pytest.approx((3.0517e-5, -3.0517e-5, 3.0517e-8))
    assert found.euler_rad == pytest.approx((0.1832595715, -0.3534291735, -1.5707963268))
    assert found.quat_wxyz == (0.5, -0.5, 0.5, -0.5)
    assert found.temperature_c == pytest.approx(25.12)
    assert (found.dev_ticks, found.status, found.size_bytes, found.t_first_ns) == (74_565, 0x0208, 64, 5 * MS)
    assert canfd.pack_old(found, 74_565, 0x0208).hex() == old.replace(" ", "")
    codec = make()
    turned, event = feed(codec, OLD_ID, old.replace("04290000", "ffffff7f"))  # an impossible roll
    assert isinstance(turned, BadFrame)
    assert isinstance(event, Measurement)
    assert (turned.reason, event.euler_rad, codec.ledger.frames_not_finite) == (BadReason.NOT_FINITE, None, 1)


@pytest.mark.parametrize(
    ("can_id", "data", "reason"),
    [
        *((FAST_ID, (1 << bit).to_bytes(4, "little").hex(), BadReason.CONTENT) for bit in (7, *range(9, 32))),
        (FAST_ID, "3300000000000000" + ACCEL + GYRO + QUAT + TIME, BadReason.LENGTH),  # 56 bytes without padding
        (FAST_ID, "0100000000000000" + ACCEL + "00" * 4, BadReason.LENGTH),  # 24 bytes in place of 20
        (FAST_ID, "0100000000000000" + ACCEL[:16], BadReason.LENGTH),
        (FAST_ID, "7f010000" + "00" * 60, BadReason.LENGTH),  # 84 bytes of fields
        (FAST_ID, "01000000000000", BadReason.LENGTH), (FAST_ID, "", BadReason.LENGTH),
        (OLD_ID, "00" * 48, BadReason.LENGTH),
    ],
)  # fmt: skip
def test_a_bitmap_that_does_not_match_makes_a_frame_bad(can_id: int, data: str, reason: BadReason) -> None:
    if reason is BadReason.CONTENT:
        data = data.ljust(128, "0")
    codec = make()
    assert feed(codec, can_id, data) == [BadFrame(reason, bytes.fromhex(data), can_id)]
    ledger = codec.ledger
    assert ledger.frames_bad() == 1
    assert (ledger.frames_bad_content, ledger.frames_bad_length) == ((1, 0) if reason is BadReason.CONTENT else (0, 1))
    assert (ledger.bytes_in_bad_frames, ledger.samples) == (len(data) // 2, 0)


def test_every_bitmap_has_shortest_length_or_64_bytes() -> None:
    codec, sizes = make(), {0: 12, 1: 12, 2: 12, 3: 12, 4: 16, 5: 8, 6: 8, 8: 4}
    made = 0
    for choice in range(1 << len(sizes)):
        bits = [bit for number, bit in enumerate(sizes) if choice >> number & 1]
        size = 8 + sum(sizes[bit] for bit in bits)
        bitmap = sum(1 << bit for bit in bits)
        for length in FD_LENGTHS:
            data = bitmap.to_bytes(4, "little") + bytes(3) + bytes([made % 256]) + bytes(max(length - 8, 0))
            shortest = min((fd_length for fd_length in FD_LENGTHS if fd_length >= size), default=-1)
            is_right = shortest > 0 and length in (shortest, 64)
            event = codec.feed_frame(FAST_ID, True, data[:length], made * MS)[-1]
            assert isinstance(event, Measurement) == is_right, (bits, length)
            made += is_right
    assert codec.ledger.frames_in_samples == made > 200
    assert codec.ledger.closes()


def test_the_sequence_number_proves_losses_and_copies_are_ignored() -> None:
    codec, random, lost, copies = make(), Random(7), 0, 0
    for n in range(2000):
        if n > 20 and random.random() < 0.02:
            lost += 1
            continue
        t_ns = n * 5 * MS + random.randrange(MS)
        data = canfd.pack_fast(Measurement(0, 0, None, (0.0, 0.0, n * 0.001)), 1 << ins.ACCEL, n)
        assert len(codec.feed_frame(FAST_ID, True, data, t_ns)) == 1
        if n % 100 == 0:
            copies += 1
            assert codec.feed_frame(FAST_ID, True, data, t_ns + 1000) == ()
    assert codec.ledger.lost_gap_device == lost > 20
    assert (codec.ledger.frames_ignored, codec.problem) == (copies, "")
    assert codec.ledger.closes()


def test_filters_and_node() -> None:
    assert [one.can_id for one in DRIVER.filters(HipnucCanfdOptions(address=9, host_address=0x20))] == [
        join(J1939Id(0, pgn, 9)) for pgn in (0xFF5A, 0xFF5B)
    ] + [join(J1939Id(0, 0xEF00, 9, host)) for host in (0x20, 0x55)]
    assert DRIVER.node_of(join(J1939Id(6, 0xFF5B, 9)), True, bytes(64)) == 9
    for pgn, source, size in ((0xFF34, 9, 8), (0xFF5B, 254, 64), (0xFF5B, 9, 7)):
        assert DRIVER.node_of(join(J1939Id(6, pgn, source)), True, bytes(size)) is None
    codec = make()
    assert codec.feed_frame(join(J1939Id(6, 0xFF34, 8)), True, bytes(8), 0) == ()
    assert (codec.unknown, codec.ledger.bytes_skipped) == ({0xFF34: 1}, 8)
