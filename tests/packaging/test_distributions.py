"""Wheel and sdist contain all files. The installed backend builds them without the network."""

import importlib.util
import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from fnmatch import fnmatch
from pathlib import Path
from typing import Final

import pytest

from hatch_build import UPLOT
from imud import __version__
from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT

BUILD: Final = "from hatchling import build; print(build.build_{1}({0!r}))"
KERNEL: Final = "imud/_kernel.abi3.so"  # compiled by the build
NOT_DISTRIBUTED: Final = {".git", ".venv", "PKG-INFO"}
"""Names in the top folder that are not distributed: the repository, an environment, and the metadata of an sdist."""
needs_hatchling: Final = pytest.mark.skipif(
    importlib.util.find_spec("hatchling") is None and not os.environ.get("CI"),
    reason="cannot find hatchling (extra dev)",
)
pytestmark = [pytest.mark.live, needs_hatchling]


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("dist")
    return build(ROOT, folder, "wheel"), build(ROOT, folder, "sdist")


def build(tree: Path, folder: Path, what: str) -> Path:
    done = subprocess.run(
        [sys.executable, "-c", BUILD.format(str(folder), what)], cwd=tree, capture_output=True, text=True, check=False,
        timeout=LIMIT_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / done.stdout.strip()


def repository() -> set[str]:
    """Return the paths of all files of the repository that are distributed: all files that .gitignore does not
    exclude, and uPlot if it is installed."""
    patterns = [line for line in (ROOT / ".gitignore").read_text().splitlines() if line]

    def is_kept(name: str, *, folder: bool) -> bool:
        return not any(fnmatch(f"{name}/" if folder else name, pattern) for pattern in patterns)

    found = {str(path.relative_to(ROOT)) for path in (ROOT / UPLOT).rglob("*") if path.is_file()}
    for folder, folders, names in os.walk(ROOT):
        top = NOT_DISTRIBUTED if folder == str(ROOT) else set()
        folders[:] = [one for one in folders if one not in top and is_kept(one, folder=True)]
        files = [one for one in names if one not in top and is_kept(one, folder=False)]
        found |= {str(Path(folder, one).relative_to(ROOT)) for one in files}
    return found


def members(sdist: Path) -> dict[str, bytes]:
    with tarfile.open(sdist) as tar:
        read = {one.name.partition("/")[2]: tar.extractfile(one) for one in tar.getmembers() if one.isfile()}
        return {name: file.read() for name, file in read.items() if file is not None}


def test_a_wheel_without_a_compiler_has_only_python_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", str(tmp_path / "none"))
    wheel = build(ROOT, tmp_path, "wheel")
    assert wheel.name.endswith("-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as file:
        assert KERNEL not in file.namelist()


def test_the_wheel_has_every_file_of_the_package_as_it_is_and_no_other(distributions: tuple[Path, Path]) -> None:
    wanted = {path for path in repository() if path.startswith("imud/")}
    with zipfile.ZipFile(distributions[0]) as wheel:
        content = {name: wheel.read(name) for name in wheel.namelist() if ".dist-info/" not in name}
    assert content.keys() - {KERNEL} == wanted
    is_on = os.environ.get("IMUD_KERNEL") != "0"
    assert (KERNEL in content) is (is_on and shutil.which(os.environ.get("CC", "cc")) is not None)
    assert all(data == (ROOT / path).read_bytes() for path, data in content.items())
    for pattern in (
        "imud/py.typed",
        "imud/include/imud.h",
        "imud/web/static/*.html",
    ):
        assert any(fnmatch(path, pattern) for path in content), pattern


def test_the_wheel_starts_the_command_and_needs_what_the_project_says(distributions: tuple[Path, Path]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    with zipfile.ZipFile(distributions[0]) as wheel:
        info = f"imud-{__version__}.dist-info"
        entries = wheel.read(f"{info}/entry_points.txt").decode()
        metadata = message_from_bytes(wheel.read(f"{info}/METADATA"))
        assert f"{info}/licenses/LICENSE" in wheel.namelist()
    assert entries.split() == ["[console_scripts]", "imud", "=", "imud.cli:main"]
    plain = [text for text in metadata.get_all("Requires-Dist") or () if "extra ==" not in text]
    assert sorted(text.lower() for text in plain) == sorted(text.lower() for text in project["dependencies"])
    assert set(metadata.get_all("Provides-Extra") or ()) == set(project["optional-dependencies"])
    environment = {**os.environ, "PYTHONPATH": str(distributions[0])}
    code = "import sys, imud.cli; print(imud.__file__); sys.argv = ['imud', '--version']; imud.cli.main()"
    argv, folder = [sys.executable, "-c", code], distributions[0].parent
    said = subprocess.check_output(argv, cwd=folder, env=environment, text=True, timeout=LIMIT_S)
    assert said.splitlines() == [f"{distributions[0]}/imud/__init__.py", f"imud {__version__}"]


def test_the_sdist_has_every_file_of_the_repository_as_it_is(distributions: tuple[Path, Path]) -> None:
    """`make check` finds the same files in the sdist as in the repository."""
    content = members(distributions[1])
    assert content.keys() - {"PKG-INFO"} == repository()
    assert {"Makefile", ".ci/run", "tests/lab_debian/run", "docs/pictures/time_stamps.svg"} <= content.keys()
    assert all(data == (ROOT / path).read_bytes() for path, data in content.items() if path != "PKG-INFO")


def test_an_unpacked_sdist_is_checked_and_built_as_here(distributions: tuple[Path, Path], tmp_path: Path) -> None:
    with tarfile.open(distributions[1]) as tar:
        tar.extractall(tmp_path, filter="data")
    tree = tmp_path / f"imud-{__version__}"
    for program in (".ci/run", "packaging/debian/build"):
        assert os.access(tree / program, os.X_OK), program
    said = subprocess.check_output(["make", "--dry-run", "check"], cwd=tree, text=True, timeout=LIMIT_S)
    for program in ("ruff check .", "mypy", "pytest"):
        assert f"/{program}" in said
    (tmp_path / "again").mkdir()
    for what, first in zip(("wheel", "sdist"), distributions, strict=True):  # the same bytes in another folder
        assert build(tree, tmp_path / "again", what).read_bytes() == first.read_bytes(), what
