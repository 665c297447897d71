"""Decoder for frames of a polled device: absent, damaged, stale (same bytes as before), or a new measurement."""

from collections.abc import Callable, Sequence
from typing import ClassVar, Final

from imud.contracts.codec import BadFrame, BadReason, PolledEvent, Vanished
from imud.drivers.state import COUNT, DAEMON
from imud.formats.state import Data, Field, StateTable
from imud.model.ledger import Ledger
from imud.model.sample import Measurement

FRAME_BYTES_MAX: Final = 512  # maximum size of a frame in a recorded state, bytes: more than a reply of Modbus
Measured = tuple[Measurement, bool]  # a measurement, and whether all its values were finite


class PolledFrameDecoder:
    """Decoder of frames of fixed size with a check value, one per transfer. Synchronization: one thread.

    The ledger counts a stale frame as good and ignored, and a frame of an absent device as skipped bytes.
    """

    STATE: ClassVar = StateTable(
        (Field(1, "stale", COUNT), Field(2, "_last", Data(FRAME_BYTES_MAX))),
        {"_ledger": DAEMON, "_size_bytes": "set by the constructor"},
    )

    def __init__(self, ledger: Ledger, size_bytes: int) -> None:
        self.stale = 0  # number of good frames with the same bytes as the previous frame
        self._ledger = ledger
        self._size_bytes = size_bytes
        self._last = b""

    def decode(
        self,
        data: bytes,
        bad: Callable[[bytes], BadReason | None],
        measure: Callable[[bytes], Measured],
    ) -> Sequence[PolledEvent]:
        """Decode a frame. `bad` returns the reason for damage, `measure` decodes a new good frame. Never raises."""
        ledger = self._ledger
        ledger.bytes_in += len(data)
        if len(data) != self._size_bytes or (why := absence(data)):
            ledger.bytes_skipped += len(data)
            short = f"expected {self._size_bytes} bytes, got {len(data)}"
            return (Vanished(short if len(data) != self._size_bytes else why),)
        reason = bad(data)
        if reason is not None:
            ledger.bytes_in_bad_frames += len(data)
            if reason is BadReason.CRC:
                ledger.frames_bad_crc += 1
            else:
                ledger.frames_bad_content += 1
            return (BadFrame(reason, data),)
        ledger.bytes_in_good_frames += len(data)
        ledger.frames_good += 1
        if data == self._last:
            self.stale += 1
            ledger.frames_ignored += 1
            return ()
        self._last = data
        ledger.frames_in_samples += 1
        measurement, finite = measure(data)
        if finite:
            return (measurement,)
        ledger.frames_not_finite += 1
        return (BadFrame(BadReason.NOT_FINITE, data), measurement)

    def add_reply(self, data: bytes, *, good: bool) -> None:
        """Count a reply from registers other than the sample registers in the ledger."""
        ledger = self._ledger
        ledger.bytes_in += len(data)
        if good:
            ledger.bytes_in_good_frames += len(data)
            ledger.frames_good += 1
            ledger.frames_in_replies += 1
        else:
            ledger.bytes_skipped += len(data)

    def reset(self) -> None:
        """Forget the previous frame: the next frame is new, even with the same bytes."""
        self._last = b""


_ONES = frozenset({0xFF})
_ZEROS = frozenset({0x00})


def absence(data: bytes) -> str:
    """Return why these bytes come from a bus without a device; empty if a device may have sent them."""
    first = data[:1]
    if first not in (b"\xff", b"\x00", b""):
        return ""
    seen = frozenset(data)
    if seen == _ONES:
        return "received only 0xFF; check the power and the data wire of the device"
    if seen == _ZEROS or not seen:
        return "received only 0x00; check the power and the data wire of the device"
    return ""
