"""CDR, the encoding of ROS 2 messages: XCDR version 1, little-endian (OMG DDSI-RTPS 2.5, 10.2; CORBA 3.3, 9.3).

A message begins with the encapsulation 00 01 00 00. Each number is aligned to its own size, counted from behind the
encapsulation. A string is its length as u32 with the final NUL, its bytes, and the NUL; a sequence is its length as u32
and its elements; arrays have no length.

`Layout` is for messages that have the same size each time, as all of samples: it is one `struct` with the padding in
its place. `CdrWriter` is for others.
"""

import re
import struct
from typing import Any, Final

ENCAPSULATION: Final = b"\x00\x01\x00\x00"
"""CDR_LE, no options."""
SIZES: Final = {"B": 1, "b": 1, "?": 1, "s": 1, "H": 2, "h": 2, "I": 4, "i": 4, "f": 4, "Q": 8, "q": 8, "d": 8}
"""Size and alignment of numbers by their code of `struct`; `s` is bytes that are encoded already."""
_NUMBERS: Final = re.compile(r"(\d*)([a-zA-Z?])")


class Layout:
    """A layout of messages of one size: numbers by their codes, and texts that are always the same. Immutable."""

    def __init__(self, *parts: str) -> None:
        """Each part is codes of numbers, as `iI` or `3d`, or a constant text after a `"`; in their order."""
        self._format, self._at = f"<{len(ENCAPSULATION)}s", 0
        texts: list[bytes] = []
        for part in parts:
            if part.startswith('"'):
                texts.append(_text(part[1:]))
                self._align(SIZES["I"])
                self._add(len(texts[-1]), "s")
            else:
                for count, code in _NUMBERS.findall(part):
                    self._align(SIZES[code])
                    self._add(int(count or 1), code)
        self.texts: Final = tuple(texts)
        """The texts with their lengths, as `pack` takes them."""
        self.pack: Final = struct.Struct(self._format).pack
        """Packs a message from ENCAPSULATION, numbers, and each of `texts` where it stands among the parts."""

    def _add(self, count: int, code: str) -> None:
        self._format += f"{count}{code}"
        self._at += count * SIZES[code]

    def _align(self, size: int) -> None:
        missing = -self._at % size
        self._format += f"{missing}x" if missing else ""
        self._at += missing


class CdrWriter:
    """Writer of one message. Synchronization: one thread."""

    def __init__(self) -> None:
        self._buffer = bytearray(ENCAPSULATION)

    def number(self, code: str, value: Any) -> "CdrWriter":
        """Append a number by its code of `struct`. Raises struct.error for one that does not fit."""
        self._align(SIZES[code])
        self._buffer += struct.pack("<" + code, value)
        return self

    def text(self, value: str) -> "CdrWriter":
        """Append a string."""
        self._align(4)
        self._buffer += _text(value)
        return self

    def done(self) -> bytes:
        """Return the message."""
        return bytes(self._buffer)

    def _align(self, size: int) -> None:
        self._buffer += bytes(-(len(self._buffer) - len(ENCAPSULATION)) % size)


def _text(value: str) -> bytes:
    data = value.replace("\0", "").encode(errors="replace") + b"\0"
    return len(data).to_bytes(4, "little") + data
