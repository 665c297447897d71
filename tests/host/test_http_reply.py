"""Replies of HTTP/1 servers: each split, each kind of content, and the limits."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.host.http_reply import (
    HEAD_BYTES,
    HEADERS_MAX,
    INTERIM_MAX,
    SWITCHING_PROTOCOLS,
    HttpReply,
    IncompleteReply,
    InvalidReply,
)

CONTENT_BYTES = 4096
CONTENT_BYTES_MAX = 65_536
HEAD = b"HTTP/1.1 200 OK\r\n"
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n"
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


def truncating_reply() -> HttpReply:
    return HttpReply(CONTENT_BYTES, truncates_content=True)


def parse(data: bytes, piece_bytes: int = 1 << 20, *, ends: bool = False) -> HttpReply:
    """Parse a reply with its complete content."""
    reply = HttpReply(CONTENT_BYTES_MAX)
    for start in range(0, len(data), piece_bytes):
        if not reply.is_complete:
            reply.feed(data[start : start + piece_bytes])
    if ends and not reply.is_complete:
        reply.end()
    return reply


@pytest.mark.parametrize(("data", "status", "content", "keeps_connection"), REPLIES)
@pytest.mark.parametrize("step", [1, 7, 100_000])
def test_replies(data: bytes, status: int, content: bytes, keeps_connection: bool, step: int) -> None:
    reply = truncating_reply()
    for offset in range(0, len(data), step):
        assert not reply.is_complete or len(content) == CONTENT_BYTES
        reply.feed(data[offset : offset + step])
    assert (reply.is_complete, reply.status, bytes(reply.content)) == (True, status, content)
    assert reply.keeps_connection == keeps_connection


def test_content_up_to_the_end() -> None:
    reply = truncating_reply()
    reply.feed(b"HTTP/1.1 401 Unauthorized\r\n\r\nno token")
    assert not reply.is_complete
    reply.end()
    assert (reply.is_complete, bytes(reply.content), reply.keeps_connection) == (True, b"no token", False)


def test_bytes_after_the_reply_end_the_connection() -> None:
    reply = truncating_reply()
    reply.feed(b"HTTP/1.1 204 No Content\r\n\r\nHTTP/1.1 204")
    assert (reply.is_complete, reply.keeps_connection) == (True, False)


@pytest.mark.parametrize("length", [0, 1, 20, 45, 60, 80])
def test_incomplete_reply(length: int) -> None:
    data = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n3\r\nabc\r\n0\r\n\r\n"
    reply = truncating_reply()
    reply.feed(data[: min(length, len(data) - 1)])
    with pytest.raises(IncompleteReply, match="closed the connection"):
        reply.end()


INVALID = {
    "other protocol": b"SSH-2.0-OpenSSH\r\n", "no code": b"HTTP/1.1 abc\r\n", "HTTP/2": b"HTTP/2 200\r\n",
    "no header": b"HTTP/1.1 200 OK\r\nabc\r\n",
    "negative length": b"HTTP/1.1 200 OK\r\nContent-Length: -1\r\n\r\n",
    "two lengths": b"HTTP/1.1 200 OK\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n",
    "length and encoding": b"HTTP/1.1 200 OK\r\nContent-Length: 1\r\nTransfer-Encoding: chunked\r\n\r\n",
    "two encodings": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\nTransfer-Encoding: gzip\r\n\r\n",
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
    + (b"1;" + b"e" * 200 + b"\r\na\r\n") * 100,
}  # fmt: skip


@pytest.mark.parametrize("data", INVALID.values(), ids=list(INVALID))
@pytest.mark.parametrize("step", [1, 100_000])
def test_invalid_replies(data: bytes, step: int) -> None:
    reply = truncating_reply()

    def feed_all() -> None:
        for offset in range(0, len(data), step):
            reply.feed(data[offset : offset + step])

    with pytest.raises(InvalidReply, match="expected"):
        feed_all()


@given(st.sampled_from([data for data, *_ in REPLIES[:7]]), st.lists(st.integers(0, 200)))
def test_any_split_has_the_same_result(data: bytes, offsets: list[int]) -> None:
    parts, whole = truncating_reply(), truncating_reply()
    whole.feed(data)
    bounds = [0, *sorted(offset for offset in offsets if offset < len(data)), len(data)]
    for start, end in pairwise(bounds):
        parts.feed(data[start:end])
    assert (parts.status, parts.content, parts.is_complete) == (whole.status, whole.content, whole.is_complete)
    assert parts.keeps_connection == whole.keeps_connection


COMPLETE_REPLIES = {
    "length": (HEAD + b"Content-Length: 5\r\n\r\nhello", 200, b"hello"),
    "empty body": (HEAD + b"content-length:0\r\n\r\n", 200, b""),
    "status 204": (b"HTTP/1.0 204 No Content\r\n\r\n", 204, b""),
    "no reason": (b"HTTP/1.1 404\r\nContent-Length: 1 \r\nA: b\r\n\r\nx", 404, b"x"),
    "interim": (INTERIM + b"HTTP/1.1 103 Hints\r\nA: b\r\n\r\n" + HEAD + b"Content-Length: 2\r\n\r\nok", 200, b"ok"),
    "chunks": (CHUNKED + b"3\r\nabc\r\n0A;x=y\r\n0123456789\r\n0\r\nTrailer: 1\r\n\r\n", 200, b"abc0123456789"),
}


@pytest.mark.parametrize("piece_bytes", [1, 2, 3, 7, 4096])
@pytest.mark.parametrize("name", COMPLETE_REPLIES)
def test_complete_replies_in_any_pieces(name: str, piece_bytes: int) -> None:
    data, status, body = COMPLETE_REPLIES[name]
    reply = parse(data, piece_bytes)
    assert (reply.is_complete, reply.status, bytes(reply.content)) == (True, status, body)
    for length in range(len(data)):
        with pytest.raises(IncompleteReply, match="closed the connection"):
            parse(data[:length], ends=True)


def test_body_until_the_end_of_the_connection() -> None:
    reply = parse(HEAD + b"\r\nab", 1)
    assert not reply.is_complete
    reply.end()
    assert reply.is_complete
    assert bytes(reply.content) == b"ab"


def test_bytes_after_a_switch_of_protocols() -> None:
    reply = parse(b"HTTP/1.1 101 Switching Protocols\r\nSec-WebSocket-Accept:  x= \r\n\r\n\x81\x00")
    assert (reply.is_complete, reply.rest, reply.headers) == (True, b"\x81\x00", {"sec-websocket-accept": "x="})
    assert (reply.status, reply.keeps_connection) == (SWITCHING_PROTOCOLS, False)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"SSH-2.0-OpenSSH\r\n\r\n", "expected an HTTP/1.1 reply"),
        (b"HTTP/2 200\r\n\r\n", "expected an HTTP/1.1 reply"),
        (b"HTTP/1.1 099 x\r\n\r\n", "expected an HTTP/1.1 reply"),
        (HEAD + b"A b\r\n\r\n", "expected a header"),
        (HEAD + b"A: 1\r\n folded\r\n\r\n", "expected a header"),
        (HEAD + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\n", "expected one header content-length"),
        (HEAD + b"Content-Length: -5\r\n\r\n", "expected one header content-length"),
        (HEAD + b"Content-Length: \xb2\r\n\r\n", "expected one header content-length"),
        (HEAD + b"Content-Length: 65537\r\n\r\n", "expected at most 65536 bytes"),
        (HEAD + b"Content-Length: 9999999999999999999\r\n\r\n", "expected one header content-length"),
        (HEAD + b"Transfer-Encoding: gzip, chunked\r\n\r\n", "expected the transfer encoding chunked"),
        (CHUNKED + b"x\r\n", "expected the length of a chunk"),
        (CHUNKED + b"-1\r\n", "expected the length of a chunk"),
        (CHUNKED + b"fffffffff\r\n", "expected the length of a chunk"),
        (CHUNKED + b"1\r\nab\r\n", "expected the end of a chunk"),
        (CHUNKED + b"1;" + b"x" * 300, "expected a line of at most 256 bytes"),
        (CHUNKED + b"0\r\n" + b"x" * 300, "expected a line of at most 256 bytes"),
    ],
)
def test_problems_of_invalid_replies(data: bytes, problem: str) -> None:
    for piece_bytes in (1, 4096):
        with pytest.raises(InvalidReply, match=problem):
            parse(data, piece_bytes)


@pytest.mark.parametrize(
    ("data", "limit"),
    [
        (HEAD + b"A: b\r\n" * 20_000, "at most 100 headers"),
        (INTERIM * 5_000, r"at most 8 interim replies \(status 1xx\)"),
        (HEAD + b"\r\n" + bytes(100_000), "at most 65536 bytes"),
        (CHUNKED + b"1\r\nx\r\n" * 20_000, "lines of at most 16384 bytes together"),
        (CHUNKED + b"FFFFFFFF\r\n" + bytes(100_000), "at most 65536 bytes"),
        (CHUNKED + b"0\r\n" + b"A: b\r\n" * 20_000, "at most 100 headers"),
    ],
    ids=["headers", "interim replies", "content", "chunks", "one chunk", "trailers"],
)
def test_an_endless_reply_ends_at_a_limit(data: bytes, limit: str) -> None:
    with pytest.raises(InvalidReply, match=f"expected .*{limit}, got more"):
        parse(data[: CONTENT_BYTES_MAX + HEAD_BYTES], 2048)


@pytest.mark.parametrize("head", [HEAD + b"\r\n", CHUNKED + b"FFFFFFFF\r\n"])
def test_content_at_its_limit_is_valid(head: bytes) -> None:
    reply = parse(head + bytes(CONTENT_BYTES_MAX), 2048)
    assert not reply.is_complete
    assert len(reply.content) == CONTENT_BYTES_MAX
    with pytest.raises(InvalidReply, match="expected at most 65536 bytes, got more"):
        reply.feed(b"x")


def test_a_repeated_header_has_one_value() -> None:
    reply = parse(HEAD + b"Content-Length: 0\r\nA: 1\r\na: 2\r\nCONTENT-LENGTH:0\r\n\r\n")
    assert (reply.is_complete, reply.headers) == (True, {"content-length": "0", "a": "1, 2"})
