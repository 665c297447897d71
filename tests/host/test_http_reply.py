"""Replies of HTTP/1 servers: each split, each kind of content, and the limits."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.host.http_reply import CONTENT_BYTES, HEADERS_MAX, INTERIM_MAX, HttpReply, InvalidReply

INTERIM = b"HTTP/1.1 100 Continue\r\n\r\n"
# Reply, status, content, and whether the server reads another request
REPLIES = (
    (b"HTTP/1.1 204 No Content\r\nX: y\r\n\r\n", 204, b"", True),
    (b"HTTP/1.1 204 No Content\nX: y\n\n", 204, b"", True),
    (b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\nabc", 200, b"abc", True),
    (b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\nConnection: Close\r\n\r\n", 200, b"", False),
    (b"HTTP/1.0 200 OK\r\nContent-Length: 1\r\n\r\na", 200, b"a", False),
    (b"HTTP/1.1 400\r\nTransfer-Encoding: chunked\r\n\r\n3;a=b\r\nabc\r\nA \r\n0123456789\r\n0\r\nT: x\r\n\r\n",
     400, b"abc0123456789", True),
    (INTERIM + b"HTTP/1.1 103 Early Hints\r\nLink: x\r\n\r\nHTTP/1.1 503 Busy\r\nContent-Length: 0\r\n\r\n",
     503, b"", True),
    (b"HTTP/1.1 500 Error\r\nContent-Length: 50000\r\n\r\n" + b"x" * 5000, 500, b"x" * CONTENT_BYTES, False),
    (b"HTTP/1.1 500 Error\r\n\r\n" + b"x" * 5000, 500, b"x" * CONTENT_BYTES, False),
)  # fmt: skip


@pytest.mark.parametrize(("data", "status", "content", "keeps_connection"), REPLIES)
@pytest.mark.parametrize("step", [1, 7, 100_000])
def test_replies(data: bytes, status: int, content: bytes, keeps_connection: bool, step: int) -> None:
    reply = HttpReply()
    for offset in range(0, len(data), step):
        assert not reply.is_complete or len(content) == CONTENT_BYTES
        reply.feed(data[offset : offset + step])
    assert (reply.is_complete, reply.status, bytes(reply.content)) == (True, status, content)
    assert reply.keeps_connection == keeps_connection


def test_content_up_to_the_end() -> None:
    reply = HttpReply()
    reply.feed(b"HTTP/1.1 401 Unauthorized\r\n\r\nno token")
    assert not reply.is_complete
    reply.end()
    assert (reply.is_complete, bytes(reply.content), reply.keeps_connection) == (True, b"no token", False)


def test_bytes_after_the_reply_end_the_connection() -> None:
    reply = HttpReply()
    reply.feed(b"HTTP/1.1 204 No Content\r\n\r\nHTTP/1.1 204")
    assert (reply.is_complete, reply.keeps_connection) == (True, False)


@pytest.mark.parametrize("length", [0, 1, 20, 45, 60, 80])
def test_incomplete_reply(length: int) -> None:
    data = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n3\r\nabc\r\n0\r\n\r\n"
    reply = HttpReply()
    reply.feed(data[: min(length, len(data) - 1)])
    with pytest.raises(ConnectionError, match="closed the connection"):
        reply.end()


INVALID = {
    "other protocol": b"SSH-2.0-OpenSSH\r\n", "no code": b"HTTP/1.1 abc\r\n", "HTTP/2": b"HTTP/2 200\r\n",
    "other protocol after 101": b"HTTP/1.1 101 Switching Protocols\r\n\r\n", "no header": b"HTTP/1.1 200 OK\r\nabc\r\n",
    "negative length": b"HTTP/1.1 200 OK\r\nContent-Length: -1\r\n\r\n",
    "two lengths": b"HTTP/1.1 200 OK\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n",
    "encoding": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: gzip, chunked\r\n\r\n",
    "chunk size": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nx\r\n",
    "chunk end": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n1\r\nabc\r\n",
    "interim replies": INTERIM * (INTERIM_MAX + 1),
    "headers": b"HTTP/1.1 200 OK\r\n" + b"a: b\r\n" * (HEADERS_MAX + 1),
    "headers of interim replies": (b"HTTP/1.1 100 C\r\n" + b"a: b\r\n" * 30 + b"\r\n") * 4,
    "long line": b"HTTP/1.1 200 " + b"x" * 10_000,
    "long headers": b"HTTP/1.1 200 OK\r\n" + (b"a" * 999 + b":\r\n") * 20,
    "trailers": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n" + b"a: b\r\n" * 101,
    "chunks of one byte": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"
    + (b"1;" + b"e" * 8000 + b"\r\na\r\n") * 3,
}  # fmt: skip


@pytest.mark.parametrize("data", INVALID.values(), ids=list(INVALID))
@pytest.mark.parametrize("step", [1, 100_000])
def test_invalid_replies(data: bytes, step: int) -> None:
    reply = HttpReply()

    def feed_all() -> None:
        for offset in range(0, len(data), step):
            reply.feed(data[offset : offset + step])

    with pytest.raises(InvalidReply, match="expected"):
        feed_all()


@given(st.sampled_from([data for data, *_ in REPLIES[:7]]), st.lists(st.integers(0, 200)))
def test_any_split_has_the_same_result(data: bytes, offsets: list[int]) -> None:
    parts, whole = HttpReply(), HttpReply()
    whole.feed(data)
    bounds = [0, *sorted(offset for offset in offsets if offset < len(data)), len(data)]
    for start, end in pairwise(bounds):
        parts.feed(data[start:end])
    assert (parts.status, parts.content, parts.is_complete) == (whole.status, whole.content, whole.is_complete)
    assert parts.keeps_connection == whole.keeps_connection
