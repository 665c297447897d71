"""imud reads only regular files. The check of the type never blocks and has no side effect."""

import errno
import grp
import os
import re
import socket
import stat
import threading
from collections.abc import Callable
from pathlib import Path
from unittest.mock import create_autospec

import msgspec
import pytest

from imud.host import files
from imud.model.errors import reason_of


def bound_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


def link_to(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (os.mkfifo, "is a FIFO"), (bound_socket, "is a socket"), (Path.mkdir, "Is a directory"),
        (link_to("/dev/zero"), "is a character device"), (link_to("/dev/ptmx"), "is a character device"),
        (link_to("/dev/stdin/none"), "Not a directory|No such file"),
    ],
)  # fmt: skip
def test_other_file_types_are_rejected_immediately(make: Callable[[Path], None], words: str, tmp_path: Path) -> None:
    make(tmp_path / "it")
    for path, expected in ((tmp_path / "it", words), ("a\0b", "null")):
        with pytest.raises(OSError, match=expected):
            files.open_regular(path)
        with pytest.raises(OSError, match=expected) as exception:
            files.read_regular_file(path, 1000)
        assert re.search(expected, reason_of(exception.value)), "a message must name the type"


def test_a_file_replaced_between_check_and_opening(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, opened = tmp_path / "it", os.open
    path.write_bytes(b"data")

    def exchange(name: str, flags: int) -> int:
        path.unlink()
        os.mkfifo(path)
        descriptors.append(opened(name, flags))
        return descriptors[0]

    descriptors: list[int] = []
    monkeypatch.setattr("imud.host.files.os.open", exchange)
    with pytest.raises(files.NotRegularFile, match="FIFO"):
        files.open_regular(path)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptors[0])


def test_no_more_is_read_than_wanted(tmp_path: Path) -> None:
    path = tmp_path / "sparse"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    assert len(files.read_regular(path, 1000)) == 1000
    files.replace_file(path, b"short")
    assert files.read_regular(path, 1000) == b"short"
    assert path.stat().st_mode & 0o777 == 0o640 & ~_umask()


def test_complete_content_up_to_a_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert files.read_regular_file(path, 5) == b"12345"
    with pytest.raises(files.FileTooLong) as exception:
        files.read_regular_file(path, 4)
    assert reason_of(exception.value) == "expected at most 4 bytes, got more"


@pytest.mark.parametrize("failing", ["os.fsync", "os.replace", "os.fchown"])
def test_a_failed_replacement_keeps_the_old_file(failing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")
    (tmp_path / "file.new").symlink_to(path)

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "failed")

    with monkeypatch.context() as patch:
        patch.setattr(f"imud.host.files.{failing}", fail)
        with pytest.raises(OSError, match="failed"):
            files.replace_file(path, b"new", owner=(os.getuid() + 1, 0))
    assert [one.name for one in tmp_path.iterdir()] == ["file"]
    assert path.read_bytes() == b"old"


def test_owner_and_mode_change_only_if_they_differ(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[int, ...]] = []
    monkeypatch.setattr("imud.host.files.os.fchown", lambda _, *owner: calls.append(owner))
    monkeypatch.setattr("imud.host.files.os.fchmod", lambda _, mode: calls.append((mode,)))
    own = os.getuid(), os.getgid()
    files.replace_file(tmp_path / "file", b"", mode=0o600, owner=own)
    assert calls == []
    files.replace_file(tmp_path / "file", b"", mode=0o666, owner=(own[0], own[1] + 1))  # the umask reduces this mode
    files.replace_file(tmp_path / "file", b"", mode=0o600, owner=(own[0] + 1, own[1]))
    assert calls == [(own[0], own[1] + 1), (0o666,), (own[0] + 1, own[1])]


def test_a_fifo_is_opened_only_with_data(tmp_path: Path) -> None:
    path = tmp_path / "fifo"
    os.mkfifo(path)
    with pytest.raises(files.NotRegularFile, match="no program writes"):
        files.open_stream(path, 1)
    writer = os.open(path, os.O_RDWR)
    os.write(writer, b"data")
    with files.open_stream(path, 1) as file:
        assert os.get_blocking(file.fileno())
        assert file.read(4) == b"data"
    os.close(writer)
    (tmp_path / "file").write_bytes(b"regular")
    with files.open_stream(tmp_path / "file", 1) as file:
        assert file.read() == b"regular"
    with pytest.raises(files.NotRegularFile, match="directory"):
        files.open_stream(tmp_path, 1)


