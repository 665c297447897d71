"""Reply of an HTTP/1 server to one request (RFC 9112), with a limit for each part.

    HTTP/1.1 100 Continue ⏎ ⏎  …  HTTP/1.1 200 OK ⏎ header ⏎ … ⏎ ⏎  content
    interim replies (1xx)         status line         headers      by length, in chunks, or up to the end

The parser accepts any split of the bytes and contains no I/O.
"""

import re
from collections.abc import Callable
from typing import Final

LINE_BYTES: Final = 8192  # maximum length of a line, bytes: the limit of usual servers for their own headers
CHUNK_LINE_BYTES: Final = 256  # maximum length of a line before or after a chunk, bytes. A size has at most 10 bytes.
HEAD_BYTES: Final = 16_384  # maximum length of all lines of a reply, with interim replies and lines of chunks, bytes
HEADERS_MAX: Final = 100  # maximum number of headers of a reply, with its interim replies. InfluxDB sends about ten.
# Maximum number of interim replies (1xx). imud requests none, and a proxy can send one or two.
INTERIM_MAX: Final = 8
SWITCHING_PROTOCOLS: Final = 101  # status of the final reply of HTTP. The bytes of another protocol follow.
NO_CONTENT: Final = frozenset((204, 304))  # status codes of replies without content
_STATUS: Final = re.compile(rb"HTTP/1\.([01]) ([1-5][0-9][0-9])(?: .*)?")
_NAME: Final = re.compile(rb"[!#$%&'*+.^_`|~0-9A-Za-z-]+")
_LENGTH: Final = re.compile(r"[0-9]{1,18}")
_CHUNK: Final = re.compile(rb"([0-9A-Fa-f]{1,8})[ \t]*(?:;.*)?")


class InvalidReply(Exception):
    """The bytes are not a reply of HTTP/1, or a part exceeds its limit."""


class IncompleteReply(InvalidReply):
    """The connection ended before the end of the reply."""


