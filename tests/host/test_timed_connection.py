"""Connections with a deadline for the complete exchange: servers that drip, flood, or do not reply, and the stop."""

import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from imud.host.http_post import REQUEST_S, HttpPost, PostAccess, PostUrl
from imud.host.timed_connection import ExchangeStopped, TimedConnection
from imud.model.units import NS_PER_S


class SteppingClock:
    """Clock that advances with each reading, and calls `on_reading` first."""

    def __init__(self, step_s: float) -> None:
        self.step_s = step_s
        self.readings = 0
        self.on_reading: Callable[[], object] = lambda: None

    def now_ns(self) -> int:
        self.readings += 1
        self.on_reading()
        return round(self.readings * self.step_s * NS_PER_S)


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server


def port_of(listener: socket.socket) -> int:
    port: int = listener.getsockname()[1]
    return port


def post_to(listener: socket.socket, clock: SteppingClock, *, tls: bool = False) -> HttpPost:
    url = PostUrl("127.0.0.1", port_of(listener), tls, "/write?db=x")
    return HttpPost(url, PostAccess(), clock.now_ns)


def send_at_each_reading(clock: SteppingClock, listener: socket.socket, data: bytes) -> list[socket.socket]:
    """Accept the connection, and send `data` at each reading of the clock."""
    accepted: list[socket.socket] = []
    listener.setblocking(False)

    def send() -> None:
        try:
            if not accepted:
                accepted.append(listener.accept()[0])
            accepted[0].sendall(data)
        except OSError:
            pass

    clock.on_reading = send
    return accepted


@pytest.mark.parametrize(
    ("data", "step_s", "problem"),
    [
        (b"H", 4, rf"no complete reply within {REQUEST_S:g} s"),
        (b"HTTP/1.1 100 Continue\r\n\r\n", 0.001, "at most 8 interim replies"),
        (b"HTTP/1.1 200 OK\r\n" + b"a: b\r\n" * 9, 0.001, "invalid HTTP reply: expected a header|at most"),
        (b"", 4, rf"no complete reply within {REQUEST_S:g} s"),
    ],
)
def test_endless_reply_ends_at_the_deadline(listener: socket.socket, data: bytes, step_s: float, problem: str) -> None:
    clock = SteppingClock(step_s)
    accepted = send_at_each_reading(clock, listener, data)
    post = post_to(listener, clock)
    with pytest.raises(OSError, match=problem):
        post.post(b"imud_a f=1i 1\n")
    for connection in accepted:
        connection.close()
    assert clock.readings * step_s < REQUEST_S + 2 * step_s, "the wait for the name server reads the clock too"


def test_tls_handshake_has_the_same_deadline(listener: socket.socket) -> None:
    clock = SteppingClock(2)
    # a record of the handshake with a length of 16 kB that never becomes complete
    accepted = send_at_each_reading(clock, listener, b"\x16")
    with pytest.raises(OSError, match=rf"no complete reply within {REQUEST_S:g} s|WRONG_VERSION|record"):
        post_to(listener, clock, tls=True).post(b"x")
    assert clock.readings <= REQUEST_S
    for connection in accepted:
        connection.close()


def test_silent_name_server_has_the_same_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    """A request to a name server cannot be ended. At most one thread waits for it."""
    answer = threading.Event()
    requests: list[object] = []

    def resolve(*place: object, **_options: object) -> list[object]:
        requests.append(place)
        answer.wait(60)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("127.0.0.1", 9))]

    monkeypatch.setattr(socket, "getaddrinfo", resolve)
    clock = SteppingClock(4)
    post = HttpPost(PostUrl("db.example", 80, False, "/w"), PostAccess(), clock.now_ns)
    for _ in range(3):
        with pytest.raises(OSError, match="no complete reply"):
            post.post(b"x")
    answer.set()
    assert len(requests) == 1


def test_early_reply_ends_the_request(listener: socket.socket) -> None:
    """The server refuses the size before it has read the body."""
    refused = threading.Event()

    def refuse() -> None:
        connection, _ = listener.accept()
        connection.recv(1000)
        connection.sendall(b"HTTP/1.1 413 Content Too Large\r\nContent-Length: 0\r\n\r\n")
        refused.wait(60)
        connection.close()

    thread = threading.Thread(target=refuse)
    thread.start()
    post = post_to(listener, SteppingClock(0.0001))
    with pytest.raises(Exception, match="the server replied 413"):
        post.post(bytes(50_000_000))
    refused.set()
    thread.join()


def test_interim_reply_does_not_end_the_request(listener: socket.socket) -> None:
    body = bytes(20_000_000)
    received: list[int] = []

    def accept_body() -> None:
        connection, _ = listener.accept()
        connection.sendall(b"HTTP/1.1 100 Continue\r\n\r\n")
        count = 0
        while count < len(body):
            count += len(connection.recv(1 << 20))
        received.append(count)
        connection.sendall(b"HTTP/1.1 204 No Content\r\n\r\n")
        connection.close()

    thread = threading.Thread(target=accept_body)
    thread.start()
    post = post_to(listener, SteppingClock(0))
    post.post(body)
    post.close()
    thread.join()
    assert received[0] >= len(body)


def test_stop_ends_the_wait(listener: socket.socket) -> None:
    clock = SteppingClock(0)
    post = post_to(listener, clock)
    clock.on_reading = lambda: post.stop() if clock.readings == 5 else None
    with pytest.raises(OSError, match="imud ended the request"):
        post.post(b"x")
    with pytest.raises(OSError, match="imud ended the request"):
        post.post(b"x")
    assert clock.readings < 20


def test_address_without_reply_leaves_time_for_the_next(
    listener: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.2", 0), backlog=0) as full:
        # a full queue of connections: the kernel ignores the next request
        others = [socket.socket() for _ in range(4)]
        for other in others:
            other.setblocking(False)
            other.connect_ex(full.getsockname())
        addresses = [
            (socket.AF_INET, socket.SOCK_STREAM, 6, "", address)
            for address in (full.getsockname(), listener.getsockname())
        ]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_a, **_k: addresses)
        connection = TimedConnection(SteppingClock(1).now_ns)
        connection.start(30)
        connection.open("127.0.0.1", port_of(listener))
        assert connection.is_open
        connection.close()
        for other in others:
            other.close()


def test_closed_connection_cannot_send() -> None:
    connection = TimedConnection(SteppingClock(0).now_ns)
    connection.start(1)
    with pytest.raises(OSError, match="not open"):
        connection.send(b"x")
    connection.stop()
    with pytest.raises(ExchangeStopped):
        connection.open("127.0.0.1", 9)
