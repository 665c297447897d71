"""The hook of hatchling compiles the kernel for the target that the environment names."""

import sysconfig
from pathlib import Path

import pytest

import hatch_build


def test_the_compiler_gets_the_folders_of_the_python_headers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler, arguments = tmp_path / "cc", tmp_path / "arguments"
    compiler.write_text(f'#!/bin/sh\necho "$@" >{arguments}\necho "error: stop" >&2\nexit 1\n')
    compiler.chmod(0o755)
    (tmp_path / "imud").mkdir()
    (tmp_path / hatch_build.SOURCE).touch()
    for value, expected in (("/a:/b", ["-I/a", "-I/b"]), ("", [f"-I{sysconfig.get_paths()['include']}"])):
        monkeypatch.setenv("IMUD_PYTHON_INCLUDE", value)
        assert hatch_build.compile_kernel(tmp_path, str(compiler)) == "error: stop"
        assert [one for one in arguments.read_text().split() if one.startswith("-I")] == expected
