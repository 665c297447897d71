"""The runner as a program: its exit status and its one line, with a shell script in QEMU's place."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.lab.host import __main__ as program
from tests.lab.host import environment, guest, kernel, monitor, packages
from tests.lab.host.errors import HungGuest
from tests.lab.host.qemu import QEMU
from tests.lab_host.conftest import FakeProgram

RUN = environment.ROOT / "tests" / "lab" / "run"
FIND_SHARE = "for word; do case $word in *mount_tag=lab*) share=${word#*path=}; share=${share%%,*};; esac; done"
"""Shell: the run's folder, from QEMU's own arguments."""


def run(*arguments: str, limit_s: float = 30.0) -> subprocess.CompletedProcess[str]:
    """tests/lab/run to its end."""
    return subprocess.run([RUN, *arguments], capture_output=True, text=True, timeout=limit_s, check=False)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--frob"], "lab: unrecognized arguments: --frob (tests/lab/run --help)\n"),
        (["--memory", "much"], "lab: argument --memory: invalid int value: 'much' (tests/lab/run --help)\n"),
        (["--memory", "64"], "lab: --memory 64: the guest needs at least 256 MB\n"),
        (["--processors", "0"], "lab: --processors 0: give 1 to 2\n"),
        (["--limit", "0"], "lab: --limit 0.0: give seconds above 0\n"),
        (["--limit", "nan"], "lab: --limit nan: give seconds above 0\n"),
    ],
)
def test_bad_options_are_one_line(arguments: list[str], line: str) -> None:
    result = run(*arguments)
    assert (result.returncode, result.stdout, result.stderr) == (program.LAB_FAILED, "", line)


def test_missing_package_is_one_line(fake_program: FakeProgram) -> None:
    fake_program("dpkg-query", "exit 1")
    result = run()
    assert result.returncode == program.LAB_FAILED
    assert (
        result.stderr == f"lab: missing Debian packages: {' '.join(packages.PACKAGES)} (make lab-deps installs them)\n"
    )


def test_machine_without_qemu_leaves_the_lab_out_in_ci(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert program.lab(["--ci"]) == 0
    assert capsys.readouterr().err == f"lab: left out: {QEMU} is not installed (make lab-deps installs it)\n"


@pytest.fixture
def fake_lab(fake_program: FakeProgram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Everything installed and built; returns the options that point at it. QEMU is left to the test."""
    fake_program("dpkg-query", "\n".join(f"echo {name} installed 1" for name in packages.PACKAGES))
    built = tmp_path / "built"
    built.mkdir()
    for name in (kernel.IMAGE, kernel.MODULE):
        (built / name).touch()
    monkeypatch.setattr(kernel, "built", lambda _say: built)
    return ["--output", str(tmp_path / "out"), "--venv", sys.prefix]


def test_status_report_and_output_come_back(
    fake_program: FakeProgram, fake_lab: list[str], tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    fake_program(QEMU, f"{FIND_SHARE}\ncat $share/script; echo '<x/>' >$share/junit.xml; echo 5 >$share/status")
    assert program.lab([*fake_lab, "--", "-k", "can or spi"]) == 5
    captured = capfdbinary.readouterr()
    assert captured.out.endswith(b"-k 'can or spi'\n")
    assert captured.err.startswith(b"lab: guest ran ")
    assert os.listdir(tmp_path / "out") == ["junit.xml"]


def test_panic_keeps_the_console(
    fake_program: FakeProgram,
    fake_lab: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    fake_program(QEMU, f"{FIND_SHARE}\necho 'Kernel panic - not syncing: oh' >$share/console.log")
    monkeypatch.setattr(sys, "argv", ["run", *fake_lab])
    handler = signal.getsignal(signal.SIGTERM)
    try:
        assert program.main() == program.LAB_FAILED
    finally:
        signal.signal(signal.SIGTERM, handler)
    assert capsys.readouterr().err.splitlines() == [
        f"lab: kept {tmp_path}/out/console.log",
        "lab: kernel panic in the guest: Kernel panic - not syncing: oh",
    ]
    assert os.listdir(tmp_path / "out") == ["console.log"]


@pytest.mark.parametrize(("hangs", "status"), [(1, 5), (2, None)])
def test_a_guest_that_hangs_is_booted_once_more(
    fake_program: FakeProgram,
    fake_lab: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    hangs: int,
    status: int | None,
) -> None:
    monkeypatch.setattr(guest.Limits, "silence_s", 0.2)
    monkeypatch.setattr(monitor, "ANSWER_S", 0.1)
    boots = tmp_path / "boots"
    hang = f"if [ $(wc -l <{boots}) -le {hangs} ]; then : >$share/alive; exec sleep 60; fi"
    fake_program(QEMU, f"{FIND_SHARE}\necho >>{boots}\n{hang}\necho 5 >$share/status")
    if status is None:
        with pytest.raises(HungGuest, match="no sign of life"):
            program.lab(fake_lab)
    else:
        assert program.lab(fake_lab) == status
    assert boots.read_text() == "\n\n"
    said = capsys.readouterr().err.splitlines()
    assert sum(line.startswith("lab: hung guest") and line.endswith("; booting once more") for line in said) == 1


def test_lab_is_not_collected_outside_the_guest() -> None:
    """The ordinary run skips tests/lab and says so, even when asked for it by name."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "tests/lab"]
    variables = {name: value for name, value in os.environ.items() if name != "IMUD_LAB"}
    result = subprocess.run(
        command, capture_output=True, text=True, timeout=50, check=False, cwd=environment.ROOT, env=variables
    )
    assert "tests/lab left out: it runs in the lab's kernel (make lab)" in result.stdout
    assert "no tests ran" in result.stdout
    assert result.returncode == pytest.ExitCode.NO_TESTS_COLLECTED


def test_deps_script_is_the_packages_program(fake_program: FakeProgram) -> None:
    fake_program("dpkg-query", "exit 1")
    script = Path(RUN).with_name("deps")
    result = subprocess.run([script, "--check"], capture_output=True, text=True, timeout=30, check=False)
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)
