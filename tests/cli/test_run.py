"""`imud check`; `imud run` is tested as a process in tests/test_daemon.py."""

from pathlib import Path

import pytest

from imud.cli import main
from tests.support.files import ROOT


def test_check_accepts_the_shipped_file_and_names_a_mistake(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shipped = ROOT / "etc" / "imud.yaml"
    assert main(["check", str(shipped)]) == 0
    assert "good" in capsys.readouterr().out
    bad = tmp_path / "bad.yaml"
    bad.write_text("devices:\n  bow:\n    uart:\n      port: /dev/ttyUSB0\n      baut: 9600\n")
    assert main(["check", str(bad)]) == 2
    error = capsys.readouterr().err
    assert "bad.yaml:5:" in error
    assert "baud" in error
