"""Server of scrapes: it replies although clients are silent, slow, do not read, or send invalid requests."""

import asyncio
import errno
import socket
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from time import monotonic
from typing import Any
from unittest.mock import Mock, call

import pytest

from imud.host.scrape_server import Answer, HttpRequest, HttpResponse, ScrapeServer, parse_request
from imud.model.errors import ServerError
from tests.support.event_loops import in_loop
from tests.support.metrics import LIMIT_S, ask, read_all


@asynccontextmanager
async def server(answer: Answer, **limits: float) -> AsyncIterator[ScrapeServer]:
    made = ScrapeServer("127.0.0.1", 0, **limits)  # type: ignore[arg-type]  # limits by name
    made.start(answer)
    try:
        yield made
    finally:
        made.close()


async def hello(_request: HttpRequest) -> HttpResponse:
    return HttpResponse("200 OK", b"hello")


@pytest.mark.parametrize("said", [b"", b"GET", b"GET /metrics HTTP/1.1\r\nHost: x\r\n"])
@in_loop
async def test_silent_clients_and_incomplete_requests_end_in_time(said: bytes) -> None:
    async with server(hello, connection_s=0.05) as served:
        with socket.create_connection(("127.0.0.1", served.port), LIMIT_S) as silent:
            silent.sendall(said)
            assert read_all(silent) == b""


@in_loop
async def test_silent_clients_cannot_lock_out_a_scraper() -> None:
    async with server(hello, connection_s=60) as served:
        silent = [socket.create_connection(("127.0.0.1", served.port), LIMIT_S) for _ in range(40)]
        for _ in range(3):
            assert (await ask(served.port))[2] == "hello"
        assert served.connections == 31
        # the server closed the oldest connections
        assert [read_all(connection) for connection in silent[:9]] == [b""] * 9
        for connection in silent:
            connection.close()


@in_loop
async def test_a_client_that_does_not_read_is_disconnected() -> None:
    asked: list[HttpRequest] = []

    async def much(request: HttpRequest) -> HttpResponse:
        asked.append(request)
        return HttpResponse("200 OK", b"x" * 50_000_000)

    async with server(much, connection_s=1.0) as served:
        with socket.create_connection(("127.0.0.1", served.port), LIMIT_S) as deaf:
            deaf.sendall(b"GET / HTTP/1.1\r\n\r\n")
            async with asyncio.timeout(LIMIT_S):
                while not asked or served.connections:
                    await asyncio.sleep(0.001)
            assert len(read_all(deaf)) < 50_000_000  # the kernel buffered this part


@pytest.mark.parametrize("head", [b"\x00\xff\r\n\r\n", b"GET /\r\n\r\n", b"GET / SPDY/3\r\n\r\n", b"\r\n\r\n"])
@in_loop
async def test_invalid_requests_get_status_400(head: bytes) -> None:
    async with server(hello) as served:
        with socket.create_connection(("127.0.0.1", served.port), LIMIT_S) as connection:
            connection.sendall(head)
            assert await asyncio.to_thread(read_all, connection) == (
                b"HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain; charset=utf-8\r\n"
                b"Content-Length: 18\r\nConnection: close\r\n\r\nexpected HTTP/1.1\n"
            )


@pytest.mark.parametrize(("size", "is_answered"), [(8192, True), (8193, False), (32768, False)])
@in_loop
async def test_a_request_above_the_limit_is_disconnected(size: int, is_answered: bool) -> None:
    async with server(hello) as served:
        with socket.create_connection(("127.0.0.1", served.port), LIMIT_S) as connection:
            head = b"GET / HTTP/1.1\r\nX: "
            connection.sendall(head + b"x" * (size - len(head) - 4) + b"\r\n\r\n")
            assert (await asyncio.to_thread(read_all, connection) != b"") == is_answered


@in_loop
async def test_the_server_pauses_without_descriptors_and_limits_times(monkeypatch: pytest.MonkeyPatch) -> None:
    accept, calls_s = socket.socket.accept, list[float]()
    call_later, pauses_s = asyncio.BaseEventLoop.call_later, list[float]()
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(0.5)

    def refuse_twice(listener: socket.socket) -> tuple[socket.socket, Any]:
        calls_s.append(monotonic())
        if len(calls_s) <= 2:
            raise OSError(errno.EMFILE, "Too many open files")
        return accept(listener)

    def soon(loop: asyncio.BaseEventLoop, delay_s: float, *work: Any) -> asyncio.TimerHandle:
        pauses_s.append(delay_s)
        return call_later(loop, delay_s / 20, *work)

    timeout = Mock(wraps=asyncio.timeout)
    async with server(hello) as served:
        assert sys.getswitchinterval() < 0.001, "a scrape does not delay the event loop"
        sys.setswitchinterval(interval_s)
        monkeypatch.setattr(asyncio.BaseEventLoop, "call_later", soon)
        monkeypatch.setattr(asyncio, "timeout", timeout)
        monkeypatch.setattr(socket.socket, "accept", refuse_twice)
        assert (await ask(served.port))[2] == "hello"
    assert pauses_s == [1.0, 1.0]
    assert call(5.0) in timeout.mock_calls, "the maximum time of a connection"
    first_s, second_s, third_s = calls_s
    assert second_s - first_s >= 0.05
    assert third_s - second_s >= 0.05


def test_parse_request() -> None:
    head = b"GET /a?b=c HTTP/1.1\r\naCCept: x/y\r\nAccept-Encoding: gzip\r\nAccept: z\r\n\r\n"
    assert parse_request(head) == HttpRequest("GET", "/a", "x/y,z")


@pytest.mark.parametrize("address", ["192.0.2.1", "not an address"])
def test_an_unusable_address_is_reported(address: str) -> None:
    with pytest.raises(ServerError, match=f"{address} port 0: .*; set metrics.address"):
        ScrapeServer(address, 0).start(hello)
