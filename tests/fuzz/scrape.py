"""Scrapes over HTTP: any head of a request gives an answer in a format that Prometheus knows, or none."""

from collections.abc import Sequence
from typing import Final

from imud.publishers.metrics.publisher import encoder_for
from imud.publishers.metrics.scrape_server import REQUEST_BYTES_MAX, parse_request
from tests.fuzz.target import Target

TYPES: Final = ("text/plain", "application/openmetrics-text", "application/vnd.google.protobuf")


def names() -> Sequence[str]:
    """The one target."""
    return ["request"]


def make(_name: str) -> Target:
    """`parse_request`, and the choice of the format by its Accept header."""
    return Target(run, seeds, words=words, bytes_max=REQUEST_BYTES_MAX)


def run(data: bytes) -> None:
    """The server gives `parse_request` what stands in front of the first empty line."""
    request = parse_request(data.partition(b"\r\n\r\n")[0])
    if request is None:
        return
    assert "?" not in request.path
    _, content_type = encoder_for(request.accept)
    assert content_type.startswith(TYPES)


def seeds() -> list[bytes]:
    """Requests of Prometheus, curl and people, and what is none."""
    prometheus = (
        b"GET /metrics HTTP/1.1\r\nHost: localhost:9321\r\nUser-Agent: Prometheus/2.54.1\r\nAccept: application/"
        b"openmetrics-text;version=1.0.0;escaping=allow-utf-8;q=0.6,application/openmetrics-text;version=0.0.1;q=0.5,"
        b"text/plain;version=1.0.0;escaping=allow-utf-8;q=0.4,text/plain;version=0.0.4;q=0.3,*/*;q=0.2\r\n"
        b"Accept-Encoding: gzip\r\nX-Prometheus-Scrape-Timeout-Seconds: 10\r\n\r\n"
    )
    curl = b"GET /metrics?name[]=up HTTP/1.1\r\nHost: x\r\nAccept: */*\r\n\r\n"
    lines = [
        b"HEAD / HTTP/1.0",
        b"POST /metrics HTTP/1.1",
        b"GET  /metrics HTTP/1.1",
        b"GET /\xff HTTP/1.1",
        b"GET",
        b"",
    ]
    odd = [
        b"accept : text/plain",
        b"Accept: application/openmetrics-text; version=x",
        b"ACCEPT:;;;,,,=",
        b":",
        b"\xff\0",
    ]
    heads = [b"GET /metrics HTTP/1.1\r\n" + header + b"\r\n\r\n" for header in odd]
    return [prometheus, curl, *(line + b"\r\n\r\n" for line in lines), *heads, b"\r\n\r\n", b"GET /" + b"a" * 8000]


def words() -> list[bytes]:
    """Words of requests."""
    media = [b"application/openmetrics-text", b"text/plain", b";version=1.0.0", b";escaping=allow-utf-8", b";q=0.5"]
    return [
        b"GET ",
        b"HEAD ",
        b" HTTP/1.1\r\n",
        b"Accept: ",
        b"\r\n\r\n",
        b"escaping=values",
        b"version=",
        b",",
        *media,
    ]
