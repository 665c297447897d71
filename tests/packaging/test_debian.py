"""Checks of the Debian package without a build. `make deb` builds it."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from imud import __version__
from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT

pytestmark = pytest.mark.live

DEBIAN = ROOT / "packaging" / "debian"
SCRIPTS = ("imud-daemon.postinst", "imud-daemon.prerm", "imud-daemon.postrm")


def fields(text: str) -> dict[str, str]:
    found: dict[str, str] = {}
    name = ""
    for line in text.splitlines():
        if line[:1] == " ":
            found[name] += "\n" + line
        else:
            name, _, value = line.partition(":")
            found[name] = value.strip()
    return found


def test_scripts_are_shell() -> None:
    for name in SCRIPTS:
        text = (DEBIAN / name).read_text()
        assert text.startswith("#!/bin/sh\nset -e\n")
        assert text.count("\n#DEBHELPER#\n") == 1
        subprocess.run(["sh", "-n", str(DEBIAN / name)], check=True, timeout=LIMIT_S)
    for name in ["build", "cross", "try", "unit"]:
        assert os.access(DEBIAN / name, os.X_OK)
        subprocess.run(["bash", "-n", str(DEBIAN / name)], check=True, timeout=LIMIT_S)


def run_script(name: str, *arguments: str, root: Path) -> str:
    """Run a script of the package with its paths below `root`. Return its output."""
    text = (DEBIAN / name).read_text()
    places = "usr/lib/imud|usr/lib/systemd/system|var/lib/imud|etc/imud|run/udev|run/systemd/system"
    moved = re.sub(rf"(?<![\w/])/({places})", rf"{root}/\1", text)
    assert moved != text
    argv = ["sh", "-c", moved, name, *arguments]
    return subprocess.run(argv, check=True, timeout=LIMIT_S, stdout=subprocess.PIPE, text=True).stdout


def test_only_a_purge_removes_the_state_and_never_that_of_another_package(tmp_path: Path) -> None:
    state = tmp_path / "var/lib/imud/state.json"
    state.parent.mkdir(parents=True)
    state.touch()
    extra = tmp_path / "usr/lib/imud/lib/python3.13/site-packages/numpy.py"
    extra.parent.mkdir(parents=True)
    extra.touch()
    for action in ("upgrade", "disappear", "abort-install", "remove"):
        assert extra.exists(), "only a removal deletes the libraries that pip installed"
        run_script("imud-daemon.postrm", action, root=tmp_path)
        assert state.exists(), action
    assert not (tmp_path / "usr/lib/imud").exists()
    run_script("imud-daemon.postrm", "purge", root=tmp_path)
    assert not state.parent.exists()
    unit, state = tmp_path / "usr/lib/systemd/system/imud.service", tmp_path / "var/lib/imud/theirs"
    for path in (unit, state):
        path.parent.mkdir(parents=True)
        path.touch()
    run_script("imud-daemon.postrm", "purge", root=tmp_path)
    assert state.exists()
    unit.unlink()
    run_script("imud-daemon.postrm", "purge", root=tmp_path)
    assert not state.exists()


def test_what_was_compiled_at_the_installation_goes_before_the_package(tmp_path: Path) -> None:
    (tmp_path / "usr/lib/imud/bin").mkdir(parents=True)
    library = tmp_path / "usr/lib/imud/lib"
    library.mkdir()
    (library / "one.py").touch()
    (tmp_path / "usr/lib/imud/bin/python3").symlink_to(sys.executable)
    first, *_ = run_script("imud-daemon.postinst", "configure", "", root=tmp_path).splitlines()
    assert first.startswith("imud-daemon: next step: run 'sudo imud setup'.")
    assert run_script("imud-daemon.postinst", "configure", "0.1.0-1", root=tmp_path) == "", "an upgrade"
    assert list(library.rglob("*.pyc"))
    run_script("imud-daemon.prerm", "remove", root=tmp_path)
    assert list(library.iterdir()) == [library / "one.py"]
    run_script("imud-daemon.prerm", "remove", root=tmp_path / "nothing")


def test_a_removal_stops_the_service_and_an_upgrade_does_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = tmp_path / "calls"
    (tmp_path / "bin").mkdir()
    stub = tmp_path / "bin/deb-systemd-invoke"
    stub.write_text(f'#!/bin/sh\necho "$@" >>{calls}\nexit 1\n')
    stub.chmod(0o755)
    monkeypatch.setenv("PATH", f"{stub.parent}:{os.environ['PATH']}")
    run_script("imud-daemon.prerm", "remove", root=tmp_path)
    assert not calls.exists(), "no systemd runs"
    (tmp_path / "run/systemd/system").mkdir(parents=True)
    run_script("imud-daemon.prerm", "upgrade", "0.2.0-1", root=tmp_path)
    assert not calls.exists()
    run_script("imud-daemon.prerm", "remove", root=tmp_path)
    assert calls.read_text() == "stop imud-web.service imud.service\n"


def test_control_overrides_and_version() -> None:
    source, package = map(fields, (DEBIAN / "control").read_text().strip().split("\n\n"))
    assert source["Source"] == package["Package"] == "imud-daemon"
    assert {"Maintainer", "Section", "Priority", "Standards-Version"} <= source.keys()
    assert package["Architecture"] == "any"
    assert "@PYTHON@" in package["Depends"]
    assert "${misc:Depends}" in package["Depends"]
    summary, *rest = package["Description"].splitlines()
    assert len(summary) < 80
    assert rest
    assert all(len(line) <= 80 for line in rest)
    lines = (DEBIAN / "imud-daemon.lintian-overrides").read_text().splitlines()
    assert lines[0].startswith("# ")
    assert all(re.match(r"# |imud-daemon( \[arm64 armhf\])?: ", line) for line in lines)
    assert (DEBIAN / "imud.py").read_text().startswith("#!/usr/lib/imud/bin/python3 -I\n")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == __version__
    assert re.match(r"imud-daemon \(@VERSION@-1~@RELEASE@\) @RELEASE@; ", (DEBIAN / "changelog").read_text())


OTHERS = {
    "imud": "/usr/bin/imud, imud.service, 60-imud.rules; github.com/richcreations/imud, version 1.6.1",
    "libimud-dev": "/usr/include/imud.h; of the same project",
}
"""Packages of other projects, with their files at the same paths as files of imud."""


def test_conflicts_extras_units_files_and_groups_of_the_package() -> None:
    _, package = map(fields, (DEBIAN / "control").read_text().strip().split("\n\n"))
    assert package["Package"] not in OTHERS, "apt would upgrade the one to the other"
    assert set(package["Conflicts"].split(", ")) == OTHERS.keys(), "without versions: whatever theirs is"
    assert not {"Provides", "Replaces", "Breaks"} & package.keys(), "imud-mqtt and others of theirs depend on imud"
    page = (ROOT / "docs/install.md").read_text()
    assert all(f"`{name}`" in page for name in (package["Package"], *OTHERS))
    _, installing, removing = re.split(r"^```sh$", page.partition("## By hand")[2], flags=re.M)
    (extras,) = re.findall(r"pip install '\.\[(.*)\]'", installing)
    assert f'"imud[{extras}]==$imud"' in (DEBIAN / "build").read_text()
    for unit in ("imud.service", "imud-web.service"):
        assert f"systemd/{unit}" in installing
        assert f"/etc/systemd/system/{unit}" in removing
    text = (DEBIAN / "build").read_text()
    taken = re.findall(r" ((?:packaging/debian|etc|systemd|imud/include)/[\w./-]+\w)(?= |\n|$)", text)
    assert len(taken) >= 8
    assert all((ROOT / one).is_file() for one in taken), taken
    (names,) = re.findall(r"for file in ([^;]*);", text)
    assert {"control", "changelog", "rules", *SCRIPTS} <= set(names.replace("\\", "").split())
    assert all((DEBIAN / one).is_file() for one in names.replace("\\", "").split())
    sysusers = (ROOT / "systemd/imud.sysusers.conf").read_text()
    made = set(re.findall(r"^g (\S+)", sysusers, re.MULTILINE))
    member_of = set(re.findall(r"^m imud (\S+)$", sysusers, re.MULTILINE))
    groups = re.findall(r"^Group=(.*)$", (ROOT / "systemd/imud.service").read_text(), re.MULTILINE)
    rules = re.findall(r'GROUP="(\w+)"', (ROOT / "etc/udev/60-imud.rules").read_text())
    assert {*groups, *member_of} <= made
    assert member_of == {"dialout", *rules}


def unit_for(release: str, text: str) -> subprocess.CompletedProcess[str]:
    argv = [str(DEBIAN / "unit"), release]
    return subprocess.run(argv, input=text, capture_output=True, text=True, check=False, timeout=LIMIT_S)


def test_the_unit_of_a_release_reloads_as_its_systemd_can() -> None:
    text = (ROOT / "systemd/imud.service").read_text()
    assert unit_for("bookworm", text).stdout == text
    lines = unit_for("trixie", text).stdout.splitlines()
    assert [line for line in lines if line.startswith("Type=")] == ["Type=notify-reload"]
    assert len(lines) == len(text.splitlines()) - 1, "all but ExecReload="
    assert set(text.splitlines()) - set(lines) == {"Type=notify", "ExecReload=/bin/kill -HUP $MAINPID"}
    for release, text in [
        ("trixie", "[Service]\nType = notify\nExecReload=/bin/kill\n"), ("trixie", "[Service]\nType=notify \n"),
        ("trixie", "[Service]\nType=simple\n"), ("trixie", "[Service]\nType=notify\nExecReload=\nType=notify\n"),
        ("bookworm", "[Service]\nType=notify\n"),
        ("bookworm", "[Service]\nType=notify-reload\nExecReload=/bin/kill\n"),
    ]:  # fmt: skip
        done = unit_for(release, text)
        assert (done.returncode, done.stdout) == (1, "")
        assert "expected one Type=" in done.stderr


def test_without_lintian_ci_makes_no_package(tmp_path: Path) -> None:
    for name in ("dirname", "true"):
        (tmp_path / name).symlink_to(shutil.which(name) or "/bin/false")
    (tmp_path / "dh").symlink_to(tmp_path / "true")
    argv = ["/bin/bash", str(DEBIAN / "build"), "sid", "amd64"]
    for ci, said in (("true", "lintian is missing, and CI=true"), ("", "expected the release")):
        environment = {"PATH": str(tmp_path), "CI": ci}
        done = subprocess.run(argv, env=environment, capture_output=True, text=True, check=False, timeout=LIMIT_S)
        assert (done.returncode, said in done.stderr) == (1, True), done.stderr
    assert "THIS PACKAGE IS NOT CHECKED" in (DEBIAN / "build").read_text()


@pytest.mark.skipif(shutil.which("pkg-config") is None, reason="cannot find pkg-config")
def test_pkg_config_reads_its_file(tmp_path: Path) -> None:
    (tmp_path / "imud.pc").write_text((DEBIAN / "imud.pc").read_text().replace("@VERSION@", __version__))
    argv = ["pkg-config", "--modversion", "imud"]
    environment = {**os.environ, "PKG_CONFIG_PATH": str(tmp_path)}
    done = subprocess.run(argv, env=environment, capture_output=True, text=True, check=True, timeout=LIMIT_S)
    assert done.stdout.strip() == __version__


def library(folder: Path, name: str, **texts: str) -> None:
    """Create a library like an installed wheel, with these license files."""
    info = folder / f"{name}-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\nAuthor: A. Uthor\n")
    (folder / f"{name}.py").touch()
    for file, text in texts.items():
        (info / file).write_text(text)
    files = [f"{name}.py", *(f"{info.name}/{file}" for file in ("METADATA", "RECORD", *texts))]
    (info / "RECORD").write_text("".join(f"{file},,\n" for file in files))


def copyright_of(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run copyright.py on a folder of installed wheels with the license of uPlot."""
    uplot = folder / "imud/web/static/uplot"
    uplot.mkdir(parents=True, exist_ok=True)
    (uplot / "LICENSE").write_text("The MIT License (MIT)\n\nCopyright (c) 2022 Leon Sorokin\n")
    return copyright_py(folder)


