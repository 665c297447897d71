"""The gate in front of an echo server: accepted and refused requests, and the end of connections."""

import gc
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from threading import Thread

import pytest

from imud.model.errors import ServerError
from imud.web import foxglove as module
from imud.web.foxglove import CONNECTIONS_MAX, HEAD_BYTES_MAX, WAITING_MAX, ViewerGate, ViewerOrigins
from tests.support.daemon_process import LIMIT_S, wait_until

pytestmark = pytest.mark.live


class Echo:
    def __init__(self) -> None:
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.ended = 0
        self._thread = Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self.socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(LIMIT_S)
        self.socket.close()

    def _run(self) -> None:
        threads = []
        while True:
            try:
                connection, _ = self.socket.accept()
            except OSError:
                break
            threads.append(Thread(target=self._repeat, args=(connection,)))
            threads[-1].start()
        for thread in threads:
            thread.join(LIMIT_S)

    def _repeat(self, connection: socket.socket) -> None:
        with connection:
            while data := connection.recv(65536):
                if b"close" in data:
                    break
                connection.sendall(data)
        self.ended += 1


@contextmanager
def gated(echo: Echo, notes: list[str] | None = None) -> Iterator[ViewerGate]:
    note = (notes if notes is not None else []).append
    gate = ViewerGate("127.0.0.1", 0, echo.socket.getsockname(), ViewerOrigins(), note=note)
    with closing(gate):
        yield gate


@pytest.fixture
def echo() -> Iterator[Echo]:
    with closing(Echo()) as one:
        yield one


def head(*lines: str, request: str = "GET / HTTP/1.1", upgrade: str = "Upgrade: websocket") -> bytes:
    return "\r\n".join([request, "Host: 127.0.0.1:8765", upgrade, *lines, "", ""]).encode()


def connect(gate: ViewerGate) -> socket.socket:
    return socket.create_connection(("127.0.0.1", gate.port), LIMIT_S)


def received(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := connection.recv(65536)):
        data += more
    return data


def answer(gate: ViewerGate, request: bytes) -> str:
    with connect(gate) as connection:
        connection.sendall(request)
        return received(connection, 1 << 30).decode()


def test_a_viewer_comes_through_with_every_byte_in_both_directions(echo: Echo) -> None:
    request = head("Origin: https://app.foxglove.dev", "Cookie: x=\xe4")
    more = bytes(range(256)) * 4096
    with gated(echo) as gate, connect(gate) as connection:
        connection.sendall(request[:10])
        connection.sendall(request[10:] + more[:100])
        sender = Thread(target=connection.sendall, args=(more[100:],))
        sender.start()
        assert received(connection, len(request) + len(more)) == request + more
        sender.join(LIMIT_S)
        connection.sendall(b"close")
        assert connection.recv(1) == b"", "the end of the server is that of the viewer"
    assert echo.ended == 1


def test_pages_of_other_sites_are_refused_and_named_once(echo: Echo) -> None:
    notes: list[str] = []
    with gated(echo, notes) as gate:
        for _ in range(2):
            refused = answer(gate, head("Origin: https://attacker.example"))
            assert refused.startswith("HTTP/1.1 403 Forbidden\r\n")
            assert "allow them with --allow-origin https://attacker.example" in refused
    assert len(notes) == 1
    assert notes[0].startswith("refused a connection: pages of 'https://attacker.example' may not read")
    assert echo.ended == 0


def test_requests_of_other_programs_are_refused(echo: Echo) -> None:
    for request_, status in [
        (head("Origin: file://", "Origin: https://attacker.example"), 400),
        (head("Host: 127.0.0.1"), 400),
        (head("no colon", "Origin: https://attacker.example"), 400),
        (head(request="GET / HTTP/1.0"), 400),
        (head(*["A: b"] * 200), 400),
        (b"\x16\x03\x01\r\n\r\n", 400),
        (head(upgrade="Upgrade: h2c"), 426),
        (b"GET / HTTP/1.1\r\nHost: attacker.example\r\nUpgrade: websocket\r\n\r\n", 403),
    ]:
        with gated(echo) as gate:
            assert answer(gate, request_).startswith(f"HTTP/1.1 {status} ")
        assert echo.ended == 0


def test_an_endless_and_a_missing_request_head(echo: Echo, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "HEAD_S", 0.05)
    with gated(echo) as gate:
        with connect(gate) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\n" + b"A" * HEAD_BYTES_MAX)
            assert is_closed(connection)
        with connect(gate) as connection:
            assert is_closed(connection), "after the time for the request"


def is_closed(connection: socket.socket) -> bool:
    try:
        return connection.recv(100) == b""
    except ConnectionResetError:
        return True


def test_the_number_of_viewers_is_limited(echo: Echo) -> None:
    with gated(echo) as gate:
        viewers = [connect(gate) for _ in range(CONNECTIONS_MAX)]
        for viewer in viewers:
            viewer.sendall(head())
            assert received(viewer, len(head())) == head()
        assert answer(gate, head()).startswith("HTTP/1.1 503 ")
        viewers.pop().close()
        wait_until(lambda: not answer_starts(gate).startswith(b"HTTP/1.1 503"), "there is room again")
        for viewer in viewers:
            viewer.close()


def test_connections_without_a_head_are_limited_and_occupy_no_place_of_a_viewer(echo: Echo) -> None:
    with gated(echo) as gate, ExitStack() as opened:
        silent = [opened.enter_context(connect(gate)) for _ in range(WAITING_MAX + 1)]
        assert is_closed(silent[0])
        viewer = opened.enter_context(connect(gate))
        viewer.sendall(head())
        assert received(viewer, len(head())) == head()
        assert is_closed(silent[1])
        silent[-1].sendall(head())
        assert received(silent[-1], len(head())) == head()


def answer_starts(gate: ViewerGate) -> bytes:
    with connect(gate) as connection:
        connection.sendall(head())
        return connection.recv(20)


def test_the_gate_ends_beside_its_viewers_and_leaves_nothing_open(echo: Echo) -> None:
    """An open connection is visible in two ways: its server thread continues, and asyncio warns at its destruction."""
    rounds, viewers_at_a_time = 3, 10
    for _ in range(rounds):
        with gated(echo) as gate:
            viewers = [connect(gate) for _ in range(viewers_at_a_time)]
            for viewer in viewers:
                viewer.sendall(head())
                assert received(viewer, len(head())) == head()
            for viewer in viewers:
                viewer.close()
    gc.collect()
    wait_until(lambda: echo.ended == rounds * viewers_at_a_time, "every connection behind ends")


def test_close_and_the_end_of_the_server_end_the_connections(echo: Echo) -> None:
    with gated(echo) as gate, connect(gate) as connection:
        connection.sendall(head())
        assert received(connection, len(head())) == head()
        gate.close()
        assert connection.recv(1) == b""
    with socket.create_server(("127.0.0.1", 0)) as unused:
        nothing = unused.getsockname()
    with closing(ViewerGate("127.0.0.1", 0, nothing, ViewerOrigins(), note=print)) as gate:
        assert answer(gate, head()) == ""
    port = echo.socket.getsockname()[1]
    with pytest.raises(ServerError, match=f"cannot listen on 127.0.0.1 port {port}: .*another `imud foxglove`"):
        ViewerGate("127.0.0.1", port, ("127.0.0.1", 1), ViewerOrigins(), note=print)
    with pytest.raises(ServerError, match=r"cannot listen on host\.invalid port 0"):
        ViewerGate("host.invalid", 0, ("127.0.0.1", 1), ViewerOrigins(), note=print)
