"""Data from a daemon, or from another program, to a client: replies, notifications, frames, or any other bytes."""

import asyncio
import atexit
import socket
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from itertools import islice
from pathlib import Path
from threading import Thread
from typing import Final

from imud.client.connection import Client
from imud.formats.jsonrpc import PROTOCOL, encode_notification, encode_result, frame_of, line_of
from imud.formats.slot import encode_slots
from imud.model.errors import ImudError
from imud.model.event import Event
from imud.model.sample import Sample, Sync
from imud.web.server import Calls
from tests.fuzz.target import Target

ITEMS: Final = 8
WAIT_S: Final = 60.0
"""Maximum wait of the client, s. The server ends the connection after the input, so that no wait takes this time."""
HELLO: Final = line_of(
    encode_notification("hello", {"protocol": PROTOCOL, "version": "0", "epoch": 1, "rights": ["read"]})
)


def _events(client: Client) -> None:
    for event in islice(client.events(), ITEMS):
        assert isinstance(event, Event)


def _samples(client: Client, encoding: str) -> None:
    for sample in islice(client.watch(encoding=encoding), ITEMS):
        assert isinstance(sample, Sample)


def _questions(client: Client) -> None:
    assert all(isinstance(device, dict) for device in client.devices())
    assert isinstance(client.status(), dict)
    assert all(isinstance(sample, Sample) for sample in client.poll())


def _descriptors(client: Client) -> None:
    client.stop_recording()
    client.snapshot()


USES: Final[Sequence[Callable[[Client], None]]] = (
    _questions, _events, lambda client: _samples(client, "json"), lambda client: _samples(client, "binary"),
    _descriptors,
)  # fmt: skip
CALLS: Final = len(USES)


def names() -> Sequence[str]:
    return ["answers"]


def make(_name: str) -> Target:
    return Target(run, seeds, words=words)


class _Daemon:
    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="imud-fuzz-")
        self.path = str(Path(self._folder.name) / "s")
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(self.path)
        self._listener.listen()
        self._listener.settimeout(WAIT_S)
        self.loop = asyncio.new_event_loop()
        atexit.register(self._close)

    @contextmanager
    def sending(self, data: bytes) -> Iterator[None]:
        thread = Thread(target=self._serve, args=(data,), name="daemon")
        thread.start()
        try:
            yield
        finally:
            thread.join(WAIT_S)

    def _serve(self, data: bytes) -> None:
        with suppress(OSError), self._listener.accept()[0] as peer:
            peer.settimeout(WAIT_S)
            peer.sendall(data)
            peer.shutdown(socket.SHUT_WR)
            while peer.recv(4096):
                pass

    def _close(self) -> None:
        self._listener.close()
        self.loop.close()
        self._folder.cleanup()


@cache
def _daemon() -> _Daemon:
    return _Daemon()


def run(data: bytes) -> None:
    """The first byte selects the client's request and whether the hello is valid. The other bytes are the data."""
    head, rest = data[0] if data else 0, data[1:]
    daemon = _daemon()
    use = head % (CALLS + 1)
    with daemon.sending((HELLO if head < 0x80 else b"") + rest), suppress(ImudError):
        if use == CALLS:
            daemon.loop.run_until_complete(Calls(daemon.path).call("actions", {"device": "bow"}))
        else:
            with Client(daemon.path, timeout_s=WAIT_S) as client:
                USES[use](client)


def seeds() -> list[bytes]:
    samples = [Sample("bow", n, 1000 * n, 5, Sync.EDGE, 1000 * n, 9, accel_m_s2=(0.1, 0.2, 9.8)) for n in (1, 2)]
    slots = b"".join(encode_slots(samples, 0))
    watched = line_of(encode_result(1, {"devices": {"bow": 0}}))
    sample = {"device": "bow", "seq": 1, "t_ns": 5, "t_err_ns": 1, "sync": "edge", "t_rx_ns": 9, "utc_ns": 7}
    event = {"t_ns": 1, "device": "bow", "kind": "up", "message": "up"}
    notes = [("sample", {**sample, "dropped": 3}), ("device", {"device": "b", "device_id": 1}), ("event", event)]
    lines = b"".join(line_of(encode_notification(*note)) for note in notes)
    frame = len(slots).to_bytes(4, "little") + slots
    answers = b"".join(line_of(encode_result(n, one)) for n, one in enumerate(([{}], {}, {"samples": [sample]}), 1))
    made = [(0, answers), (1, line_of(encode_result(1, {})) + lines), (2, watched + lines)]
    made += [(3, watched + frame + frame_of(encode_notification("sample", sample)) + frame[:90])]
    made += [(3, watched + b"\xff\xff\xff\x7f"), (4, line_of(encode_result(1, {"records_dropped": 2}))), (5, answers)]
    made += [(0x80, HELLO), (0x85, HELLO + answers), (0x80, b"[" * 4000), (0x80, b"\xff\n"), (0x81, b"{}\n")]
    wrong: list[object] = [None, 5, [], {}, "x"]
    for use in range(CALLS + 1):
        made += [(use, line_of(encode_result(1, one))) for one in wrong]
        made += [(use, b'{"id":null,"error":%s}\n' % one) for one in (b"5", b'{"code":"x","message":3}')]
    odd: list[object] = [{}, {"device": 5, "device_id": []}, [], {**event, "kind": []}, {**sample, "dropped": "x"}]
    for name in ("sample", "device", "event", "dropped"):
        made += [(use, watched + line_of(encode_notification(name, one))) for use in (1, 2) for one in odd]
    made += [(0x80, line_of(encode_notification("hello", one))) for one in odd]
    made += [(0x85, line_of(encode_notification("hello", one))) for one in odd]
    return [bytes([head]) + rest for head, rest in made]


def words() -> list[bytes]:
    own = ["jsonrpc", "2.0", "id", "method", "params", "result", "error", "code", "message", "devices", "samples"]
    own += ["sample", "device", "device_id", "dropped", "event", "hello", "seconds", "records_dropped", "kind"]
    return [f'"{word}"'.encode() for word in own]
