"""MotionValues of a ring: manually computed values, limited work, and no overwritten slot."""

import math
import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from imud.formats.slot import SLOT_BYTES, encode_slot
from imud.model.sample import Sample, Sync, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.metrics.rings import MotionValues, RingReader, RingView, motion_of
from tests.support.rings import DEVICE, SLOTS, START_NS, Board

OVERTAKEN_SLOTS, SAMPLES_MAX = 8, 4096
G = 9.81


def slot(seq: int, t_ns: int, accel: Vector3 | None, euler: Vector3 | None = None) -> bytes:
    return encode_slot(Sample("bow", seq, t_ns, 1, Sync.ARRIVAL, t_ns, 0, accel_m_s2=accel, euler_rad=euler), 0)


def slots(accelerations: Sequence[Vector3 | None], rate_hz: int = 100, start_ns: int = 0) -> bytes:
    period_ns = NS_PER_S // rate_hz
    return b"".join(slot(n + 1, start_ns + n * period_ns, accel) for n, accel in enumerate(accelerations))


def motion(data: bytes, since_ns: int = 0) -> MotionValues:
    found = motion_of(data, since_ns)
    assert found is not None
    return found


def test_vibration_has_the_computed_values_of_each_block() -> None:
    """X rests. Y is ±0.5 around 0.1. Z is 9.81 plus 1 in one of ten samples: variance 0.09."""
    found = motion(slots([(0.0, 0.1 + (0.5 if n % 2 else -0.5), G + (n % 10 == 3)) for n in range(100)]))
    assert found.vibration_rms_m_s2 == pytest.approx((0.0, 0.5, 0.3), abs=1e-6)
    assert found.vibration_peak_m_s2 == pytest.approx((0.0, 0.5, 0.9), abs=1e-9)
    assert found.accel_norm_m_s2 == pytest.approx(math.hypot(0.0, 0.1, G + 0.1), rel=1e-12)
    assert found.span_ns == 990 * NS_PER_MS
    found = motion(slots([(0.0, 0.0, 2 * G)] * 150 + [(0.0, 3.0, 4.0)] * 100))
    assert found.accel_norm_m_s2 == pytest.approx(5.0)
    # the step is at the boundary of two blocks
    assert found.vibration_peak_m_s2 == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    before = slots([(0.0, 0.0, G)] * 50)
    after = slots([(0.0, G, 0.0)] * 50, start_ns=3600 * NS_PER_S)
    found = motion(before + after)
    assert found.vibration_rms_m_s2 == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert found.span_ns == 3600 * NS_PER_S + 490 * NS_PER_MS


def test_slow_motion_is_not_vibration_and_the_span_does_not_change_the_rms() -> None:
    """The sensor turns in 20 s, so gravity moves from Z to X. The vibration is a sine of 25 Hz with amplitude 0.2."""

    def at(n: int) -> Vector3:
        turn = math.pi / 2 * n / 2000
        return G * math.sin(turn), 0.2 * math.sin(2 * math.pi * 25 * n / 100), G * math.cos(turn)

    data = slots([at(n) for n in range(2000)])
    long, short = motion(data), motion(data, since_ns=17 * NS_PER_S)
    assert (long.span_ns, short.span_ns) == (19_990 * NS_PER_MS, 2_990 * NS_PER_MS)
    for found in (long, short):
        assert found.vibration_rms_m_s2 is not None
        x, y, z = found.vibration_rms_m_s2
        assert y == pytest.approx(0.2 / math.sqrt(2), rel=1e-9)
        assert x < 0.23  # gravity moves by at most 0.77 m/s² per second, a standard deviation of 0.22
        assert z < 0.23
    assert long.vibration_peak_m_s2 is not None
    assert max(long.vibration_peak_m_s2) < 0.4


def test_missing_values_are_absent() -> None:
    assert motion_of(b"", 0) is None
    assert motion_of(slots([(0.0, 0.0, G)]), 1) is None  # older than the span
    assert motion(slot(1, 5, None, (0.1, 0.2, 0.3))) == MotionValues(0, (0.1, 0.2, 0.3), None, None, None)
    few = motion(slots([(0.0, 0.0, G)] * 7, rate_hz=7))
    assert few.accel_norm_m_s2 == pytest.approx(G)
    assert few.vibration_rms_m_s2 is few.vibration_peak_m_s2 is None
    assert motion(slots([(0.0, 0.0, G)] * 8, rate_hz=10)).vibration_rms_m_s2 is not None
    data: list[Vector3 | None] = [(0.5 if n % 4 == 0 else -0.5, 0.0, G) if n % 2 == 0 else None for n in range(100)]
    found = motion(slots(data))
    assert found.vibration_rms_m_s2 == pytest.approx((0.5, 0.0, 0.0), abs=1e-6)
    assert found.accel_norm_m_s2 == pytest.approx(G)


def test_each_part_of_the_work_is_reported() -> None:
    pieces: list[int] = []
    assert motion_of(slots([(0.0, 0.0, G)] * 1000), 0, pieces.append) is not None
    assert pieces == [1000, *[100] * 30]


def read(board: Board, newest: int, *, motion: bool = True) -> RingView:
    reader = RingReader(lambda: None, motion=motion)
    return reader.read({DEVICE: str(board.path)}, {DEVICE: newest}, board.now_ns)[DEVICE]


