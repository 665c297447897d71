"""Attitude, acceleration and vibration of each device, computed from its ring in shared memory during a scrape.

This adds no work per sample. The HTTP thread copies the newest slots from the ring file (pread cannot cause SIGBUS) and
computes over columns. The work is limited: at most one reading per second, SAMPLES_MAX slots per device, and a pause
after VALUES_PER_TURN values.

    slots ──▶ time stamps ──▶ span: since the previous reading, at least SPAN_MIN_NS, at most the copied slots
    blocks of BLOCK_NS ──▶ mean and deviations of each axis ──▶ RMS and peak over all blocks

Vibration is the deviation from the mean of a block. It does not contain gravity and motion slower than about 1 Hz. Its
RMS does not depend on the length of the span.

A CRC check is not necessary. The thread that writes the ring also makes the snapshot, so all slots up to its newest
sample are complete. imud reads `newest_seq` again after the copy to find the slots that were overwritten during the
copy.
"""

import math
import os
import struct
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from itertools import compress
from operator import mul
from typing import Final, NamedTuple

from imud.formats.ring import HEADER_BYTES, HEARTBEAT_LIMIT_NS, OPEN_FLAGS, STATE_LIVE, RingHeader, decode_header
from imud.formats.slot import HAS_ACCEL, HAS_EULER, SLOT_BYTES, SLOT_FIELDS
from imud.model.errors import ServerError
from imud.model.sample import Vector3
from imud.model.units import NS_PER_S

# Minimum time between two readings of the rings, ns. Scrapes in between return the same values.
LOOK_NS: Final = NS_PER_S
# Maximum number of slots per device: a complete ring of the default size, 4 s at 1 kHz, 1.3 MB and 2 ms of CPU time
SAMPLES_MAX: Final = 4096
SPAN_MIN_NS: Final = 10 * NS_PER_S  # Minimum span, ns. A second scraper must not shorten the span of the first.
# Number of values between two pauses, 0.3 ms. A pause takes long if many programs need CPU time.
VALUES_PER_TURN: Final = 4096
BLOCK_NS: Final = NS_PER_S
BLOCK_SAMPLES_MIN: Final = 8  # minimum number of samples in a block for vibration
# Number of slots that imud ignores next to the slot that is being written, because a reader can see the stores of the
# writer in another order
OVERTAKEN_SLOTS: Final = 8

