"""Socket file: imud replaces the file of a dead daemon, keeps the file of a live one, and removes its own."""

import errno
import os
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import pytest

from imud.model.errors import ServerError
from imud.model.units import NS_PER_S
from imud.publishers.socket.server import PATH_MAX_BYTES, SOCKET_MODE, Listener, SocketOptions, SocketServer
from tests.support.socket_rig import Peer, alone, context, in_server, serving


@alone()
async def test_a_stale_socket_is_replaced_and_a_live_one_left_alone(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(tmp_path / "imud.sock"))
    async with serving(tmp_path) as server:
        second = SocketServer(SocketOptions(path=server.hub.path), context())
        with pytest.raises(ServerError, match="another daemon serves"):
            second.start()
        second.close()
        await Peer.greeted(server)  # the first server still works


@alone()
async def test_close_leaves_a_socket_alone_that_is_another_daemon_s(tmp_path: Path) -> None:
    path = tmp_path / "imud.sock"
    server = SocketServer(SocketOptions(path=str(path)), context())
    server.start()
    path.unlink()
    successor = SocketServer(SocketOptions(path=str(path)), context())
    successor.start()
    server.close()
    server.close()
    assert path.is_socket()
    await Peer.greeted(successor)
    successor.close()
    assert not path.exists()


@alone()
async def test_the_directory_is_made_or_the_error_names_the_next_step(tmp_path: Path) -> None:
    server = SocketServer(SocketOptions(path=str(tmp_path / "run" / "imud" / "s")), context())
    server.start()
    assert (tmp_path / "run" / "imud").stat().st_mode & 0o777 == 0o755
    server.close()
    (tmp_path / "file").touch()
    for path, words in (
        (tmp_path / "file" / "s", "cannot make the directory"),
        (tmp_path / "file", "another kind of file"),
    ):
        blocked = SocketServer(SocketOptions(path=str(path)), context())
        with pytest.raises(ServerError, match=words):
            blocked.start()
        blocked.close()
    assert (tmp_path / "file").is_file()
    with pytest.raises(ServerError, match=f"at most {PATH_MAX_BYTES} bytes"):
        Listener(tmp_path / ("x" * 120), "imud", "imud-control")


@pytest.mark.parametrize("step", ["chmod", "listen", "rename"])
@alone()
async def test_a_failed_start_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    def refuse(*_: object, **_names: object) -> None:
        raise OSError(12, "Cannot allocate memory")

    owner = {"chmod": os, "listen": socket.socket, "rename": Path}[step]
    descriptors = len(os.listdir("/proc/self/fd"))
    server = SocketServer(SocketOptions(path=str(tmp_path / "imud.sock")), context())
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
        server.tick(NS_PER_S - 1)
        assert not path.exists()
        server.tick(NS_PER_S)
    assert path.stat().st_mode & 0o777 == 0o660
    assert await peer.result("unwatch") == {}
    second = await Peer.greeted(server)
    assert await second.result("unwatch") == {}
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


def test_a_path_of_the_greatest_length(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / ("x" * (PATH_MAX_BYTES - len(str(tmp_path)) - 1))
    as_process(monkeypatch, 4_194_303, lambda: Listener(path, GROUP)).close()
    longer = path.with_name(path.name + "x")
    with pytest.raises(ServerError, match=f"at most {PATH_MAX_BYTES} bytes, got {PATH_MAX_BYTES + 1}"):
        Listener(longer, GROUP)


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


def test_another_daemon_replaces_the_file_just_after_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "imud.sock"
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


def test_a_file_in_the_way_of_the_first_name(tmp_path: Path) -> None:
    file = tmp_path / f"imud.sock.{os.getpid()}"
    file.touch()
    with pytest.raises(ServerError, match=f"{file.name} exists; remove it"):
        Listener(tmp_path / "imud.sock", GROUP)
    assert list(tmp_path.iterdir()) == [file]


def failing(error: OSError) -> Callable[..., NoReturn]:
    def fail(*_: object, **__: object) -> NoReturn:
        raise error

    return fail


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
        patch.setattr(f"imud.publishers.socket.server.{function}", failing(error))
        with pytest.raises(ServerError, match=words):
            Listener(path, GROUP)
    assert path.is_socket()


def test_missing_permissions_are_warnings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    denied = failing(PermissionError(errno.EPERM, "Operation not permitted"))
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