def test_a_ring_that_has_wrapped_is_read_in_order(board: Board) -> None:
    board.publish(range(1, 151))
    board.now_ns = 160 * NS_PER_MS
    board.tick(0)
    found = read(board, 150)
    assert found.written
    assert found.motion is not None
    assert found.motion.span_ns == 54 * NS_PER_MS  # 96 to 150: the writer can overwrite 9 slots during the copy
    assert found.motion.accel_norm_m_s2 == pytest.approx(math.hypot(123.0, 123.25, 123.5))


def test_only_samples_of_the_snapshot_with_consecutive_numbers_are_used(board: Board) -> None:
    board.publish(range(1, 41))
    board.now_ns = 0
    found = read(board, 30)
    assert found.motion is not None
    assert found.motion.span_ns == 29 * NS_PER_MS
    assert read(board, 0).motion is None
    assert read(board, 30).motion is not None
    board.poke(4096 + 20 * SLOT_BYTES, (7).to_bytes(8, "little"))
    assert read(board, 30).motion is None


@pytest.mark.parametrize("more", [1, 10, 54, 63, 64, 65, 500])
def test_slots_overwritten_in_the_copy_are_ignored(board: Board, more: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The writer writes `more` samples during the copy. imud ignores slots that can be incomplete."""
    board.publish(range(1, 65))
    board.now_ns = 0
    real = os.pread
    copied: list[int] = []

    def pread(fd: int, size: int, at: int) -> bytes:
        data = real(fd, size, at)
        if size >= SLOT_BYTES and at and not copied:
            copied.append(size)
            board.publish(range(65, 65 + more))
        return data

    monkeypatch.setattr(os, "pread", pread)
    found = read(board, 64)
    assert copied
    left = SLOTS - 1 - OVERTAKEN_SLOTS - more
    if left > 0:
        assert found.motion is not None
        assert found.motion.span_ns == (left - 1) * NS_PER_MS
    else:
        assert found.motion is None


def test_a_ring_is_written_if_its_file_exists_and_has_a_heartbeat(board: Board) -> None:
    board.publish(range(1, 31))
    board.tick()
    assert read(board, 30).written
    assert read(board, 30, motion=False) == RingView(True), "the option motion"
    board.now_ns += NS_PER_S
    assert not read(board, 30).written
    board.tick()
    assert read(board, 30).written
    board.poke(0, b"another!")
    assert read(board, 30) == RingView(False)
    board.path.unlink()
    assert read(board, 30) == RingView(False)
    assert RingReader(lambda: None, motion=True).read({"bow": ""}, {}, START_NS) == {"bow": RingView(False)}


def test_a_pause_follows_each_number_of_values_and_the_newest_4096_samples_are_read(tmp_path: Path) -> None:
    """Few samples cause no pause. 4096 samples are read, then added up in four blocks on three axes."""
    for count, expected in ((100, 0), (5000, 4)):
        pauses: list[int] = []
        folder = tmp_path / str(count)
        folder.mkdir()
        board = Board(folder, slots=2 * SAMPLES_MAX, now_ns=0)
        board.publish(range(1, count + 1))
        reader = RingReader(lambda pauses=pauses: pauses.append(1), motion=True)  # type: ignore[misc]
        motion = reader.read({DEVICE: str(board.path)}, {DEVICE: count}, 0)[DEVICE].motion
        assert motion is not None
        assert (len(pauses), motion.span_ns) == (expected, (min(count, SAMPLES_MAX) - 1) * NS_PER_MS)
        board.publisher.close()


def test_scrapes_within_one_second_share_one_reading(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    board.publish(range(1, 31))
    board.tick()
    opened: list[str] = []
    real = os.open

    def counted(path: str, flags: int) -> int:
        opened.append(path)
        return real(path, flags)

    monkeypatch.setattr(os, "open", counted)
    reader = RingReader(lambda: None, motion=True)
    rings, newest = {DEVICE: str(board.path)}, {DEVICE: 30}
    first = reader.read(rings, newest, board.now_ns)
    for later_ns in range(0, NS_PER_S, NS_PER_S // 100):
        assert reader.read(rings, newest, board.now_ns + later_ns) is first
    assert len(opened) == 1
    reader.read(rings, newest, board.now_ns + NS_PER_S)
    assert len(opened) == 2


def test_the_span_is_the_time_since_the_previous_reading_at_least_ten_seconds(tmp_path: Path) -> None:
    board = Board(tmp_path, slots=SAMPLES_MAX, now_ns=0)
    reader = RingReader(lambda: None, motion=True)

    def span_s(now_s: float) -> float:
        view = reader.read({DEVICE: str(board.path)}, {DEVICE: 4000}, round(now_s * NS_PER_S))[DEVICE]
        assert view.motion is not None
        return view.motion.span_ns / NS_PER_S

    for seq in range(1, 4001, 100):  # samples at 100 Hz until 40 s
        times = [(n, n * 10 * NS_PER_MS) for n in range(seq, seq + 100)]
        board.publish_samples([Sample(DEVICE, n, t, 1, Sync.ARRIVAL, 0, 0, accel_m_s2=(0, 0, G)) for n, t in times])
    assert span_s(40.0) == 10.0
    assert span_s(41.5) == 8.5  # the last sample is at 40 s, the span starts at 31.5 s
    reader = RingReader(lambda: None, motion=True)
    span_s(15.0)
    assert span_s(40.0) == 25.0
    board.publisher.close()
