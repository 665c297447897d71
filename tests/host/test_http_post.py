"""POST requests: headers, connections that stay open, and TLS errors."""

import gzip
import os
from pathlib import Path

import pytest

from imud.host.http_post import HttpPost, PostAccess, PostUrl, RequestRejected, post_url
from tests.support.event_loops import VirtualClock
from tests.support.line_protocol import FakeDatabase, fake_database

BODY = b"m f=1i 1\n"


def post(database: FakeDatabase, access: PostAccess, *, compress: bool = False) -> HttpPost:
    url = post_url(database.url)
    assert url is not None
    return HttpPost(url, access, VirtualClock().now_ns, compress=compress)


def test_parts_of_urls() -> None:
    assert post_url("https://db.example/api/v2/write?bucket=b") == ("db.example", 443, True, "/api/v2/write?bucket=b")
    assert post_url("http://[::1]:9000/write") == ("::1", 9000, False, "/write")


@pytest.mark.parametrize(
    ("content", "header"), [("abc\nmore", "Token abc"), ("Bearer abc\r\n", "Bearer abc"), ("Basic dTpw", "Basic dTpw")]
)
def test_headers_and_compression(tmp_path: Path, content: str, header: str) -> None:
    (tmp_path / "token").write_text(content)
    with fake_database() as database:
        one = post(database, PostAccess(str(tmp_path / "token")), compress=True)
        one.post(BODY)
        (tmp_path / "token").write_text("new")
        database.replies = [(204, ""), (400, "x" * 10_000)]
        one.post(BODY)
        with pytest.raises(RequestRejected) as caught:
            one.post(BODY)
        assert str(caught.value) == f"the server replied 400: {'x' * 200}"
        one.post(BODY)
        one.close()
        (path, first), (_, second), *_ = database.requests
        assert (path, first["Authorization"], second["Authorization"]) == ("/write?db=imud", header, "Token new")
        assert [gzip.decompress(body) for body in database.bodies] == [BODY] * 3


@pytest.mark.parametrize("content", [b"", b"\n", "ü".encode(), b"a\0b", None])
def test_an_invalid_token_file_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "token"
    if content is not None:
        path.write_bytes(content)
    problem = "No such file" if content is None else "expected a token in printable ASCII, got other bytes"
    with fake_database() as database:
        one = post(database, PostAccess(str(path)))
        with pytest.raises(OSError, match=rf"token_file {path}: {problem}"):
            one.post(BODY)
        assert not database.requests


def test_token_and_ca_file_are_fifos(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with fake_database() as database:
        url = post_url(database.url)
        assert url is not None
        for delivery in (
            HttpPost(url, PostAccess(token_file=str(fifo)), VirtualClock().now_ns),
            HttpPost(url._replace(tls=True), PostAccess(ca_file=str(fifo)), VirtualClock().now_ns),
        ):
            with pytest.raises(OSError, match="is a FIFO, expected a regular file"):
                delivery.post(BODY)
        assert not database.requests


def test_a_server_without_tls_and_a_missing_ca_file_are_problems() -> None:
    with fake_database() as database:
        url = post_url(database.url)
        assert url is not None
        with pytest.raises(OSError, match=r"WRONG_VERSION_NUMBER|record layer|HTTP"):
            HttpPost(url._replace(tls=True), PostAccess(), VirtualClock().now_ns).post(BODY)
        with pytest.raises(OSError, match="No such file"):
            HttpPost(
                PostUrl("127.0.0.1", url.port, True, "/w"), PostAccess(None, "/absent.pem"), VirtualClock().now_ns
            ).post(BODY)


def test_another_protocol_is_an_error() -> None:
    """imud requests no other protocol."""
    with fake_database() as database:
        database.replies = [(101, "")]
        delivery = post(database, PostAccess())
        with pytest.raises(OSError, match="the server replied 101"):
            delivery.post(BODY)
        delivery.post(BODY)
        delivery.close()
        assert len(database.connections) == 2
