"""packaging/release rejects wrong, incomplete and changed releases. Stubs replace gate, builds and trials."""

import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT

pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(not all(map(shutil.which, ("git", "make", "dpkg"))), reason="cannot find git, make and dpkg"),
]

MAKEFILE: Final = """
ARCH := $(shell dpkg --print-architecture)
wheels:
	mkdir -p build/dist
	echo wheel >build/dist/imud-1.2.3-py3-none-any.whl
apt-repository:
	mkdir -p build/apt/dists/trixie build/apt/pool/trixie
	echo signed >build/apt/dists/trixie/InRelease
	for arch in $(ARCH); do echo deb >build/apt/pool/trixie/imud-daemon_1.2.3-1~trixie_$$arch.deb; done
image-try:
	mkdir -p build/image
	echo image >build/image/imud-1.2.3-$(ARCH).tar
	packaging/image/try build/image/imud-1.2.3-$(ARCH).tar
"""
FILES: Final = {
    ".gitignore": "build/\n",
    "Makefile": MAKEFILE,
    "pyproject.toml": '[project]\nname = "imud"\nversion = "1.2.3"\n',
    "CHANGELOG.md": "# Changelog\n\n## 1.2.3 - 2026-11-28\n\n## 1.2.2\n",
    "packaging/image/compose.yaml": "",
    ".ci/run": 'echo "the gate runs"',
    ".ci/test-wheels": '[ "$REQUIRED" = yes ]',
    "packaging/apt/try": '[ -f "$1" ]',
    "packaging/image/try": '[ -f "$1" ]',
    # a key ring with the key AB12
    "build/bin/gpg": 'case "$*" in *detach-sign*) touch SHA256SUMS.asc ;; *) echo "[GNUPG:] VALIDSIG AB12" ;; esac',
}
ALL: Final = "wheels apt image"


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    is_program = path.suffix == "" and path.name not in {"Makefile", ".gitignore"}
    path.write_text(f"#!/bin/bash\n{text}\n" if is_program else text)
    path.chmod(0o755 if is_program else 0o644)


def git(tree: Path, *arguments: str) -> None:
    who = ("-c", "user.name=a", "-c", "user.email=a@b")
    subprocess.run(["git", *who, *arguments], cwd=tree, check=True, capture_output=True, timeout=LIMIT_S)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return a checkout of the tag v1.2.3."""
    for name, text in FILES.items():
        write(tmp_path / name, text)
    shutil.copy(ROOT / "packaging/release", tmp_path / "packaging/release")
    for arguments in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "a"], ["tag", "v1.2.3"]):
        git(tmp_path, *arguments)
    return tmp_path


def release(tree: Path, *options: str, **variables: str) -> tuple[int, str]:
    """Run the script. Return its exit status and its output."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("CI", "GIT_", "MAKE"))}
    done = subprocess.run(
        ["packaging/release", *options], cwd=tree, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        check=False, timeout=LIMIT_S,
        env={**kept, "PATH": f"{tree}/build/bin:{os.environ['PATH']}", "APT_KEY": "AB12", **variables},
    )  # fmt: skip
    return done.returncode, done.stdout


def test_a_release_is_built_verified_and_published(tree: Path) -> None:
    status, text = release(tree, RELEASE_KEY="AB12")
    assert status == 0, text
    assert "the gate runs" in text
    assert (tree / "build/release/SHA256SUMS.asc").exists()
    report = (tree / "build/release/report.txt").read_text()
    assert "gate: passed" in report
    for part in ("wheels: verified", "apt: verified imud-daemon_1.2.3", "image: verified"):
        assert part in report
    commands = {f"PUBLISH_{name}": f"cp -r . {tree}/build/public-{name}" for name in ("WHEELS", "SUMS")}
    status, text = release(tree, "--publish", CI="true", **commands)
    assert (status, text.splitlines()[-1]) == (
        0,
        "published: wheels sums; without a command, not published: apt image",
    )
    assert (tree / "build/public-WHEELS/imud-1.2.3-py3-none-any.whl").exists()
    assert (tree / "build/public-SUMS/SHA256SUMS").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pyproject.toml": '[project]\nversion = "1.2.4"\n'}, "expected the tag v1.2.4 of pyproject.toml"),
        ({"CHANGELOG.md": "## 1.2.4\n"}, "expected 1.2.3 as first entry of CHANGELOG.md, got '1.2.4'"),
        ({"new.txt": ""}, "expected a clean checkout"),
    ],
)  # fmt: skip
def test_only_a_clean_checkout_of_the_tag_is_released(tree: Path, changes: dict[str, str], message: str) -> None:
    for name, text in changes.items():
        write(tree / name, text)
    status, text = release(tree, "--no-gate")
    assert (status, message in text) == (1, True), text
    assert not (tree / "build/release").exists()


