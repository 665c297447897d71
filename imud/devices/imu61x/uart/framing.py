r"""Frames of the Forsense IMU61x on a UART, both directions. Manual "IMU61X Interface Protocol", section 1.2.

    0    1    2       4        6                 6 + length
    +----+----+-------+--------+-----------------+-----------+
    | AA | 55 | id    | length | payload         | CRC-32    |    device to host; all little-endian
    | 55 | AA |       |        |                 |           |    host to device
    +----+----+-------+--------+-----------------+-----------+

The CRC (`common.crc32`) covers every byte before it, the sync word included.

A frame whose check fails spends only its sync word, because a real frame may begin inside the false one. What follows
up to its claimed end counts as part of it unless it turns out to be good. While a claimed frame is incomplete
everything waits, at most FRAME_BYTES_MAX; `flush` ends the wait when the line went idle.
"""

import struct
from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from imud.contracts.codec import BadFrame, BadReason
from imud.devices.imu61x.common.family import crc32
from imud.ledger import Ledger

DEVICE_SYNC: Final = b"\xaa\x55"
"""Begins what the device sends."""
HOST_SYNC: Final = b"\x55\xaa"
"""Begins what the host sends."""
HEADER: Final = struct.Struct("<2sHH")  # sync word, id, payload length
CRC_BYTES: Final = 4
OVERHEAD_BYTES: Final = HEADER.size + CRC_BYTES
PAYLOAD_BYTES_MAX: Final = 256
"""The longest known payload has 66 bytes (S1, whose length differs by model); a false length then hides at most five
samples, 23 ms at 115200 baud."""
FRAME_BYTES_MAX: Final = OVERHEAD_BYTES + PAYLOAD_BYTES_MAX


class Frame(msgspec.Struct, frozen=True, gc=False):
    """A frame whose CRC matches."""

    frame_id: int
    payload: bytes
    raw: bytes
    trailing_bytes: int
    """Bytes of the same read that follow it."""


def encode_frame(sync: bytes, frame_id: int, payload: bytes) -> bytes:
    """A frame around `payload`. Raises ValueError for a payload that is empty or above PAYLOAD_BYTES_MAX."""
    if not 1 <= len(payload) <= PAYLOAD_BYTES_MAX:
        raise ValueError(f"payload of {len(payload)} bytes: expected 1 … {PAYLOAD_BYTES_MAX}")
    body = HEADER.pack(sync, frame_id, len(payload)) + payload
    return body + crc32(body).to_bytes(CRC_BYTES, "little")


