"""Which packages are missing, and their installation, with fake dpkg-query and apt programs."""

import os
from pathlib import Path

import pytest

from tests.lab.host import packages
from tests.lab.host.errors import LabError
from tests.lab_host.conftest import FakeProgram

ALL_INSTALLED = "\n".join(f"echo {name} installed 1.2-3" for name in packages.PACKAGES)


@pytest.fixture
def no_programs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A PATH with nothing in it."""
    monkeypatch.setenv("PATH", str(tmp_path))


def test_nothing_missing(fake_program: FakeProgram, capsys: pytest.CaptureFixture[str]) -> None:
    fake_program("dpkg-query", ALL_INSTALLED)
    fake_program("apt-get", "echo must not be called; exit 1")
    assert packages.main([]) == 0
    assert capsys.readouterr().out == "lab: all packages are installed\n"
    assert packages.kernel_source_version() == "1.2-3"


def test_missing_packages_are_one_line(fake_program: FakeProgram, capsys: pytest.CaptureFixture[str]) -> None:
    """A package known to dpkg but removed (config-files) is missing as well."""
    script = ALL_INSTALLED.replace("flex installed", "flex config-files").replace("echo bison installed 1.2-3", "")
    fake_program("dpkg-query", f"{script}\nexit 1")
    assert packages.main(["--check"]) == 1
    assert capsys.readouterr().err == "lab: missing Debian packages: flex bison (make lab-deps installs them)\n"


@pytest.mark.usefixtures("no_programs")
def test_no_dpkg() -> None:
    with pytest.raises(LabError, match="dpkg-query is not there"):
        packages.missing()


def test_bad_argument(capsys: pytest.CaptureFixture[str]) -> None:
    assert packages.main(["--frob"]) == 1
    assert capsys.readouterr().err.count("\n") == 1


@pytest.fixture
def as_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """The effective user is root."""
    monkeypatch.setattr(os, "geteuid", lambda: 0)


@pytest.mark.usefixtures("as_root")
def test_install_asks_for_the_missing_only(fake_program: FakeProgram, tmp_path: Path) -> None:
    fake_program("apt-cache", "printf 'bc:\\n  Installed: (none)\\n  Candidate: 1.07\\n'")
    fake_program("apt-get", f'echo "$@" >>{tmp_path}/calls')
    packages.install(["bc"])
    calls = (tmp_path / "calls").read_text(encoding="utf-8").splitlines()
    assert calls == ["update", "install --yes --no-install-recommends bc"]


@pytest.mark.usefixtures("as_root")
def test_unknown_package_names_its_archive(fake_program: FakeProgram) -> None:
    fake_program("apt-cache", "printf 'bc:\\n  Installed: (none)\\n  Candidate: (none)\\n'")
    fake_program("apt-get", "exit 0")
    with pytest.raises(LabError, match=r"apt has no candidate for: bc linux-source-6.12 .*bookworm-security"):
        packages.install(["bc", packages.KERNEL_SOURCE])


@pytest.mark.usefixtures("as_root")
def test_apt_failure(fake_program: FakeProgram) -> None:
    fake_program("apt-get", "exit 100")
    with pytest.raises(LabError, match="apt-get update failed"):
        packages.install(["bc"])


@pytest.mark.usefixtures("no_programs")
def test_neither_root_nor_sudo(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(LabError, match="run as root: apt-get install bc"):
        packages.install(["bc"])
