"""Readers for programs on the host: `Client` for the UNIX socket, `Ring` for shared memory.

`__all__` is the public interface (docs/python.md).
"""

from imud.client.connection import Client, EventStream, Hello, Watch
from imud.client.ring import Ring, RingRead, default_directory
from imud.formats.jsonrpc import Code, RpcError, default_path
from imud.formats.ring import LedgerBlock, RingHeader
from imud.model.bucket import Bucket
from imud.model.errors import ImudError, LinkDenied, LinkError, LinkMissing, ServerError
from imud.model.event import Event, EventKind, PastEvents, StoredEvent
from imud.model.sample import Position, Sample, Sync

__all__ = [
    "Bucket", "Client", "Code", "Event", "EventKind", "EventStream", "Hello", "ImudError", "LedgerBlock",
    "LinkDenied", "LinkError", "LinkMissing", "PastEvents", "Position", "Ring", "RingHeader", "RingRead",
    "RpcError", "Sample", "ServerError", "StoredEvent", "Sync", "Watch", "default_directory", "default_path",
]  # fmt: skip
