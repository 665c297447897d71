"""The blocking client with the real server, and with invalid servers."""

import math
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from unittest.mock import Mock

import pytest
from msgspec.structs import replace

from imud.client.connection import Client, EventStream, decoded, event_of, rpc_error
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceState
from imud.formats.jsonrpc import RpcError, default_path
from imud.formats.recording import is_recording
from imud.model.errors import LinkDenied, LinkError, LinkMissing, ServerError
from imud.model.event import Event, EventKind, PastEvents
from imud.publishers.socket.server import SocketServer
from tests.support.socket_rig import DEVICES, EPOCH, NOW_NS, Daemon, batch, daemon, sample

HELLO = b'{"jsonrpc":"2.0","method":"hello","params":{"protocol":1,"version":"9","epoch":7,"rights":["read"],"x":1}}\n'


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Daemon]:
    with daemon(tmp_path) as running:
        yield running


def publish(served: Daemon, *batches: Batch) -> None:
    def work(server: SocketServer) -> None:
        for each in batches:
            server.publish(each)

    served.do(work)


def test_requests_conventions_and_refused_requests(served: Daemon) -> None:
    with Client(served.path) as client:
        assert (client.hello.protocol, client.hello.epoch) == (1, EPOCH)
        assert "read" in client.hello.rights
        assert [device["name"] for device in client.devices()] == ["imu0", "imu1"]
        assert client.status()["now_ns"] == NOW_NS
        assert client.schema()["slot"]["bytes"] == 320
        assert client.poll() == []
        publish(served, batch("imu0", 4), batch("imu1", 5))
        assert client.poll() == [sample("imu0", 4), sample("imu1", 5)]
        assert client.poll(["imu1"]) == [sample("imu1", 5)]
        (bucket,) = client.history(["imu1"], convention="enu-flu")["imu1"]
        assert (bucket.seq, bucket.accel_m_s2) == (5, ((-0.5, -0.125, 9.75),) * 2)
    # a device with x right, y forward, z up: its y axis points to the front
    with Client(served.path) as client:
        publish(served, batch("imu0", 4))
        (newest,) = client.poll(["imu0"], convention="enu-flu")
        assert newest.accel_m_s2 == (-0.5, -0.125, 9.75)
        watch = client.watch(convention="ned-frd", timeout_s=60)
        publish(served, batch("imu0", 5))
        assert next(watch).accel_m_s2 == (-0.5, 0.125, -9.75)
        with pytest.raises(RpcError):
            client.watch(convention="up")
    with Client(served.path) as client:
        with pytest.raises(RpcError, match="known: imu0, imu1") as caught:
            client.watch(["imu7"])
        assert caught.value.code == -32602
        with pytest.raises(RpcError, match="expected a method that imud knows"):
            client.call("config.get")
        with pytest.raises(TypeError, match="list of names"):
            client.poll("imu0")
        with pytest.raises(ValueError, match="finite number, got nan"):
            client.watch(rate_hz=math.nan)
        with pytest.raises(ValueError, match="finite number, got inf"):
            client.notify("imu0", latency_ms=math.inf)
        assert len(client.devices()) == 2


@pytest.mark.parametrize("encoding", ["json", "binary"])
def test_watch_returns_complete_samples_between_requests(served: Daemon, encoding: str) -> None:
    with Client(served.path) as client:
        watch = client.watch(encoding=encoding, timeout_s=60)
        assert watch.device_ids == DEVICES
        publish(served, batch("imu0", 1, 2), batch("imu1", 123))
        assert len(client.devices()) == 2  # the client keeps samples that arrive before the reply
        publish(served, batch("imu0", 3))
        wanted = [sample("imu0", 1), sample("imu0", 2), sample("imu1", 123), sample("imu0", 3)]
        assert list(islice(watch, 4)) == wanted
        served.do(lambda server: server.add_device("imu9", 9))
        publish(served, batch("imu9"))
        assert next(watch) == sample("imu9")
        assert watch.dropped == {}
        publish(served, batch("imu0", 4))
        client.unwatch()
        publish(served, batch("imu0", 5))
        assert list(watch) == [sample("imu0", 4)]


