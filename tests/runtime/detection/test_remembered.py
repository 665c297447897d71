"""What was found is there after a restart; a bad file costs nothing but the memory."""

from pathlib import Path

import pytest

from imud.runtime.detection.remembered import FILE_NAME, Remembered, RememberedDevice


def test_survives_a_restart(tmp_path: Path) -> None:
    Remembered(tmp_path).put("bow", RememberedDevice("hipnuc-uart", 921600))
    assert Remembered(tmp_path).get("bow") == RememberedDevice("hipnuc-uart", 921600)
    assert Remembered(tmp_path).get("stern") is None


def test_unchanged_finding_does_not_write(tmp_path: Path) -> None:
    memory = Remembered(tmp_path)
    memory.put("bow", RememberedDevice("hipnuc-uart", 9600))
    (tmp_path / FILE_NAME).unlink()
    memory.put("bow", RememberedDevice("hipnuc-uart", 9600))
    assert not (tmp_path / FILE_NAME).exists()


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b'{"bow": {"driver": 1, "baud": "x"}}', b"\xff\xfe"])
def test_damaged_file_is_reported_and_replaced(
    tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / FILE_NAME).write_bytes(content)
    memory = Remembered(tmp_path)
    assert "cannot be used" in caplog.text
    memory.put("bow", RememberedDevice("hipnuc-uart", 9600))
    assert Remembered(tmp_path).get("bow") == RememberedDevice("hipnuc-uart", 9600)


def test_unwritable_folder_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    memory = Remembered(tmp_path / "missing")
    memory.put("bow", RememberedDevice("hipnuc-uart", 9600))
    assert "cannot be written" in caplog.text
    assert memory.get("bow") == RememberedDevice("hipnuc-uart", 9600)


def test_no_folder_remembers_in_memory_only() -> None:
    memory = Remembered(None)
    memory.put("bow", RememberedDevice("hipnuc-uart", 9600))
    assert memory.get("bow") == RememberedDevice("hipnuc-uart", 9600)
