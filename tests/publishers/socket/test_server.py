"""Socket server end to end: greeting, requests, samples in both encodings, events, limits."""

import asyncio
import errno
import itertools
import os
import random
import socket
import struct
import subprocess
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from unittest.mock import Mock

import pytest

from imud import __version__
from imud.formats.slot import SLOT_BYTES, decode_slot
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.model.sample import SAMPLE_FIELDS
from imud.publishers.socket.server import Listener, SocketOptions, SocketServer, _is_leftover
from tests.support import socket_rig
from tests.support.socket_rig import Peer, alone, batch, in_server, sample, serving, until

CHECK_NS, PATH_MAX_BYTES, SOCKET_MODE = 950_000_000, 99, 0o660
FORMS_PER_USER = 16


@in_server()
async def test_hello_devices_status_and_schema(server: SocketServer) -> None:
    rights = ["read", "control"] if os.getuid() == 0 else ["read"]
    params = {"protocol": 1, "version": __version__, "epoch": socket_rig.EPOCH, "rights": rights}
    peer = await Peer.connect(server)
    assert await peer.message() == {"jsonrpc": "2.0", "method": "hello", "params": params}
    devices = await peer.result("devices")
    assert [(d["name"], d["device_id"], d["state"], d["sync"]) for d in devices] == [
        ("imu0", 0, "running", "regression"),
        ("imu1", 1, "running", "regression"),
    ]
    status = await peer.result("status")
    assert (status["now_ns"], status["devices"][1]["ledger"]) == (socket_rig.NOW_NS, {"bytes_in": 82})
    (client,) = status["socket"]["clients"]
    assert (client["pid"], client["uid"], client["sent"]) == (os.getpid(), os.getuid(), 0)
    schema = await peer.result("schema")
    assert tuple(field["name"] for field in schema["fields"]) == SAMPLE_FIELDS
    assert (schema["devices"]["imu0"]["navigation_frame"], schema["slot"]["bytes"]) == ("ENU", SLOT_BYTES)


