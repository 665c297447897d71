"""Parser of the HTTP/1.1 reply to one request. It only computes: the client reads the bytes.

    head (1xx: ignored) ─▶ head ─▶ body: Content-Length | chunks | until the end of the connection

The limit counts all bytes of the reply: interim replies, headers and the overhead of chunks cost time too.
"""

import re
from collections.abc import Callable
from typing import Final

STATUS_LINE: Final = re.compile(rb"HTTP/1\.[01] ([1-9][0-9]{2})(?: [^\r\n]*)?")
HEADER: Final = re.compile(rb"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([^\r\n]*?)[ \t]*")
LENGTH: Final = re.compile(rb"[0-9]{1,9}")
CHUNK_LINE: Final = re.compile(rb"([0-9A-Fa-f]{1,8})[ \t]*(?:;[^\r\n]*)?")
# Maximum length of the status line and the headers, bytes. imud parses them in one turn: 8 kB of headers cost 1 ms.
HEAD_BYTES_MAX: Final = 8192
LINE_BYTES_MAX: Final = 256  # maximum length of the line before a chunk, and of a line after the last chunk, bytes
HEAD_END: Final = b"\r\n\r\n"
LINE_END: Final = b"\r\n"
SWITCHING_PROTOCOLS: Final = 101
WITHOUT_BODY: Final = (204, 304)


class InvalidReply(Exception):
    """The bytes are not a valid HTTP reply, or the reply is too long."""


class ReplyParser:
    """Parser of one reply. Synchronization: one thread."""

    def __init__(self, bytes_max: int) -> None:
        """`bytes_max` is the maximum number of bytes of the complete reply."""
        self.status = 0  # status of the final reply; 0 before its head
        self.headers: dict[str, str] = {}  # headers of the final reply, with names in lower case
        self.body = bytearray()
        self.is_complete = False
        self.rest = b""  # bytes after a reply with status 101: the first frames of the WebSocket
        self._bytes_max = bytes_max
        self._received_bytes = 0
        self._buffer = bytearray()
        self._missing_bytes = 0  # bytes of the body, or of the chunk, that are still missing
        self._step: Callable[[], bool] = self._read_head

    def feed(self, data: bytes) -> None:
        """Add bytes. Raises InvalidReply."""
        self._received_bytes += len(data)
        self._buffer += data
        while not self.is_complete and self._step():
            pass
        if not self.is_complete and self._received_bytes > self._bytes_max:
            raise InvalidReply(f"expected at most {self._bytes_max} bytes, got more")

    def end(self) -> None:
        """Add the end of the connection. Raises InvalidReply if the reply is not complete."""
        if self._step == self._read_until_end:
            self.is_complete = True
        if not self.is_complete:
            raise InvalidReply("expected a complete reply, got the end of the connection")

    # Each step reads a part of the buffer. It returns whether the next step can follow, or needs more bytes.

    def _read_head(self) -> bool:
        end = self._buffer.find(HEAD_END, 0, HEAD_BYTES_MAX + len(HEAD_END))
        if end < 0:
            if len(self._buffer) > HEAD_BYTES_MAX:
                raise InvalidReply(f"expected headers of at most {HEAD_BYTES_MAX} bytes, got more")
            return False
        status_line, *lines = bytes(self._buffer[:end]).split(LINE_END)
        del self._buffer[: end + len(HEAD_END)]
        match = STATUS_LINE.fullmatch(status_line)
        if match is None:
            raise InvalidReply("expected an HTTP/1.1 reply, got other bytes")
        status = int(match[1])
        if status < 200 and status != SWITCHING_PROTOCOLS:  # an interim reply
            return True
        self.status = status
        self.headers = _parse_headers(lines)
        self._choose_body()
        return True

    def _choose_body(self) -> None:
        encoding = self.headers.get("transfer-encoding")
        length = self.headers.get("content-length")
        if self.status == SWITCHING_PROTOCOLS:
            self.rest = bytes(self._buffer)
            self.is_complete = True
        elif self.status in WITHOUT_BODY:
            self.is_complete = True
        elif encoding is not None:
            if encoding.lower() != "chunked":
                raise InvalidReply("expected the transfer encoding chunked, got another encoding")
            self._step = self._read_chunk_line
        elif length is not None:
            if LENGTH.fullmatch(length.encode()) is None or int(length) > self._bytes_max:
                raise InvalidReply(f"expected at most {self._bytes_max} bytes, got more")
            self._missing_bytes = int(length)
            self._step = self._read_length
        else:
            self._step = self._read_until_end

    def _read_length(self) -> bool:
        self._take_body()
        self.is_complete = self._missing_bytes == 0
        return False

    def _read_until_end(self) -> bool:
        self.body += self._buffer
        self._buffer.clear()
        return False

    def _read_chunk_line(self) -> bool:
        line = self._take_line()
        if line is None:
            return False
        match = CHUNK_LINE.fullmatch(line)
        if match is None:
            raise InvalidReply("expected the length of a chunk, got other bytes")
        self._missing_bytes = int(match[1], 16)
        self._step = self._read_chunk if self._missing_bytes else self._read_trailer
        return True

    def _read_chunk(self) -> bool:
        self._take_body()
        if self._missing_bytes or len(self._buffer) < len(LINE_END):
            return False
        if not self._buffer.startswith(LINE_END):
            raise InvalidReply("expected the end of a chunk, got other bytes")
        del self._buffer[: len(LINE_END)]
        self._step = self._read_chunk_line
        return True

    def _read_trailer(self) -> bool:
        line = self._take_line()
        self.is_complete = line == b""
        return line is not None

    def _take_body(self) -> None:
        piece = self._buffer[: self._missing_bytes]
        del self._buffer[: len(piece)]
        self.body += piece
        self._missing_bytes -= len(piece)

    def _take_line(self) -> bytes | None:
        """Return the next line without its end; None if it is not complete."""
        end = self._buffer.find(LINE_END, 0, LINE_BYTES_MAX + len(LINE_END))
        if end < 0:
            if len(self._buffer) > LINE_BYTES_MAX:
                raise InvalidReply(f"expected a line of at most {LINE_BYTES_MAX} bytes, got a longer line")
            return None
        line = bytes(self._buffer[:end])
        del self._buffer[: end + len(LINE_END)]
        return line


def _parse_headers(lines: list[bytes]) -> dict[str, str]:
    """Return the headers. Raises InvalidReply. Two different lengths or encodings would have two meanings."""
    headers: dict[str, str] = {}
    for line in lines:
        match = HEADER.fullmatch(line)
        if match is None:
            raise InvalidReply("expected a header, got other bytes")
        name = match[1].decode("ascii").lower()
        value = match[2].decode("latin-1")
        if headers.get(name, value) != value and name in ("content-length", "transfer-encoding"):
            raise InvalidReply(f"expected one header {name}, got several")
        headers[name] = value
    return headers
