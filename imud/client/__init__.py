"""Readers for programs on the host: `Client` for the UNIX socket, `Ring` for shared memory."""

from imud.client.connection import Client, EventStream, Hello, Watch
from imud.client.ring import Ring, RingRead
from imud.formats.jsonrpc import RpcError

__all__ = ["Client", "EventStream", "Hello", "Ring", "RingRead", "RpcError", "Watch"]