@in_server()
async def test_json_samples_have_the_names_of_the_design_and_only_the_selected_members(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    assert await peer.result("watch") == {
        "encoding": "json", "devices": socket_rig.DEVICES, "rate_hz": 0.0, "latency_ms": 0.0,
    }  # fmt: skip
    server.publish(batch("imu0", 7, 2))
    server.publish(batch("imu1", 1))
    first, second, other = await peer.messages(3)
    assert first["method"] == "sample"
    assert first["params"] == {
        "device": "imu0", "seq": 7, "t_ns": 80_000_007_000_000, "t_err_ns": 12_000, "sync": "regression",
        "t_rx_ns": 80_000_007_200_000, "utc_ns": 1_790_000_000_007_000_000, "t_dev_ns": 7_000_000,
        "accel_m_s2": [0.125, -0.5, 9.75], "gyro_rad_s": [0.25, 0.5, -0.75], "temperature_c": 31.5,
    }  # fmt: skip
    assert (second["params"]["seq"], other["params"]["device"]) == (8, "imu1")
    reply = await peer.result("watch", devices=["imu1"], fields=["gyro_rad_s", "mag_t"])
    assert reply["devices"] == {"imu1": 1}
    server.publish(batch("imu0"))
    server.publish(batch("imu1"))
    params = (await peer.message())["params"]
    assert params == {"device": "imu1", "seq": 1, "t_ns": 80_000_001_000_000, "gyro_rad_s": [0.25, 0.5, -0.75]}
    await peer.result("unwatch")
    server.publish(batch("imu1", 2))
    await peer.send(b'{"jsonrpc":"2.0","id":"last","method":"poll"}\n')
    assert (await peer.message())["id"] == "last"


@pytest.mark.parametrize("seq", [1, 0x7B])  # 0x7B is `{`: the slot begins like JSON
@in_server()
async def test_binary_frames_hold_one_slot_each(server: SocketServer, seq: int) -> None:
    peer = await Peer.greeted(server)
    assert (await peer.result("watch", encoding="binary"))["devices"] == socket_rig.DEVICES
    peer.framed = True
    server.publish(batch("imu1", seq, 2))
    for number in (seq, seq + 1):
        slot = await peer.body()
        assert len(slot) == SLOT_BYTES
        assert decode_slot(slot, "imu1") == sample("imu1", number)


@in_server()
async def test_after_a_binary_watch_everything_is_framed_for_good(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    await peer.result("watch", encoding="binary")
    peer.framed = True
    assert len(await peer.result("devices")) == 2
    await peer.result("watch", encoding="json", fields=["sync"])
    server.publish(batch())
    assert ((await peer.message())["params"]["sync"], (await peer.error("nonsense"))[0]) == ("regression", -32601)
    lines, frames = await Peer.greeted(server), await Peer.greeted(server)
    await frames.result("watch", encoding="binary")
    frames.framed = True
    for peer in (frames, lines):
        await peer.result("watch")
    server.publish(batch("imu0", 1, 2))
    for seq in (1, 2):
        assert ((await lines.message())["params"]["seq"], (await frames.message())["params"]["seq"]) == (seq, seq)


def test_framed_json_is_never_as_long_as_slots() -> None:
    from imud.formats.jsonrpc import frame_of

    for size in range(2, 1100):
        frame = frame_of(b"{" + b" " * (size - 2) + b"}")
        (length,) = struct.unpack_from("<I", frame)
        assert length == len(frame) - 4
        assert length % SLOT_BYTES


@in_server()
async def test_a_device_that_appears_later_matches_a_watch_of_all(server: SocketServer) -> None:
    all_of_them, one = await Peer.greeted(server), await Peer.greeted(server)
    await all_of_them.result("watch")
    await one.result("watch", devices=["imu0"])
    server.add_device("imu9", 9)
    server.publish(batch("imu9"))
    server.publish(batch("imu0"))
    told, first = await all_of_them.messages(2)
    assert (told["method"], told["params"]) == ("device", {"device": "imu9", "device_id": 9})
    assert first["params"]["device"] == "imu9"
    assert (await one.message())["params"]["device"] == "imu0"


@in_server()
async def test_poll_gives_the_newest_of_each_device(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    assert await peer.result("poll") == {"now_ns": socket_rig.NOW_NS, "samples": []}
    server.publish(batch("imu0", 1, 3))
    server.publish(batch("imu1", 5))
    assert [s["seq"] for s in (await peer.result("poll"))["samples"]] == [3, 5]
    chosen = await peer.result("poll", devices=["imu1"], fields=["t_ns", "sync"])
    assert chosen["samples"] == [{"device": "imu1", "seq": 5, "t_ns": 80_000_005_000_000, "sync": "regression"}]
    server.remove_device("imu0")
    server.add_device("imu0", 0)  # the old sample is not returned
    assert [s["seq"] for s in (await peer.result("poll"))["samples"]] == [5]


@in_server()
async def test_events_go_to_the_clients_that_requested_them(server: SocketServer) -> None:
    everything, one, none = [await Peer.greeted(server) for _ in range(3)]
    await everything.result("events")
    await one.result("events", devices=["imu1"])
    await none.result("devices")
    for name in ("imu0", "imu1", ""):
        server.event(Event(5, name, EventKind.DOWN, "gone", {"errno": 5}))
    seen = [(await everything.message())["params"] for _ in range(3)]
    assert [event["device"] for event in seen] == ["imu0", "imu1", ""]
    assert seen[0] == {"t_ns": 5, "device": "imu0", "kind": "down", "message": "gone", "detail": {"errno": 5}}
    assert [(await one.message())["params"]["device"] for _ in range(2)] == ["imu1", ""]
    await everything.result("events", enable=False)
    server.event(Event(6, "imu0", EventKind.UP, "back"))
    assert (len(await everything.result("devices")), len(await none.result("devices"))) == (2, 2)


@in_server()
async def test_one_set_of_fields_has_one_form_in_any_order(server: SocketServer) -> None:
    fields = ["sync", "mag_t", "gyro_rad_s", "t_err_ns", "accel_m_s2"]
    peers = []
    for number in range(2 * FORMS_PER_USER):  # a user may have 16 forms
        peers.append(await Peer.greeted(server))
        random.Random(number).shuffle(fields)
        await peers[-1].result("watch", fields=fields)
    server.publish(batch())
    assert len({await peer.body() for peer in peers}) == 1


@in_server()
async def test_a_user_s_clients_watch_a_limited_number_of_selections(server: SocketServer) -> None:
    peers = [await Peer.greeted(server) for _ in range(FORMS_PER_USER + 1)]
    names = ["sync", "gyro_rad_s", "accel_m_s2", "t_err_ns", "utc_ns", "mag_t", "t_rx_ns"]
    choices = list(itertools.combinations(names, 2))
    for peer, fields in zip(peers[:-1], choices[:FORMS_PER_USER], strict=True):
        await peer.result("watch", fields=fields)
    assert (await peers[-1].error("watch", fields=choices[FORMS_PER_USER]))[0] == -32004
    await peers[0].result("watch", fields=choices[FORMS_PER_USER])  # replaces its own form
    await peers[-1].result("watch", fields=choices[1])  # an existing form


@alone()
async def test_to_many_clients_samples_go_in_several_turns_and_none_is_lost(tmp_path: Path) -> None:
    clock = socket_rig.SteppingClock()
    async with serving(tmp_path, clock) as server:
        peers = [await Peer.greeted(server) for _ in range(100)]
        for number, peer in enumerate(peers):
            await peer.result("watch", **({"rate_hz": 1000.0} if number % 3 else {}))
        clock.step_ns = 400_000  # each read of the clock adds 0.4 ms
        for seq in range(1, 6):
            server.publish(batch("imu0", seq))
            waiting = sum(client.queue_samples > 0 for client in server.hub.clients())
        clock.step_ns = 0
        assert waiting == 34  # `publish` ends after 1 ms; it reads the clock after 32 clients
        for peer in peers:
            assert [message["params"]["seq"] for message in await peer.messages(5)] == list(range(1, 6))
        assert all(client.dropped == 0 for client in server.hub.clients())


@pytest.mark.parametrize("selection", ["one", "many"])
@in_server(memory_mb=8)
async def test_the_queues_of_all_clients_together_are_bounded(server: SocketServer, selection: str) -> None:
    fields = ["sync", "gyro_rad_s", "accel_m_s2", "t_err_ns", "utc_ns", "t_dev_ns", "t_rx_ns", "temperature_c"]
    peers = [await Peer.greeted(server) for _ in range(20)]
    for number, peer in enumerate(peers):
        chosen = {"fields": fields[: 1 + number % 8]} if selection == "many" else {}
        await peer.result("watch", **chosen)
    for seq in range(1, 1801):
        server.publish(batch("imu0", seq))
    server.tick(0)
    clients = server.hub.clients()
    assert sum(client.dropped for client in clients)
    assert 1 << 20 < sum(client.queue_bytes for client in clients) < 4 << 20


@in_server(clients_max=2)
async def test_one_client_too_many_gets_an_error(server: SocketServer) -> None:
    _first, second, third = (await Peer.greeted(server), await Peer.greeted(server), await Peer.connect(server))
    assert (await third.message())["error"]["code"] == -32002
    assert await third.ended()
    assert server.hub.status().refused == 1
    second.close()
    await until(lambda: len(server.hub.connections) == 1)
    await Peer.greeted(server)


@in_server()
async def test_clients_are_seen_through_the_context(server: SocketServer) -> None:
    known = server.hub.context.outputs.clients
    assert not known[0]()
    peer = await Peer.greeted(server)
    await peer.result("watch", encoding="binary")
    server.publish(batch("imu0", 1, 3))
    (client,) = known[0]()
    assert (client.encoding, client.sent, client.dropped, client.queue_samples) == ("binary", 3, 0, 0)
    server.close()
    assert known == []


@in_server()
async def test_out_of_descriptors_pauses_accepting_until_the_next_tick_and_is_logged_once(
    server: SocketServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    calls = 0

    def refuse(_sock: socket.socket) -> None:
        nonlocal calls
        calls += 1
        raise OSError(24, "Too many open files")

    with monkeypatch.context() as patch:
        patch.setattr(socket.socket, "accept", refuse)
        peer = await Peer.connect(server)
        for count in range(1, 11):
            await until(lambda count=count: calls >= count)  # type: ignore[misc]
            for _ in range(10):
                await asyncio.sleep(0)
            assert calls == count  # no busy loop
            if count < 10:
                server.tick(0)
    for _ in range(20):
        await asyncio.sleep(0)
    assert not server.hub.connections  # only after the tick
    server.tick(0)
    assert (await peer.message())["method"] == "hello"
    assert caplog.text.count("cannot accept a client: Too many open files") == 1


@pytest.mark.parametrize(("step_ns", "accepted"), [(0, [16, 32, 40]), (100_000, [2, 4, 6])])
@alone()
async def test_accepting_takes_a_limited_part_of_a_turn(tmp_path: Path, step_ns: int, accepted: list[int]) -> None:
    """At most 16 clients, and at most 0.3 ms."""
    clock = socket_rig.SteppingClock()
    async with serving(tmp_path, clock) as server:
        for _ in range(40):
            await Peer.connect(server)
        found = []
        clock.step_ns = step_ns
        for _ in range(3):
            await asyncio.sleep(0)
            found.append(server.hub.accepted)
        assert found == accepted


@in_server()
async def test_a_client_that_left_before_accept(server: SocketServer, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = Mock(side_effect=OSError(107, "Transport endpoint is not connected"))
    monkeypatch.setattr("imud.publishers.socket.server.peer_of", gone)
    assert await (await Peer.connect(server)).ended()
    status = server.hub.status()
    assert (status.accepted, status.refused, status.failed) == (0, 0, 0)


broken = Mock(side_effect=ZeroDivisionError("a mistake"))


@pytest.mark.parametrize(
    "place", ["Quota.admit", "ClientConnection.__init__", "Greeting", "peer_of"], ids=lambda place: place.split(".")[0]
)
@in_server()
async def test_an_error_while_a_client_is_greeted_ends_only_this_client(
    server: SocketServer, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    good = await Peer.greeted(server)
    with monkeypatch.context() as patch:
        patch.setattr(f"imud.publishers.socket.server.{place}", broken)
        bad = await Peer.connect(server)
        if place == "Greeting":
            assert (await bad.message())["error"]["code"] == -32603
        assert await bad.ended()
    assert (server.hub.status().failed, len(server.hub.connections)) == (1, 1)
    other = await Peer.greeted(server)
    for peer in (good, other):
        assert len(await peer.result("devices")) == 2


@pytest.mark.parametrize("what", ["wake", "tick", "event", "reply"])
@in_server()
async def test_an_error_ends_only_this_client(server: SocketServer, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    socket_rig.done_late.clear()
    bad, good = await Peer.greeted(server), await Peer.greeted(server)
    connection, _ = server.hub.connections.values()
    for peer in (bad, good):
        await peer.result("events")
    os.close(await descriptor(bad))
    if what == "wake":
        monkeypatch.setattr(connection, "wake", broken)
        server.publish(batch())
    elif what == "tick":
        monkeypatch.setattr(connection, "tick", broken)
        server.hub.ending[connection] = None
        server.tick(0)
    else:
        monkeypatch.setattr(connection, "post", broken)
        if what == "event":
            server.event(Event(5, "", EventKind.UP, "back"))
        else:
            socket_rig.done_late.set()
            await bad.send(b'{"jsonrpc":"2.0","id":9,"method":"command","params":{"device":"imu0","name":"wait"}}\n')
    await until(lambda: connection.closed)
    assert server.hub.status().failed == 1
    assert len(await good.result("devices")) == 2


async def descriptor(peer: Peer) -> int:
    await peer.send(b'{"jsonrpc":"2.0","id":7,"method":"notify","params":{"device":"imu0"}}\n')
    while True:
        await asyncio.sleep(0)
        with suppress(BlockingIOError):
            _data, fds, _flags, _address = socket.recv_fds(peer.sock, 4096, 4)
            return fds[0]


@alone()
async def test_a_stale_socket_is_replaced_and_those_of_other_daemons_are_left_alone(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(tmp_path / "imud.sock"))
    async with serving(tmp_path) as server:
        second = SocketServer(SocketOptions(path=server.hub.path), socket_rig.context())
        with pytest.raises(ServerError, match="another daemon serves"):
            second.start()
        second.close()
        await Peer.greeted(server)  # the first server still works
    path = tmp_path / "imud.sock"
    server = SocketServer(SocketOptions(path=str(path)), socket_rig.context())
    server.start()
    path.unlink()
    successor = SocketServer(SocketOptions(path=str(path)), socket_rig.context())
    successor.start()
    server.close()
    server.close()
    assert path.is_socket()
    await Peer.greeted(successor)
    successor.close()
    assert not path.exists()


@alone()
async def test_the_directory_is_made_or_the_error_names_the_next_step(tmp_path: Path) -> None:
    server = SocketServer(SocketOptions(path=str(tmp_path / "run" / "imud" / "s")), socket_rig.context())
    server.start()
    assert (tmp_path / "run" / "imud").stat().st_mode & 0o777 == 0o755
    server.close()
    (tmp_path / "file").touch()
    for path, words in (
        (tmp_path / "file" / "s", "cannot make the directory"),
        (tmp_path / "file", "another kind of file"),
    ):
        blocked = SocketServer(SocketOptions(path=str(path)), socket_rig.context())
        with pytest.raises(ServerError, match=words):
            blocked.start()
        blocked.close()
    assert (tmp_path / "file").is_file()


@pytest.mark.parametrize("step", ["chmod", "listen", "rename"])
@alone()
async def test_a_failed_start_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    refuse = Mock(side_effect=OSError(12, "Cannot allocate memory"))
    owner = {"chmod": os, "listen": socket.socket, "rename": Path}[step]
    descriptors = len(os.listdir("/proc/self/fd"))
    server = SocketServer(SocketOptions(path=str(tmp_path / "imud.sock")), socket_rig.context())
    with monkeypatch.context() as patch:
        patch.setattr(owner, step, refuse)
        with pytest.raises(ServerError, match="Cannot allocate memory"):
            server.start()
    assert not os.listdir(tmp_path)
    assert len(os.listdir("/proc/self/fd")) == descriptors
    server.close()


@in_server(group="no-such-group-here", control_group="root")
async def test_a_missing_group_is_a_warning_only(server: SocketServer, caplog: pytest.LogCaptureFixture) -> None:
    assert os.stat(server.hub.path).st_mode & 0o777 == 0o660
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "group 'no-such-group-here' (socket.group) does not exist" in caplog.text
    assert "make it with `sudo groupadd --system no-such-group-here`" in caplog.text


GROUP = "no-such-group-here"


@pytest.mark.parametrize("blocked", ["", "another daemon", "a file"])
@in_server()
async def test_a_removed_socket_file_is_created_again(
    server: SocketServer, tmp_path: Path, caplog: pytest.LogCaptureFixture, blocked: str
) -> None:
    path, peer = tmp_path / "imud.sock", await Peer.greeted(server)
    unaccepted = socket.socket(socket.AF_UNIX)
    unaccepted.connect(str(path))
    path.unlink()
    other = Listener(path, "") if blocked == "another daemon" else None
    if blocked == "a file":
        path.touch()
    caplog.clear()
    for _ in range(10):
        server.tick(0)
    if blocked:
        (problem,) = [one.getMessage() for one in caplog.records if one.levelname == "ERROR"]
        assert f"the file {path} was removed or replaced: " in problem
        if other is not None:
            other.close()
        path.unlink(missing_ok=True)
        server.tick(CHECK_NS - 1)
        assert not path.exists()
        server.tick(CHECK_NS)
    assert path.stat().st_mode & 0o777 == 0o660
    assert await peer.result("unwatch") == {}
    assert await (await Peer.greeted(server)).result("unwatch") == {}
    assert len(server.hub.connections) == 3
    assert sum("created it again" in one.getMessage() for one in caplog.records) == 1
    unaccepted.close()


def leave_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))


def around_rename(
    monkeypatch: pytest.MonkeyPatch, before: Callable[[], object], after: Callable[[], object] = lambda: None
) -> None:
    rename = Path.rename

    def once(file: Path, target: Path) -> Path:
        monkeypatch.setattr(Path, "rename", rename)
        before()
        done = rename(file, target)
        after()
        return done

    monkeypatch.setattr(Path, "rename", once)


def as_process(monkeypatch: pytest.MonkeyPatch, pid: int, work: Callable[[], Listener]) -> Listener:
    """Run `work` with another process number."""
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: pid)
        return work()


@pytest.mark.parametrize("stale", [False, True])
def test_the_file_appears_with_its_final_rights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stale: bool) -> None:
    path = tmp_path / "imud.sock"
    if stale:
        leave_socket(path)
    inodes = [path.lstat().st_ino if stale else 0]

    def before() -> None:
        assert path.exists() == stale
        inodes.append(path.lstat().st_ino if stale else 0)
        (file,) = set(tmp_path.iterdir()) - {path}
        assert file.name == f"imud.sock.{os.getpid()}"
        assert file.stat().st_mode & 0o777 == SOCKET_MODE

    def after() -> None:
        assert path.stat().st_mode & 0o777 == SOCKET_MODE
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))  # all connections succeed after this

    around_rename(monkeypatch, before, after)
    listener = Listener(path, GROUP)
    assert inodes == [inodes[0]] * 2  # the old file exists until the rename
    assert [file.name for file in tmp_path.iterdir()] == ["imud.sock"]
    listener.close()
    assert not list(tmp_path.iterdir())


def test_paths_of_the_socket_are_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / ("x" * (PATH_MAX_BYTES - len(str(tmp_path)) - 1))
    as_process(monkeypatch, 4_194_303, lambda: Listener(path, GROUP)).close()
    longer = path.with_name(path.name + "x")
    with pytest.raises(ServerError, match=f"at most {PATH_MAX_BYTES} bytes, got {PATH_MAX_BYTES + 1}"):
        Listener(longer, GROUP)
    with pytest.raises(ValueError, match=f"path: expected at most {PATH_MAX_BYTES} bytes, got {PATH_MAX_BYTES + 1}: "):
        SocketOptions(path=str(longer))
    file = tmp_path / f"imud.sock.{os.getpid()}"
    file.touch()
    with pytest.raises(ServerError, match=f"{file.name} exists; remove it"):
        Listener(tmp_path / "imud.sock", GROUP)
    assert list(tmp_path.iterdir()) == [file]


def test_two_daemons_start_at_the_same_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "imud.sock"
    others: list[Listener] = []
    listen = socket.socket.listen

    def meanwhile(sock: socket.socket, backlog: int) -> None:
        monkeypatch.setattr(socket.socket, "listen", listen)
        others.append(as_process(monkeypatch, os.getppid(), lambda: Listener(path, GROUP)))
        listen(sock, backlog)

    monkeypatch.setattr(socket.socket, "listen", meanwhile)
    with pytest.raises(ServerError, match="another daemon serves"):
        Listener(path, GROUP)
    assert [file.name for file in tmp_path.iterdir()] == ["imud.sock"]
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(path))
        others[0].sock.accept()[0].close()
    others[0].close()
    other = tmp_path / "other"

    def replace() -> None:
        leave_socket(other)
        other.rename(path)

    around_rename(monkeypatch, lambda: None, replace)
    with pytest.raises(ServerError, match="has just taken"):
        Listener(path, GROUP)
    assert [file.name for file in tmp_path.iterdir()] == ["imud.sock"]  # the socket of the other daemon