def test_watch_selects_and_a_second_watch_ends_the_first(served: Daemon) -> None:
    with Client(served.path) as client:
        watch = client.watch(["imu0"], ["accel_m_s2"], 100, "json", timeout_s=60)
        publish(served, batch("imu1"), batch("imu0", 1, 12))
        first, second = islice(watch, 2)
        assert (first.seq, second.seq) == (1, 11)
        assert first == replace(sample("imu0"), gyro_rad_s=None, temperature_c=None, t_dev_ns=None)
        old = client.watch(["imu0"])
        publish(served, batch("imu0"))
        new = client.watch(["imu1"], encoding="json", timeout_s=60)
        publish(served, batch("imu0", 2), batch("imu1"))
        assert next(new) == sample("imu1")
        assert list(old) == []
    with Client(served.path) as client:
        watch = client.watch(encoding="json", timeout_s=60)
        odd = replace(sample(), gyro_rad_s=(math.nan, 1.0, math.inf), temperature_c=math.nan)
        publish(served, Batch("imu0", 0, [odd]))
        got = next(watch)
        assert got.gyro_rad_s is not None
        assert got.temperature_c is not None
        assert [math.isnan(value) for value in (*got.gyro_rad_s, got.temperature_c)] == [True, False, True, True]


@pytest.mark.parametrize("encoding", ["json", "binary"])
def test_dropped_samples_are_reported(served: Daemon, encoding: str) -> None:
    with Client(served.path) as client:
        watch = client.watch(encoding=encoding, timeout_s=60)
        calls: list[tuple[str, int]] = []
        watch.on_dropped = lambda device, count: calls.append((device, count))
        for first in range(1, 8000, 100):
            publish(served, batch("imu0", first, 100), batch("imu1", first, 100))
        seen = {"imu0": 0, "imu1": 0}
        for each in watch:
            seen[each.device] += 1
            if (each.device, each.seq) == ("imu1", 8000):
                break
        for name, count in seen.items():
            assert count + watch.dropped[name] == 8000
        assert dict(calls) == watch.dropped
        assert min(watch.dropped.values()) > 1000


def test_recordings_and_snapshots_are_descriptors(served: Daemon) -> None:
    def take(sock: socket.socket) -> float:
        with sock:
            sock.send(b"a snapshot")
        return 299.5

    served.do(lambda server: server.hub.context.outputs.snapshots.append(take))
    with Client(served.path) as client:
        fd, seconds = client.snapshot()
        assert seconds == 299.5
        with open(fd, "rb") as file:
            assert file.read() == b"a snapshot"
        with open(client.record(["imu0"]), "rb") as file:
            assert client.stop_recording() == 0
            assert is_recording(file.read())


def test_events(served: Daemon) -> None:
    with Client(served.path) as client:
        events = client.events(["imu1"], timeout_s=60)
        down = Event(7, "imu1", EventKind.DOWN, "the adapter was pulled out", {"errno": 5})
        served.do(lambda server: server.event(replace(down, device="imu0")))
        served.do(lambda server: server.event(down))
        assert next(iter(events)) == down
        watch = client.watch(timeout_s=60)
        publish(served, batch("imu0", 5))
        served.do(lambda server: server.event(down))
        assert (next(events), next(watch)) == (down, sample("imu0", 5))  # the sample arrived first
        served.do(lambda server: server.hub.context.past_events.add(down))
        (stored,) = client.past_events(7, ["imu1"]).events
        assert (stored.t_ns, stored.message) == (7, down.message)
        assert client.past_events(8) == PastEvents([], 8)
        short = client.events(timeout_s=0.01)
        with pytest.raises(TimeoutError, match="no event within"):
            next(short)
    assert [rpc_error({"code": 7, "message": "m", "data": data}).data for data in ({"a": 1}, [1])] == [{"a": 1}, None]
    event = event_of({"t_ns": 1, "device": "imu0", "kind": "earthquake", "message": "m", "later": 1})
    assert event.kind == "earthquake"
    with pytest.raises(ServerError, match="cannot decode 'event' of the daemon: "):
        event_of({"t_ns": 1})
    with pytest.raises(ServerError, match=r"'asleep' - .*; if imud was updated, restart the daemon"):
        decoded(["asleep"], list[DeviceState])


