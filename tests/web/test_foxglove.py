"""The relay between a daemon and a viewer: offered topics, messages, requests, and the gate in front."""

import asyncio
import gc
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Any, NamedTuple
from unittest.mock import AsyncMock, Mock, call, patch

import msgspec
import pytest

from imud.bridges.channel import Dialect, MessageChannel
from imud.bridges.json import JsonDialect
from imud.bridges.ros2 import Ros2Dialect
from imud.contracts.publisher import Batch
from imud.contracts.status import Deviations
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.publishers.socket.server import SocketServer
from imud.web.foxglove import VIEWER_BYTES, VIEWER_PAUSE_S, Relay, ViewerGate, ViewerOrigins, _forward
from tests.support import socket_rig
from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.socket_rig import NOW_NS, batch, daemon

CONNECTIONS_MAX, HEAD_BYTES_MAX, WAITING_MAX = 32, 16_384, 64
pytestmark = pytest.mark.live
OFFSET_NS = 1_000_000_000_000


class Said(NamedTuple):
    topic: str
    message: dict[str, Any]
    utc_ns: int


class FakeViewer:
    def __init__(self) -> None:
        self.is_subscribed = True
        self.said: Queue[Said] = Queue()

    def open(self, channel: MessageChannel[Any]) -> None:
        self.said.put(Said(f"open {channel.topic}", {}, 0))

    def close_topic(self, topic: str) -> None:
        self.said.put(Said(f"close {topic}", {}, 0))

    def send(self, channel: MessageChannel[Any], item: object, utc_ns: int) -> None:
        data = channel.encode(item)
        if data is not None:
            message = msgspec.json.decode(data) if channel.message_encoding == "json" else {"data": data}
            self.said.put(Said(channel.topic, message, utc_ns))

    def problem(self, text: str) -> None:
        self.said.put(Said("problem", {"text": text}, 0))

    def wait_for(self, topic: str, is_it: Callable[[Said], object] = lambda _said: True) -> Said:
        while not ((said := self.said.get(timeout=LIMIT_S)).topic == topic and is_it(said)):
            pass
        return said


@contextmanager
def relaying(path: str | Path, viewer: FakeViewer, dialect: Dialect | None = None, **options: Any) -> Iterator[Relay]:
    relay = Relay(str(path), viewer, dialect or JsonDialect(), **options)
    thread = Thread(target=relay.run)
    with patch("imud.web.foxglove.utc_offset_ns", lambda _ahead_ns: OFFSET_NS):
        thread.start()
        try:
            yield relay
        finally:
            relay.stop()
            thread.join(LIMIT_S)
            assert not thread.is_alive()


def test_samples_events_and_status_come(tmp_path: Path) -> None:
    viewer = FakeViewer()
    noise = {"imu0": Deviations(gyro_rad_s=0.5)}
    with daemon(tmp_path) as served, relaying(served.path, viewer, noise=noise):
        status = viewer.wait_for("/imu0/status")
        assert (status.message["state"], status.message["rate_hz"]) == ("running", 1000.0)
        viewer.wait_for("/imu1/status")
        served.do(lambda server: server.publish(batch("imu0", 7)))
        imu = viewer.wait_for("/imu0/imu/data")
        # sensor: x right, y forward; body: x forward, y left
        assert imu.message["linear_acceleration"] == {"x": -0.5, "y": -0.125, "z": 9.75}
        assert imu.message["angular_velocity"] == {"x": 0.5, "y": -0.25, "z": -0.75}
        assert imu.message["angular_velocity_covariance"] == [0.25, 0, 0, 0, 0.25, 0, 0, 0, 0.25]
        assert imu.message["linear_acceleration_covariance"] == [1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-4]  # from the status
        assert imu.utc_ns == 1_790_000_000_007_000_000
        stamp = viewer.wait_for("/imu0/stamp")
        assert (stamp.message["seq"], stamp.message["t_err_ns"]) == (7, 12_000)
        served.do(lambda server: server.event(Event(5, "imu1", EventKind.DOWN, "is gone")))
        event = viewer.wait_for("/events")
        assert (event.message["name"], event.message["message"]) == ("imu1", "down: is gone")
        assert (event.message["level"], event.utc_ns) == (3, 5 + OFFSET_NS)


