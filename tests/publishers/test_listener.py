"""Life and death of the socket file: a dead daemon's is replaced, a live one's is left alone, ours is removed."""

import os
import socket
from pathlib import Path

import pytest

from imud.errors import ServerError
from imud.publishers.socket import SocketServer, SocketSettings
from tests.publishers.socket_rig import Peer, context, run, serving


def test_a_stale_socket_is_replaced_and_a_live_one_left_alone(tmp_path: Path) -> None:
    async def body() -> None:
        with socket.socket(socket.AF_UNIX) as dead:
            dead.bind(str(tmp_path / "imud.sock"))
        async with serving(tmp_path) as server:
            second = SocketServer(SocketSettings(path=server.hub.path), context())
            with pytest.raises(ServerError, match="another daemon serves"):
                second.start()
            second.close()
            peer = await Peer.greeted(server)  # the first is unharmed
            peer.close()

    run(body)


def test_close_leaves_a_socket_alone_that_is_another_daemon_s(tmp_path: Path) -> None:
    async def body() -> None:
        path = tmp_path / "imud.sock"
        server = SocketServer(SocketSettings(path=str(path)), context())
        server.start()
        path.unlink()
        successor = SocketServer(SocketSettings(path=str(path)), context())
        successor.start()
        server.close()
        server.close()
        assert path.is_socket()
        peer = await Peer.greeted(successor)
        peer.close()
        successor.close()
        assert not path.exists()

    run(body)


def test_the_directory_is_made_or_the_error_says_what_to_do(tmp_path: Path) -> None:
    async def body() -> None:
        server = SocketServer(SocketSettings(path=str(tmp_path / "run" / "imud" / "s")), context())
        server.start()
        assert (tmp_path / "run" / "imud").stat().st_mode & 0o777 == 0o755
        server.close()
        (tmp_path / "file").touch()
        for path, words in (
            (tmp_path / "file" / "s", "cannot make the directory"),
            (tmp_path / "file", "another kind of file"),
            (tmp_path / ("x" * 120), "at most 107 bytes"),
        ):
            blocked = SocketServer(SocketSettings(path=str(path)), context())
            with pytest.raises(ServerError, match=words):
                blocked.start()
            blocked.close()
        assert (tmp_path / "file").is_file()

    run(body)


def test_a_failed_start_leaves_nothing_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_sock: socket.socket, _backlog: int) -> None:
        raise OSError(12, "Cannot allocate memory")

    async def body() -> None:
        path = tmp_path / "imud.sock"
        server = SocketServer(SocketSettings(path=str(path)), context())
        with monkeypatch.context() as patch:
            patch.setattr(socket.socket, "listen", refuse)
            with pytest.raises(ServerError, match="Cannot allocate memory"):
                server.start()
        assert not path.exists()
        server.close()

    run(body)


def test_a_missing_group_is_a_warning_only(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async def body() -> None:
        async with serving(tmp_path, group="no-such-group-here") as server:
            assert os.stat(server.hub.path).st_mode & 0o777 == 0o660

    run(body)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "no-such-group-here" in caplog.text
