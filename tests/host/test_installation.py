"""The command that installs a library fits the environment of imud."""

import os
import shutil
import sys
from importlib import import_module
from pathlib import Path

import pytest

from imud.host import installation
from imud.model.errors import BadArgument, ServerError


@pytest.mark.parametrize(
    ("has_pip", "can_write", "has_system_pip", "uid", "command"),
    [
        (True, True, True, 1000, "/e/python3 -m pip install 'imud[web]'"),
        (True, False, True, 1000, "sudo /e/python3 -m pip install 'imud[web]'"),
        (False, True, True, 0, "python3 -m pip --python /e/python3 install 'imud[web]'"),
        (False, True, False, 0,
         "apt install python3-pip && python3 -m pip --python /e/python3 install 'imud[web]'"),
        (False, False, False, 1000,
         "sudo apt install python3-pip && sudo python3 -m pip --python /e/python3 install 'imud[web]'"),
        (False, True, False, 1000,
         "sudo apt install python3-pip && python3 -m pip --python /e/python3 install 'imud[web]'"),
    ],
)  # fmt: skip
def test_the_command_uses_the_pip_and_the_rights_of_the_environment(
    monkeypatch: pytest.MonkeyPatch, command: str, uid: int, *, has_pip: bool, can_write: bool, has_system_pip: bool
) -> None:
    monkeypatch.setattr(installation, "find_spec", lambda _name: object() if has_pip else None)
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}" if has_system_pip else None)
    monkeypatch.setattr(os, "access", lambda path, mode: can_write and (path, mode) == (sys.prefix, os.W_OK))
    monkeypatch.setattr(os, "geteuid", lambda: uid)
    monkeypatch.setattr(sys, "executable", "/e/python3")
    assert installation.install_command("imud[web]") == command


def test_an_import_that_fails_names_the_library_and_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "install_command", lambda requirement: f"get {requirement}")
    monkeypatch.setitem(sys.modules, "mcap.records", None)
    with (
        pytest.raises(ServerError, match=r"^cannot import mcap; install the extra export: get imud\[export\]$"),
        installation.needs_extra("export", ServerError),
    ):
        import_module("mcap.records")
    with pytest.raises(BadArgument, match="cannot import a library; "), installation.needs_extra("export"):
        raise ImportError("libpq")
    with pytest.raises(ModuleNotFoundError), installation.needs_extra("export"):
        import_module("imud.nothing")
    with pytest.raises(ModuleNotFoundError), installation.needs_extra(""):
        import_module("mcap.records")


def test_the_documents_are_in_the_checkout_in_the_package_or_in_the_source(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert Path(installation.documents(), "operate.md").is_file()
    monkeypatch.setattr(installation, "DOCUMENTS", (tmp_path / "checkout", tmp_path / "package"))
    assert installation.documents() == "docs in the source of imud"
    (tmp_path / "package/docs").mkdir(parents=True)
    (tmp_path / "package/docs/index.md").touch()
    assert installation.documents() == f"{tmp_path}/package/docs"
