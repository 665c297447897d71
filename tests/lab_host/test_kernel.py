"""The build's own logic; the build itself is run by `make lab`."""

from pathlib import Path

import pytest

from tests.lab.host import kernel
from tests.lab.host.errors import LabError

FRAGMENT = "# a comment\nCONFIG_CAN=y\nCONFIG_HZ_250=y\n# CONFIG_VT is not set\n"


def test_configuration_taken() -> None:
    kernel.require_config(FRAGMENT, "CONFIG_CAN=y\nCONFIG_HZ_250=y\n# CONFIG_VT is not set\n")
    kernel.require_config(FRAGMENT, "CONFIG_CAN=y\nCONFIG_HZ_250=y\n")  # nothing offers VT at all


@pytest.mark.parametrize(
    ("got", "lost"),
    [
        ("CONFIG_CAN=m\nCONFIG_HZ_250=y\n", "CONFIG_CAN=y"),
        ("CONFIG_CAN=y\n", "CONFIG_HZ_250=y"),
        ("CONFIG_CAN=y\nCONFIG_HZ_250=y\nCONFIG_VT=y\n", "CONFIG_VT off"),
    ],
)
def test_configuration_lost(got: str, lost: str) -> None:
    with pytest.raises(LabError, match=f"the kernel did not take {lost}$"):
        kernel.require_config(FRAGMENT, got)


def test_fragment_names_no_option_twice() -> None:
    lines = kernel.CONFIG.read_text(encoding="ascii").splitlines()
    options = [line.removeprefix("# ").split("=")[0].split()[0] for line in lines if "CONFIG_" in line]
    assert len(options) == len(set(options))


def test_failed_step_quotes_the_first_error(tmp_path: Path) -> None:
    log = tmp_path / "build.log"
    with pytest.raises(LabError, match=r"build: sh -c failed: main.c:3: error: expected ';'"):
        kernel.step(
            ["sh", "-c", "echo fine; echo \"main.c:3: error: expected ';'\"; echo make: Error 1; exit 2"], tmp_path, log
        )
    assert "fine" in log.read_text(encoding="utf-8")


def test_full_disk_is_named(tmp_path: Path) -> None:
    with pytest.raises(LabError, match="tar: write: No space left on device"):
        kernel.step(["sh", "-c", "echo tar: write: No space left on device; exit 2"], tmp_path, tmp_path / "log")


def test_step_takes_too_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel, "STEP_LIMIT_S", 0.1)
    with pytest.raises(LabError, match="build: sleep took more than"):
        kernel.step(["sleep", "60"], tmp_path, tmp_path / "log")


def test_step_forgets_an_outer_make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Called from `make lab`, the kernel's make must not take over its flags and job server."""
    monkeypatch.setenv("MAKEFLAGS", "-n --jobserver-auth=3,4")
    log = tmp_path / "log"
    kernel.step(["sh", "-c", 'echo "flags=$MAKEFLAGS."'], tmp_path, log)
    assert log.read_text(encoding="utf-8") == "flags=.\n"


def test_trim_keeps_what_modules_are_built_from(tmp_path: Path) -> None:
    for folder in ("include", "scripts", "drivers/net", "arch/x86", "arch/arm", "tools/objtool", "tools/perf"):
        (tmp_path / folder).mkdir(parents=True)
    for file in ("Makefile", "Module.symvers", ".config", "vmlinux", "bzImage"):
        (tmp_path / file).touch()
    kernel.trim(tmp_path)
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")}
    assert left == {
        *("include", "scripts", "arch", "arch/x86", "tools", "tools/objtool"),
        *("Makefile", "Module.symvers", ".config", "bzImage"),
    }