_OFFSETS: Final = {field.name: field.offset for field in SLOT_FIELDS}
_WORDS: Final = SLOT_BYTES // 8
_SEQ, _T_NS, _ACCEL = (_OFFSETS[name] // 8 for name in ("seq", "t_ns", "accel_m_s2"))
_PRESENT: Final = _OFFSETS["present"] // 4
_EULER: Final = struct.Struct(f"<{_OFFSETS['euler_rad']}x3d")


class MotionValues(NamedTuple):
    """Motion of one device over the newest samples. A value is None if the device does not send it."""

    span_ns: int  # time from the oldest to the newest sample of the span
    attitude_rad: Vector3 | None  # roll, pitch and yaw of the newest sample, in the published convention
    accel_norm_m_s2: float | None  # norm of the mean acceleration over the newest block
    vibration_rms_m_s2: Vector3 | None  # X, Y, Z; None if no block has BLOCK_SAMPLES_MIN samples
    vibration_peak_m_s2: Vector3 | None  # maximum deviation from the mean of a block


class RingView(NamedTuple):
    """State of the ring of one device."""

    written: bool  # True if the file exists and the daemon writes it
    motion: MotionValues | None = None  # None without samples in the span, or if the option `motion` is off


class RingReader:
    """Reader of the rings of all devices. Synchronization: the HTTP thread."""

    def __init__(self, pause: Callable[[], None], *, motion: bool) -> None:
        self._pause = pause
        self._motion = motion
        self._values = 0  # number of values since the last pause
        self._looked_ns: int | None = None
        self._views: dict[str, RingView] = {}

    def read(self, rings: Mapping[str, str], newest: Mapping[str, int], now_ns: int) -> Mapping[str, RingView]:
        """Return the views by device. Return the previous views if they are not older than LOOK_NS.

        `rings` contains the path of each ring, empty if imud could not create it. `newest` contains the newest sequence
        numbers. Both are from one turn of the event loop, at about `now_ns`.
        """
        before_ns = self._looked_ns
        if before_ns is None or now_ns - before_ns >= LOOK_NS:
            since_ns = now_ns - SPAN_MIN_NS if before_ns is None else min(before_ns, now_ns - SPAN_MIN_NS)
            self._looked_ns = now_ns
            self._views = {
                name: self._view(path, newest.get(name, 0), since_ns, now_ns) for name, path in rings.items()
            }
        return self._views

    def _view(self, path: str, newest: int, since_ns: int, now_ns: int) -> RingView:
        try:
            fd = os.open(path, OPEN_FLAGS)
        except OSError:  # also for an empty path
            return RingView(False)
        try:
            header = _header(fd, path)
            written = header.state == STATE_LIVE and now_ns - header.heartbeat_ns < HEARTBEAT_LIMIT_NS
            motion = motion_of(_newest_slots(fd, path, header, newest), since_ns, self._used) if self._motion else None
        except (OSError, ServerError):
            return RingView(False)
        finally:
            os.close(fd)
        return RingView(written, motion)

    def _used(self, values: int) -> None:
        self._values += values
        if self._values >= VALUES_PER_TURN:
            self._values = 0
            self._pause()


def _header(fd: int, path: str) -> RingHeader:
    return decode_header(os.pread(fd, HEADER_BYTES, 0), path)


def _newest_slots(fd: int, path: str, header: RingHeader, newest: int) -> bytes:
    """Return at most SAMPLES_MAX slots up to the number `newest`, oldest first, with consecutive numbers."""
    count = header.slot_count
    newest = min(newest, header.newest_seq)
    oldest = max(header.first_seq, newest + 1 - min(count, SAMPLES_MAX))
    first, end = oldest % count, oldest % count + max(newest + 1 - oldest, 0)
    copied = _pread_slots(fd, first, min(end, count)) + _pread_slots(fd, 0, end - count)
    after = _header(fd, path)
    gone = max(after.newest_seq + 2 + OVERTAKEN_SLOTS - count, after.first_seq) - oldest
    slots = copied[max(gone, 0) * SLOT_BYTES :]
    numbers = memoryview(slots).cast("Q")[_SEQ::_WORDS].tolist()
    return slots if numbers == list(range(newest + 1 - len(numbers), newest + 1)) else b""


def _pread_slots(fd: int, first: int, end: int) -> bytes:
    return os.pread(fd, (end - first) * SLOT_BYTES, HEADER_BYTES + first * SLOT_BYTES) if end > first else b""


def motion_of(slots: bytes, since_ns: int, used: Callable[[int], None] = lambda _: None) -> MotionValues | None:
    """Return the motion over the slots with time stamps from `since_ns`, oldest first; None if there is no slot. This
    function calls `used` with the number of values after each part of the work."""
    view = memoryview(slots)
    times = view.cast("q")[_T_NS::_WORDS].tolist()
    first = bisect_left(times, since_ns)
    if first == len(times):
        return None
    view, times = view[first * SLOT_BYTES :], times[first:]
    bits = view.cast("I")[_PRESENT :: SLOT_BYTES // 4].tolist()
    attitude = _EULER.unpack_from(view, len(view) - SLOT_BYTES) if bits[-1] & HAS_EULER else None
    numbers = view.cast("d")
    axes: list[list[float]] = [
        numbers[_ACCEL + axis :: _WORDS].tolist()  # type: ignore[misc]  # typeshed declares integers for all formats
        for axis in range(3)
    ]
    used(len(times))
    span_ns = times[-1] - times[0]
    if not all(present & HAS_ACCEL for present in set(bits)):
        having = [present & HAS_ACCEL for present in bits]
        times, axes = list(compress(times, having)), [list(compress(axis, having)) for axis in axes]
    blocks = _blocks(times)
    if not blocks:
        return MotionValues(span_ns, attitude, None, None, None)
    means = [_mean(axis[slice(*blocks[0])]) for axis in axes]
    deviations = [_deviation(axis, blocks, used) for axis in axes]
    rms, peak = zip(*deviations, strict=True) if None not in deviations else (None, None)
    return MotionValues(span_ns, attitude, math.hypot(*means), rms, peak)


def _blocks(times: list[int]) -> list[tuple[int, int]]:
    """Return first index and end of each block of BLOCK_NS, newest first. The newest block is complete."""
    blocks, end = [], len(times)
    while end:
        first = bisect_left(times, times[end - 1] - BLOCK_NS + 1)
        blocks.append((first, end))
        end = first
    return blocks


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _deviation(
    axis: list[float], blocks: list[tuple[int, int]], used: Callable[[int], None]
) -> tuple[float, float] | None:
    """Return RMS and peak of the deviation from the mean of each block; None if all blocks are too small."""
    squares, size, peak = 0.0, 0, 0.0
    for first, end in blocks:
        if end - first >= BLOCK_SAMPLES_MIN:
            block = axis[first:end]
            mean = _mean(block)
            squares += max(sum(map(mul, block, block)) - len(block) * mean * mean, 0.0)
            peak = max(peak, max(block) - mean, mean - min(block))
            size += len(block)
            used(len(block))
    return (math.sqrt(squares / size), peak) if size else None
