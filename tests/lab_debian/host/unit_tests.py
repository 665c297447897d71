"""The unit tests of codecs, clock, ring and C header with the Python of a foreign architecture.

They need no booted system. They run under qemu-user, which emulates neither memory nor devices of a machine, with the
libraries of imud's package for that architecture.
"""

import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

from tests.lab.host import results
from tests.lab.host.environment import ROOT
from tests.lab.host.errors import LabError
from tests.lab_debian.host import user_mode
from tests.lab_debian.host.release import PYTHONS, Release

NAME = "unit-tests"
CLOCK = (
    "arrival_fit", "arrival_time", "clock_even_run", "device_time_stamp_time", "device_utc", "edge_pairing",
)  # fmt: skip
"""Tests of the clock without tests that simulate hours of arrivals, which take several minutes each in emulation."""
PARTS = {
    "codecs": (
        "tests/formats",
        *sorted(
            str(path.relative_to(ROOT))
            for name in ("test_codec*", "test_common*", "test_can", "test_i2c", "test_spi", "test_nmea2000")
            for path in ROOT.glob(f"tests/drivers/**/{name}.py")
        ),
        *(f"tests/drivers/test_every_{kind}_driver.py" for kind in ("stream", "can", "polled")),
    ),
    "clock": tuple(f"tests/sampling/test_{name}.py" for name in CLOCK),
    "ring": ("tests/publishers/test_shm.py", "tests/client/test_ring.py"),
    "C header": ("tests/include",),
}
"""Folders and files of tests by subject, without tests of scripts, settings and simulators, which contain no layout of
bytes."""
TEST_LIMIT_S = 600
"""Time limit per test, s: ten times the normal limit."""
LIMIT_S = 3600.0  # all tests under qemu-user
REPORT = "unit-tests.xml"
LINES_SHOWN = 12  # last lines of the output after a failure


@dataclass
class Tally:
    passed: int = 0
    skipped: int = 0
    seconds: float = 0.0
    failures: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        return self.passed > 0 and not self.failures


def run(release: Release, package: Path, python: Path, output: Path, say: Callable[[str], None]) -> int:
    """Run all parts. Return 0 if all tests passed, otherwise 1. Raises LabError if the tests cannot run.

    `package` is imud's package, `python` has pip.
    """
    made = user_mode.built(release, python, say)
    start_s = time.monotonic()
    with results.run_folder(output) as work:
        result = pytest(made, work, unpack(package, work, release))
        report = work / REPORT
        if not report.exists():
            lines = result.stdout.strip().splitlines() or ["no output"]
            raise LabError(f"the unit tests on {release.name} failed with exit status {result.returncode}: {lines[-1]}")
        text = report.read_text(encoding="utf-8")
        shutil.copy(report, output / REPORT)
    good = shown(counted(text))
    say(f"{release.name}: the unit tests ran {time.monotonic() - start_s:.0f} s; report: {output / REPORT}")
    return 0 if good and result.returncode == 0 else 1


def pytest(made: Path, work: Path, site: str) -> subprocess.CompletedProcess[str]:
    """Run the tests with the libraries at `site`. The report is in `work`. Raises LabError after a time limit."""
    words = ["/usr/bin/env", "--chdir=/mnt/tree", "/usr/bin/python3", "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    words += [
        f"--timeout={TEST_LIMIT_S}", f"--junit-xml=/mnt/{REPORT}", *(path for part in PARTS.values() for path in part),
    ]  # fmt: skip
    try:
        return subprocess.run(
            user_mode.command(made, work, ROOT, words), env=user_mode.environment(user_mode.SITE, site), text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=LIMIT_S, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired as error:
        raise LabError(f"expected the end of the unit tests within {LIMIT_S:.0f} s") from error


def unpack(package: Path, work: Path, release: Release) -> str:
    """Unpack imud's package into the run's folder. Return the path of its libraries in the emulated system."""
    try:
        subprocess.run(["dpkg-deb", "--extract", str(package), str(work / "package")], check=True, timeout=600)
    except (subprocess.SubprocessError, OSError) as error:
        raise LabError(f"cannot unpack the package {package}: {error}") from error
    site = f"package/usr/lib/imud/lib/python{PYTHONS[release.suite]}/site-packages"
    if not (work / site).is_dir():
        raise LabError(f"cannot find {site.removeprefix('package/')} in {package}; is it a package for {release.name}?")
    shutil.rmtree(work / site / "imud")  # the tests use the same package from the repository
    return f"/mnt/{site}"


def counted(report: str) -> dict[str, Tally]:
    """Return the results of each part, from pytest's report (JUnit XML)."""
    tallies = {name: Tally() for name in PARTS}
    for case in ElementTree.fromstring(report).iter("testcase"):
        # pytest gives an unreadable file no class, and its name is the name of the file
        place = (case.get("classname") or str(case.get("name"))).replace(".", "/")
        part = next((name for name, paths in PARTS.items() if place.startswith(stems(paths))), "")
        if not part:
            raise LabError(f"expected only tests of PARTS in the report, got {place}")
        tally = tallies[part]
        tally.seconds += float(case.get("time", "0"))
        bad = [element for element in case if element.tag in ("failure", "error")]
        if bad:
            tally.failures.append(f"{place}: {case.get('name')}\n{bad[0].text or bad[0].get('message', '')}")
        elif case.find("skipped") is not None:
            tally.skipped += 1
        else:
            tally.passed += 1
    return tallies


def stems(paths: tuple[str, ...]) -> tuple[str, ...]:
    """Return the prefixes of class names in the report for these folders and files."""
    return tuple(path.removesuffix(".py") for path in paths)


def shown(tallies: dict[str, Tally]) -> bool:
    """Print a line for each part, and the failures. Return whether all parts are good."""
    for name, tally in tallies.items():
        word = "PASS" if tally.good else "FAIL"
        counts = f"{tally.passed} passed, {tally.skipped} skipped, {len(tally.failures)} failed"
        print(f"{word} {tally.seconds:6.1f} s  {NAME}: {name}: {counts}", flush=True)
        for failure in tally.failures:
            for line in failure.splitlines()[:1] + failure.splitlines()[1:][-LINES_SHOWN:]:
                print(f"       {line}", flush=True)
    return all(tally.good for tally in tallies.values())
