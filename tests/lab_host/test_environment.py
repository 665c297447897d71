"""The guest's script and Python."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.lab.host import environment
from tests.lab.host.environment import Python
from tests.lab.host.errors import LabError

PYTHON = Python(Path("/venv"), Path("/base"))


def test_absent_virtual_environment(tmp_path: Path) -> None:
    with pytest.raises(LabError, match=r"no Python at .*/bin/python"):
        environment.find_python(tmp_path)


def test_virtual_environment_without_pytest(tmp_path: Path) -> None:
    interpreter = tmp_path / "bin" / "python"
    interpreter.parent.mkdir()
    interpreter.write_text(
        "#!/bin/sh\necho \"ModuleNotFoundError: No module named 'pytest'\" >&2\nexit 1\n", encoding="ascii"
    )
    interpreter.chmod(0o755)
    with pytest.raises(LabError, match="cannot run pytest: ModuleNotFoundError: No module named 'pytest'"):
        environment.find_python(tmp_path)


def test_this_environment_is_found() -> None:
    found = environment.find_python(Path(sys.prefix))
    assert found == Python(Path(sys.prefix), Path(sys.base_prefix))


def test_arguments_come_last_and_whole() -> None:
    command = environment.pytest_command(PYTHON, ["-k", "can and not j1939", "tests/lab/test_can.py"])
    assert command[:3] == ["/venv/bin/python", "-m", "pytest"]
    assert command[-3:] == ["-k", "can and not j1939", "tests/lab/test_can.py"]
    assert "testpaths=tests/lab" in command


def test_script_quotes_and_cleans(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command keeps its words, runs in the repository's root, and sees only the lab's variables."""
    monkeypatch.setenv("IMUD_SECRET", "1")
    show = 'import os, sys; print(sys.argv[1:], os.getcwd(), "IMUD_SECRET" in os.environ, os.environ["IMUD_LAB"])'
    text = environment.script(PYTHON, [sys.executable, "-c", show, "a b", "$HOME", "'"])
    output = subprocess.run(["sh", "-c", text], capture_output=True, text=True, check=True).stdout
    assert output == f"{['a b', '$HOME', chr(39)]} {environment.ROOT} False /run/lab\n"


def test_root_is_the_repository() -> None:
    assert (environment.ROOT / "tests" / "lab" / "run").exists()
    assert environment.shown_folders(PYTHON) == [environment.ROOT, Path("/venv"), Path("/base")]
