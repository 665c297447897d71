"""Sockets of outputs on a kernel without IPv6."""

import errno
import socket

import pytest

from imud.model.errors import ServerError
from imud.publishers.metrics.scrape_server import HttpRequest, HttpResponse, ScrapeServer
from imud.publishers.nmea0183 import TcpOutput, UdpOutput
from tests.support.event_loops import VirtualClock, in_loop


@in_loop
async def test_a_kernel_without_ipv6(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(family: int, kind: int) -> socket.socket:
        if family == socket.AF_INET6:
            raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")
        return real(family, kind)

    async def answer(_request: HttpRequest) -> HttpResponse:
        raise AssertionError

    real = socket.socket
    monkeypatch.setattr(socket, "socket", make)
    made = UdpOutput("::1", 9)
    made.put(b"$HEHDT,98.3,T*2F\r\n")
    assert (made.status().dropped, made.status().readers) == (1, 0)
    assert "not supported" in made.status().problem
    made.close()
    with pytest.raises(ServerError, match="::1 port 0: Address family not supported by protocol"):
        TcpOutput("::1", 0, VirtualClock().now_ns).open()
    with pytest.raises(ServerError, match="::1 port 0: Address family not supported by protocol"):
        ScrapeServer("::1", 0, answer).start()
