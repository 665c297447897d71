"""Where sentences go: clients of a TCP server, datagrams, a serial port. None of them ever makes the caller wait.

What an output does not take at once is dropped by the whole sentence and counted: the next one is newer. Of a sentence
that was taken in part, the rest is kept and comes first. Synchronization: the event loop's thread; serial ports are
opened in another, because the driver of a USB adapter takes its time for it.
"""

import asyncio
import logging
import os
import socket
from collections.abc import Callable
from typing import Final, Protocol

import serial

from imud.contracts.status import OutputStatus
from imud.errors import ServerError, reason_of
from imud.units import NS_PER_S

log = logging.getLogger(__name__)

BACKLOG: Final = 8
CLIENTS_MAX: Final = 32
"""Plotters and instruments of one vessel; one more is refused, so that those that are there go on."""
STUCK_NS: Final = 30 * NS_PER_S
"""A client that takes nothing for so long is disconnected."""
RECV_BYTES: Final = 4096
RETRY_FIRST_NS: Final = NS_PER_S
RETRY_MOST_NS: Final = 30 * NS_PER_S
ACCEPT_PAUSE_S: Final = 1.0
"""After the process ran out of descriptors."""


class SentenceOutput(Protocol):
    """A way out."""

    def put(self, sentences: bytes) -> None:
        """Send whole sentences, or drop them."""
        ...

    def tick(self, now_ns: int) -> None:
        """Look after connections; called ten times a second."""
        ...

    def status(self) -> OutputStatus:
        """What was sent."""
        ...

    def close(self) -> None:
        """Close; may be called twice."""
        ...


class TcpClient:
    """One client that reads."""

    def __init__(self, sock: socket.socket, peer: str) -> None:
        self.sock = sock
        self.peer = peer
        self._rest = b""
        """Of sentences that were taken in part."""
        self.full_ns: int | None = None
        """Since when it has no room for what is sent; None while it has, and while nothing is sent."""

    def put(self, sentences: bytes, now_ns: int) -> bool:
        """Send, or drop; return whether they were sent. Raises OSError when the connection has ended."""
        try:
            if self._rest:
                count = self.sock.send(self._rest)
                self._rest = self._rest[count:]
                self.full_ns = None
            if self._rest:
                return False
            self._rest = sentences[self.sock.send(sentences) :]
            self.full_ns = None
        except BlockingIOError:
            if self.full_ns is None:
                self.full_ns = now_ns
            return False
        return True


class TcpOutput:
    """A TCP server: each client gets all sentences from now on. What clients send is read and ignored."""

    def __init__(self, address: str, port: int, now_ns: Callable[[], int]) -> None:
        self._address = address
        self.port = port
        """The bound port once open, also where 0 was asked for."""
        self._now_ns = now_ns
        self._clients: dict[int, TcpClient] = {}
        self._listener: socket.socket | None = None
        self._sent = self._dropped = 0

    def open(self) -> None:
        """Listen. Raises ServerError when address and port cannot be had."""
        family = socket.AF_INET6 if ":" in self._address else socket.AF_INET
        listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((self._address, self.port))
            listener.listen(BACKLOG)
        except OSError as error:
            listener.close()
            raise ServerError(
                f"NMEA 0183 cannot be served at {self._address} port {self.port}: {reason_of(error)}; "
                f"set nmea0183.tcp_port to another port, or to null"
            ) from error
        listener.setblocking(False)
        self.port = listener.getsockname()[1]
        self._listener = listener
        asyncio.get_running_loop().add_reader(listener, self._accept)

    def put(self, sentences: bytes) -> None:
        """Send to every client that has room."""
        now_ns, count = self._now_ns(), sentences.count(b"\n")
        for number, client in list(self._clients.items()):
            try:
                if client.put(sentences, now_ns):
                    self._sent += count
                    continue
            except OSError:  # reset by the peer
                self._drop_client(number)
            self._dropped += count

    def tick(self, now_ns: int) -> None:
        """Disconnect clients that take nothing."""
        for number, client in list(self._clients.items()):
            if client.full_ns is not None and now_ns - client.full_ns > STUCK_NS:
                log.info(
                    "nmea0183: %s is disconnected: it has read nothing for %d s", client.peer, STUCK_NS // NS_PER_S
                )
                self._drop_client(number)

    def status(self) -> OutputStatus:
        """What was sent."""
        name = f"tcp {self._address}:{self.port}"
        return OutputStatus(name, self._sent, self._dropped, len(self._clients), "")

    def close(self) -> None:
        """Stop listening and disconnect everybody; may be called twice."""
        for number in list(self._clients):
            self._drop_client(number)
        listener, self._listener = self._listener, None
        if listener is not None:
            asyncio.get_running_loop().remove_reader(listener)
            listener.close()

    def _accept(self) -> None:
        listener = self._listener
        if listener is None:
            return
        try:
            sock, address = listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError:  # out of descriptors: the listener stays readable, an immediate retry would be a busy loop
            loop = asyncio.get_running_loop()
            loop.remove_reader(listener)
            loop.call_later(ACCEPT_PAUSE_S, self._listen_again)
            return
        peer = f"{address[0]} port {address[1]}"
        if len(self._clients) >= CLIENTS_MAX:
            log.info("nmea0183: %s is refused: there are %d clients already", peer, CLIENTS_MAX)
            sock.close()
            return
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        number = sock.fileno()
        self._clients[number] = TcpClient(sock, peer)
        asyncio.get_running_loop().add_reader(sock, self._read, number)

    def _listen_again(self) -> None:
        if self._listener is not None:
            asyncio.get_running_loop().add_reader(self._listener, self._accept)

    def _read(self, number: int) -> None:
        client = self._clients.get(number)
        if client is None:
            return
        try:
            if client.sock.recv(RECV_BYTES):
                return
        except BlockingIOError:
            return
        except OSError:
            pass  # reset by the peer
        self._drop_client(number)

    def _drop_client(self, number: int) -> None:
        client = self._clients.pop(number)
        asyncio.get_running_loop().remove_reader(client.sock)
        client.sock.close()


