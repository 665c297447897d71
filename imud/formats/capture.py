r"""Capture files: received bytes of a link. A raw capture contains only the bytes; a stamped capture also the read
times.

A stamped capture starts with one line of ASCII. Records follow to the end of the file, little-endian::

    #imud-capture 1 driver=hipnuc-uart baud=115200 start_utc_ns=1763717507000000000\n
    ┌───────────────┬─────────────┬───────────────┐
    │ t_ns i64      │ length u32  │ length bytes  │  t_ns is CLOCK_MONOTONIC immediately after the read
    └───────────────┴─────────────┴───────────────┘

Values of the first line are percent-encoded (RFC 3986), in any order; the reader keeps unknown keys. A file without the
magic bytes is a raw capture. The last record may be incomplete (power loss). A length over RECORD_BYTES_MAX or a
decreasing time means damage: the reader stops and reports it in `problem`.
"""

import re
import struct
from collections.abc import Iterator, Mapping
from typing import BinaryIO, Final, NamedTuple
from urllib.parse import unquote

from imud.model.errors import ImudError

MAGIC: Final = b"#imud-capture "
VERSION: Final = "1"
HEADER_BYTES_MAX: Final = 4096
RECORD_BYTES_MAX: Final = 1 << 20  # Maximum size of one read of any link. A larger length means damage.
RAW_CHUNK_BYTES: Final = 4096  # size of the pieces of a raw capture, the maximum of one tty read

_HEXADECIMAL: Final = re.compile(rb"(?:[0-9A-Fa-f]{2}[ ,:\t]?){4,}[0-9A-Fa-f]?")

RECORD: Final = struct.Struct("<qI")  # head of a record: `t_ns`, length


class Chunk(NamedTuple):
    """Bytes of one read."""

    t_ns: int | None  # CLOCK_MONOTONIC immediately after the read; None in a raw capture
    data: bytes


class CaptureReader:
    """Reader of a raw or stamped capture from a binary stream, seekable or not. Iterate once. The first bytes of the
    file decide between raw and stamped."""

    def __init__(self, file: BinaryIO) -> None:
        """Raises ImudError for a stamped capture of another version or with an invalid first line, and for text."""
        self._file = file
        self._offset = 0
        self.problem = ""  # error of the file after the iteration, one sentence; empty if the file is complete
        self.is_damaged = False  # after the iteration: whether the file is damaged, not only incomplete
        self._head = _read_fully(file, len(MAGIC))
        self.stamped = self._head == MAGIC
        if _HEXADECIMAL.fullmatch(self._head):
            raise ImudError("expected the bytes of a device, got them as hexadecimal text; convert it with `xxd -r -p`")
        # Decoded keys and values of the first line
        self.details: Mapping[str, str] = self._read_details() if self.stamped else {}

    @property
    def baud(self) -> int:
        """Baud rate from the first line, bit/s; 0 if it is missing."""
        return self._number("baud")

    @property
    def hold_ns(self) -> int:
        """Latency timer of the adapter from the first line, ns; 0 if it is missing."""
        return self._number("hold_ns")

    def __iter__(self) -> Iterator[Chunk]:
        return self._records() if self.stamped else self._pieces()

    def _number(self, key: str) -> int:
        text = self.details.get(key, "")
        return int(text) if text.isascii() and text.isdigit() and len(text) < 19 else 0

    def _read_details(self) -> dict[str, str]:
        line = self._file.readline(HEADER_BYTES_MAX)
        self._offset = len(MAGIC) + len(line)
        version, *pairs = line.decode("ascii", "replace").split() or [""]
        if version != VERSION or not line.endswith(b"\n"):
            raise ImudError(
                f"cannot read the capture: expected version {VERSION}, got {version[:20]!r}; is the file damaged?"
            )
        return {key: unquote(value) for key, _, value in (pair.partition("=") for pair in pairs)}

    def _pieces(self) -> Iterator[Chunk]:
        data = self._head + _read_fully(self._file, RAW_CHUNK_BYTES - len(self._head))
        while data:
            yield Chunk(None, data)
            data = self._file.read(RAW_CHUNK_BYTES)

    def _records(self) -> Iterator[Chunk]:
        newest_ns: int | None = None
        while header := _read_fully(self._file, RECORD.size):
            if len(header) < RECORD.size:
                self.problem = f"the last {len(header)} bytes are an incomplete record; imud ignores them"
                return
            t_ns, length = RECORD.unpack(header)
            if length > RECORD_BYTES_MAX or (newest_ns is not None and t_ns < newest_ns):
                self.is_damaged = True
                self.problem = (
                    f"damaged at byte {self._offset}: record of {length} bytes at {t_ns} ns; imud ignores the rest"
                )
                return
            data = _read_fully(self._file, length)
            if len(data) < length:
                self.problem = f"the last {len(header) + len(data)} bytes are an incomplete record; imud ignores them"
                return
            self._offset += len(header) + length
            newest_ns = t_ns
            yield Chunk(t_ns, data)


def _read_fully(file: BinaryIO, size: int) -> bytes:
    """Return `size` bytes; fewer bytes only at the end of the file."""
    parts = []
    # a pipe returns fewer bytes per read
    while size > 0 and (part := file.read(size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)
