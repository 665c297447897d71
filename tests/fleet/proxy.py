"""TCP proxy in front of a broker. It forwards, stalls, cuts or resets connections, or limits their speed.

One thread serves all connections. The buffer is limited, so that a slow end slows the other end.
"""

import selectors
import socket
import struct
import threading
from contextlib import suppress
from typing import Final

PIECE_BYTES: Final = 16_384
ROUND_S: Final = 0.02
RESET_AT_CLOSE: Final = struct.pack("ii", 1, 0)  # SO_LINGER of 0 s: close() sends RST instead of FIN (tcp(7))


class Proxy:
    """Proxy. Synchronization: any thread may call the methods."""

    def __init__(self, port: int) -> None:
        self.bytes_s: float | None = None  # maximum rate from gateway to broker, bytes/s; None: no limit
        self.connections = 0  # number of accepted connections
        self._to = port
        self._stalled = self._cut = self._ended = False
        self._pairs: dict[socket.socket, socket.socket] = {}
        self._from_gateway: set[socket.socket] = set()
        self._passing = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        self.port = int(self._listener.getsockname()[1])
        self._thread = threading.Thread(target=self._run, name="proxy")
        self._thread.start()

    def stall(self) -> None:
        """Forward nothing, as with a cable that is unplugged behind a switch."""
        self._stalled = True

    def cut(self) -> None:
        self._cut = True

    def reset(self) -> None:
        """Reset all connections and accept new ones.

        On loopback, the other end has received RST when this method returns.
        """
        with self._passing:
            for one in self._from_gateway:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_AT_CLOSE)
            self._drop_all()

    def restore(self) -> None:
        self._stalled = self._cut = False

    def close(self) -> None:
        self._ended = True
        self._thread.join()
        self._drop_all()
        self._listener.close()

    def _run(self) -> None:
        pause = threading.Event()
        while not self._ended:
            if self._cut:
                self._drop_all()
                with suppress(OSError):
                    self._listener.accept()[0].close()
                pause.wait(ROUND_S)
            elif self._stalled:
                pause.wait(ROUND_S)
            else:
                self._round()
                if self.bytes_s is not None:
                    pause.wait(ROUND_S)

    def _round(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._listener, selectors.EVENT_READ)
            with self._passing:
                for one in self._pairs:
                    selector.register(one, selectors.EVENT_READ)
            ready = selector.select(ROUND_S)
            with self._passing:
                for key, _ in ready:
                    if key.fileobj is self._listener:
                        self._accept()
                    else:
                        self._pass_on(key.fileobj)  # type: ignore[arg-type]  # only sockets are registered

    def _accept(self) -> None:
        with suppress(OSError):
            near, _ = self._listener.accept()
            self.connections += 1
            try:
                far = socket.create_connection(("127.0.0.1", self._to), timeout=5)
            except OSError:
                near.close()
                return
            self._pairs |= {near: far, far: near}
            self._from_gateway.add(near)

    def _pass_on(self, source: socket.socket) -> None:
        target = self._pairs.get(source)
        if target is None:
            return
        is_limited = self.bytes_s is not None and source in self._from_gateway
        most = max(1, round(self.bytes_s * ROUND_S)) if is_limited and self.bytes_s is not None else PIECE_BYTES
        try:
            data = source.recv(most)
            target.settimeout(5)
            if data:
                target.sendall(data)
                return
        except OSError:
            pass
        self._drop(source, target)

    def _drop(self, *both: socket.socket) -> None:
        for one in both:
            self._pairs.pop(one, None)
            self._from_gateway.discard(one)
            one.close()

    def _drop_all(self) -> None:
        self._drop(*list(self._pairs))
