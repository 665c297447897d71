"""TCP and UDP sockets for an IP address."""

import socket
from typing import Final

BACKLOG: Final = 128  # number of connections that wait for `accept`


def open_socket(address: str, kind: socket.SocketKind) -> socket.socket:
    """Return a socket that does not block, of the family of an IP address. Raises OSError, also if the kernel has no
    IPv6."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    made = socket.socket(family, kind)
    made.setblocking(False)
    return made


def listen(address: str, port: int) -> socket.socket:
    """Return a TCP server socket. Port 0 selects a free port. Raises OSError."""
    listener = open_socket(address, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((address, port))
        listener.listen(BACKLOG)
    except OSError:
        listener.close()
        raise
    return listener
