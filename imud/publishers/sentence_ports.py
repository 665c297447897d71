"""Ports for sentences of NMEA 0183: TCP server, UDP datagrams, and a serial port that imud opens again after a loss."""

import asyncio
import logging
import os
import socket
from collections.abc import Callable
from functools import partial
from typing import Final, Protocol

import serial

from imud.contracts.status import OutputStatus
from imud.host.network import listen, open_socket
from imud.host.threads import call_in_thread
from imud.model.errors import ServerError, reason_of
from imud.model.units import NS_PER_S
from imud.model.work_budget import WorkBudget, WorkLimits

log = logging.getLogger(__name__)

CLIENTS_MAX: Final = 32  # maximum number of clients: plotters and instruments of one vessel
STUCK_NS: Final = 30 * NS_PER_S  # time without progress after which imud disconnects a client, ns
UNREAD_NS: Final = 10 * NS_PER_S  # time without progress after which a client or a serial port is a problem, ns
RECV_BYTES: Final = 4096
# Work that the connections and the data of one host may cause. No client needs to send data.
PEER_LIMITS: Final = WorkLimits(second_cpu_ns=20_000_000)
CONNECTIONS: Final = "the connections of new clients"  # peer of the budget for `accept`
RETRY_FIRST_NS: Final = NS_PER_S
RETRY_MOST_NS: Final = 30 * NS_PER_S
ACCEPT_PAUSE_S: Final = 1.0  # pause of accept after the process ran out of descriptors, s


class SentenceOutput(Protocol):
    """Port for sentences."""

    def put(self, sentences: bytes) -> None:
        """Send complete sentences, or drop them."""
        ...

    def tick(self, now_ns: int) -> None:
        """Check connections. The output calls this method ten times a second."""
        ...

    def status(self) -> OutputStatus:
        """Return the counters and the problem of the port."""
        ...

    def close(self) -> None:
        """Close the port. A second call does nothing."""
        ...