def test_notify_gives_a_descriptor_that_wakes(served: Daemon) -> None:
    with Client(served.path) as client:
        watch = client.watch(timeout_s=60)
        publish(served, batch("imu0"))
        fd = client.notify("imu0")
        publish(served, batch("imu0", 2, 3), batch("imu1"), batch("imu0", 5))
        assert len(client.devices()) == 2  # the reply arrives after the wake-ups
        assert os.read(fd, 64)
        with pytest.raises(BlockingIOError):
            os.read(fd, 64)
        another = client.notify("imu0")
        assert os.read(fd, 64) == b""
        publish(served, batch("imu0", 6))
        assert len(client.devices()) == 2
        assert os.read(another, 64)
        assert next(watch).seq == 1
        client._fds.append(fd)  # as after a late reply
        client.devices()
        client._fds.append(another)
    for closed in (fd, another):
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(closed)


def test_path_of_the_environment(served: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMUD_SOCKET", served.path)
    with Client() as client:
        assert client.path == served.path
    with pytest.raises(LinkMissing, match="no daemon at /nowhere"):
        Client("/nowhere")  # the argument has priority over IMUD_SOCKET
    monkeypatch.setenv("IMUD_SOCKET", "")
    assert default_path() == "/run/imud/imud.sock"
    monkeypatch.delenv("IMUD_SOCKET")
    assert default_path() == "/run/imud/imud.sock"


def test_no_daemon_there_and_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "imud.sock"
    with pytest.raises(LinkMissing, match="is imud running"):
        Client(path)
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with pytest.raises(LinkMissing, match="is imud running"):
        Client(path)

    path.unlink()
    with socket.socket(socket.AF_UNIX) as busy, socket.socket(socket.AF_UNIX) as waiting:
        busy.bind(str(path))
        busy.listen(0)
        waiting.connect(str(path))
        with pytest.raises(LinkError, match=r"cannot connect to .*: Resource temporarily unavailable"):
            Client(path, timeout_s=0.01)
    deny = Mock(side_effect=PermissionError(13, "Permission denied"))
    monkeypatch.setattr(socket.socket, "connect", deny)
    with pytest.raises(LinkDenied, match="group imud"):
        Client("/x")


def test_a_daemon_that_ends_raises_link_missing(tmp_path: Path) -> None:
    with daemon(tmp_path) as served:
        client = Client(served.path)
        watch = client.watch()
    with pytest.raises(LinkMissing, match="closed the connection"):
        next(watch)
    client.close()
    client.close()


@contextmanager
def answering(path: Path, answer: bytes) -> Iterator[None]:
    done = threading.Event()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            sock, _ = listener.accept()
            with sock:
                sock.sendall(answer)
                done.wait(60)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


@pytest.mark.parametrize(
    ("answer", "error", "words"),
    [
        (b'{"jsonrpc":"2.0","id":null,"error":{"code":-32001,"message":"uid 5 may not"}}\n', LinkDenied, "uid 5 may"),
        (b"SSH-2.0\n", ServerError, "expected a JSON object"),
        (b"{}\n", ServerError, "expected the daemon's hello"),
        (HELLO.replace(b'"protocol":1', b'"protocol":2'), ServerError, "expected protocol 1, got 2"),
        (HELLO.replace(b'"epoch":7', b'"epoch":"x"'), ServerError, "cannot decode the greeting"),
        (b"", TimeoutError, "no hello within"),
        (HELLO + b'{"id":1,"result":{"devices":{}}}\n\xff\xff\xff\xff', ServerError, "expected a frame of at most"),
        (HELLO + b'{"id":1,"result":{"devices":{"a":0}}}\n\x40\x01\x00\x00' + bytes(320), ServerError, "CRC"),
        (HELLO + b'{"id":1,"result":{"devices":{}}}\n\x40\1\0\0' + bytes(320), ServerError, "known device .*, got 0"),
    ],
)  # fmt: skip
def test_invalid_servers_raise_errors(tmp_path: Path, answer: bytes, error: type[Exception], words: str) -> None:
    path = tmp_path / "s"
    limit_s = 0.2 if error is TimeoutError else 60
    with answering(path, answer), pytest.raises(error, match=words), Client(path, timeout_s=limit_s) as client:
        next(client.watch(timeout_s=limit_s))


@pytest.mark.parametrize("method", ["watch", "poll", "history"])
def test_a_daemon_without_conventions_raises_an_error(tmp_path: Path, method: str) -> None:
    """An older daemon ignores the parameter and sends the axes of the device."""
    path = tmp_path / "s"
    answer, error = HELLO + b'{"id":1,"result":{"devices":{},"samples":[]}}\n', "does not know the convention ned-frd"
    with answering(path, answer), Client(path) as client, pytest.raises(ServerError, match=error):
        getattr(client, method)([], convention="ned-frd")


WATCHING = HELLO + b'{"id":1,"result":{"devices":{}}}\n'


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (HELLO + b'{"method":5}\n', "expected a string as method"),
        (HELLO + b'{"id":1,"error":5}\n', "cannot decode the error 5"),
        (
            HELLO + b'{"id":1,"result":{"devices":5}}\n',
            "cannot decode 'watch' of the daemon: ",
        ),
        (WATCHING + b'{"method":"sample","params":5}\n', "cannot decode the notification 'sample': expected an object"),
        (WATCHING + b'{"method":"sample","params":{"seq":"x"}}\n', "cannot decode a sample: .*seq"),
        (WATCHING + b'{"method":"dropped","params":{"device":"a","dropped":"x"}}\n', "dropped"),
    ],
)
def test_invalid_json_raises_errors(tmp_path: Path, answer: bytes, words: str) -> None:
    with answering(tmp_path / "s", answer), Client(tmp_path / "s", timeout_s=60) as client:
        with pytest.raises((ServerError, RpcError), match=words):
            next(client.watch(encoding="json", timeout_s=60))
        assert client.fileno() >= 0


