"""The shell completions contain all commands, and each shell accepts its file."""

import shutil
import subprocess
from pathlib import Path

import pytest

from docs.generate.completions import FILES, completions
from imud.cli import COMMANDS
from tests.support.daemon_process import LIMIT_S

pytestmark = pytest.mark.live
pytest.importorskip("shtab", reason="cannot find shtab (extra dev)")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completions")
    for file, text in completions().items():
        (path / file).parent.mkdir()
        (path / file).write_text(text)
    return path


def test_every_shell_can_read_its_file_and_knows_all_commands(folder: Path) -> None:
    for shell in FILES:
        text = (folder / FILES[shell]).read_text()
        for command in (*COMMANDS, "scan", "assign"):
            assert command in text
        assert "convention" in text
        assert "ned-frd" in text
    for shell in FILES:
        if shutil.which(shell) is None:
            pytest.skip(f"cannot find {shell}")
        subprocess.run([shell, "-n", str(folder / FILES[shell])], check=True, timeout=LIMIT_S)


def completed_by_bash(folder: Path, *words: str) -> list[str]:
    script = 'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _shtab_imud; echo "${COMPREPLY[@]}"'
    argv = ["bash", "--norc", "-c", script, "bash", str(folder / FILES["bash"]), *words]
    return subprocess.run(argv, capture_output=True, text=True, check=True, timeout=LIMIT_S).stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="cannot find bash")
def test_bash_completes_commands_options_values_and_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert completed_by_bash(folder, "imud", "wa") == ["watch"]
    assert completed_by_bash(folder, "imud", "watch", "--conv") == ["--convention"]
    assert completed_by_bash(folder, "imud", "watch", "--convention", "n") == ["ned-frd"]
    (folder / "boat.yaml").touch()
    monkeypatch.chdir(folder)
    assert completed_by_bash(folder, "imud", "check", "boa") == ["boat.yaml"]
