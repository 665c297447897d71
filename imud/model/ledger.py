"""Ledger of one device: counters of every byte, frame and lost sample. The ledger balances after every callback.

Hot paths add to plain integers; the outputs read them. Synchronization: only the event loop reads and writes the
ledger, between two callbacks. Another thread requests a snapshot from the loop, because inside a callback the ledger
does not balance.
"""

from collections.abc import Mapping
from operator import itemgetter
from typing import Final

# Names in the order of shared memory. Append new names at the end.
LEDGER_FIELDS: Final = (
    "bytes_in",  # every byte, CAN data byte or register byte from the link
    "bytes_in_good_frames",
    "bytes_in_bad_frames",  # from the sync word of a damaged frame to its end by the length field
    "bytes_skipped",  # outside all frames
    "bytes_pending",  # possible start of a frame
    "frames_good",
    "frames_in_samples",
    "frames_in_replies",  # lines of text and reply frames
    "frames_ignored",  # valid frames without values that imud decodes
    "frames_pending",  # valid frames of an incomplete sample
    "frames_bad_crc",
    "frames_bad_length",
    "frames_bad_content",  # correct check value, impossible content
    "unknown_tags",  # sub-packets with an unknown tag in valid frames
    "samples",
    "lost_gap_device",  # lost samples according to the device counter, without a known cause
    "lost_crc",  # lost samples at a damaged frame
    "lost_overrun",  # lost samples at an overrun of the kernel
    "lost_queue",  # samples dropped from a full queue of the daemon
    "replies_late",  # replies after the timeout
    "replies_unsolicited",  # text without a request
    "frames_not_finite",  # valid frames from which imud removed NaN, infinite or physically impossible values
    "lost_unknown",  # gaps with an unknown number of lost samples
    "frames_lost",  # CAN frames that did not arrive, according to the SID or the period of their kind
)


class Ledger:
    """Counters of one device since start, all non-negative integers."""

    __slots__ = LEDGER_FIELDS

    bytes_in: int
    bytes_in_good_frames: int
    bytes_in_bad_frames: int
    bytes_skipped: int
    bytes_pending: int
    frames_good: int
    frames_in_samples: int
    frames_in_replies: int
    frames_ignored: int
    frames_pending: int
    frames_bad_crc: int
    frames_bad_length: int
    frames_bad_content: int
    unknown_tags: int
    samples: int
    lost_gap_device: int
    lost_crc: int
    lost_overrun: int
    lost_queue: int
    replies_late: int
    replies_unsolicited: int
    frames_not_finite: int
    lost_unknown: int
    frames_lost: int

    def __init__(self) -> None:
        for name in LEDGER_FIELDS:
            setattr(self, name, 0)

    def bytes_open(self) -> int:
        """Return the number of uncounted bytes; 0 if the ledger balances."""
        known = self.bytes_in_good_frames + self.bytes_in_bad_frames + self.bytes_skipped + self.bytes_pending
        return self.bytes_in - known

    def frames_open(self) -> int:
        """Return the number of uncounted good frames; 0 if the ledger balances."""
        known = self.frames_in_samples + self.frames_in_replies + self.frames_ignored + self.frames_pending
        return self.frames_good - known

    def closes(self) -> bool:
        """Return whether the ledger balances."""
        return self.bytes_open() == 0 and self.frames_open() == 0

    def frames_bad(self) -> int:
        """Return the number of damaged frames."""
        return self.frames_bad_crc + self.frames_bad_length + self.frames_bad_content

    def lost(self) -> int:
        """Return the number of lost samples, within one per gap, without `lost_unknown`."""
        return self.lost_gap_device + self.lost_crc + self.lost_overrun + self.lost_queue

    def add_unknown_gap(self) -> None:
        """Count a gap with an unknown number of lost samples."""
        self.lost_unknown += 1

    def values(self) -> tuple[int, ...]:
        """Return all counters in the order of LEDGER_FIELDS. A written tuple is faster than `attrgetter`."""
        return (
            self.bytes_in, self.bytes_in_good_frames, self.bytes_in_bad_frames, self.bytes_skipped, self.bytes_pending,
            self.frames_good, self.frames_in_samples, self.frames_in_replies, self.frames_ignored, self.frames_pending,
            self.frames_bad_crc, self.frames_bad_length, self.frames_bad_content, self.unknown_tags, self.samples,
            self.lost_gap_device, self.lost_crc, self.lost_overrun, self.lost_queue, self.replies_late,
            self.replies_unsolicited, self.frames_not_finite, self.lost_unknown, self.frames_lost,
        )  # fmt: skip

    def losses(self) -> tuple[int, ...]:
        """Return the counters of losses in the order of LOST_FIELDS."""
        return self.lost_gap_device, self.lost_crc, self.lost_overrun, self.lost_queue, self.lost_unknown

    def troubles(self) -> tuple[int, ...]:
        """Return the counters of losses and of frames that imud could not use."""
        return (
            self.lost_gap_device, self.lost_crc, self.lost_overrun, self.lost_queue, self.lost_unknown,
            self.frames_bad_crc, self.frames_bad_length, self.frames_bad_content, self.frames_not_finite,
        )  # fmt: skip

    def snapshot(self) -> dict[str, int]:
        """Return all counters by name."""
        return dict(zip(LEDGER_FIELDS, self.values(), strict=True))


# The first counter of each balance is the sum of the others.
BYTE_FIELDS: Final = ("bytes_in", "bytes_in_good_frames", "bytes_in_bad_frames", "bytes_skipped", "bytes_pending")
FRAME_FIELDS: Final = ("frames_good", "frames_in_samples", "frames_in_replies", "frames_ignored", "frames_pending")
LOST_FIELDS: Final = tuple(name for name in LEDGER_FIELDS if name.startswith("lost_"))  # counters of losses by cause
NOTHING_LOST: Final = (0,) * len(LOST_FIELDS)


def lost(counts: Mapping[str, int]) -> int:
    """Return the number of lost samples in a snapshot, without gaps of unknown size."""
    return counts["lost_gap_device"] + counts["lost_crc"] + counts["lost_overrun"] + counts["lost_queue"]


def bytes_open(counts: Mapping[str, int]) -> int:
    """Return the number of uncounted bytes in a snapshot; 0 if the ledger balances."""
    return _open(*itemgetter(*BYTE_FIELDS)(counts))


def frames_open(counts: Mapping[str, int]) -> int:
    """Return the number of uncounted good frames in a snapshot; 0 if the ledger balances."""
    return _open(*itemgetter(*FRAME_FIELDS)(counts))


def _open(count: int, *accounted: int) -> int:
    return count - sum(accounted)
