"""Replies of InfluxDB: complete exchanges of `HttpPost` with a server that sends any bytes in any pieces.

The first byte of an input is the length of a piece, and whether the server closes the connection after the last piece.
The exchange ends within its deadline, with success, a rejection or an OSError that has a printable reason.
"""

import socket
import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Final

from imud.host import timed_connection
from imud.host.http_post import REQUEST_S, HttpPost, PostAccess, PostUrl, RequestRejected
from imud.model.units import NS_PER_S
from tests.fuzz.target import Target, check_printable

BODY: Final = b"imud_sample f=1i 1\n"
PIECES_MAX: Final = 64
READINGS_MAX: Final = 250
"""Maximum number of clock readings of an exchange. Each reading advances the clock by STEP_S."""
STEP_S: Final = 0.2
KEEPS: Final = 0x80
"""Bit of the first byte: the server keeps the connection open."""
_NO_WAIT: Final = struct.pack("ii", 1, 0)
"""Value of SO_LINGER: no connection stays in TIME_WAIT, because thousands of exchanges per second need new ports."""


class Server:
    """Server in the thread of the client. Each reading of the clock sends the next piece of the reply."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0), backlog=8)
        self.listener.setblocking(False)
        self._accepted: list[socket.socket] = []
        self._pieces: Iterator[bytes] = iter(())
        self._keeps = False
        self.readings = 0

    def start(self, data: bytes) -> None:
        """Reply to the next connection with the pieces of an input."""
        length = (data[0] & ~KEEPS if data else 0) or 4096
        reply = data[1:]
        length = max(length, -(-len(reply) // PIECES_MAX))
        self._keeps = bool(data) and bool(data[0] & KEEPS)
        self._pieces = iter([reply[offset : offset + length] for offset in range(0, len(reply), length)])
        self.readings = 0

    def now_ns(self) -> int:
        self.readings += 1
        try:
            connection, _ = self.listener.accept()
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_WAIT)
            self._accepted.append(connection)
        except BlockingIOError:
            pass
        if self._accepted:
            self._send(self._accepted[-1])
        return round(self.readings * STEP_S * NS_PER_S)

    def _send(self, connection: socket.socket) -> None:
        try:
            piece = next(self._pieces, None)
            if piece is not None:
                connection.sendall(piece)
            elif not self._keeps:
                connection.shutdown(socket.SHUT_WR)
        except OSError:  # the client closed the connection
            pass

    def end(self) -> None:
        """Close all connections."""
        for connection in self._accepted:
            connection.close()
        self._accepted.clear()


@lru_cache(1)
def shared_server() -> Server:
    """Return the server of this process. It listens until the process ends."""
    return Server()


def names() -> Sequence[str]:
    return ["reply"]


def make(_name: str) -> Target:
    timed_connection.LOOK_S = 0.0  # type: ignore[misc]  # the server sends before each wait
    server = shared_server()
    port = server.listener.getsockname()[1]

    def run(data: bytes) -> None:
        post = HttpPost(PostUrl("127.0.0.1", port, False, "/write"), PostAccess(), server.now_ns)
        try:
            for part in (data, data[:1] + data[1:][::-1][:64]):
                server.start(part)
                exchange(post)
                assert server.readings <= READINGS_MAX, server.readings
        finally:
            server.end()
            post.close()

    return Target(run, seeds, words=words)


def exchange(post: HttpPost) -> None:
    """Send one request. Success, a rejection and an OSError are possible, but no other exception."""
    try:
        post.post(BODY)
    except RequestRejected as error:
        check_printable(str(error))
    except OSError as error:
        check_printable(str(error))


def seeds() -> list[bytes]:
    replies = [
        b"HTTP/1.1 204 No Content\r\nX-Influxdb-Version: 1.6.7\r\n\r\n",
        b"HTTP/1.1 400 Bad Request\r\nContent-Length: 13\r\n\r\npartial write",
        b"HTTP/1.1 413 Too Large\r\nConnection: close\r\n\r\nx",
        b"HTTP/1.1 401 Unauthorized\r\nTransfer-Encoding: chunked\r\n\r\n5;a\r\nhello\r\n0\r\nT: x\r\n\r\n",
        b"HTTP/1.1 100 Continue\r\n\r\n" * 3 + b"HTTP/1.1 204 \r\n\r\n",
        b"HTTP/1.1 103 Early Hints\r\nLink: x\r\n\r\nHTTP/1.0 503 Busy\r\n\r\n" + b"y" * 500,
        b"HTTP/1.1 200 OK\r\nContent-Length: 18446744073709551615\r\n\r\n",
        b"HTTP/2 200\r\n\r\n", b"\x15\x03\x03\x00\x02\x02\x28", b"",
    ]  # fmt: skip
    return [bytes([step]) + reply for reply in replies for step in (0, 7 | KEEPS)]


def words() -> list[bytes]:
    return [
        b"HTTP/1.1 ", b"HTTP/1.0 ", b"204", b"100 Continue\r\n\r\n", b"413", b"Content-Length: ", b"\r\n\r\n",
        b"Transfer-Encoding: chunked\r\n", b"Connection: close\r\n", b"\r\n0\r\n\r\n", b"ffffffffffff\r\n",
    ]  # fmt: skip


assert READINGS_MAX > REQUEST_S / STEP_S
