"""Documents of the Debian package: their links, and the pages that imud, units, examples and scripts refer to."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT
from tests.test_docs import ANCHOR_LINK, LINK, anchors, prose

pytestmark = pytest.mark.live

PROGRAM = ROOT / "packaging/debian/documents.py"
FOLDER = "/usr/share/doc/imud-daemon/"
PAGE = re.compile(r"docs/([\w-]+\.(?:md|schema\.json))(?:#(\w+))?")
"""Reference to a page in a text: its file name and anchor."""
TEXTS = [
    path
    for folder in ("imud", "etc", "systemd", "packaging")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in {"", ".py", ".c", ".h", ".yaml", ".yml", ".json", ".service", ".conf", ".rules", ".js", ".html"}
    or path.name.startswith("imud-daemon.")
    if path.is_file() and "uplot" not in path.parts
]
"""Files of the package, and the files that create the package."""


def copied(folder: Path, program: Path = PROGRAM) -> subprocess.CompletedProcess[str]:
    """Run documents.py."""
    argv = [sys.executable, str(program), str(folder)]
    return subprocess.run(argv, capture_output=True, text=True, check=False, timeout=LIMIT_S)


def test_the_package_contains_each_page_that_texts_and_links_name(tmp_path: Path) -> None:
    assert (
        f'"$python" packaging/debian/{PROGRAM.name} "$tree/root{FOLDER[:-1]}"\n'
        in (ROOT / "packaging/debian/build").read_text()
    )
    assert copied(tmp_path).returncode == 0
    pages = {file.relative_to(tmp_path).as_posix() for file in tmp_path.rglob("*.md")}
    assert {f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")} | {"README.md"} <= pages
    for file in map(tmp_path.joinpath, pages):
        for target in LINK.findall(prose(file)):
            assert "://" in target or (file.parent / target).is_file(), f"{file.name}: {target}"
        for target, anchor in ANCHOR_LINK.findall(prose(file)):
            page = file.parent / target if target else file
            assert page.suffix != ".md" or anchor in anchors(page), f"{file.name}: {target}#{anchor}"
    references = [(path, *found) for path in TEXTS for found in PAGE.findall(path.read_text())]
    assert len({path for path, *_ in references}) > 30
    assert [one for one in references if not (tmp_path / "docs" / one[1]).is_file()] == []
    wrong = [(path, anchor) for path, page, anchor in references if anchor not in anchors(tmp_path / "docs" / page)]
    assert [one for one in wrong if one[1]] == []


def test_paths_of_documents_in_units_and_scripts_exist(tmp_path: Path) -> None:
    assert copied(tmp_path).returncode == 0
    pattern = re.compile(rf"{FOLDER}([\w./-]*\w)")
    found = {(path.name, target) for path in TEXTS for target in pattern.findall(path.read_text())}
    generated = {("build", "examples"), ("changelog", "changelog.gz")}
    assert {name for name, _ in found} >= {"imud.service", "imud-web.service", "imud-daemon.postinst"}
    assert [one for one in found - generated if not (tmp_path / one[1]).exists()] == []


def test_a_link_without_a_file_ends_the_build(tmp_path: Path) -> None:
    program = tmp_path / "source/packaging/debian" / PROGRAM.name
    program.parent.mkdir(parents=True)
    program.write_text(PROGRAM.read_text())
    (tmp_path / "source/README.md").write_text("[a](https://example.org/) [b](#b) [c](docs/c.md#d)\n")
    done = copied(tmp_path / "out", program)
    assert done.returncode == 1
    assert done.stderr.endswith(f"expected the target of a link, got no file {tmp_path}/source/docs/c.md\n")
