"""Results of searches after a restart. An invalid file only loses the results."""

import os
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from imud.device.search import FILE_NAME, Remembered, RememberedDevice
from imud.host.files import replace_file

FOUND = RememberedDevice("hipnuc-uart", 9600)


def remember(folder: Path, **found: RememberedDevice) -> None:
    """Store results as one daemon from its start to its end."""
    before = set(threading.enumerate())
    with closing(Remembered(folder)) as memory:
        for name, one in found.items():
            memory.put(name, one)
    assert "remembered" not in {thread.name for thread in set(threading.enumerate()) - before}


def recalled(folder: Path, device: str) -> RememberedDevice | None:
    """Return the result that the next daemon reads."""
    with closing(Remembered(folder)) as memory:
        return memory.get(device)


def test_results_survive_a_restart_and_are_written_once(tmp_path: Path) -> None:
    remember(tmp_path, bow=RememberedDevice("hipnuc-uart", 921600))
    assert recalled(tmp_path, "bow") == RememberedDevice("hipnuc-uart", 921600)
    assert recalled(tmp_path, "stern") is None
    assert [file.name for file in tmp_path.iterdir()] == [FILE_NAME]
    remember(tmp_path, bow=FOUND)
    written = (tmp_path / FILE_NAME).stat()
    remember(tmp_path, bow=FOUND)
    assert (tmp_path / FILE_NAME).stat().st_ino == written.st_ino
    with closing(Remembered(tmp_path)) as memory:
        for number in range(500):
            memory.put(f"d{number % 7}", RememberedDevice("hipnuc-uart", number))
    assert [recalled(tmp_path, f"d{number % 7}") for number in range(493, 500)] == [
        RememberedDevice("hipnuc-uart", number) for number in range(493, 500)
    ]


DEEP = b'{"bow": {"driver": "x", "baud": 1, "more": ' + b"[" * 100_000


def fifo(file: Path) -> None:
    os.mkfifo(file)


def endless(file: Path) -> None:
    file.symlink_to("/dev/zero")


def terminal(file: Path) -> None:
    file.symlink_to("/dev/ptmx")


def half(file: Path) -> None:
    file.write_bytes(b"half")


def loop(file: Path) -> None:
    file.symlink_to(file)


def holding(content: bytes) -> Callable[[Path], object]:
    return lambda file: file.write_bytes(content)


DAMAGED = [b"", b"{", b"[1]", b'{"bow": {"driver": 1, "baud": "x"}}', b"\xff\xfe", DEEP]


@pytest.mark.parametrize("make", [fifo, endless, terminal, loop, *map(holding, DAMAGED)])
@pytest.mark.timeout(5)
def test_an_invalid_file_is_reported_and_replaced(
    tmp_path: Path, make: Callable[[Path], object], caplog: pytest.LogCaptureFixture
) -> None:
    make(tmp_path / FILE_NAME)
    remember(tmp_path, bow=FOUND)
    assert "cannot use" in caplog.text
    assert recalled(tmp_path, "bow") == FOUND


def test_a_missing_state_directory_is_created(tmp_path: Path) -> None:
    remember(tmp_path / "var" / "imud", bow=FOUND)
    assert recalled(tmp_path / "var" / "imud", "bow") == FOUND


def test_a_directory_in_place_of_the_file_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / FILE_NAME).mkdir()
    remember(tmp_path, bow=FOUND)
    assert "cannot use" in caplog.text
    assert "cannot write" in caplog.text
    assert [file.name for file in tmp_path.iterdir()] == [FILE_NAME]


@pytest.mark.parametrize("make", [fifo, endless, half])
@pytest.mark.timeout(5)
def test_the_temporary_file_of_a_killed_daemon_is_replaced(tmp_path: Path, make: Callable[[Path], None]) -> None:
    """imud removes the temporary file of any type and does not follow a link."""
    make(tmp_path / (FILE_NAME + ".new"))
    remember(tmp_path, bow=FOUND)
    assert recalled(tmp_path, "bow") == FOUND


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "file"
    replace_file(file, b"old")

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("imud.host.files.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        replace_file(file, b"new")
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]


def test_without_a_folder_results_stay_in_memory(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with closing(Remembered(None)) as memory:
        memory.put("bow", FOUND)
        assert memory.get("bow") == FOUND
    (tmp_path / "taken").touch()
    with closing(Remembered(tmp_path / "taken" / "imud")) as memory:
        memory.put("bow", FOUND)
        assert memory.get("bow") == FOUND
    assert "cannot write" in caplog.text
