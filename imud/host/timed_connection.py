"""TCP connection of a thread, with one deadline for each exchange.

A timeout of a socket applies to each `recv`: a server that sends one byte before each timeout holds the thread forever.
The deadline of this connection includes the name resolution, the connection, TLS, the request and the reply.

    start(seconds) ─▶ open ─▶ send ─▶ receive ─▶ receive ─▶ …        stop: from any thread
"""

import os
import select
import socket
import ssl
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from imud.model.errors import reason_of
from imud.model.options import is_ip_address
from imud.model.units import NS_PER_S

LOOK_S: Final = 0.1  # time between two checks of the deadline and of `stop`, s: a tenth of the time for a stop
RECEIVE_BYTES: Final = 4096  # maximum length of one read, bytes: a usual reply in one read


class ExchangeStopped(OSError):
    """Another thread ended the exchange with `stop`."""


class _Resolution:
    """Request for the addresses of a host name, in a thread of its own: a request to a name server cannot be ended."""

    def __init__(self, host: str, port: int) -> None:
        self.place = (host, port)
        self.addresses: list[tuple[socket.AddressFamily, tuple[object, ...]]] = []
        self.problem = ""
        self.is_done = threading.Event()

    def run(self) -> None:
        try:
            results = socket.getaddrinfo(*self.place, type=socket.SOCK_STREAM)
            self.addresses = [(family, address) for family, _, _, _, address in results]
        except OSError as error:
            self.problem = reason_of(error)
        except UnicodeError:  # a name that IDNA cannot encode
            self.problem = "expected a valid host name, got a name that DNS cannot contain"
        self.is_done.set()


class TimedConnection:
    """Connection to one server. Synchronization: one thread at a time; any thread may call `stop`."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        """`now_ns` returns CLOCK_MONOTONIC, ns."""
        self._now_ns = now_ns
        self._sock: socket.socket | None = None
        self._resolution: _Resolution | None = None
        self._early = b""  # data that arrived while `send` was sending
        self._limit_s = 0.0
        self._end_ns = 0
        self._is_stopped = False

    def start(self, seconds: float) -> None:
        """Start an exchange that must end within `seconds`."""
        self._limit_s = seconds
        self._end_ns = self._now_ns() + round(seconds * NS_PER_S)

    def stop(self) -> None:
        """End the present exchange and all later exchanges. They raise ExchangeStopped."""
        self._is_stopped = True

    @property
    def is_open(self) -> bool:
        return self._sock is not None

    def open(self, host: str, port: int, context: ssl.SSLContext | None = None) -> None:
        """Connect. With `context`, complete the TLS handshake. Raises OSError."""
        self.close()
        addresses = self._resolve(host, port)
        problem: OSError = OSError(f"the name {host} has no address")

        for index, (family, address) in enumerate(addresses):
            self._check()
            # an address without a reply must leave time for the next address
            share_ns = (self._end_ns - self._now_ns()) // (len(addresses) - index)
            try:
                self._connect(family, address, self._now_ns() + share_ns)
                break
            except ExchangeStopped:
                raise
            except OSError as error:
                problem = error
                self.close()

        if self._sock is None:
            raise problem
        if context is not None:
            self._start_tls(context, host)

    def send(self, data: bytes | memoryview) -> int:
        """Send data. Return the number of sent bytes: `send` ends when the server sends data, because a server can
        reply before it has read all data, for example that the request is too large. Raises OSError."""
        sock = self._opened()
        rest = memoryview(data)
        while rest and not self._early:
            self._check()
            try:
                rest = rest[sock.send(rest) :]
            except (ssl.SSLWantReadError, ssl.SSLWantWriteError, BlockingIOError):
                self._poll(select.POLLIN | select.POLLOUT)
            except (BrokenPipeError, ConnectionResetError):  # the reply can be in the receive buffer
                break
            if rest:
                self._early = self._receive_now() or b""
        return len(data) - len(rest)

    def receive(self) -> bytes:
        """Return received data; empty if the server closed the connection. Raises OSError."""
        while True:
            self._check()
            data, self._early = self._early, b""
            if data:
                return data
            arrived = self._receive_now()
            if arrived is not None:
                return arrived
            self._poll(select.POLLIN)

    def has_input(self) -> bool:
        """Return whether data or the end of the connection wait. An idle server sends nothing."""
        return self._receive_now() is not None

    def close(self) -> None:
        """Close the connection. `open` connects again."""
        sock, self._sock = self._sock, None
        self._early = b""
        if sock is not None:
            sock.close()

    def _opened(self) -> socket.socket:
        if self._sock is None:
            raise OSError("the connection is not open")
        return self._sock

    def _resolve(self, host: str, port: int) -> list[tuple[socket.AddressFamily, tuple[object, ...]]]:
        """Return the addresses of a host. A request that missed its deadline continues: at most one thread waits."""
        resolution = self._resolution
        if resolution is None or resolution.place != (host, port):
            resolution = self._resolution = _Resolution(host, port)
            if is_ip_address(host):
                resolution.run()
            else:
                threading.Thread(target=resolution.run, name="name server", daemon=True).start()

        while not resolution.is_done.wait(0):
            self._check()
            resolution.is_done.wait(LOOK_S)
        self._resolution = None
        if resolution.problem:
            raise OSError(f"{host}: {resolution.problem}")
        return resolution.addresses

    def _connect(self, family: socket.AddressFamily, address: tuple[object, ...], end_ns: int) -> None:
        sock = self._sock = socket.socket(family, socket.SOCK_STREAM)
        sock.setblocking(False)
        with suppress(BlockingIOError):
            sock.connect(address)
            return
        while not self._poll(select.POLLOUT):
            self._check()
            if self._now_ns() >= end_ns:
                raise TimeoutError("no reply to the connection request")
        code = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if code:
            raise OSError(code, os.strerror(code))

    def _start_tls(self, context: ssl.SSLContext, host: str) -> None:
        sock = self._opened()
        try:
            tls = context.wrap_socket(sock, server_hostname=host, do_handshake_on_connect=False)
        except ValueError as error:  # a name that a certificate cannot contain
            raise OSError(f"{host}: expected a host name of a certificate, got another name") from error
        self._sock = tls
        while True:
            self._check()
            try:
                tls.do_handshake()
                return
            except ssl.SSLWantReadError:
                self._poll(select.POLLIN)
            except ssl.SSLWantWriteError:
                self._poll(select.POLLOUT)

    def _receive_now(self) -> bytes | None:
        """Return the data that arrived; None without data, empty at the end of the connection."""
        try:
            return self._opened().recv(RECEIVE_BYTES)
        except (ssl.SSLWantReadError, ssl.SSLWantWriteError, BlockingIOError):
            return None
        except ssl.SSLEOFError:
            return b""

    def _check(self) -> None:
        """Raise TimeoutError after the deadline, and ExchangeStopped after `stop`."""
        if self._is_stopped:
            raise ExchangeStopped("imud ended the request")
        if self._now_ns() >= self._end_ns:
            raise TimeoutError(f"no complete reply within {self._limit_s:g} s")

    def _poll(self, events: int) -> bool:
        """Wait for the socket, at most LOOK_S. Return whether one of `events` or an error occurred."""
        poll = select.poll()
        poll.register(self._opened(), events)
        return bool(poll.poll(LOOK_S * 1000))