class FrameFinder:
    """Finder of the frames of one direction in bytes of any split. Synchronization: one thread.

    Books into the ledger every byte and every damaged frame, but not the frames it returns: only the caller knows
    whether they are good.
    """

    def __init__(self, ledger: Ledger, sync: bytes) -> None:
        self._ledger = ledger
        self._sync = sync
        self._tail = b""
        """Incomplete rest of the bytes: begins with a sync word, or is the first half of one."""
        self._bad_ahead = 0
        """Claimed rest of a damaged frame, in bytes from the begin of the tail."""
        self.idle = True
        """Whether the next bytes can be decoded without the earlier ones. To be read only."""

    def feed(self, data: bytes) -> Sequence[Frame | BadFrame]:
        """Add bytes in the order they came; return what they completed. Never raises for any bytes."""
        self._ledger.bytes_in += len(data)
        return self._scan(self._tail + data if self._tail else data, 0)

    def feed_rest(self, data: bytes, take_run: Callable[[bytes], int]) -> Sequence[Frame | BadFrame]:
        """Add bytes as `feed`, of which `take_run` takes whole frames first; it returns how many bytes those have.

        It is given what waited together with `data`, unless that may belong to a damaged frame.
        """
        self._ledger.bytes_in += len(data)
        if self._tail:
            data = self._tail + data
        return self._scan(data, 0, 0 if self._bad_ahead else take_run(data))

    def flush(self) -> Sequence[Frame | BadFrame]:
        """Drop an incomplete frame if a whole one waits inside it; no-op otherwise. Called when the line is idle."""
        found: list[Frame | BadFrame] = []
        while drop_before := self._whole_inside():
            found += self._scan(self._tail, drop_before)
        return found

    def reset(self) -> None:
        """Skip what is pending: the stream broke."""
        self._ledger.bytes_skipped += len(self._tail)
        self._tail = b""
        self._bad_ahead = 0
        self.idle = True
        self._ledger.bytes_pending = 0

    def _scan(self, data: bytes, drop_before: int, at: int = 0) -> list[Frame | BadFrame]:
        """Find all that is complete in `data` from `at`; incomplete frames that begin before `drop_before` are bad."""
        found: list[Frame | BadFrame] = []
        sync, total = self._sync, len(data)
        while at < total:
            begin = data.find(sync, at)
            if begin < 0:
                end = total - data.endswith(sync[:1], at)
                self._skip(at, end)
                at = end
                break
            self._skip(at, begin)
            at, waiting = begin, self._frame_at(data, begin, drop_before, found)
            if at == waiting:
                break
            at = waiting
        self._tail = data[at:]
        self._bad_ahead = max(self._bad_ahead - at, 0)
        self.idle = not (self._tail or self._bad_ahead)
        self._ledger.bytes_pending = total - at
        return found

    def _frame_at(self, data: bytes, at: int, drop_before: int, found: list[Frame | BadFrame]) -> int:
        """Find the frame whose sync word is at `at`; return where it ends, or `at` if it is not complete yet."""
        total = len(data)
        if total - at < HEADER.size:
            return self._spend_sync(data, at, total, BadReason.CRC, found) if at < drop_before else at
        frame_id: int
        length: int
        _, frame_id, length = HEADER.unpack_from(data, at)
        begin = at + HEADER.size
        if not 1 <= length <= PAYLOAD_BYTES_MAX:
            return self._spend_sync(data, at, begin, BadReason.LENGTH, found)
        end = begin + length + CRC_BYTES
        if end > total and at >= drop_before:
            return at
        raw = data[at:end]
        if end > total or not _crc_matches(raw):
            return self._spend_sync(data, at, end, BadReason.CRC, found)
        found.append(Frame(frame_id, raw[HEADER.size : -CRC_BYTES], raw, total - end))
        return end

    def _skip(self, at: int, end: int) -> None:
        """Count bytes that belong to no frame; those that a damaged frame claimed count as its."""
        bad = max(min(self._bad_ahead, end) - at, 0)
        self._ledger.bytes_in_bad_frames += bad
        self._ledger.bytes_skipped += end - at - bad

    def _spend_sync(self, data: bytes, at: int, end: int, reason: BadReason, found: list[Frame | BadFrame]) -> int:
        """Spend only the sync word of what begins at `at` and claims to reach `end`: it is no frame."""
        ledger = self._ledger
        if reason is BadReason.CRC:
            ledger.frames_bad_crc += 1
        else:
            ledger.frames_bad_length += 1
        ledger.bytes_in_bad_frames += len(self._sync)
        self._bad_ahead = max(self._bad_ahead, end)
        found.append(BadFrame(reason, data[at:end]))
        return at + len(self._sync)

    def _whole_inside(self) -> int:
        """Find the first frame with a matching CRC in the tail, after its own sync word; 0 for none."""
        tail, sync = self._tail, self._sync
        at = tail.find(sync, len(sync))
        while at > 0:
            length = int.from_bytes(tail[at + 4 : at + HEADER.size], "little")
            raw = tail[at : at + OVERHEAD_BYTES + length]
            if 1 <= length <= PAYLOAD_BYTES_MAX and len(raw) == OVERHEAD_BYTES + length and _crc_matches(raw):
                return at
            at = tail.find(sync, at + len(sync))
        return 0


def _crc_matches(raw: bytes) -> bool:
    return crc32(raw[:-CRC_BYTES]) == int.from_bytes(raw[-CRC_BYTES:], "little")