class HttpReply:
    """Parser of one reply. Synchronization: one thread."""

    def __init__(self, content_bytes: int, *, truncates_content: bool = False) -> None:
        """`content_bytes` is the maximum length of the content. With `truncates_content`, the reply is complete after
        these bytes, and the connection must end. Otherwise a longer content is invalid."""
        self.status = 0  # status code; 0 before the status line of the final reply
        self.headers: dict[str, str] = {}  # headers of the present reply: names in lower case, values of a name joined
        self.content = bytearray()
        self.rest = b""  # bytes after a reply with the status SWITCHING_PROTOCOLS
        self.is_complete = False
        self.keeps_connection = False  # whether the server reads another request after this complete reply
        self._content_bytes = content_bytes
        self._truncates_content = truncates_content
        self._data = bytearray()  # received bytes that no step has processed
        self._searched_bytes = 0  # bytes of `_data` without a line feed
        self._line_bytes = 0
        self._header_count = 0
        self._interim_count = 0
        self._length: int | None = None  # rest of the content or of the chunk; None: up to the end of the connection
        self._is_chunked = False
        self._read_line: Callable[[bytes], None] | None = self._read_status  # None: content follows

    def feed(self, data: bytes) -> None:
        """Process received bytes. Raises InvalidReply."""
        self._data += data
        while not self.is_complete and (self._take_content() if self._read_line is None else self._take_line()):
            pass
        if self.is_complete and self._data:
            self.keeps_connection = False  # bytes that imud did not request would precede the next reply

    def end(self) -> None:
        """Process the end of the connection. Raises IncompleteReply."""
        self.keeps_connection = False
        if self.is_complete:
            return
        if not self._line_bytes and not self._data:
            raise IncompleteReply("the server closed the connection without a reply")
        if self._read_line is not None or self._length is not None:
            raise IncompleteReply("the server closed the connection within its reply")
        self.is_complete = True

    # --- lines --------------------------------------------------------------------------------------------------------

    def _take_line(self) -> bool:
        """Read the next line. Return False if the line is incomplete. Raises InvalidReply above a limit."""
        end = self._data.find(b"\n", self._searched_bytes)
        length = len(self._data) if end < 0 else end + 1
        line_bytes_max = CHUNK_LINE_BYTES if self._is_chunked else LINE_BYTES
        if length > min(line_bytes_max, HEAD_BYTES - self._line_bytes):
            raise InvalidReply(
                f"expected a line of at most {line_bytes_max} bytes and lines of at most {HEAD_BYTES} bytes together, "
                f"got more"
            )
        if end < 0:
            self._searched_bytes = len(self._data)
            return False

        line = bytes(self._data[:end]).removesuffix(b"\r")
        del self._data[:length]
        self._searched_bytes = 0
        self._line_bytes += length
        assert self._read_line is not None
        self._read_line(line)
        return True

    def _read_status(self, line: bytes) -> None:
        match = _STATUS.fullmatch(line)
        if match is None:
            raise InvalidReply("expected an HTTP/1.1 reply, got other bytes")

        self.headers = {}
        self._read_line = self._read_header
        status = int(match[2])
        if status >= 200 or status == SWITCHING_PROTOCOLS:
            self.status = status
            self.keeps_connection = match[1] == b"1"
            return
        self._interim_count += 1
        if self._interim_count > INTERIM_MAX:
            raise InvalidReply(f"expected at most {INTERIM_MAX} interim replies (status 1xx), got more")

    def _read_header(self, line: bytes) -> None:
        if not line:
            self._start_content()
            return

        self._count_header()
        name_bytes, colon, value_bytes = line.partition(b":")
        if not colon or not _NAME.fullmatch(name_bytes) or b"\r" in value_bytes:
            raise InvalidReply("expected a header, got other bytes")
        name = name_bytes.decode("ascii").lower()
        value = value_bytes.strip(b" \t").decode("latin-1")
        if self.headers.get(name, value) != value:
            value = f"{self.headers[name]}, {value}"
        self.headers[name] = value

    def _read_chunk_size(self, line: bytes) -> None:
        match = _CHUNK.fullmatch(line)
        if match is None:
            raise InvalidReply("expected the length of a chunk, got other bytes")
        self._length = int(match[1], 16)
        self._read_line = None if self._length else self._read_trailer

    def _read_chunk_end(self, line: bytes) -> None:
        if line:
            raise InvalidReply("expected the end of a chunk, got other bytes")
        self._read_line = self._read_chunk_size

    def _read_trailer(self, line: bytes) -> None:
        self._count_header()
        self.is_complete = not line

    def _count_header(self) -> None:
        self._header_count += 1
        if self._header_count > HEADERS_MAX:
            raise InvalidReply(f"expected at most {HEADERS_MAX} headers, got more")

    # --- content ------------------------------------------------------------------------------------------------------

    def _start_content(self) -> None:
        """Choose the end of the content. Raises InvalidReply for headers with more than one meaning."""
        encoding = self.headers.get("transfer-encoding")
        length = self.headers.get("content-length")
        if "close" in self.headers.get("connection", "").lower():
            self.keeps_connection = False

        if not self.status:
            self._read_line = self._read_status
        elif self.status == SWITCHING_PROTOCOLS:
            self.rest = bytes(self._data)
            self.keeps_connection = False
            self.is_complete = True
        elif self.status in NO_CONTENT:
            self.is_complete = True
        elif encoding is not None:
            if encoding.lower() != "chunked" or length is not None:
                raise InvalidReply("expected the transfer encoding chunked without a length, got other headers")
            self._is_chunked = True
            self._read_line = self._read_chunk_size
        elif length is not None:
            if not _LENGTH.fullmatch(length):
                raise InvalidReply("expected one header content-length with a number, got another value")
            self._length = int(length)
            self.is_complete = self._length == 0
            self._read_line = None
            if self._length > self._content_bytes and not self._truncates_content:
                raise InvalidReply(f"expected at most {self._content_bytes} bytes, got more")
        else:
            self.keeps_connection = False
            self._read_line = None

    def _take_content(self) -> bool:
        """Take content up to its length. Return False if there are no bytes."""
        size = len(self._data) if self._length is None else min(self._length, len(self._data))
        if not size:
            return False

        self.content += self._data[:size]
        del self._data[:size]
        if self._length is not None:
            self._length -= size
        if self._length == 0 and self._is_chunked:
            self._read_line = self._read_chunk_end
        elif self._length == 0:
            self.is_complete = True

        if len(self.content) > self._content_bytes:
            if not self._truncates_content:
                raise InvalidReply(f"expected at most {self._content_bytes} bytes, got more")
            del self.content[self._content_bytes :]
            self.is_complete = True
            self.keeps_connection = False
        return True
