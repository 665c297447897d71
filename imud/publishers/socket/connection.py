"""One client of the socket: its lines come in, its subscriptions are kept, everything for it goes out through here."""

import asyncio
import logging
import socket
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Final

from imud.contracts.status import ClientStatus
from imud.formats.jsonrpc import LINE_MAX_BYTES, Code, RpcError, encode_error, frame_of, line_of
from imud.publishers.socket.outbox import NO_FD, Limits, Outbox
from imud.publishers.socket.rights import Peer, Rights
from imud.publishers.socket.subscription import Subscription
from imud.publishers.socket.waker import Waker

log = logging.getLogger(__name__)

RECV_BYTES: Final = 65536
LINES_PER_TURN: Final = 4
"""After so many requests of one client the event loop has its turn: 64 KiB hold a thousand `status` requests."""
LINGER_TICKS: Final = 20
"""A client that is done has so many ticks (100 ms each) to take what still waits for it."""


@dataclass(frozen=True, slots=True)
class Owner:
    """What a connection needs of the server."""

    on_line: Callable[["Connection", bytes], None]
    on_close: Callable[["Connection"], None]
    on_evicted: Callable[[], None]
    limits: Limits


class Connection:
    """A connected client with at least the right to read. Synchronization: the event loop's thread."""

    def __init__(self, number: int, sock: socket.socket, peer: Peer, rights: Rights, owner: Owner) -> None:
        self.number = number
        self.peer = peer
        self.rights = rights
        self.outbox = Outbox(sock, owner.limits, self._broken, self._flooded, self._emptied)
        self.subscription: Subscription | None = None
        self.event_devices: Collection[str] | None = ()
        """Devices whose events are wanted; None for all, empty for none."""
        self.framed = False
        """Whether messages go out as frames; stays so once it is."""
        self.wakers: dict[str, Waker] = {}
        """By device whose batches wake the client."""
        self.closed = False
        self._sock = sock
        self._owner = owner
        self._input = bytearray()
        self._searched = 0
        self._linger_ticks: int | None = None
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(sock, self._readable)

    def post(self, body: bytes, fd: int = NO_FD) -> None:
        """Send one JSON object, with a copy of a descriptor where one is given."""
        if not self.closed:
            self.outbox.put_reply(frame_of(body) if self.framed else line_of(body), fd)
            if not self.outbox.waiting:
                self._handed_over()

    def wants_events_of(self, device: str) -> bool:
        """Whether events of `device` are wanted; those of the daemon itself ("") go to all who want any."""
        wanted = self.event_devices
        return wanted is None or device in wanted or (not device and bool(wanted))

    def status(self) -> ClientStatus:
        """What is known of this client now."""
        outbox = self.outbox
        return ClientStatus(
            number=self.number,
            pid=self.peer.pid,
            uid=self.peer.uid,
            control=Rights.CONTROL in self.rights,
            encoding=str(self.subscription.form) if self.subscription else "",
            sent=outbox.sent,
            dropped=outbox.dropped,
            queue_samples=outbox.queue_samples,
            queue_bytes=outbox.queue_bytes,
        )

    def make_waker(self, device: str) -> int:
        """A new descriptor for the client, to be sent with the next `post`: batches of `device` wake it, not the old.

        Raises RpcError where that cannot be, for one while the old one still waits to be sent: it is not in place of
        what the client has not seen, and a client that never reads would gather descriptors of the daemon's.
        """
        old = self.wakers.get(device)
        if old is not None and old.client_end != NO_FD:
            message = "notify: the reply to the one before still waits for this client; read it, then ask again"
            raise RpcError(Code.UNAVAILABLE, message)
        try:
            waker = Waker()
        except OSError as error:
            raise RpcError(Code.UNAVAILABLE, f"notify: the daemon cannot make a descriptor: {error.strerror}") from None
        if old is not None:
            old.close()
        self.wakers[device] = waker
        return waker.client_end

    def wake(self, device: str) -> bool:
        """Wake the client if it wants that; False, once, when it has closed its descriptor, which ends it."""
        waker = self.wakers.get(device)
        if waker is None or waker.wake():
            return True
        self.wakers.pop(device).close()
        return False

    def finish(self) -> None:
        """Take nothing more from the client, give it what waits, then close."""
        if self.closed or self._linger_ticks is not None:
            return
        self._loop.remove_reader(self._sock)
        self._linger_ticks = LINGER_TICKS
        if not self.outbox.waiting:
            self.close()

    def tick(self) -> None:
        """Called ten times a second."""
        if self._linger_ticks is not None:
            self._linger_ticks -= 1
            if self._linger_ticks <= 0:
                self.close()

    def close(self) -> None:
        """Close at once; may be called twice."""
        if self.closed:
            return
        self.closed = True
        self._loop.remove_reader(self._sock)
        self.outbox.close()
        self._sock.close()
        for waker in self.wakers.values():
            waker.close()
        self.wakers.clear()
        self._input.clear()
        self._owner.on_close(self)

    # --- reading ----------------------------------------------------------------------------------------------------

    def _readable(self) -> None:
        try:
            data = self._sock.recv(RECV_BYTES)
        except BlockingIOError:
            return
        except OSError:  # reset by the peer
            self.close()
            return
        if not data:
            self.finish()
            return
        self._input += data
        self._work()

    def _work(self) -> None:
        """Handle lines that are there; after some of them, let others have their turn first."""
        for _ in range(LINES_PER_TURN):
            if self.closed or self._linger_ticks is not None:
                return
            line = self._take_line()
            if line is None:
                return
            if line.strip():
                self._owner.on_line(self, line)
        if not self.closed:
            self._loop.remove_reader(self._sock)
            self._loop.call_soon(self._resume)

    def _resume(self) -> None:
        if self.closed or self._linger_ticks is not None:
            return
        self._loop.add_reader(self._sock, self._readable)
        self._work()

    def _take_line(self) -> bytes | None:
        """The next whole line; None when there is none yet, or when the client is over the limit and finished."""
        data = self._input
        end = data.find(b"\n", self._searched)
        if (len(data) if end < 0 else end) > LINE_MAX_BYTES:
            self._refuse_line()
            return None
        if end < 0:
            self._searched = len(data)
            return None
        line = bytes(data[:end])
        del data[: end + 1]
        self._searched = 0
        return line

    def _refuse_line(self) -> None:
        self._input.clear()
        self._owner.on_evicted()
        message = f"a line has at most {LINE_MAX_BYTES} bytes; this connection ends"
        self.post(encode_error(RpcError(Code.LINE_TOO_LONG, message)))
        self.finish()

    # --- the outbox's side ------------------------------------------------------------------------------------------

    def _broken(self, reason: str) -> None:
        """The client is gone, or does not deserve to stay. Called from `publish` too: nothing is iterated over here."""
        if not self.closed:
            log.info("client %d (pid %d, uid %d) is gone: %s", self.number, self.peer.pid, self.peer.uid, reason)
            self.close()

    def _flooded(self) -> None:
        self._owner.on_evicted()
        self._broken("it does not read the answers to what it asks")

    def _emptied(self) -> None:
        self._handed_over()
        if self._linger_ticks is not None:
            self.close()

    def _handed_over(self) -> None:
        """All that waited is sent, descriptors too."""
        for waker in self.wakers.values():
            waker.handed_over()
