"""imud reads only regular files. The check of the type never blocks and has no side effect."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from imud.host.files import NotRegularFile, open_regular, read_regular, replace_file


def fifo(path: Path) -> None:
    os.mkfifo(path)


def bound_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


def link_to(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (fifo, "is a FIFO"),
        (bound_socket, "is a socket"),
        (Path.mkdir, "Is a directory"),
        (link_to("/dev/zero"), "is a character device"),
        (link_to("/dev/ptmx"), "is a character device"),
        (link_to("/dev/stdin/none"), "Not a directory|No such file"),
    ],
)
def test_other_file_types_are_rejected_immediately(make: Callable[[Path], None], words: str, tmp_path: Path) -> None:
    make(tmp_path / "it")
    with pytest.raises(OSError, match=words):
        open_regular(tmp_path / "it")


def test_a_path_with_a_null_character() -> None:
    with pytest.raises(OSError, match="null"):
        open_regular("a\0b")


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
    with pytest.raises(NotRegularFile, match="FIFO"):
        open_regular(path)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptors[0])


def test_no_more_is_read_than_wanted(tmp_path: Path) -> None:
    path = tmp_path / "sparse"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    assert len(read_regular(path, 1000)) == 1000
    replace_file(path, b"short")
    assert read_regular(path, 1000) == b"short"
    assert path.stat().st_mode & 0o777 == 0o640 & ~_umask()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