@pytest.mark.parametrize("surplus", [0, 1])
def test_waiting_messages_are_limited(tmp_path: Path, surplus: int) -> None:
    event = b'{"method":"event","params":{"t_ns":%d,"device":"bow","kind":"loss","message":""}}\n'
    events = b"".join(event % number for number in range(65_536 + surplus))
    with answering(tmp_path / "s", HELLO + events + b'{"id":1,"result":5}\n'), Client(tmp_path / "s") as client:
        assert client.call("anything") == 5
        assert client.discarded == surplus
        assert next(EventStream(client, 60)).t_ns == surplus  # the oldest message was discarded


def test_a_reply_without_its_descriptor_is_an_error(tmp_path: Path) -> None:
    reply = b'{"id":1,"result":{"seconds":1.0}}\n'
    missing = pytest.raises(ServerError, match=r"expected a descriptor in the reply to record\.snapshot, got a reply")
    with answering(tmp_path / "s", HELLO + reply), Client(tmp_path / "s", timeout_s=60) as client, missing:
        client.snapshot()


def test_a_late_reply_to_watch_leaves_a_usable_connection(tmp_path: Path) -> None:
    path, peers = tmp_path / "s", list[socket.socket]()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def greet() -> None:
            peers.append(listener.accept()[0])
            peers[0].sendall(HELLO)

        thread = threading.Thread(target=greet)
        thread.start()
        client = Client(path)
        thread.join()
    with peers[0] as peer, client:
        client.timeout_s = 0.0
        with pytest.raises(TimeoutError, match="no watch within"):
            client.watch()
        client.timeout_s = 3600.0  # the last request has a limit of its own
        status = b'{"id":2,"result":{"now_ns":5}}'
        late = b'{"id":1,"result":{"devices":{"a":0}}}\n'
        peer.sendall(late + len(status).to_bytes(4, "little") + status)
        assert client.status() == {"now_ns": 5}
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
        client.timeout_s = 0.001
        with pytest.raises(TimeoutError, match="the connection is closed"):
            client.call("status", filler="x" * 1_000_000)
        with pytest.raises(LinkMissing):
            client.status()