def test_without_a_subscription_events_arrive_and_samples_are_not_requested(tmp_path: Path) -> None:
    viewer = FakeViewer()
    viewer.is_subscribed = False
    with daemon(tmp_path) as served, relaying(served.path, viewer):
        viewer.wait_for("/imu1/status")
        served.do(lambda server: server.publish(batch("imu0", 1)))
        served.do(lambda server: server.event(Event(5, "imu1", EventKind.UP, "is there")))
        missing = {"/events", "open /imu0/imu/data"}  # opened with the newest sample, before or after the event
        while missing:
            missing.discard(viewer.said.get(timeout=LIMIT_S).topic)
        assert not served.do(lambda server: any(client.encoding for client in server.hub.clients()))
        viewer.is_subscribed = True
        while not served.do(lambda server: any(client.encoding for client in server.hub.clients())):
            viewer.said.get(timeout=LIMIT_S)  # the relay subscribes with one of the next status messages
        served.do(lambda server: server.publish(batch("imu0", 2)))
        viewer.wait_for("/imu0/stamp", lambda said: said.message["seq"] == 2)


def test_only_the_wanted_device_is_shown(tmp_path: Path) -> None:
    viewer = FakeViewer()
    with daemon(tmp_path) as served, relaying(served.path, viewer, devices=["imu1"]):
        first = viewer.said.get(timeout=LIMIT_S)
        while first.topic != "/imu1/status":
            assert not first.topic.startswith("/imu0")
            first = viewer.said.get(timeout=LIMIT_S)
        served.do(lambda server: server.publish(batch("imu0", 1)))
        served.do(lambda server: server.publish(batch("imu1", 2)))
        while (said := viewer.said.get(timeout=LIMIT_S)).topic != "/imu1/stamp":
            assert not said.topic.startswith("/imu0")


def test_the_relay_continues_after_a_restart_of_the_daemon(tmp_path: Path) -> None:
    viewer = FakeViewer()
    with daemon(tmp_path) as served:
        path = served.path
        relay = relaying(path, viewer)
        relay.__enter__()
        viewer.wait_for("/imu0/status")
    try:
        assert str(path) in viewer.wait_for("problem", lambda said: said.message["text"]).message["text"]
        with daemon(tmp_path) as served:
            viewer.wait_for("problem", lambda said: not said.message["text"])
            viewer.wait_for("/imu1/status")
            served.do(lambda server: server.publish(batch("imu0", 9)))
            viewer.wait_for("/imu0/stamp", lambda said: said.message["seq"] == 9)
    finally:
        relay.__exit__(None, None, None)


def levels(said: Said) -> dict[str, int]:
    return {one["name"]: one["level"] for one in said.message["status"]}


def test_diagnostics_come_and_are_stale_without_the_daemon(tmp_path: Path) -> None:
    viewer = FakeViewer()
    with relaying(tmp_path / "imud.sock", viewer):
        with daemon(tmp_path):
            said = viewer.wait_for("/diagnostics")
            assert (levels(said), said.utc_ns) == ({"imud: imu0": 0, "imud: imu1": 0}, NOW_NS + OFFSET_NS)
        stale = viewer.wait_for("/diagnostics", lambda said: 0 not in levels(said).values())
        assert levels(stale) == {"imud: imu0": 3, "imud: imu1": 3}
        assert str(tmp_path) in stale.message["status"][0]["message"]
        with daemon(tmp_path):
            viewer.wait_for("/diagnostics", lambda said: set(levels(said).values()) == {0})


def test_the_topic_of_transforms_stays_for_another_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = FakeViewer()

    def until(topic: str) -> list[str]:
        topics: list[str] = []
        while topic not in topics:
            topics.append(viewer.said.get(timeout=LIMIT_S).topic)
        return topics

    def publish(server: SocketServer, name: str) -> None:
        (plain,) = batch(name).samples
        turned = msgspec.structs.replace(plain, quat_wxyz=(1.0, 0.0, 0.0, 0.0))
        server.publish(Batch(name, socket_rig.DEVICES[name], [turned]))

    with relaying(tmp_path / "imud.sock", viewer, Ros2Dialect()):
        with daemon(tmp_path) as served:
            until("/imu1/status")
            for name in socket_rig.DEVICES:
                served.do(lambda server, name=name: publish(server, name))  # type: ignore[misc]
                until("open /tf" if name == "imu0" else "open /imu1/imu/data")
        monkeypatch.setattr(socket_rig, "DEVICES", {"imu1": 1})
        with daemon(tmp_path):
            topics = until("/imu1/status")
            assert "close /imu0/imu/data" in topics
            assert "close /tf" not in topics
        monkeypatch.setattr(socket_rig, "DEVICES", {"imu2": 2})
        with daemon(tmp_path):
            assert "close /tf" in until("/imu2/status")


