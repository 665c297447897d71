"""`tests/lab/run`: boots the lab and runs pytest on tests/lab in it.

Exit status: the status of pytest (0 all passed, 1 some failed, ... 5 none selected) or of the --exec command; 10 with
one line on standard error if the lab itself failed; 130 and 143 after SIGINT and SIGTERM.
"""

import argparse
import platform
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from tests.lab.host import environment, guest, kernel, packages, results
from tests.lab.host.errors import HungGuest, LabError
from tests.lab.host.qemu import QEMU, Machine

LAB_FAILED = 10
MIN_MEMORY_MB = 256  # minimum of --memory
DEFAULT_MEMORY_MB = 1024
MAX_PROCESSORS = 2  # the kernel's CONFIG_NR_CPUS
DEFAULT_PROCESSORS = 1
"""Default number of processors of the guest. On a busy two-core host, two processors took twice as long: 27 and 36 s
for boot and collection, with one processor 14 and 16 s (tests/lab/run --processors N --exec '.venv/bin/python -m pytest
--collect-only')."""


class Parser(argparse.ArgumentParser):
    """Parser that raises LabError with one line for invalid options."""

    def error(self, message: str) -> NoReturn:
        raise LabError(f"{message} (tests/lab/run --help)")


def parser() -> Parser:
    options = Parser(prog="tests/lab/run", allow_abbrev=False, description="Run tests/lab in a kernel under QEMU.")
    options.add_argument("--ci", action="store_true", help="exit with 0 and a message if QEMU is not installed")
    options.add_argument("--build-only", action="store_true", help="build the kernel and the module, do not boot")
    options.add_argument("--exec", metavar="COMMAND", help="run this shell command in the guest instead of pytest")
    options.add_argument("--venv", type=Path, default=environment.ROOT / ".venv", help="default: .venv")
    options.add_argument("--output", type=Path, default=environment.ROOT / "build" / "lab", help="default: build/lab")
    options.add_argument("--memory", type=int, default=DEFAULT_MEMORY_MB, metavar="MB", help="default: %(default)s")
    options.add_argument("--processors", type=int, default=DEFAULT_PROCESSORS, metavar="N", help="default: %(default)s")
    options.add_argument(
        "--steady", action="store_true", help="use a clock that counts the guest's instructions, 1 ns each"
    )
    options.add_argument("--limit", type=float, default=guest.Limits.total_s, metavar="S", help="default: %(default)s")
    options.add_argument("arguments", nargs="*", metavar="-- PYTEST_ARGUMENT", help="such as: -- -k can -v")
    return options


def say(line: str) -> None:
    print(f"lab: {line}", file=sys.stderr, flush=True)


def boot(options: argparse.Namespace, python: environment.Python, built: Path) -> int:
    command = ["sh", "-c", options.exec] if options.exec else environment.pytest_command(python, options.arguments)
    silence_s = guest.STEADY_SILENCE_S if options.steady else guest.Limits.silence_s
    limits = guest.Limits(total_s=options.limit, silence_s=silence_s)
    failed = True
    with results.run_folder(options.output) as folder:
        shutil.copy(built / kernel.MODULE, folder)
        shown = "".join(f"{path}\n" for path in environment.shown_folders(python))
        (folder / "shown").write_text(shown, encoding="utf-8")
        (folder / "script").write_text(environment.script(python, command), encoding="utf-8")

        def machine(uart_fds: tuple[int, int], monitor_fd: int) -> list[str]:
            image, console = built / kernel.IMAGE, folder / "console.log"
            memory_mb, processors, steady = options.memory, options.processors, options.steady
            return Machine(image, folder, console, memory_mb, processors, uart_fds, monitor_fd, steady).command()

        start_s = time.time()
        try:
            status = guest.run(machine, guest.Folder(folder), limits, guest.to_terminal)
            failed = status != 0
            say(timing(folder, start_s))
        finally:
            for path in results.keep(folder, options.output, failed):
                say(f"kept {path}")
    return status


def timing(folder: Path, start_s: float) -> str:
    ran = f"guest ran {time.time() - start_s:.1f} s"
    mark = folder / "first-test"
    return f"first test after {mark.stat().st_mtime - start_s:.1f} s, {ran}" if mark.exists() else ran


def check(options: argparse.Namespace) -> None:
    if platform.machine() != "x86_64":
        raise LabError(f"expected an x86_64 host, because the guest runs the host's programs; got {platform.machine()}")
    if options.memory < MIN_MEMORY_MB:
        raise LabError(f"--memory: expected at least {MIN_MEMORY_MB} MB, got {options.memory}")
    if not 1 <= options.processors <= MAX_PROCESSORS:
        raise LabError(f"--processors: expected 1 to {MAX_PROCESSORS}, got {options.processors}")
    if not options.limit > 0:
        raise LabError(f"--limit: expected seconds above 0, got {options.limit}")
    if any(character in str(environment.ROOT) for character in '"\n'):
        raise LabError(
            f"cannot use the repository folder {str(environment.ROOT)!r}: the kernel does not support its name"
        )
    packages.require_all()


def lab(arguments: list[str]) -> int:
    options = parser().parse_args(arguments)
    if options.ci and shutil.which(QEMU) is None:
        say(f"skipped: cannot find {QEMU}; try make lab-deps")
        return 0
    check(options)
    python = environment.find_python(options.venv)
    built = kernel.built(say)
    if options.build_only:
        return 0
    environment.precompile(python)
    try:
        return boot(options, python, built)
    except HungGuest as error:
        say(f"{error}; booting again")
        return boot(options, python, built)


def terminate(number: int, _frame: object) -> NoReturn:
    """Exit with status 143 on SIGTERM, so that QEMU also ends."""
    raise SystemExit(128 + number)


def run_program(lab: Callable[[list[str]], int], say: Callable[[str], None]) -> int:
    signal.signal(signal.SIGTERM, terminate)
    try:
        return lab(sys.argv[1:])
    except LabError as error:
        say(str(error))
        return LAB_FAILED
    except KeyboardInterrupt:
        say("interrupted")
        return 128 + signal.SIGINT


def main() -> int:
    return run_program(lab, say)


if __name__ == "__main__":
    sys.exit(main())
