"""HTTP replies: lengths, chunks, interim replies, limits, and every split of the bytes."""

import pytest

from imud.publishers.signalk.http_reply import HEAD_BYTES_MAX, InvalidReply, ReplyParser

LIMIT = 65_536


def parse(data: bytes, piece_bytes: int = 1 << 20, *, ends: bool = False) -> ReplyParser:
    reply = ReplyParser(LIMIT)
    for start in range(0, len(data), piece_bytes):
        if not reply.is_complete:
            reply.feed(data[start : start + piece_bytes])
    if ends and not reply.is_complete:
        reply.end()
    return reply


HEAD = b"HTTP/1.1 200 OK\r\n"
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n"
INTERIM = b"HTTP/1.1 100 Continue\r\n\r\n"
REPLIES = {
    "length": (HEAD + b"Content-Length: 5\r\n\r\nhello", 200, b"hello"),
    "empty body": (HEAD + b"content-length:0\r\n\r\n", 200, b""),
    "status 204": (b"HTTP/1.0 204 No Content\r\n\r\n", 204, b""),
    "no reason": (b"HTTP/1.1 404\r\nContent-Length: 1 \r\nA: b\r\n\r\nx", 404, b"x"),
    "interim": (INTERIM + b"HTTP/1.1 103 Hints\r\nA: b\r\n\r\n" + HEAD + b"Content-Length: 2\r\n\r\nok", 200, b"ok"),
    "chunks": (CHUNKED + b"3\r\nabc\r\n0A;x=y\r\n0123456789\r\n0\r\nTrailer: 1\r\n\r\n", 200, b"abc0123456789"),
}


@pytest.mark.parametrize("piece_bytes", [1, 2, 3, 7, 4096])
@pytest.mark.parametrize("name", REPLIES)
def test_complete_replies_in_any_pieces(name: str, piece_bytes: int) -> None:
    data, status, body = REPLIES[name]
    reply = parse(data, piece_bytes)
    assert (reply.is_complete, reply.status, bytes(reply.body)) == (True, status, body)
    for length in range(len(data)):
        with pytest.raises(InvalidReply, match="end of the connection"):
            parse(data[:length], ends=True)


def test_body_until_the_end_of_the_connection() -> None:
    reply = parse(HEAD + b"\r\nab", 1)
    assert not reply.is_complete
    reply.end()
    assert reply.is_complete
    assert bytes(reply.body) == b"ab"


def test_bytes_after_a_switch_of_protocols() -> None:
    reply = parse(b"HTTP/1.1 101 Switching Protocols\r\nSec-WebSocket-Accept:  x= \r\n\r\n\x81\x00")
    assert (reply.is_complete, reply.rest, reply.headers) == (True, b"\x81\x00", {"sec-websocket-accept": "x="})


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"SSH-2.0-OpenSSH\r\n\r\n", "expected an HTTP/1.1 reply"),
        (b"HTTP/2 200\r\n\r\n", "expected an HTTP/1.1 reply"),
        (b"HTTP/1.1 099 x\r\n\r\n", "expected an HTTP/1.1 reply"),
        (HEAD + b"A b\r\n\r\n", "expected a header"),
        (HEAD + b"A: 1\r\n folded\r\n\r\n", "expected a header"),
        (HEAD + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\n", "expected one header content-length"),
        (HEAD + b"Content-Length: -5\r\n\r\n", "expected at most 65536 bytes"),
        (HEAD + b"Content-Length: \xb2\r\n\r\n", "expected at most 65536 bytes"),
        (HEAD + b"Content-Length: 65537\r\n\r\n", "expected at most 65536 bytes"),
        (HEAD + b"Content-Length: 9999999999999999999\r\n\r\n", "expected at most 65536 bytes"),
        (HEAD + b"Transfer-Encoding: gzip, chunked\r\n\r\n", "expected the transfer encoding chunked"),
        (CHUNKED + b"x\r\n", "expected the length of a chunk"),
        (CHUNKED + b"-1\r\n", "expected the length of a chunk"),
        (CHUNKED + b"fffffffff\r\n", "expected the length of a chunk"),
        (CHUNKED + b"1\r\nab\r\n", "expected the end of a chunk"),
        (CHUNKED + b"1;" + b"x" * 300, "expected a line of at most 256 bytes"),
        (CHUNKED + b"0\r\n" + b"x" * 300, "expected a line of at most 256 bytes"),
    ],
)
def test_invalid_replies(data: bytes, problem: str) -> None:
    for piece_bytes in (1, 4096):
        with pytest.raises(InvalidReply, match=problem):
            parse(data, piece_bytes)


@pytest.mark.parametrize(
    "data",
    [
        INTERIM * 5_000,
        HEAD + b"\r\n" + bytes(100_000),
        CHUNKED + b"1\r\nx\r\n" * 20_000,
        CHUNKED + b"FFFFFFFF\r\n" + bytes(100_000),
        CHUNKED + b"0\r\n" + b"A: b\r\n" * 20_000,
    ],
    ids=["interim replies", "body", "chunks", "one chunk", "trailers"],
)
def test_an_endless_reply_ends_at_the_limit(data: bytes) -> None:
    with pytest.raises(InvalidReply, match="expected at most 65536 bytes, got more"):
        parse(data[: LIMIT + 1], 2048)
    assert not parse(data[:LIMIT], 2048).is_complete


def test_length_of_the_headers() -> None:
    """imud parses all headers in one turn of the event loop."""
    fill = HEAD_BYTES_MAX - len(HEAD) - len(b"A: ")
    for piece_bytes in (1, 2048, 1 << 20):
        reply = parse(HEAD + b"A: " + b"x" * fill + b"\r\n\r\n", piece_bytes, ends=True)
        assert len(reply.headers["a"]) == fill
        for data in (HEAD + b"A: " + b"x" * (fill + 1) + b"\r\n\r\n", HEAD + b"A: b\r\n" * 20_000):
            with pytest.raises(InvalidReply, match="expected headers of at most 8192 bytes, got more"):
                parse(data, piece_bytes)