class TcpClient:
    def __init__(self, sock: socket.socket, peer: str, host: str = "") -> None:
        self.sock = sock
        self.peer = peer  # address and port, for messages
        self.host = host  # address of the host, which has one budget for all its connections
        self._rest = b""  # rest of a sentence that the kernel accepted in part
        # Time since which the socket buffer is full; None if it has room or imud sends nothing
        self.full_ns: int | None = None
        self.is_half_closed = False  # whether the client has shut down its sending direction, or closed the connection

    def put(self, sentences: bytes, now_ns: int) -> bool:
        """Send or drop sentences. Return whether imud sent them. Raises OSError if the connection ended."""
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
    """TCP server. Each client receives all sentences. imud reads and ignores data from clients."""

    def __init__(self, address: str, port: int, now_ns: Callable[[], int], budget: WorkBudget | None = None) -> None:
        """`budget` limits the work that clients cause; None: no limit."""
        self._budget = budget
        self._deferred: list[int] = []  # clients whose data stay in the kernel until the next tick
        self._is_accept_deferred = False
        self._address = address
        self.port = port  # bound port after `open`, also if the configured port is 0
        self._now_ns = now_ns
        self._clients: dict[int, TcpClient] = {}
        self._listener: socket.socket | None = None
        self._sent = self._dropped = 0

    def open(self) -> None:
        """Listen. Raises ServerError if address and port cannot be used."""
        try:
            listener = listen(self._address, self.port)
        except OSError as error:
            raise ServerError(
                f"cannot open the NMEA 0183 server at {self._address} port {self.port}: {reason_of(error)}; "
                f"set nmea0183.tcp_address to an address of the host, or nmea0183.tcp_port to another port or null"
            ) from error
        self.port = listener.getsockname()[1]
        self._listener = listener
        asyncio.get_running_loop().add_reader(listener, self._accept, listener)

    def put(self, sentences: bytes) -> None:
        """Send sentences to each client with room in its socket buffer."""
        now_ns, count = self._now_ns(), sentences.count(b"\n")
        for number, client in list(self._clients.items()):
            try:
                if client.put(sentences, now_ns):
                    self._sent += count
                    continue
            except OSError:  # the client reset the connection
                self._drop_client(number)
            self._dropped += count

    def tick(self, now_ns: int) -> None:
        """Disconnect clients without progress, and read from the clients above the budget again."""
        self._continue_reading()
        for number, client in list(self._clients.items()):
            if client.full_ns is not None and now_ns - client.full_ns > STUCK_NS:
                log.info("nmea0183: disconnecting %s, which did not read for %d s", client.peer, STUCK_NS // NS_PER_S)
                self._drop_client(number)

    def status(self) -> OutputStatus:
        now_ns = self._now_ns()
        unread = [
            client
            for client in self._clients.values()
            if client.full_ns is not None and now_ns - client.full_ns >= UNREAD_NS
        ]
        problem = self._budget.problem(now_ns) if self._budget is not None else ""
        if unread and unread[0].full_ns is not None:
            problem = f"{unread[0].peer} has not read for {(now_ns - unread[0].full_ns) // NS_PER_S} s"
        refused = self._budget.refused if self._budget is not None else 0
        name = f"tcp {self._address}:{self.port}"
        readers = len(self._clients) - len(unread)
        return OutputStatus(name, self._sent, self._dropped, readers, problem, refused)

    def close(self) -> None:
        """Stop listening and disconnect all clients. A second call does nothing."""
        for number in list(self._clients):
            self._drop_client(number)
        listener, self._listener = self._listener, None
        if listener is not None:
            asyncio.get_running_loop().remove_reader(listener)
            listener.close()

    def _may_work(self, host: str) -> bool:
        """Return whether the budget permits work for a host in this turn. Charge the work to the host."""
        if self._budget is None:
            return True
        self._budget.start_turn(self._now_ns())
        return self._budget.admit(host)

    def _end_work(self) -> None:
        if self._budget is not None:
            self._budget.end_turn()

    def _continue_reading(self) -> None:
        """Read from the clients again that were above their budget, and accept clients again."""
        loop = asyncio.get_running_loop()
        deferred, self._deferred = self._deferred, []
        for number in deferred:
            client = self._clients.get(number)
            if client is not None and not client.is_half_closed:
                loop.add_reader(client.sock, self._read, number)
        if self._is_accept_deferred:
            self._is_accept_deferred = False
            self._listen_again()

    def _accept(self, listener: socket.socket) -> None:
        # the address of the next client is known only after `accept`: all connections have one budget together
        if not self._may_work(CONNECTIONS):
            asyncio.get_running_loop().remove_reader(listener)
            self._is_accept_deferred = True
            return
        self._accept_client(listener)
        self._end_work()

    def _accept_client(self, listener: socket.socket) -> None:
        try:
            sock, address = listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError:  # out of descriptors: the listener stays readable, so an immediate retry would be a busy loop
            loop = asyncio.get_running_loop()
            loop.remove_reader(listener)
            loop.call_later(ACCEPT_PAUSE_S, self._listen_again)
            return
        peer = f"{address[0]} port {address[1]}"
        half_closed = [number for number, client in self._clients.items() if client.is_half_closed]
        if len(self._clients) >= CLIENTS_MAX and half_closed:  # without sentences, imud does not see which are closed
            self._drop_client(half_closed[0])
        if len(self._clients) >= CLIENTS_MAX:
            log.info("nmea0183: rejecting %s: the limit of %d clients is reached", peer, CLIENTS_MAX)
            sock.close()
            return
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        number = sock.fileno()
        self._clients[number] = TcpClient(sock, peer, address[0])
        asyncio.get_running_loop().add_reader(sock, self._read, number)

    def _listen_again(self) -> None:
        if self._listener is not None:
            asyncio.get_running_loop().add_reader(self._listener, self._accept, self._listener)

    def _read(self, number: int) -> None:
        client = self._clients.get(number)
        if client is None:
            return
        if not self._may_work(client.host):
            asyncio.get_running_loop().remove_reader(client.sock)
            self._deferred.append(number)
            return
        self._read_client(client, number)
        self._end_work()

    def _read_client(self, client: TcpClient, number: int) -> None:
        try:
            if not client.sock.recv(RECV_BYTES):  # the next sentences show whether the client still reads
                client.is_half_closed = True
                asyncio.get_running_loop().remove_reader(client.sock)
        except BlockingIOError:
            return
        except OSError:  # the client reset the connection
            self._drop_client(number)

    def _drop_client(self, number: int) -> None:
        client = self._clients.pop(number)
        asyncio.get_running_loop().remove_reader(client.sock)
        client.sock.close()


class UdpOutput:
    """Datagrams to one address: a host, a broadcast address or a multicast group."""

    def __init__(self, address: str, port: int) -> None:
        self._address = (address, port)
        self._sock: socket.socket | None = None
        self._sent = self._dropped = 0
        self._problem = ""

    def put(self, sentences: bytes) -> None:
        """Send sentences as one datagram."""
        count = sentences.count(b"\n")
        try:
            self._opened().sendto(sentences, self._address)
        except OSError as error:  # no IPv6, no route, network down, or no receiver: the next datagram can arrive
            self._dropped += count
            problem = reason_of(error)
            if problem != self._problem:
                log.warning("nmea0183: datagrams to %s port %d: %s", *self._address, problem)
            self._problem = problem
        else:
            self._sent += count
            self._problem = ""

    def tick(self, _now_ns: int) -> None:
        """Do nothing: UDP has no connection."""

    def status(self) -> OutputStatus:
        address, port = self._address
        return OutputStatus(f"udp {address}:{port}", self._sent, self._dropped, int(not self._problem), self._problem)

    def close(self) -> None:
        """Close the socket. A second call does nothing."""
        if self._sock is not None:
            self._sock.close()

    def _opened(self) -> socket.socket:
        if self._sock is None:
            self._sock = open_socket(self._address[0], socket.SOCK_DGRAM)
            if self._sock.family == socket.AF_INET:
                self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        return self._sock


def open_serial(port: str, baud: int) -> int:
    """Open a serial port for writing without waiting, 8N1. Return its descriptor. Raises OSError."""
    made = serial.Serial(port, baud, timeout=0, write_timeout=0, exclusive=True)
    try:
        fd = os.dup(made.fileno())
    finally:
        made.close()
    os.set_blocking(fd, False)
    return fd


class SerialOutput:
    """Serial port. imud opens it again after a loss."""

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
        self._full_ns: int | None = None  # time since which the port accepts no data; None if it accepts data
        self._sent = self._dropped = 0
        self._problem = "not open yet"

    def put(self, sentences: bytes) -> None:
        """Write sentences. Drop them if the port is missing or its queue is full."""
        count = sentences.count(b"\n")
        if self._fd is None:
            self._dropped += count
            return
        try:
            if self._rest:
                self._rest = self._rest[os.write(self._fd, self._rest) :]
                self._full_ns = None
            if self._rest:
                self._dropped += count
                return
            self._rest = sentences[os.write(self._fd, sentences) :]
            self._full_ns = None
            self._sent += count
        except BlockingIOError:
            self._dropped += count
            if self._full_ns is None:
                self._full_ns = self._now_ns()
        except OSError as error:
            self._dropped += count
            self._lose(reason_of(error))

    def tick(self, now_ns: int) -> None:
        """Open the port if an attempt is due."""
        if self._fd is None and self._opening is None and now_ns >= self._due_ns:
            self._opening = call_in_thread("nmea0183", partial(self._open_port, self._port, self._baud))
            self._opening.add_done_callback(self._opened)

    def status(self) -> OutputStatus:
        is_open = self._fd is not None
        problem = self._problem
        full_ns = 0 if self._full_ns is None else self._now_ns() - self._full_ns
        if is_open and full_ns >= UNREAD_NS:
            is_open = False
            problem = f"the port has accepted no data for {full_ns // NS_PER_S} s; check its flow control"
        return OutputStatus(f"serial {self._port}", self._sent, self._dropped, int(is_open), problem)

    def close(self) -> None:
        """Close the port. A second call does nothing."""
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
            log.info("nmea0183: sending to %s at %d baud", self._port, self._baud)
        elif isinstance(error, (OSError, ValueError)):  # ValueError: the driver does not support the baud rate
            self._lose(reason_of(error))
        else:
            raise error

    def _lose(self, problem: str) -> None:
        self._close_port()
        if problem != self._problem:
            log.warning("nmea0183: %s: %s; trying again", self._port, problem)
        self._problem = problem
        self._due_ns = self._now_ns() + self._wait_ns
        self._wait_ns = min(2 * self._wait_ns, RETRY_MOST_NS)

    def _close_port(self) -> None:
        fd, self._fd, self._rest = self._fd, None, b""
        self._full_ns = None
        if fd is not None:
            os.close(fd)


def _close_late(opening: "asyncio.Future[int]") -> None:
    """Close a port that a thread opened after the output was closed."""
    if not opening.cancelled() and opening.exception() is None:
        os.close(opening.result())