class UdpOutput:
    """Datagrams to one address: a host, a network's broadcast address or a multicast group."""

    def __init__(self, address: str, port: int) -> None:
        self._address = (address, port)
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self._sock = socket.socket(family, socket.SOCK_DGRAM)
        self._sock.setblocking(False)
        if family == socket.AF_INET:
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._sent = self._dropped = 0
        self._problem = ""

    def put(self, sentences: bytes) -> None:
        """Send them as one datagram."""
        count = sentences.count(b"\n")
        try:
            self._sock.sendto(sentences, self._address)
        except OSError as error:  # no route, network down, or nobody there: the next one may arrive
            self._dropped += count
            problem = reason_of(error)
            if problem != self._problem:
                log.warning("nmea0183: datagrams to %s port %d: %s", *self._address, problem)
            self._problem = problem
        else:
            self._sent += count
            self._problem = ""

    def tick(self, _now_ns: int) -> None:
        """No-op: there is no connection."""

    def status(self) -> OutputStatus:
        """What was sent."""
        address, port = self._address
        return OutputStatus(f"udp {address}:{port}", self._sent, self._dropped, int(not self._problem), self._problem)

    def close(self) -> None:
        """Close; may be called twice."""
        self._sock.close()


def open_serial(port: str, baud: int) -> int:
    """Open a serial port for writing without waiting, 8N1; return its descriptor. Raises OSError."""
    made = serial.Serial(port, baud, timeout=0, write_timeout=0, exclusive=True)
    try:
        fd = os.dup(made.fileno())
    finally:
        made.close()
    os.set_blocking(fd, False)
    return fd


class SerialOutput:
    """A serial port, opened again after it was away."""

    def __init__(
        self, port: str, baud: int, now_ns: Callable[[], int], open_port: Callable[[str, int], int] = open_serial
    ) -> None:
        self._port, self._baud = port, baud
        self._now_ns = now_ns
        self._open_port = open_port
        self._fd: int | None = None
        self._opening: asyncio.Future[int] | None = None
        self._due_ns = 0
        self._wait_ns = RETRY_FIRST_NS
        self._rest = b""
        self._sent = self._dropped = 0
        self._problem = "not open yet"

    def put(self, sentences: bytes) -> None:
        """Write, or drop while the port is away or its queue is full."""
        count = sentences.count(b"\n")
        if self._fd is None:
            self._dropped += count
            return
        try:
            if self._rest:
                self._rest = self._rest[os.write(self._fd, self._rest) :]
            if self._rest:
                self._dropped += count
                return
            self._rest = sentences[os.write(self._fd, sentences) :]
            self._sent += count
        except BlockingIOError:
            self._dropped += count
        except OSError as error:
            self._dropped += count
            self._lose(reason_of(error))

    def tick(self, now_ns: int) -> None:
        """Open the port when that is due."""
        if self._fd is None and self._opening is None and now_ns >= self._due_ns:
            loop = asyncio.get_running_loop()
            self._opening = loop.run_in_executor(None, self._open_port, self._port, self._baud)
            self._opening.add_done_callback(self._opened)

    def status(self) -> OutputStatus:
        """What was sent."""
        is_open = self._fd is not None
        return OutputStatus(f"serial {self._port}", self._sent, self._dropped, int(is_open), self._problem)

    def close(self) -> None:
        """Close; may be called twice."""
        opening, self._opening = self._opening, None
        if opening is not None:
            opening.remove_done_callback(self._opened)
            opening.add_done_callback(_close_late)
        self._close_port()

    def _opened(self, opening: "asyncio.Future[int]") -> None:
        self._opening = None
        error = opening.exception()
        if error is None:
            self._fd, self._wait_ns, self._problem = opening.result(), RETRY_FIRST_NS, ""
            log.info("nmea0183: sentences go to %s at %d baud", self._port, self._baud)
        elif isinstance(error, (OSError, ValueError)):  # ValueError: a rate that the driver does not have
            self._lose(reason_of(error))
        else:
            raise error

    def _lose(self, problem: str) -> None:
        self._close_port()
        if problem != self._problem:
            log.warning("nmea0183: %s: %s; it is opened again when it can be", self._port, problem)
        self._problem = problem
        self._due_ns = self._now_ns() + self._wait_ns
        self._wait_ns = min(2 * self._wait_ns, RETRY_MOST_NS)

    def _close_port(self) -> None:
        fd, self._fd, self._rest = self._fd, None, b""
        if fd is not None:
            os.close(fd)


def _close_late(opening: "asyncio.Future[int]") -> None:
    """Close a port that was opened while the output was closed."""
    if not opening.cancelled() and opening.exception() is None:
        os.close(opening.result())