def test_leftovers_of_dead_daemons_go_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "imud.sock"
    with subprocess.Popen(["true"]) as ended:
        pass
    for name in (f"imud.sock.{ended.pid}.x", "imud.sock.x", f"other.{ended.pid}"):
        leave_socket(tmp_path / name)
    (tmp_path / f"imud.sock.0{ended.pid}").touch()
    with (
        subprocess.Popen(["cat"], stdin=subprocess.PIPE) as other,
        socket.socket(socket.AF_UNIX) as alive,  # of a container with invisible processes
    ):
        for number in (ended.pid, os.getpid(), other.pid):
            leave_socket(tmp_path / f"imud.sock.{number}")
        alive.bind(str(tmp_path / f"imud.sock.00{ended.pid}"))
        alive.listen()
        Listener(path, GROUP).close()
    assert {file.name for file in tmp_path.iterdir()} == {
        f"imud.sock.{other.pid}", f"imud.sock.{ended.pid}.x", "imud.sock.x", f"other.{ended.pid}",
        f"imud.sock.0{ended.pid}", f"imud.sock.00{ended.pid}",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("function", "error", "words"),
    [
        ("socket.socket.connect", TimeoutError(), "another daemon serves .*imud.sock; stop it"),
        ("socket.socket.connect", BlockingIOError(errno.EAGAIN, ""), "another daemon serves .*imud.sock; stop it"),
        ("socket.socket.connect", PermissionError(errno.EACCES, "Permission denied"), "cannot check whether a daemon"),
        ("Path.lstat", OSError(errno.EIO, "Input/output error"), "cannot check .*imud.sock: Input/output error"),
    ],
)
def test_an_existing_socket_that_cannot_be_checked_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, function: str, error: OSError, words: str
) -> None:
    path = tmp_path / "imud.sock"
    leave_socket(path)
    with monkeypatch.context() as patch:
        patch.setattr(f"imud.publishers.socket.server.{function}", Mock(side_effect=error))
        with pytest.raises(ServerError, match=words):
            Listener(path, GROUP)
        assert _is_leftover(path, os.getpid()) == (function == "Path.lstat")  # the socket of a dead daemon
    assert path.is_socket()


def test_missing_rights_warn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    denied = Mock(side_effect=PermissionError(errno.EPERM, "Operation not permitted"))
    monkeypatch.setattr("imud.publishers.socket.server.os.chown", denied)
    monkeypatch.setattr("imud.publishers.socket.server.os.setxattr", denied)
    listener = Listener(tmp_path / "imud.sock", "root", "root")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", denied)
        listener.close()
    assert [one.split(":")[0].replace(str(tmp_path), "") for one in caplog.messages] == [
        "cannot give /imud.sock to group 'root'", "cannot set the ACL of /imud.sock", "cannot remove /imud.sock",
    ]  # fmt: skip
    again = Listener(tmp_path / "imud.sock", "root")
    (tmp_path / "imud.sock").unlink()
    again.close()
