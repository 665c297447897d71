"""CAN logs as `candump -L` of can-utils writes them: one frame a line, stamped with the wall clock.

    (1763717507.123456) can0 065#0000803F00000040
     time s              bus  identifier, 3 hex digits (11 bits) or 8 (29 bits), # data

Lines that are not classical data frames are skipped and counted: remote frames (`#R`), CAN FD (`##`), error frames
(bit 29 of the identifier). A direction mark (`R`, `T`) after the data and a raw length code (`_9`) after eight bytes
are accepted.
"""

import re
from collections.abc import Iterator
from typing import BinaryIO, Final

from imud.formats.can import ERROR_FLAG, EXTENDED_ID_MAX, STANDARD_ID_MAX, CanFrame
from imud.units import NS_PER_S

LINE_BYTES_MAX: Final = 512
"""The longest line, CAN FD with 64 bytes and a long bus name, has some 190."""
_FRAME: Final = re.compile(
    rb"\((\d{1,18})\.(\d{1,9})\) +(\S+) +([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#((?:[0-9A-Fa-f]{2}){0,8})(?:_[0-9A-Fa-f])?"
    rb"(?: [RT])?\s*"
)
_OTHER: Final = re.compile(
    rb"\(\d{1,18}\.\d{1,9}\) +\S+ +[0-9A-Fa-f]{3,8}#(?:#[0-9A-Fa-f]+|R[\dA-Fa-f_]*)(?: [RT])?\s*"
)


class CandumpReader:
    """Reader of a log from any binary stream. Iterate once: frames with the log's times as `t_rx_ns`, never falling."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.passed_over = 0
        """Valid lines that are no data frame."""
        self.bad_lines = 0
        self.first_bad = 0
        """Number of the first line that is none of a log, from 1; 0 when there is none."""

    @property
    def problem(self) -> str:
        """After iterating: the fault of the file, one sentence; empty when it has none."""
        if not self.bad_lines:
            return ""
        return f"{self.bad_lines} lines are none of a candump log (candump -L), the first is line {self.first_bad}"

    def __iter__(self) -> Iterator[CanFrame]:
        newest_ns, number = 0, 0
        while line := self._file.readline(LINE_BYTES_MAX):
            number += 1
            match = _FRAME.fullmatch(line)
            if match is None:
                self._note(line, number)
                continue
            seconds, fraction, _, digits, data = match.groups()
            can_id = int(digits, 16)
            if can_id & ERROR_FLAG or can_id > EXTENDED_ID_MAX or (len(digits) == 3 and can_id > STANDARD_ID_MAX):
                self._note(line if can_id & ERROR_FLAG else b"bad", number, passed=bool(can_id & ERROR_FLAG))
                continue
            newest_ns = max(newest_ns, int(seconds) * NS_PER_S + int(fraction.ljust(9, b"0")))
            yield CanFrame(can_id, len(digits) == 8, bytes.fromhex(data.decode("ascii")), newest_ns)

    def _note(self, line: bytes, number: int, *, passed: bool = False) -> None:
        if passed or _OTHER.fullmatch(line):
            self.passed_over += 1
        elif line.strip():
            self.bad_lines += 1
            self.first_bad = self.first_bad or number
