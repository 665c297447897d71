"""HTTP requests to the metrics and to `imud web`.

The reply to a scrape uses a format of Prometheus, or there is no reply. Without the token, `imud web` permits no
control. It rejects requests that its page cannot send.
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from msgspec import to_builtins

from imud.formats.jsonrpc import encode_request, parse_object
from imud.host.scrape_server import REQUEST_BYTES_MAX, encoder_for, parse_request
from imud.web.guard import WebGuard, host_name, is_address
from imud.web.messages import CallRequest, LoginRequest, Look, decode_body
from tests.fuzz.target import Target

TOKEN: Final = b"a-token-that-is-long-enough"
NOW_S: Final = 1_800_000_000.0
TYPES: Final = ("text/plain", "application/openmetrics-text", "application/vnd.google.protobuf")


def names() -> Sequence[str]:
    return ["request"]


def make(_name: str) -> Target:
    """Make a target: `parse_request` and the choice of the format by the Accept header, or the rules of `imud web`."""
    return Target(run, seeds, words=words, bytes_max=REQUEST_BYTES_MAX)


def run(data: bytes) -> None:
    """The server passes the bytes before the first empty line to `parse_request`."""
    look_at_page_request(data)
    request = parse_request(data.partition(b"\r\n\r\n")[0])
    if request is None:
        return
    assert "?" not in request.path
    _, content_type = encoder_for(request.accept)
    assert content_type.startswith(TYPES)


def look_at_page_request(data: bytes) -> None:
    head, _, body = data.partition(b"\r\n\r\n")
    headers = dict[str, str]()
    for line in head.decode("utf-8", "surrogateescape").split("\r\n")[1:]:
        name, _, value = line.partition(":")
        headers[name.strip().lower()] = value.strip()
    host, origin, cookie = (headers.get(name) for name in ("host", "origin", "cookie"))
    guard = WebGuard(TOKEN, lambda: NOW_S, reading_needs_token=True, names=["gateway"])
    if not guard.host_problem(host):
        name = host_name(host or "")
        assert name in ("localhost", "gateway") or is_address(name)
    if not guard.origin_problem(origin, host, with_token=False):
        assert origin is not None
        assert origin.lower() in {f"{scheme}://{host}".lower() for scheme in ("http", "https")}
    rights = guard.rights(headers.get("authorization"), cookie)
    known = TOKEN.decode() in headers.get("authorization", "") or guard.new_session() == cookie
    assert rights.read == rights.control
    assert known or not rights.control
    for kind in (LoginRequest, CallRequest, Look):
        with suppress(ValueError):
            decoded = decode_body(body, kind)
            assert parse_object(encode_request("m", to_builtins(decoded), 1))["method"] == "m"


def page_seeds() -> list[bytes]:
    session = WebGuard(TOKEN, lambda: NOW_S, reading_needs_token=True).new_session()
    heads = [
        b"Host: localhost:9322\r\nOrigin: http://localhost:9322\r\nCookie: " + session.encode(),
        b"Host: [::1]:80\r\nOrigin: https://[::1]:80\r\nAuthorization: Bearer " + TOKEN,
        b"Host: gateway.\r\nOrigin: null\r\nAuthorization: Bearer \xff\xfe",
        b"Host: 127.0.0.1.example.org\r\nOrigin: http://attacker.example\r\nCookie: 1.2",
    ]
    bodies = [
        b'{"token":"' + TOKEN + b'"}',
        b'{"method":"command","params":{"device":"bow","name":"save","arguments":{"a":[1e300,null,18446744073709551616]}}}',
        b'{"look":"device","device":"bow","rate_hz":50,"spectrum":"mag_t","acknowledged":3}',
        b'{"method":"actions","params":{"a":' + b"[" * 4000,
        b'{"token":"\xff"}',
    ]
    posts = [b"POST /api/call HTTP/1.1\r\n" + heads[n % 4] + b"\r\n\r\n" + body for n, body in enumerate(bodies)]
    return [*posts, *(b"GET /api/session HTTP/1.1\r\n" + head + b"\r\n\r\n" for head in heads)]


def seeds() -> list[bytes]:
    prometheus = (
        b"GET /metrics HTTP/1.1\r\nHost: localhost:9321\r\nUser-Agent: Prometheus/2.54.1\r\nAccept: application/"
        b"openmetrics-text;version=1.0.0;escaping=allow-utf-8;q=0.6,application/openmetrics-text;version=0.0.1;q=0.5,"
        b"text/plain;version=1.0.0;escaping=allow-utf-8;q=0.4,text/plain;version=0.0.4;q=0.3,*/*;q=0.2\r\n"
        b"Accept-Encoding: gzip\r\nX-Prometheus-Scrape-Timeout-Seconds: 10\r\n\r\n"
    )
    curl = b"GET /metrics?name[]=up HTTP/1.1\r\nHost: x\r\nAccept: */*\r\n\r\n"
    lines = [
        b"HEAD / HTTP/1.0", b"POST /metrics HTTP/1.1", b"GET  /metrics HTTP/1.1", b"GET /\xff HTTP/1.1", b"GET", b"",
    ]  # fmt: skip
    odd = [
        b"accept : text/plain", b"Accept: application/openmetrics-text; version=x", b"ACCEPT:;;;,,,=", b":", b"\xff\0",
    ]  # fmt: skip
    heads = [b"GET /metrics HTTP/1.1\r\n" + header + b"\r\n\r\n" for header in odd]
    return [
        *page_seeds(), prometheus, curl, *(line + b"\r\n\r\n" for line in lines), *heads, b"\r\n\r\n",
        b"GET /" + b"a" * 8000,
    ]  # fmt: skip


def words() -> list[bytes]:
    media = [b"application/openmetrics-text", b"text/plain", b";version=1.0.0", b";escaping=allow-utf-8", b";q=0.5"]
    return [
        b"GET ", b"HEAD ", b" HTTP/1.1\r\n", b"Accept: ", b"\r\nHost: ", b"\r\nOrigin: http://", b"\r\nCookie: ",
        b"\r\nAuthorization: Bearer ", TOKEN, b'"method":', b'"params":', b"\r\n\r\n", b"escaping=values", b"version=",
        b",", *media,
    ]  # fmt: skip
