"""`tests/lab_debian/run`: boots Debian releases under QEMU, installs the package of imud, and runs the guest's checks.

Exit status: 0 if all checks passed; 1 if a check failed; 10 if the lab itself failed, with the cause on standard error;
130 and 143 after SIGINT and SIGTERM.
"""

import argparse
import contextlib
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from tests.lab.host import guest, results
from tests.lab.host.__main__ import Parser, run_program
from tests.lab.host.environment import ROOT
from tests.lab.host.errors import HungGuest, LabError
from tests.lab_debian.host import image, packages, unit_tests
from tests.lab_debian.host.machine import SENSOR, DebianMachine, answered
from tests.lab_debian.host.release import AMD64, ARM64, Release

GUEST = Path(__file__).resolve().parents[1] / "guest"
LIMITS = guest.Limits(total_s=3600.0, boot_s=1800.0, silence_s=300.0)
"""Time limits, s. On a busy host, an emulated arm64 system takes minutes to its first sign of life."""
SIMULATOR_LIMIT_S = 60.0
POLL_S = 0.05
SIMULATED_RATE_HZ = 20
"""Rate of the simulated sensor, Hz. QEMU's adapter buffers 384 bytes: four frames, 200 ms at this rate."""
BYTECODE = "__pycache__"


def parser() -> argparse.ArgumentParser:
    options = Parser(prog="tests/lab_debian/run", allow_abbrev=False, description="Check the package on Debian.")
    options.add_argument("--ci", action="store_true", help="exit with 0 and a message if the lab cannot run")
    options.add_argument("--arm64", action="store_true", help="use arm64, with unit tests, instead of amd64")
    options.add_argument("--suite", choices=[release.suite for release in AMD64], help="run only this release")
    options.add_argument("--build-only", action="store_true", help="build images and packages, do not boot")
    options.add_argument("--short", action="store_true", help="plug the adapter in twice, not ten times")
    options.add_argument("--package", type=Path, metavar="DEB", help="install this package instead of building one")
    options.add_argument("--exec", metavar="COMMAND", help="run this shell command in the guest instead of the checks")
    options.add_argument("--venv", type=Path, default=ROOT / ".venv", help="default: .venv")
    options.add_argument("--output", type=Path, default=ROOT / "build" / "lab-debian", help="default: build/lab-debian")
    options.add_argument("only", nargs="*", metavar="GROUP", help="groups of checks to run, such as: replug rights")
    return options


def say(line: str) -> None:
    print(f"lab-debian: {line}", file=sys.stderr, flush=True)


def chosen(options: argparse.Namespace) -> list[Release]:
    found = [release for release in (ARM64 if options.arm64 else AMD64) if options.suite in (None, release.suite)]
    if unit_tests.NAME in options.only and not options.arm64:
        raise LabError(f"cannot run {unit_tests.NAME} for the architecture of the host; try --arm64")
    if not found:
        raise LabError(f"--suite: expected {', '.join(r.suite for r in ARM64)} for arm64, got {options.suite}")
    return found


def program(options: argparse.Namespace, release: Release, groups: list[str]) -> str:
    if options.exec:
        return f"{options.exec}\n"
    words = [release.architecture, *(["--short"] if options.short else []), *groups]
    return f"exec python3 -B -m tests.lab_debian.guest {' '.join(words)}\n"


@contextlib.contextmanager
def simulator(python: Path, node: Path) -> Iterator[int]:
    """Simulate a sensor behind the pseudo-terminal `node`. Yield its process id. Raises LabError if it fails."""
    command = [str(python), "-m", "imud.sim", "--path", str(node), "--rate", str(SIMULATED_RATE_HZ)]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT
    )
    try:
        give_up_s = time.monotonic() + SIMULATOR_LIMIT_S
        while not node.exists():
            if process.poll() is not None or time.monotonic() >= give_up_s:
                raise LabError(f"cannot start the simulated sensor: {' '.join(command)}")
            time.sleep(POLL_S)
        yield process.pid
    finally:
        process.kill()
        process.wait()
        if process.stdin:
            process.stdin.close()


def fill(folder: Path, release: Release, package: Path, script: str) -> None:
    shutil.copytree(GUEST, folder / GUEST.relative_to(ROOT), ignore=shutil.ignore_patterns(BYTECODE))
    shutil.copy(package, folder / "imud.deb")
    packages.next_version(package, folder)
    (folder / "release").write_text(f"{release.suite}\n", encoding="ascii")
    (folder / "script").write_text(script, encoding="utf-8")


def boot(options: argparse.Namespace, release: Release, groups: list[str], made: image.Image, package: Path) -> int:
    output = options.output / release.name
    failed, start_s = True, time.monotonic()
    with results.run_folder(output) as folder, contextlib.ExitStack() as stack:
        fill(folder, release, package, program(options, release, groups))
        sockets = stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-lab-"))
        machine = DebianMachine(release, made, folder, Path(sockets))
        python = options.venv.absolute() / "bin" / "python"
        try:
            with simulator(python, Path(sockets) / SENSOR) as sensor, answered(Path(sockets), sensor):
                status = guest.run(
                    lambda _uart_fds, monitor_fd: machine.command(monitor_fd), guest.Folder(folder), LIMITS,
                    guest.to_terminal,
                )  # fmt: skip
            failed = status != 0
        finally:
            kept = keep(folder, output, failed)
            say(
                f"{release.name}: the guest ran {time.monotonic() - start_s:.0f} s" + (f"; kept {kept}" if kept else "")
            )
    return status


def keep(folder: Path, output: Path, failed: bool) -> str:
    """Keep the guest's journal and results, and after a failure the logs of kernel and QEMU. Return their paths."""
    for name in ("journal.log", "results.json"):
        (output / name).unlink(missing_ok=True)
        if (folder / name).exists():
            shutil.copy(folder / name, output / name)
    logs = results.keep(folder, output, failed)
    journal = [output / "journal.log"] if failed and (output / "journal.log").exists() else []
    return ", ".join(str(path) for path in logs + journal)


def lab(arguments: Sequence[str]) -> int:
    options = parser().parse_args(arguments)
    releases = chosen(options)
    for release in releases:
        if why := packages.obstacle(release):
            if not options.ci:
                raise LabError(why)
            say(f"skipped: {why}")
            return 0
    return max(run_release(options, release) for release in releases)


def run_release(options: argparse.Namespace, release: Release) -> int:
    python = options.venv.absolute() / "bin" / "python"
    checked = [group for group in options.only if group != unit_tests.NAME]
    boots = bool(options.exec or checked or not options.only)
    start_s = time.monotonic()
    try:
        made = image.built(release, say) if boots else None
    except LabError as error:
        if not options.ci:
            raise
        say(f"skipped: {error}")  # Debian's packages are not available
        return 0
    package = options.package or packages.build(release, python)
    say(f"{release.name}: image and package after {time.monotonic() - start_s:.0f} s")
    if options.build_only:
        return 0
    worst = 0
    if release.foreign and not options.exec and (not options.only or unit_tests.NAME in options.only):
        worst = unit_tests.run(release, package, python, options.output / release.name, say)
    if made is None:
        return worst
    try:
        return max(worst, boot(options, release, checked, made, package))
    except HungGuest as error:
        say(f"{error}; booting again")
        return max(worst, boot(options, release, checked, made, package))


def main() -> int:
    return run_program(lab, say)


if __name__ == "__main__":
    sys.exit(main())