def copyright_py(folder: Path) -> subprocess.CompletedProcess[str]:
    argv = [sys.executable, str(DEBIAN / "copyright.py"), str(folder)]
    return subprocess.run(argv, capture_output=True, text=True, check=False, timeout=LIMIT_S)


def test_copyright_refuses_a_wheel_without_uplot(tmp_path: Path) -> None:
    done = copyright_py(tmp_path)
    assert (done.returncode, "uplot/LICENSE'; install npm, then build again" in done.stderr) == (1, True), done.stderr


def test_copyright_has_each_library_with_its_text_or_refuses_it(tmp_path: Path) -> None:
    library(tmp_path, "one", LICENSE="Copyright (c) 2020 Someone\n\nDo what you like.\n")
    library(tmp_path, "two", LICENSE="  Apache License\n  Version 2.0, January 2004\n")
    library(tmp_path, "pyserial")
    text = copyright_of(tmp_path).stdout
    uplot = "*/site-packages/imud/web/static/uplot/*"
    assert f"Files: {uplot}\nCopyright: Copyright (c) 2022 Leon Sorokin\nLicense: uplot\n" in text
    assert "Files: */site-packages/one-1.dist-info* */site-packages/one.py*\n" in text
    assert "Copyright: Copyright (c) 2020 Someone\nLicense: one\n Copyright (c) 2020 Someone\n .\n Do what" in text
    place = "/usr/share/common-licenses/Apache-2.0"
    assert f"Copyright: A. Uthor\nLicense: two\n The text of Apache-2.0 is in {place}." in text
    assert "License: pyserial\n Redistribution and use" in text
    library(tmp_path, "bare")
    done = copyright_of(tmp_path)
    assert done.returncode == 1
    assert "expected a license text in the wheel of bare" in done.stderr
