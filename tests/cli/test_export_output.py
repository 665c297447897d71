"""The output file of an export is complete, or it does not exist."""

import os
import threading
from pathlib import Path

import pytest

from imud.cli.export import ExportFile
from imud.model.errors import BadArgument, ImudError


def output(path: Path | None, folder: Path, *, force: bool = False, binary: bool = False) -> ExportFile:
    source = folder / "source"
    source.touch()
    return ExportFile(path, source=source, force=force, binary=binary)


def interrupted(out: ExportFile) -> None:
    try:
        with out:
            out.write(b"new")
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        pass


def test_the_file_is_there_when_it_is_whole_and_only_then(tmp_path: Path) -> None:
    file = tmp_path / "a"
    with output(file, tmp_path) as out:
        out.write(b"one")
        assert not file.exists()
        out.write(b"two")
    assert file.read_bytes() == b"onetwo"
    assert out.written_bytes == 6
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a", "source"]
    interrupted(output(tmp_path / "b", tmp_path))
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a", "source"]


def test_a_file_that_is_there_is_kept_without_force(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"old")
    with pytest.raises(BadArgument, match="replace it with --force"):
        output(file, tmp_path)
    interrupted(output(file, tmp_path, force=True))
    assert file.read_bytes() == b"old"
    with output(file, tmp_path, force=True) as out:
        out.write(b"new")
    assert file.read_bytes() == b"new"


def test_what_is_exported_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "source").write_bytes(b"a recording")
    (tmp_path / "link").symlink_to(tmp_path / "source")
    for name in ("source", "link"):
        with pytest.raises(BadArgument, match="name another file"):
            output(tmp_path / name, tmp_path, force=True)
    assert (tmp_path / "source").read_bytes() == b"a recording"


def test_a_missing_folder_and_a_full_disk_are_errors_with_the_name(tmp_path: Path) -> None:
    with pytest.raises(ImudError, match="none/a: No such file or directory"):
        output(tmp_path / "none" / "a", tmp_path)
    out = output(Path("/dev/full"), tmp_path)
    with pytest.raises(ImudError, match="/dev/full: No space left on device"), out:
        out.write(b"x")
    assert Path("/dev/full").is_char_device()


def test_a_fifo_is_written_in_place(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    got: list[bytes] = []
    reader = threading.Thread(target=lambda: got.append(fifo.read_bytes()))
    reader.start()
    with output(fifo, tmp_path) as out:
        out.write(b"through")
    reader.join(10)
    assert got == [b"through"]
    assert fifo.is_fifo()


def test_a_terminal_gets_no_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    with pytest.raises(BadArgument, match="cannot write MCAP to a terminal"):
        output(None, tmp_path, binary=True)
    with output(None, tmp_path):
        pass
