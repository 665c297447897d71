"""Backups: readable YAML files with a date, limited in number, never half-written."""

from pathlib import Path

import pytest
import yaml

from imud.device.flash import BackupFolder, backup_text
from imud.model.units import NS_PER_S

BACKUPS_MAX = 10

T_NS = 1_795_000_000 * NS_PER_S
"""2026-11-18T11:06:40Z."""


def test_a_backup_has_identity_time_and_settings() -> None:
    text = backup_text("bow", "hipnuc-uart", {"product": "HI14", "serial_number": "04"}, {"mode": "6-axis"}, T_NS)
    assert yaml.safe_load(text) == {
        "device": "bow", "driver": "hipnuc-uart", "time": "2026-11-18T11:06:40Z",
        "identity": {"product": "HI14", "serial_number": "04"}, "settings": {"mode": "6-axis"},
    }  # fmt: skip
    assert text.startswith("# Settings of bow as the device reported them. `imud settings bow --restore FILE`")


def test_the_newest_of_each_device_are_kept_in_the_state_directory(tmp_path: Path) -> None:
    folder = BackupFolder(tmp_path)
    other = folder.write("bow-2", "x", T_NS)
    files = [folder.write("bow", str(number), T_NS + number * NS_PER_S) for number in range(BACKUPS_MAX + 3)]
    assert {file.name for file in (tmp_path / "backups").iterdir()} == {
        other.name, *(file.name for file in files[3:]),
    }  # fmt: skip
    assert (files[-1].name, files[-1].read_text()) == ("bow.20261118T110652.000000Z.yaml", "12")
    assert files[-1].stat().st_mode & 0o007 == 0
    with pytest.raises(OSError, match="no state directory"):
        BackupFolder(None).write("bow", "x", T_NS)