class Echo:
    def __init__(self) -> None:
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.ended = 0
        self._thread = Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self.socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(LIMIT_S)
        self.socket.close()

    def _run(self) -> None:
        threads = []
        while True:
            try:
                connection, _ = self.socket.accept()
            except OSError:
                break
            threads.append(Thread(target=self._repeat, args=(connection,)))
            threads[-1].start()
        for thread in threads:
            thread.join(LIMIT_S)

    def _repeat(self, connection: socket.socket) -> None:
        with connection:
            while data := connection.recv(65536):
                if b"close" in data:
                    break
                connection.sendall(data)
        self.ended += 1


@contextmanager
def gated(echo: Echo, notes: list[str] | None = None) -> Iterator[ViewerGate]:
    note = (notes if notes is not None else []).append
    gate = ViewerGate("127.0.0.1", 0, echo.socket.getsockname(), ViewerOrigins(), note=note)
    with closing(gate):
        yield gate


@pytest.fixture
def echo() -> Iterator[Echo]:
    with closing(Echo()) as one:
        yield one


def head(*lines: str, request: str = "GET / HTTP/1.1", upgrade: str = "Upgrade: websocket") -> bytes:
    return "\r\n".join([request, "Host: 127.0.0.1:8765", upgrade, *lines, "", ""]).encode()


def connect(gate: ViewerGate) -> socket.socket:
    return socket.create_connection(("127.0.0.1", gate.port), LIMIT_S)


def received(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := connection.recv(65536)):
        data += more
    return data


def answer(gate: ViewerGate, request: bytes, size: int = 1 << 30) -> str:
    with connect(gate) as connection:
        connection.sendall(request)
        return received(connection, size).decode()


def test_a_viewer_comes_through_with_every_byte_in_both_directions(echo: Echo) -> None:
    request = head("Origin: https://app.foxglove.dev", "Cookie: x=\xe4")
    more = bytes(range(256)) * 4096
    with gated(echo) as gate, connect(gate) as connection:
        connection.sendall(request[:10])
        connection.sendall(request[10:] + more[:100])
        sender = Thread(target=connection.sendall, args=(more[100:],))
        sender.start()
        assert received(connection, len(request) + len(more)) == request + more
        sender.join(LIMIT_S)
        connection.sendall(b"close")
        assert connection.recv(1) == b"", "the end of the server is that of the viewer"
    assert echo.ended == 1


