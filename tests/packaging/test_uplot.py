"""A build installs uPlot, or reports the reason and continues. The reasons come from replacements of npm."""

import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterable
from json import loads
from pathlib import Path
from typing import Final

import pytest

import hatch_build
from hatch_build import LOCK, UPLOT, UPLOT_FILES, different_file, install_uplot
from tests.packaging.test_distributions import BUILD, members, needs_hatchling
from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT, needs_uplot

pytestmark = pytest.mark.live
FAILING: Final = "echo 'npm error code ENOTFOUND' >&2; echo more >&2; exit 1"
INSTALLING: Final = f"test -f package-lock.json && mkdir node_modules && cp -r {ROOT / UPLOT} node_modules/"
SCRIPT: Final = "dist/uPlot.iife.min.js"
FILES: Final = {f"{UPLOT}/{name}" for name in UPLOT_FILES}


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Return the folder of a small checkout without uPlot."""
    tree = tmp_path / "checkout"
    (tree / "imud").mkdir(parents=True)
    names = ("pyproject.toml", "hatch_build.py", ".gitignore", "README.md", "LICENSE")
    for name in (*names, "imud/__init__.py", "imud/_kernel.c"):
        shutil.copy(ROOT / name, tree / name)
    shutil.copytree(ROOT / LOCK, tree / LOCK)
    return tree


def use_npm(monkeypatch: pytest.MonkeyPatch, folder: Path, script: str) -> None:
    """Replace npm with a script. An empty script removes npm. Switch the kernel off."""
    programs = folder / "programs"
    shutil.rmtree(programs, ignore_errors=True)
    programs.mkdir()
    for name in () if not script else ("cp", "mkdir", "sleep"):
        (programs / name).symlink_to(shutil.which(name, path=os.defpath) or name)
    if script:
        (programs / "npm").write_text(f"#!/bin/sh\n{script}\n")
        (programs / "npm").chmod(0o755)
    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.setenv("IMUD_KERNEL", "0")


def run(program: str, tree: Path, status: int = 0) -> subprocess.CompletedProcess[str]:
    """Run Python with a program or `-c` and a text. The kernel makes the status of hatch_build.py 1."""
    argv = [sys.executable, *program.split(" ", 1)]
    done = subprocess.run(argv, cwd=tree, capture_output=True, text=True, check=False, timeout=LIMIT_S)
    assert done.returncode == status, done.stdout + done.stderr
    return done


def build(tree: Path, what: str) -> tuple[dict[str, bytes], str]:
    """Build a wheel or an sdist. Return its files, and the messages of the build."""
    done = run(f"-c {BUILD.format(str(tree.parent), what)}", tree)
    path = tree.parent / done.stdout.strip()
    if what == "sdist":
        return members(path), done.stderr
    with zipfile.ZipFile(path) as wheel:
        return {name: wheel.read(name) for name in wheel.namelist()}, done.stderr


def uplot_of(names: Iterable[str]) -> set[str]:
    return {name for name in names if "/uplot/" in name}


def test_the_lock_file_has_a_digest_and_no_address() -> None:
    text = (ROOT / LOCK / "package-lock.json").read_text()
    (version,) = loads((ROOT / LOCK / "package.json").read_text())["dependencies"].values()
    locked = loads(text)["packages"]["node_modules/uplot"]
    assert (locked["version"], locked["integrity"][:7]) == (version, "sha512-")
    assert ("resolved" in text, "://" in text) == (False, False)


@needs_uplot
def test_the_installed_files_are_those_of_the_table() -> None:
    assert different_file(ROOT / UPLOT) == ""
    assert "The MIT License" in (ROOT / UPLOT / "LICENSE").read_text()


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("", "npm is missing; install npm"),
        (FAILING, "npm ci failed: npm error code ENOTFOUND; connect this host to the registry of npm"),
        ("exit 3", "npm ci failed: status 3; connect this host to the registry of npm"),
        ("exec sleep 60", "npm ci did not end in 0.2 s; connect this host to the registry of npm"),
        ("exit 0", f"{SCRIPT}: expected the SHA-256 {UPLOT_FILES[SCRIPT]}, got no file; correct UPLOT_FILES"),
    ],
)  # fmt: skip
def test_a_failed_installation_has_a_reason_and_removes_other_files(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, script: str, reason: str
) -> None:
    use_npm(monkeypatch, checkout.parent, script)
    monkeypatch.setattr(hatch_build, "NPM_S", 0.2 if "sleep" in script else LIMIT_S)
    (checkout / UPLOT).mkdir(parents=True)
    (checkout / UPLOT / "LICENSE").write_text("of another version")
    assert install_uplot(checkout) == reason
    assert not (checkout / UPLOT).exists()


def test_a_checkout_without_lock_file_has_a_reason(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_npm(monkeypatch, checkout.parent, FAILING)
    (checkout / LOCK / "package.json").unlink()
    assert "No such file" in install_uplot(checkout)


@needs_hatchling
@pytest.mark.parametrize(("script", "reason"), [("", "npm is missing; install npm"), (FAILING, "npm ci failed: ")])
def test_a_build_without_npm_reports_one_line_and_continues(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, script: str, reason: str
) -> None:
    use_npm(monkeypatch, checkout.parent, script)
    wheel, said = build(checkout, "wheel")
    assert uplot_of(wheel) == set()
    (line,) = (one for one in said.splitlines() if "uPlot" in one)
    assert line.startswith(f"imud is built without uPlot, imud web shows no plots: {reason}")
    assert line.endswith(", then build again (in a checkout: python hatch_build.py)")
    sdist, said = build(checkout, "sdist")
    assert (uplot_of(sdist), said.splitlines()) == (set(), [line])
    done = run("hatch_build.py", checkout, 1)
    assert done.stdout.splitlines()[1:] == [line]


@needs_hatchling
@needs_uplot
def test_an_sdist_contains_uplot_and_its_build_needs_no_npm(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_npm(monkeypatch, tmp_path, INSTALLING)
    sdist, said = build(checkout, "sdist")
    assert (uplot_of(sdist), said) == (FILES, "")
    use_npm(monkeypatch, tmp_path, FAILING)
    for name, data in sdist.items():
        (tmp_path / "sdist" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "sdist" / name).write_bytes(data)
    wheel, said = build(tmp_path / "sdist", "wheel")
    assert "uPlot" not in said
    assert {name: wheel[name] for name in uplot_of(wheel)} == {name: (ROOT / name).read_bytes() for name in FILES}


@needs_uplot
def test_the_program_installs_uplot_in_a_checkout(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_npm(monkeypatch, checkout.parent, INSTALLING)
    assert run("hatch_build.py", checkout, 1).stdout.splitlines()[1:] == [f"{UPLOT} contains uPlot"]
    assert different_file(checkout / UPLOT) == ""
