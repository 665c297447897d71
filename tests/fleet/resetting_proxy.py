"""A TCP proxy in front of a broker that resets connections (RST) at a given moment, whatever is under way."""

import socket
import struct
import threading
from contextlib import suppress
from typing import Final

RESET_AT_CLOSE: Final = struct.pack("ii", 1, 0)
"""SO_LINGER of 0 s: close() sends RST instead of FIN (tcp(7))."""


class ResettingProxy:
    """The proxy. Synchronization: methods from any thread."""

    def __init__(self, port: int) -> None:
        """`port` is the broker's, on loopback."""
        self._to = port
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def reset(self) -> None:
        """Reset all connections: on loopback the other end has the RST when this returns. New ones are accepted."""
        pairs, self._pairs = self._pairs, []
        for near, far in pairs:
            near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_AT_CLOSE)
            with suppress(OSError):  # the other end has left
                # the thread that waits in recv() holds the socket open: shutdown of reading wakes it, and sends nothing
                near.shutdown(socket.SHUT_RD)
            near.close()
            with suppress(OSError):
                far.shutdown(socket.SHUT_RDWR)
            far.close()

    def close(self) -> None:
        """End it."""
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.reset()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._to), timeout=5)
                far.settimeout(None)
                self._pairs.append((near, far))
                for source, target in ((near, far), (far, near)):
                    threading.Thread(target=self._pass_on, args=(source, target), daemon=True).start()

    def _pass_on(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                target.sendall(data)
        with suppress(OSError):
            target.shutdown(socket.SHUT_WR)
