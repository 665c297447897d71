"""Finds the lines of text in what is left of a HiPNUC byte stream once its binary frames are taken out.

A line is 1 … 255 printable ASCII characters or tabs, ended by LF or CR LF. A binary frame may cut a line anywhere, the
two parts belong together. Text has no check value: after any other byte a line begins anew, so a damaged line can
leave its end behind as a line of its own; those who wait for a reply know what it looks like.
"""

from typing import Final

from imud.contracts.codec import TextLine
from imud.ledger import Ledger

LINE_CHARACTERS_MAX: Final = 255
"""Longest line, without its end: replies of the manual are below 80. More means that the line end was lost."""

_PRINTABLE: Final = bytes([0x09, *range(0x20, 0x7F)])


class LineFinder:
    """Gathers text across reads and frames, and books every byte it was given: good, bad, skipped, or still held.

    Synchronization: one thread. Holds at most LINE_CHARACTERS_MAX + 1 bytes.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self._held = b""
        """Printable characters without a line end yet, with the CR that may belong to it."""
        self._held_bad = 0
        """How many of them, from the first on, lie where a damaged frame claimed to be."""
        self._overlong = False
        """The line is longer than allowed: it is dropped up to its end."""

    @property
    def pending_bytes(self) -> int:
        """Bytes held for a line that has not ended."""
        return len(self._held)

    def take(self, data: bytes, bad: int) -> list[TextLine]:
        """Take bytes that belong to no frame, the first `bad` of them inside a damaged one; return whole lines."""
        lines: list[TextLine] = []
        start = 0
        while (feed := data.find(b"\n", start)) >= 0:
            self._extend(data[start:feed], max(bad - start, 0))
            self._end(bad > feed, lines)
            start = feed + 1
        if start < len(data):
            self._extend(data[start:], max(bad - start, 0))
        return lines

    def break_off(self) -> None:
        """Something other than text came: what is held is no line."""
        self._drop(len(self._held))
        self._overlong = False

    def clear(self) -> None:
        """The stream broke: what is held is skipped."""
        self._held_bad = 0
        self.break_off()

    def _extend(self, part: bytes, bad: int) -> None:
        """Append `part`, which has no LF, and keep the printable characters after the last other byte."""
        self._held_bad += min(bad, len(part))
        held = self._held = self._held + part
        returned = held.endswith(b"\r")
        body = held[:-1] if returned else held
        characters = len(body) - len(body.rstrip(_PRINTABLE))
        if characters < len(body):
            self._overlong = False
            self._drop(len(body) - characters)
        if characters > LINE_CHARACTERS_MAX:
            self._overlong = True
        if self._overlong:
            self._drop(characters)

    def _end(self, bad: bool, lines: list[TextLine]) -> None:
        """The LF of a line; `bad` says whether it lies inside a damaged frame."""
        ledger = self._ledger
        text = self._held.removesuffix(b"\r")
        if text and not self._overlong:
            lines.append(TextLine(text.decode("ascii")))
            ledger.bytes_in_good_frames += len(self._held) + 1
            ledger.frames_good += 1
            ledger.frames_in_replies += 1
            self._held, self._held_bad = b"", 0
            return
        self.break_off()
        if bad:
            ledger.bytes_in_bad_frames += 1
        else:
            ledger.bytes_skipped += 1

    def _drop(self, count: int) -> None:
        """Give up the first `count` bytes held."""
        bad = min(count, self._held_bad)
        self._ledger.bytes_in_bad_frames += bad
        self._ledger.bytes_skipped += count - bad
        self._held_bad -= bad
        self._held = self._held[count:]
