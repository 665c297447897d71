"""The ledger of one device: an account of every byte, frame and lost sample. It closes to zero at every moment.

Hot paths add to plain integers; the outputs read them. Synchronization: written and read by the event loop only,
between two callbacks; another thread asks the loop for a snapshot, because inside a callback the sums are not closed.
"""

from collections.abc import Mapping
from operator import attrgetter
from typing import Final

LEDGER_FIELDS: Final = (
    "bytes_in",  # every byte (or CAN data byte, or register byte) that the link delivered
    "bytes_in_good_frames",
    "bytes_in_bad_frames",  # from a sync word whose frame failed its check, up to where that frame claimed to end
    "bytes_skipped",  # belong to no frame
    "bytes_pending",  # may still become a frame
    "frames_good",
    "frames_in_samples",
    "frames_in_replies",  # text lines and reply frames
    "frames_ignored",  # valid, without content that imud decodes
    "frames_pending",  # valid, waiting for the rest of their sample
    "frames_bad_crc",
    "frames_bad_length",
    "frames_bad_content",  # check value right, content impossible
    "unknown_tags",  # sub-packets whose tag is not known; the frame stays good
    "samples",
    "lost_gap_device",  # samples missing by the device's own counter, no cause heard
    "lost_crc",  # samples missing where a damaged frame was heard
    "lost_overrun",  # samples missing where the kernel counted an overrun
    "lost_queue",  # samples a queue of the daemon gave up
    "replies_late",  # replies that came after their time-out
    "replies_unsolicited",  # text that answers no request
    "frames_not_finite",  # good frames whose NaN or infinite values were left out
    "lost_unknown",  # gaps, not samples: how many are missing is not known within one
)
"""Names in the order of shared memory; new ones go to the end."""


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

    def __init__(self) -> None:
        for name in LEDGER_FIELDS:
            setattr(self, name, 0)

    def bytes_open(self) -> int:
        """Bytes unaccounted for; 0 in a ledger that closes."""
        return bytes_open(self.snapshot())

    def frames_open(self) -> int:
        """Good frames unaccounted for; 0 in a ledger that closes."""
        return frames_open(self.snapshot())

    def closes(self) -> bool:
        """Whether both sums are zero."""
        return self.bytes_open() == 0 and self.frames_open() == 0

    def frames_bad(self) -> int:
        """Damaged frames of every reason."""
        return self.frames_bad_crc + self.frames_bad_length + self.frames_bad_content

    def lost(self) -> int:
        """Samples lost by every cause; right within one for each gap but `lost_unknown`."""
        return lost(self.snapshot())

    def add_unknown_gap(self) -> None:
        """Count a gap between samples whose size is not known."""
        self.lost_unknown += 1

    def values(self) -> tuple[int, ...]:
        """Return all counters in the order of LEDGER_FIELDS."""
        values: tuple[int, ...] = _ALL(self)
        return values

    def snapshot(self) -> dict[str, int]:
        """Return all counters by name."""
        return dict(zip(LEDGER_FIELDS, self.values(), strict=True))


_ALL = attrgetter(*LEDGER_FIELDS)
LOST_FIELDS: Final = tuple(name for name in LEDGER_FIELDS if name.startswith("lost_"))
"""Losses by their cause."""


def lost(counts: Mapping[str, int]) -> int:
    """Samples lost by every cause in a snapshot, wherever it was read; gaps of unknown size are not among them."""
    return counts["lost_gap_device"] + counts["lost_crc"] + counts["lost_overrun"] + counts["lost_queue"]


def bytes_open(counts: Mapping[str, int]) -> int:
    """Bytes unaccounted for in a snapshot, wherever it was read; 0 in a ledger that closes."""
    accounted = counts["bytes_in_good_frames"] + counts["bytes_in_bad_frames"] + counts["bytes_skipped"]
    return counts["bytes_in"] - accounted - counts["bytes_pending"]


def frames_open(counts: Mapping[str, int]) -> int:
    """Good frames unaccounted for in a snapshot; 0 in a ledger that closes."""
    accounted = counts["frames_in_samples"] + counts["frames_in_replies"] + counts["frames_ignored"]
    return counts["frames_good"] - accounted - counts["frames_pending"]
