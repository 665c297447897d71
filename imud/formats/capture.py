r"""Capture files: bytes of a link. A raw capture is the bytes alone; a stamped one has the time of each read.

A stamped capture begins with one line of ASCII, then come records to the end of the file, little-endian::

    #imud-capture 1 driver=hipnuc-uart baud=115200 start_utc_ns=1763717507000000000\n
    ┌───────────────┬─────────────┬───────────────┐
    │ t_ns i64      │ length u32  │ length bytes  │  t_ns is CLOCK_MONOTONIC right after the read
    └───────────────┴─────────────┴───────────────┘

Values of the first line are percent-encoded (RFC 3986), unknown keys are kept, their order is free. Any file that does
not begin with the magic is a raw capture. A last record that is cut short (power loss) is normal; a length over
RECORD_BYTES_MAX or a time before its predecessor's means damage: reading stops there and `problem` says so.
"""

import struct
from collections.abc import Iterator, Mapping
from typing import BinaryIO, Final, NamedTuple
from urllib.parse import unquote

from imud.model.errors import ImudError

MAGIC: Final = b"#imud-capture "
VERSION: Final = "1"
HEADER_BYTES_MAX: Final = 4096
RECORD_BYTES_MAX: Final = 1 << 20
"""Largest read of any link; a larger length is damage."""
RAW_CHUNK_BYTES: Final = 4096
"""Size of the pieces of a raw capture: as much as a tty hands over at once."""

RECORD: Final = struct.Struct("<qI")
"""Head of a record: `t_ns`, length."""


class Chunk(NamedTuple):
    """Bytes of one read."""

    t_ns: int | None
    """CLOCK_MONOTONIC right after the read; None in a raw capture."""
    data: bytes


class CaptureReader:
    """Reader of a raw or stamped capture from any binary stream, seekable or not. Iterate once.

    The first bytes of the file decide which of the two it is.
    """

    def __init__(self, file: BinaryIO) -> None:
        """Raises ImudError for a stamped capture of another version, or with a broken first line."""
        self._file = file
        self._offset = 0
        self.problem = ""
        """After iterating: how the file is cut short or damaged, one sentence; empty when it is whole."""
        self.is_damaged = False
        """After iterating: whether it is damaged, not only cut short."""
        self._head = _read_fully(file, len(MAGIC))
        self.stamped = self._head == MAGIC
        self.details: Mapping[str, str] = self._read_details() if self.stamped else {}
        """Everything in the first line, decoded."""

    @property
    def baud(self) -> int:
        """Rate named in the first line, bit/s; 0 when none is."""
        return self._number("baud")

    @property
    def hold_ns(self) -> int:
        """Longest time that the adapter held bytes back, as named in the first line, ns; 0 if it is not."""
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
                f"capture of version {version[:20]!r}: this imud reads version {VERSION}; or is it damaged?"
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
                self.problem = f"the last {len(header)} bytes are a record cut short, left out"
                return
            t_ns, length = RECORD.unpack(header)
            if length > RECORD_BYTES_MAX or (newest_ns is not None and t_ns < newest_ns):
                self.is_damaged = True
                self.problem = (
                    f"damaged at byte {self._offset}: record of {length} bytes at {t_ns} ns; the rest is left out"
                )
                return
            data = _read_fully(self._file, length)
            if len(data) < length:
                self.problem = f"the last {len(header) + len(data)} bytes are a record cut short, left out"
                return
            self._offset += len(header) + length
            newest_ns = t_ns
            yield Chunk(t_ns, data)


def _read_fully(file: BinaryIO, size: int) -> bytes:
    """Up to `size` bytes; fewer only at the end (a pipe hands over less at a time)."""
    parts = []
    while size > 0 and (part := file.read(size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)