def test_group_of_a_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gid, name = next((one.gr_gid, one.gr_name) for one in grp.getgrall() if one.gr_gid)
    status = list(tmp_path.stat())
    for found, expected in ((gid, name), (0, "other"), (4_000_000_000, "other")):
        status[5] = found
        monkeypatch.setattr("imud.host.files.os.stat", lambda _: os.stat_result(status))
        assert files.group_of("/dev/ttyUSB0", "other") == expected
    monkeypatch.undo()
    assert files.group_of(str(tmp_path / "absent"), "other") == "other"
    for uid, user in ((0, "root"), (4_000_000_000, "4000000000")):
        monkeypatch.setattr("imud.host.files.os.geteuid", lambda uid=uid: uid)
        assert files.user_name() == user


def test_a_state_file_keeps_the_newest_content(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "new" / "state" / "file"
    join = create_autospec(threading.Thread.join, side_effect=threading.Thread.join)
    monkeypatch.setattr(threading.Thread, "join", join)
    for content in ({"a": 1}, {"b": 2}):
        state = files.StateFile(path, "saving", "is empty")
        state.read(dict[str, int])
        state.write({"old": 0})
        state.write(content)
        state.close()
        state.close()
        state.write({"after": 1})  # ignored: the thread has ended
        assert path.read_bytes() == msgspec.json.encode(content)
        assert files.StateFile(None, "", "").read(dict[str, int]) == {}
    assert path.parent.stat().st_mode & 0o777 == 0o750 & ~_umask()
    assert [call.args[1:] for call in join.call_args_list] == [(1.0,)] * 2  # a slow disk delays the end by at most 1 s
    state = files.StateFile(path, "saving", "is empty")
    assert (state.read(dict[str, int]), caplog.messages) == ({"b": 2}, [])
    path.unlink()
    assert (state.read(dict[str, int]), caplog.messages) == ({}, [])
    for wrong in (b"{", b'{"a": "text"}', b"\xff", b'{"a":1}' + b" " * (1 << 20) + b"}"):
        path.write_bytes(wrong)
        expected = {"a": 1} if len(wrong) > 1 << 20 else {}  # imud reads at most 1 MiB
        assert state.read(dict[str, int]) == expected
    assert len(caplog.messages) == 3
    assert all("it does not contain the JSON that imud writes; is empty" in one for one in caplog.messages)
    path.unlink()
    path.mkdir()
    state.write({})
    state.close()
    assert f"cannot write {path}: Is a directory; after the next start is empty" in caplog.messages[-1]
    for folder in (Path("/proc/imud"), Path("/dev/null")):
        caplog.clear()
        state = files.StateFile(folder / "file", "saving", "is empty")
        state.close()  # without content
        (message,) = caplog.messages
        assert f"cannot write {folder}/file: " in message
    assert files.StateFile(None, "", "").read(dict[str, int]) == {}


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@pytest.mark.parametrize(
    ("mode", "is_safe"),
    [(0o755, True), (0o700, True), (0o1777, True), (0o1775, True), (0o775, False), (0o757, False), (0o777, False)],
)
def test_others_can_replace_files_if_they_can_write_without_the_sticky_bit(mode: int, is_safe: bool) -> None:
    status = os.stat_result((stat.S_IFDIR | mode, 0, 0, 1, os.geteuid(), 0, 0, 0, 0, 0))
    problem = files.can_replace(status, "/a", "recordings")
    expected = f"/a has mode {mode:04o}: other users can replace recordings; chmod go-w /a"
    assert problem == ("" if is_safe else expected)
    foreign = os.stat_result((stat.S_IFDIR | 0o700, 0, 0, 1, os.geteuid() + 12345, 0, 0, 0, 0, 0))
    assert f"/a belongs to user {os.geteuid() + 12345}, who can replace it" in files.can_replace(foreign, "/a", "it")
    root = os.stat_result((stat.S_IFDIR | 0o700, 0, 0, 1, 0, 0, 0, 0, 0, 0))
    assert files.can_replace(root, "/a", "it") == ""