def test_flood_of_viewer_is_slowed() -> None:
    """The gate reads at most VIEWER_BYTES in each pause, so that a flood of subscriptions waits in the kernel."""

    async def count() -> tuple[int, int]:
        reader, writer = asyncio.StreamReader(), Mock(spec=asyncio.StreamWriter)
        reader.feed_data(bytes(1_000_000))
        reader.feed_eof()
        sizes: list[int] = []
        writer.write = lambda data: sizes.append(len(data))
        with patch("asyncio.sleep", AsyncMock()) as pauses:
            await _forward(reader, writer, VIEWER_BYTES, VIEWER_PAUSE_S)
        assert pauses.await_args_list == [call(VIEWER_PAUSE_S)] * len(sizes)
        return len(sizes), max(sizes)

    assert asyncio.run(count()) == (-(-1_000_000 // VIEWER_BYTES), VIEWER_BYTES)


def test_other_sites_and_programs_are_refused(echo: Echo) -> None:
    notes: list[str] = []
    with gated(echo, notes) as gate:
        for _ in range(2):
            refused = answer(gate, head("Origin: https://attacker.example"))
            assert refused.startswith("HTTP/1.1 403 Forbidden\r\n")
            assert "allow them with --allow-origin https://attacker.example" in refused
    assert len(notes) == 1
    assert notes[0].startswith("refused a connection: pages of 'https://attacker.example' may not read")
    assert echo.ended == 0
    for request_, status in (
        (head("Origin: file://", "Origin: https://attacker.example"), 400), (head("Host: 127.0.0.1"), 400),
        (head("no colon", "Origin: https://attacker.example"), 400), (head(request="GET / HTTP/1.0"), 400),
        (head(*["A: b"] * 200), 400), (b"\x16\x03\x01\r\n\r\n", 400), (head(upgrade="Upgrade: h2c"), 426),
        (b"GET / HTTP/1.1\r\nHost: attacker.example\r\nUpgrade: websocket\r\n\r\n", 403),
    ):  # fmt: skip
        with gated(echo) as gate:
            assert answer(gate, request_).startswith(f"HTTP/1.1 {status} ")
        assert echo.ended == 0


def test_an_endless_and_a_missing_request_head(echo: Echo, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.web.foxglove.HEAD_S", 0.05)
    with gated(echo) as gate:
        with connect(gate) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\n" + b"A" * HEAD_BYTES_MAX)
            assert is_closed(connection)
        with connect(gate) as connection:
            assert is_closed(connection), "after the time for the request"


def is_closed(connection: socket.socket) -> bool:
    try:
        return connection.recv(100) == b""
    except ConnectionResetError:
        return True


def test_the_number_of_viewers_is_limited(echo: Echo) -> None:
    with gated(echo) as gate:
        viewers = [connect(gate) for _ in range(CONNECTIONS_MAX)]
        for viewer in viewers:
            viewer.sendall(head())
            assert received(viewer, len(head())) == head()
        assert answer(gate, head()).startswith("HTTP/1.1 503 ")
        viewers.pop().close()
        wait_until(lambda: not answer(gate, head(), 12).startswith("HTTP/1.1 503"), "there is room again")
        for viewer in viewers:
            viewer.close()


def test_connections_without_a_head_are_limited_and_occupy_no_place_of_a_viewer(echo: Echo) -> None:
    with gated(echo) as gate, ExitStack() as opened:
        silent = [opened.enter_context(connect(gate)) for _ in range(WAITING_MAX + 1)]
        assert is_closed(silent[0])
        viewer = opened.enter_context(connect(gate))
        viewer.sendall(head())
        assert received(viewer, len(head())) == head()
        assert is_closed(silent[1])
        silent[-1].sendall(head())
        assert received(silent[-1], len(head())) == head()


def test_the_gate_ends_beside_its_viewers_and_leaves_nothing_open(echo: Echo) -> None:
    """An open connection is visible in two ways: its server thread continues, and asyncio warns at its destruction."""
    rounds, viewers_at_a_time = 3, 10
    for _ in range(rounds):
        with gated(echo) as gate:
            viewers = [connect(gate) for _ in range(viewers_at_a_time)]
            for viewer in viewers:
                viewer.sendall(head())
                assert received(viewer, len(head())) == head()
            for viewer in viewers:
                viewer.close()
    gc.collect()
    wait_until(lambda: echo.ended == rounds * viewers_at_a_time, "every connection behind ends")


def test_close_and_the_end_of_the_server_end_the_connections(echo: Echo) -> None:
    with gated(echo) as gate, connect(gate) as connection:
        connection.sendall(head())
        assert received(connection, len(head())) == head()
        gate.close()
        assert connection.recv(1) == b""
    with socket.create_server(("127.0.0.1", 0)) as unused:
        nothing = unused.getsockname()
    with closing(ViewerGate("127.0.0.1", 0, nothing, ViewerOrigins(), note=print)) as gate:
        assert answer(gate, head()) == ""
    port = echo.socket.getsockname()[1]
    with pytest.raises(ServerError, match=f"cannot listen on 127.0.0.1 port {port}: .*another `imud foxglove`"):
        ViewerGate("127.0.0.1", port, ("127.0.0.1", 1), ViewerOrigins(), note=print)
    with pytest.raises(ServerError, match=r"cannot listen on host\.invalid port 0"):
        ViewerGate("host.invalid", 0, ("127.0.0.1", 1), ViewerOrigins(), note=print)
