"""Reply of an HTTP/1 server to one request (RFC 9112), with a limit for each part.

    HTTP/1.1 100 Continue ⏎ ⏎  …  HTTP/1.1 204 No Content ⏎ header ⏎ … ⏎ ⏎  content
    interim replies (1xx)         status line              headers          by length, in chunks, or up to the end

The parser accepts any split of the bytes and contains no I/O.
"""

import re
from collections.abc import Callable
from typing import Final

LINE_BYTES: Final = 8192  # maximum length of a line, bytes: the limit of usual servers for their own headers
HEAD_BYTES: Final = 16_384  # maximum length of all lines of a reply together, with its interim replies, bytes
HEADERS_MAX: Final = 100  # maximum number of headers of a reply, with its interim replies. InfluxDB sends about ten.
# Maximum number of interim replies (1xx). imud requests none, and a proxy can send one or two.
INTERIM_MAX: Final = 8
# Maximum length of the content that imud reads, bytes. It is only for the message of an error.
CONTENT_BYTES: Final = 4096
_STATUS: Final = re.compile(rb"HTTP/1\.([01]) ([1-5][0-9][0-9])(?: .*)?")
_LENGTH: Final = re.compile(rb"[0-9]{1,18}")
_CHUNK: Final = re.compile(rb"([0-9A-Fa-f]{1,12})[ \t]*(?:;.*)?")
SWITCHING: Final = 101  # status of a change of the protocol, which imud does not request
NO_CONTENT: Final = frozenset((204, 304))  # status codes of replies without content


class InvalidReply(Exception):
    """The bytes are not a reply of HTTP/1, or a part exceeds its limit."""


class HttpReply:
    """Parser of one reply. Synchronization: one thread."""

    def __init__(self) -> None:
        self.status = 0  # status code; 0 before the status line of the final reply
        self.content = bytearray()  # start of the content, at most CONTENT_BYTES
        self.is_complete = False
        self.keeps_connection = False  # whether the server reads another request after this complete reply
        self._data = bytearray()  # received bytes that no step has processed
        self._searched = 0  # bytes of `_data` without a line feed
        self._line_bytes = 0
        self._headers = 0
        self._interims = 0
        self._length: int | None = None  # rest of the content or of the chunk; None: up to the end of the connection
        self._is_chunked = False
        # Function that processes the next part. It returns False if the part is incomplete.
        self._step: Callable[[], bool] = self._take_status

    def feed(self, data: bytes) -> None:
        """Process received bytes. Raises InvalidReply."""
        self._data += data
        while not self.is_complete and self._step():
            pass
        if self.is_complete and self._data:
            self.keeps_connection = False  # bytes that imud did not request would precede the next reply

    def end(self) -> None:
        """Process the end of the connection. Raises ConnectionError if the reply is incomplete."""
        self.keeps_connection = False
        if self.is_complete:
            return
        if not self.status and not self._line_bytes and not self._data:
            raise ConnectionError("the server closed the connection without a reply")
        if self._step != self._take_content or self._length is not None:
            raise ConnectionError("the server closed the connection within its reply")
        self.is_complete = True

    # --- steps --------------------------------------------------------------------------------------------------------

    def _take_status(self) -> bool:
        line = self._take_line()
        if line is None:
            return False
        match = _STATUS.fullmatch(line)
        if match is None or int(match[2]) == SWITCHING:
            raise InvalidReply("expected a status line of HTTP/1, got other bytes")

        status = int(match[2])
        if status < 200:
            self._interims += 1
            if self._interims > INTERIM_MAX:
                raise InvalidReply(f"expected at most {INTERIM_MAX} interim replies (status 1xx), got more")
            self._step = self._take_interim_header
            return True

        self.status = status
        self.keeps_connection = match[1] == b"1"
        self._step = self._take_header
        return True

    def _take_interim_header(self) -> bool:
        line = self._take_line()
        if line is None:
            return False
        self._count_header()
        if not line:
            self._step = self._take_status
        return True

    def _take_header(self) -> bool:
        line = self._take_line()
        if line is None:
            return False
        if not line:
            self._start_content()
            return True

        self._count_header()
        name, colon, value = line.partition(b":")
        if not colon:
            raise InvalidReply("expected a header of HTTP/1, got other bytes")
        self._note_header(name.strip().lower(), value.strip())
        return True

    def _note_header(self, name: bytes, value: bytes) -> None:
        if name == b"content-length":
            if not _LENGTH.fullmatch(value) or self._length not in (None, int(value)):
                raise InvalidReply("expected one length of the content, got another value")
            self._length = int(value)
        elif name == b"transfer-encoding":
            self._is_chunked = value.lower() == b"chunked"
            if not self._is_chunked:
                raise InvalidReply("expected the transfer encoding `chunked`, got another encoding")
        elif name == b"connection" and b"close" in value.lower():
            self.keeps_connection = False

    def _start_content(self) -> None:
        if self.status in NO_CONTENT:
            self.is_complete = True
        elif self._is_chunked:
            self._step = self._take_chunk_size
        else:
            self.is_complete = self._length == 0
            self.keeps_connection = self.keeps_connection and self._length is not None
            self._step = self._take_content

    def _take_content(self) -> bool:
        """Take content up to its length. The reply is complete after CONTENT_BYTES; then the connection must end."""
        rest_bytes = CONTENT_BYTES - len(self.content)
        size = len(self._data) if self._length is None else min(self._length, len(self._data))
        if not size:
            return False

        self.content += self._data[: min(size, rest_bytes)]
        del self._data[:size]
        if self._length is not None:
            self._length -= size

        if self._length == 0 and self._is_chunked:
            self._step = self._take_chunk_end
        elif self._length == 0:
            self.is_complete = True
        if not self.is_complete and len(self.content) >= CONTENT_BYTES:
            self.is_complete = True
            self.keeps_connection = False
        return True

    def _take_chunk_size(self) -> bool:
        line = self._take_line()
        if line is None:
            return False
        match = _CHUNK.fullmatch(line)
        if match is None:
            raise InvalidReply("expected the size of a chunk, got other bytes")
        self._length = int(match[1], 16)
        self._step = self._take_content if self._length else self._take_trailer
        return True

    def _take_chunk_end(self) -> bool:
        line = self._take_line()
        if line is None:
            return False
        if line:
            raise InvalidReply("expected the end of a chunk, got other bytes")
        self._step = self._take_chunk_size
        return True

    def _take_trailer(self) -> bool:
        line = self._take_line()
        if line is None:
            return False
        self._count_header()
        self.is_complete = not line
        return True

    # --- lines --------------------------------------------------------------------------------------------------------

    def _take_line(self) -> bytes | None:
        """Return the next line without its end; None if it is incomplete. Raises InvalidReply above a limit."""
        end = self._data.find(b"\n", self._searched)
        length = len(self._data) if end < 0 else end + 1
        if length > LINE_BYTES or self._line_bytes + length > HEAD_BYTES:
            raise InvalidReply(
                f"expected headers of at most {HEAD_BYTES} bytes with lines of at most {LINE_BYTES} bytes, got more"
            )
        if end < 0:
            self._searched = len(self._data)
            return None

        line = bytes(self._data[:end])
        del self._data[:length]
        self._searched = 0
        self._line_bytes += length
        return line.removesuffix(b"\r")

    def _count_header(self) -> None:
        self._headers += 1
        if self._headers > HEADERS_MAX:
            raise InvalidReply(f"expected at most {HEADERS_MAX} headers, got more")