def test_a_commit_after_the_tag_is_not_released(tree: Path) -> None:
    git(tree, "commit", "-qm", "b", "--allow-empty")
    status, text = release(tree)
    assert (status, "expected the tag v1.2.3 of pyproject.toml at this commit, got ''" in text) == (1, True), text


@pytest.mark.parametrize(
    ("name", "text", "missing"),
    [
        (".ci/run", "exit 1", ALL),
        (".ci/test-wheels", "exit 1", ALL),
        ("packaging/apt/try", "exit 1", "apt image"),
        ("build/bin/gpg", "echo VALIDSIG CD34", "apt image"),
        (
            "Makefile",
            MAKEFILE.replace("in $(ARCH)", "in $(ARCH) riscv64"),
            "apt image",
        ),  # a package that cannot run here
        ("packaging/image/try", "exit 1", "image"),
        ("Makefile", MAKEFILE.replace("image-try:", "picture:"), "image"),
        ("packaging/image/try", "touch new.txt", ""),
    ],
)
def test_a_part_that_fails_makes_the_release_incomplete(tree: Path, name: str, text: str, missing: str) -> None:
    write(tree / name, text)
    git(tree, "add", "-A")
    git(tree, "commit", "-qm", "b", "--allow-empty")
    git(tree, "tag", "--force", "v1.2.3")
    status, said = release(tree)
    assert status != 0
    assert said.splitlines()[-1] == f"packaging/release: the release is incomplete, missing:{missing and ' '}{missing}"
    assert not (tree / "build/release/SHA256SUMS").exists()


def test_the_report_names_parts_and_checks_that_are_left_out(tree: Path) -> None:
    status, text = release(tree, "--no-gate", PARTS="wheels")
    assert status == 0, text
    assert "the gate runs" not in text
    assert "not signed" in text
    report = (tree / "build/release/report.txt").read_text()
    assert "gate: not verified" in report
    assert "apt: missing (PARTS=wheels)\nimage: missing (PARTS=wheels)" in report
    status, text = release(tree, PARTS="wheel")
    assert (status, "got 'wheel'" in text) == (1, True), text
    published = {"CI": "true", "PUBLISH_WHEELS": f"touch {tree}/build/published"}
    for variables, message in (
        ({**published}, "expected the verified part apt, got: apt: missing"),
        ({**published, "CI": ""}, "only a CI system publishes"),
        ({"CI": "true", "PARTS": "wheels"}, "expected a command in PUBLISH_WHEELS"),
    ):
        status, text = release(tree, "--publish", **variables)
        assert (status, message in text) == (1, True), text
        assert not (tree / "build/published").exists()


def test_a_changed_file_is_not_published(tree: Path) -> None:
    published = {"CI": "true", "PARTS": "wheels", "PUBLISH_WHEELS": f"touch {tree}/build/published"}
    status, text = release(tree, "--publish", **published)
    assert (status, "SHA256SUMS; try packaging/release without" in text) == (1, True), text
    assert release(tree, "--no-gate", PARTS="wheels")[0] == 0
    made = tree / "build/release"
    wheel = next((made / "wheels").iterdir())
    original = wheel.read_text()
    write(wheel, "changed\n")
    assert "a file changed after its verification" in release(tree, "--publish", **published)[1]
    wheel.unlink()
    assert "a file changed after its verification" in release(tree, "--publish", **published)[1]
    write(wheel, original)
    write(made / "wheels/new.whl", "")
    assert "expected the files of SHA256SUMS" in release(tree, "--publish", **published)[1]
    (made / "wheels/new.whl").unlink()
    git(tree, "commit", "-qm", "b", "--allow-empty")
    git(tree, "tag", "--force", "v1.2.3")
    assert "expected a release of commit" in release(tree, "--publish", **published)[1]
    assert not (tree / "build/published").exists()


def test_a_command_that_fails_ends_the_publication(tree: Path) -> None:
    assert release(tree, "--no-gate")[0] == 0
    status, text = release(tree, "--publish", CI="true", PUBLISH_WHEELS="true", PUBLISH_APT="false; true",
                           PUBLISH_SUMS=f"touch {tree}/build/published")  # fmt: skip
    assert status == 1
    assert text.splitlines()[-1] == (
        "packaging/release: PUBLISH_APT failed with status 1: false; true; published before: wheels; "
        "not published: apt sums; without a command: image"
    )
    assert not (tree / "build/published").exists()
