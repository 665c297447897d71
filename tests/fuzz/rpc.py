"""The UNIX socket: one line through `parse_request`, and all data of a client through a server with two devices."""

import asyncio
import atexit
import grp
import json
import os
import socket
import tempfile
from collections.abc import Coroutine, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

from imud.drivers import DRIVERS
from imud.formats.jsonrpc import RpcError, encode_error, encode_result, parse_object, parse_request
from imud.model.errors import Rejected
from imud.model.event import Event, EventKind
from imud.model.sample import SAMPLE_FIELDS
from imud.publishers.socket.server import SocketOptions, SocketServer
from tests.fuzz.target import Target
from tests.support.publisher_context import publisher_context
from tests.support.socket_rig import DEVICES, EPOCH, NOW_NS, FakeControl, batch, device_status

T = TypeVar("T")

ANSWER_S: Final = 5.0  # limit for the replies of the server
REPLIES_PER_LINE_MAX: Final = 1
BLANK: Final = b" \t\r"
"""White space of JSON within a line (RFC 8259, section 2). `bytes.strip` also removes vertical tabs, for example."""
ERROR_CHARACTERS_MAX: Final = 1024
METHODS: Final = (
    "devices", "status", "schema", "watch", "unwatch", "poll", "events", "notify", "actions", "command",
    "calibrations", "calibrate", "stop_calibration",
)  # fmt: skip
VERBS: Final = DRIVERS["hipnuc-uart"].verbs
QUIET_TURNS: Final = 50  # turns of the loop without data after which the server has sent all replies


def names() -> Sequence[str]:
    return ["line", "connection"]


def make(name: str) -> Target:
    return Target({"line": run_line, "connection": run_connection}[name], seeds, words=words, bytes_max=8192)


def run_line(data: bytes) -> None:
    """The result is a request with a reply, or an error that the server can send."""
    try:
        request = parse_request(data)
    except RpcError as error:
        _check_error(error)
        return
    assert parse_object(encode_result(request.request_id, {}))["id"] == request.request_id


def run_connection(data: bytes) -> None:
    """A client sends the data and closes its side. The server sends at most one reply per line and continues to run."""
    rig = _rig()
    rig.do(rig.serve(data))


def _own_group() -> str:
    return grp.getgrgid(os.getgid()).gr_name


def _check_error(error: RpcError) -> None:
    assert parse_object(encode_error(error))["error"]["code"] == error.code
    assert len(str(error)) < ERROR_CHARACTERS_MAX


class _Rig:
    """A server with an event loop. The loop runs while a client is connected."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda _loop, context: self._strays.append(context))
        self._strays: list[dict[str, Any]] = []
        self._folder = tempfile.TemporaryDirectory(prefix="imud-fuzz-")
        self.server = self.do(self._start())
        atexit.register(self._close)

    def do(self, work: Coroutine[Any, Any, T]) -> T:
        """Run `work` in the loop. Raises the exceptions that the loop caught."""
        result = self._loop.run_until_complete(asyncio.wait_for(work, ANSWER_S))
        strays, self._strays = self._strays, []
        for stray in strays:
            raise AssertionError(stray["message"]) from stray.get("exception")
        return result

    def _close(self) -> None:
        self._loop.run_until_complete(self._stop())
        self._loop.close()
        self._folder.cleanup()

    async def _stop(self) -> None:
        self.server.close()

    async def _start(self) -> SocketServer:
        statuses = [device_status(*item) for item in DEVICES.items()]
        context = publisher_context(lambda: statuses, EPOCH, lambda: NOW_NS, _Control)
        server = SocketServer(SocketOptions(path=str(Path(self._folder.name, "s")), group=_own_group()), context)
        server.start()
        for name, number in DEVICES.items():
            server.add_device(name, number)
        server.publish(batch())
        return server

    async def serve(self, data: bytes) -> None:
        """Connect, send, close the own side, and read until the server is quiet, while samples and events arrive."""
        received = await self._talk(data)
        while self.server.hub.connections:  # ends with the time-out of `do` at the latest
            await asyncio.sleep(0)
        _check_received(received, data)

    async def _talk(self, data: bytes) -> bytes:
        loop = asyncio.get_running_loop()
        received = bytearray()
        with socket.socket(socket.AF_UNIX) as peer:
            peer.setblocking(False)
            await loop.sock_connect(peer, self.server.hub.path)
            try:
                await loop.sock_sendall(peer, data)
                await asyncio.sleep(0)
                self.server.publish(batch(first=2))
                self.server.event(Event(NOW_NS, "imu0", EventKind.UP, "found"))
                peer.shutdown(socket.SHUT_WR)
                quiet = 0
                while quiet < QUIET_TURNS:  # the server keeps a connection with a subscription
                    await asyncio.sleep(0)
                    try:
                        part = peer.recv(1 << 16)
                    except BlockingIOError:
                        quiet += 1
                        continue
                    received += part
                    quiet = 0 if part else QUIET_TURNS
            except ConnectionError:  # the server closed the connection before it had read all data
                return b""
        return bytes(received)


@cache
def _rig() -> _Rig:
    return _Rig()


class _Control(FakeControl):
    """A device with the actions of a real driver. It checks the arguments like the daemon and executes nothing."""

    actions = VERBS

    async def act(self, name: str, arguments: Mapping[str, Any]) -> object:
        if name not in VERBS:
            raise Rejected(f"no action {name}")
        VERBS[name].arguments(arguments)
        return {"done": name}


def _check_received(received: bytes, data: bytes) -> None:
    """Check that all messages before the first frame are JSON objects, at most one reply for each line."""
    if b"binary" in data:  # the data may contain frames
        return
    replies = 0
    for line in received.split(b"\n"):
        if line:
            message = json.loads(line)
            assert message["jsonrpc"] == "2.0"
            replies += "method" not in message
    lines = [line for line in data.split(b"\n") if line.strip(BLANK)]
    assert replies <= REPLIES_PER_LINE_MAX * len(lines)


def seeds() -> list[bytes]:
    requests = [{"jsonrpc": "2.0", "id": number, "method": method} for number, method in enumerate(METHODS)]
    arguments = {"rate_hz": 100}
    params: list[tuple[str, dict[str, Any]]] = [
        ("watch", {"devices": ["imu0"], "fields": ["seq", "accel_m_s2"], "rate_hz": 10}),
        ("watch", {"encoding": "binary"}), ("poll", {"devices": ["imu1"], "fields": ["t_ns"]}),
        ("events", {"devices": ["imu0"], "enable": False}), ("notify", {"device": "imu0"}),
        ("actions", {"device": "imu0"}),
        *(("command", {"device": "imu0", "name": name, "arguments": arguments}) for name in VERBS),
    ]  # fmt: skip
    requests += [{"jsonrpc": "2.0", "id": "a", "method": method, "params": given} for method, given in params]
    lines = [json.dumps(request).encode() + b"\n" for request in requests]
    odd = [
        b"{}\n", b"[]\n", b"\n\r\n \n", b"\x0b\n\r", b"[" * 200 + b"\n", b'{"jsonrpc":"2.0","method":"poll"}\n',
        b"x" * 70_000,
    ]  # fmt: skip
    return [*lines, b"".join(lines[:12]), b"".join(lines), *odd]


def words() -> list[bytes]:
    own = ["jsonrpc", "2.0", "id", "method", "params", "devices", "fields", "rate_hz", "encoding", "binary", "json"]
    known = [*own, "enable", "device", "name", "arguments", *METHODS, *DEVICES, *SAMPLE_FIELDS, *VERBS]
    return [json.dumps(word).encode() for word in known]
