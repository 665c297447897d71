"""The unit tests on a foreign architecture: when they run, what they are given, what is made of their report."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import pytest

from tests.lab.host.environment import ROOT
from tests.lab.host.errors import LabError
from tests.lab_debian.host import __main__ as program
from tests.lab_debian.host import image, packages, unit_tests, user_mode
from tests.lab_debian.host.release import ARM64, Release
from tests.lab_host.conftest import FakeProgram, fake_program

__all__ = ["fake_program"]

TRIXIE_ARM64 = ARM64[0]
SITE = "usr/lib/imud/lib/python3.13/site-packages"


def case(place: str, inside: str = "") -> str:
    """A test in pytest's report."""
    return f'<testcase classname="{place}" name="test_it" time="0.5">{inside}</testcase>'


def report(*more: str) -> str:
    """A report with a test of each part that passed, and more."""
    places = ("tests.formats.test_can", "tests.clock.test_intervals", "tests.publishers.shm.test_publisher")
    passed = [case(place) for place in (*places, "tests.include.test_c_header")]
    return f"<testsuites><testsuite>{''.join([*passed, *more])}</testsuite></testsuites>"


# --- what they import -------------------------------------------------------------------------------------------------


def imported(path: Path, seen: set[Path]) -> Iterator[str]:
    """Names of the modules that a test file imports when it is read, and so its helpers in `tests`, and theirs."""
    if path in seen:
        return
    seen.add(path)
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            names = [one.name for one in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{one.name}" for one in node.names)]
        else:
            continue
        for name in names:
            yield name.partition(".")[0]
            helper = ROOT / f"{name.replace('.', '/')}.py"
            if name.startswith("tests.") and helper.exists():
                yield from imported(helper, seen)


def distribution(requirement: str) -> str:
    """Name of what a requirement asks for, as it is compared."""
    found = re.match(r"[\w.-]+", requirement)
    assert found, requirement
    return found[0].lower().replace("_", "-")


def test_what_the_tests_import_is_there() -> None:
    """In WHEELS, or among the libraries of imud itself, which its package has."""
    paths = [ROOT / name for part in unit_tests.PARTS.values() for name in part]
    files = [one for path in paths for one in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
    seen: set[Path] = set()
    names = {name for file in files for name in imported(file, seen)}
    assert {"pytest", "imud"} <= names
    owners = packages_distributions()
    foreign = names - set(sys.stdlib_module_names) - {"imud", "tests"}
    wanted = {name: {distribution(one) for one in owners.get(name, [name])} for name in foreign}
    given = {distribution(one) for one in (*user_mode.WHEELS, *(requires("imud") or ())) if "extra ==" not in one}
    assert {name: who for name, who in wanted.items() if not who & given} == {}


# --- what is run when -------------------------------------------------------------------------------------------------


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """What a run does, in its order; each part of it ends with 0, but the boot with 1."""
    steps: list[str] = []

    def unit(*_arguments: object) -> int:
        steps.append("unit tests")
        return 0

    def boot(_options: object, _release: object, groups: list[str], *_arguments: object) -> int:
        steps.append(f"boot {' '.join(groups)}".strip())
        return 1

    def built(_release: object, _say: object) -> image.Image:
        steps.append("image")
        return image.Image(tmp_path, tmp_path, tmp_path)

    monkeypatch.setattr(packages, "obstacle", lambda _release: "")
    monkeypatch.setattr(image, "built", built)
    monkeypatch.setattr(unit_tests, "run", unit)
    monkeypatch.setattr(program, "boot", boot)
    return steps


@pytest.mark.parametrize(
    ("arguments", "steps", "status"),
    [
        (["--arm64"], ["image", "unit tests", "boot"], 1),
        (["--arm64", "unit-tests"], ["unit tests"], 0),
        (["--arm64", "unit-tests", "doctor"], ["image", "unit tests", "boot doctor"], 1),
        (["--arm64", "doctor", "streaming"], ["image", "boot doctor streaming"], 1),
        (["--arm64", "--exec", "true"], ["image", "boot"], 1),
        (["--suite", "trixie"], ["image", "boot"], 1),
    ],
)
def test_a_run_has_the_groups_that_were_asked_for(
    arguments: list[str], steps: list[str], status: int, done: list[str]
) -> None:
    assert program.lab(["--package", "imud.deb", *arguments]) == status
    assert done == steps


def test_the_worst_status_is_the_runs(done: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unit_tests, "run", lambda *_arguments: 1)
    monkeypatch.setattr(program, "boot", lambda *_arguments: 0)
    assert program.lab(["--package", "imud.deb", "--arm64"]) == 1


# --- one run, with a shell script in place of the program that enters the root file system ----------------------------


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of imud for trixie, with one library."""
    tree = tmp_path / "tree"
    (tree / "DEBIAN").mkdir(parents=True)
    (tree / "DEBIAN/control").write_text(
        "Package: imud-daemon\nVersion: 1\nArchitecture: arm64\nMaintainer: a <a@localhost>\nDescription: it\n"
    )
    for name in ("imud", "yaml"):
        (tree / SITE / name).mkdir(parents=True)
    result = tmp_path / "imud.deb"
    subprocess.run(["dpkg-deb", "--build", str(tree), str(result)], check=True, stdout=subprocess.DEVNULL)
    return result


@pytest.fixture
def entered(fake_program: FakeProgram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeProgram:
    """Takes the text of a shell script that stands for the programs in the root file system; $work is /mnt there."""
    monkeypatch.setattr(user_mode, "built", lambda *_arguments: tmp_path / "made")

    def enter(name: str, text: str) -> Path:
        place = fake_program(
            name, f'while [ "$1" != {tmp_path}/made ]; do shift; done\nwork=$2 tree=$3\nshift 3\n{text}'
        )
        monkeypatch.setitem(image.CLEAN, "PATH", f"{place.parent}:/usr/bin:/bin")
        return place

    return enter


def run(package: Path, output: Path) -> int:
    """One run."""
    return unit_tests.run(TRIXIE_ARM64, package, Path("python"), output, lambda _line: None)


def test_the_tests_run_on_the_packages_libraries_and_the_repositorys_imud(
    entered: FakeProgram, package: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entered(
        "unshare",
        f"""
        [ -d $work/package/{SITE}/yaml ] && [ ! -e $work/package/{SITE}/imud ] && [ $tree = {ROOT} ] || exit 3
        [ $PYTHONPATH = /opt/site:/mnt/package/{SITE} ] || exit 4
        case "$*" in *" --chdir=/mnt/tree /usr/bin/python3 -m pytest "*" tests/include") ;; *) exit 5;; esac
        echo '{report(case("tests.devices.hipnuc.uart.test_codec", "<skipped/>"))}' >$work/{unit_tests.REPORT}""",
    )
    assert run(package, tmp_path / "out") == 0
    assert capsys.readouterr().out.splitlines() == [
        "PASS    1.0 s  unit-tests: codecs: 1 passed, 1 skipped, 0 failed",
        "PASS    0.5 s  unit-tests: clock: 1 passed, 0 skipped, 0 failed",
        "PASS    0.5 s  unit-tests: ring: 1 passed, 0 skipped, 0 failed",
        "PASS    0.5 s  unit-tests: C header: 1 passed, 0 skipped, 0 failed",
    ]
    assert (tmp_path / "out" / unit_tests.REPORT).exists()


def test_a_status_of_pytest_that_no_test_explains_is_a_failure(
    entered: FakeProgram, package: Path, tmp_path: Path
) -> None:
    entered("unshare", f"echo '{report()}' >$work/{unit_tests.REPORT}; exit 2")
    assert run(package, tmp_path / "out") == 1


def test_a_run_without_a_report_is_one_line(entered: FakeProgram, package: Path, tmp_path: Path) -> None:
    entered("unshare", "echo 'mount: not permitted'; exit 32")
    with pytest.raises(LabError, match=r"the unit tests on trixie-arm64 ended with 32: mount: not permitted"):
        run(package, tmp_path / "out")


def test_a_package_of_another_release_is_named(package: Path, tmp_path: Path) -> None:
    with pytest.raises(
        LabError, match=r"has no usr/lib/imud/lib/python3.11/site-packages: is it one for bookworm-arm64"
    ):
        unit_tests.unpack(package, tmp_path, Release("bookworm", "arm64"))


# --- the report -------------------------------------------------------------------------------------------------------


def test_a_test_that_failed_is_shown_with_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    failed = case("tests.clock.test_intervals", '<failure message="no">first\nE  assert 1 == 2</failure>')
    broken = case("tests.include.test_c_header", '<error message="no compiler"/>')
    tallies = unit_tests.counted(report(failed, broken))
    assert not unit_tests.shown(tallies)
    out = capsys.readouterr().out
    assert "FAIL    1.0 s  unit-tests: clock: 1 passed, 0 skipped, 1 failed\n" in out
    assert "       tests/clock/test_intervals: test_it\n       first\n       E  assert 1 == 2\n" in out
    assert "no compiler" in out


def test_a_file_that_cannot_be_read_is_shown_with_its_error(capsys: pytest.CaptureFixture[str]) -> None:
    unread = (
        """<testcase classname="" name="tests.formats.test_rmc" time="0"><error>ImportError: x</error></testcase>"""
    )
    tallies = unit_tests.counted(report(unread))
    assert not unit_tests.shown(tallies)
    assert "ImportError: x" in capsys.readouterr().out


def test_a_part_of_which_no_test_ran_is_a_failure() -> None:
    skipped = f"<testsuite>{case('tests.clock.test_intervals', '<skipped/>')}</testsuite>"
    assert not any(tally.good for tally in unit_tests.counted(skipped).values())


def test_what_was_not_asked_for_is_named() -> None:
    with pytest.raises(LabError, match="outside of what was asked for: tests/cli/test_run"):
        unit_tests.counted(report(case("tests.cli.test_run")))


def test_the_parts_are_there() -> None:
    assert all((ROOT / path).exists() for paths in unit_tests.PARTS.values() for path in paths)


# --- the root file system ---------------------------------------------------------------------------------------------


def test_emulation_is_enabled_once(fake_program: FakeProgram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image, "BINFMT", tmp_path)
    folder = fake_program("mount", f"echo mount >>{tmp_path}/asked").parent
    fake_program("update-binfmts", f"echo $* >>{tmp_path}/asked; touch {tmp_path}/$2")
    monkeypatch.setitem(image.CLEAN, "PATH", f"{folder}:/usr/bin:/bin")
    for architecture in ("amd64", "arm64", "arm64"):
        image.enable_emulation(architecture)
    assert (tmp_path / "asked").read_text() == "mount\n--enable qemu-aarch64\n"


def test_a_host_without_emulation_is_one_line(
    fake_program: FakeProgram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(image, "BINFMT", tmp_path)
    folder = fake_program("mount", "echo unknown filesystem type >&2; exit 32").parent
    monkeypatch.setitem(image.CLEAN, "PATH", f"{folder}:/usr/bin:/bin")
    with pytest.raises(LabError, match="programs for arm64 do not run here: mount: unknown filesystem type"):
        image.enable_emulation("arm64")


def test_wheels_are_those_of_the_release_and_a_failure_is_one_line(fake_program: FakeProgram, tmp_path: Path) -> None:
    pip = fake_program("python", f"echo $* >{tmp_path}/asked; echo; echo no such wheel >&2; exit 1")
    with pytest.raises(LabError, match="wheels for trixie-arm64: no such wheel"):
        user_mode.install_wheels(TRIXIE_ARM64, pip, tmp_path / "site")
    asked = (tmp_path / "asked").read_text()
    assert "--python-version 3.13 --platform manylinux_2_17_aarch64" in asked
    assert asked.endswith(f"{' '.join(user_mode.WHEELS)}\n")


def test_a_root_file_system_has_a_key_of_its_own() -> None:
    assert user_mode.key(TRIXIE_ARM64) != user_mode.key(Release("bookworm", "arm64"))
