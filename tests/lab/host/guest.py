"""Runs one guest to its end: starts QEMU, forwards its output, and checks its signs of life.

A guest ends in one of four ways: it wrote its exit status; QEMU ended without a status (a panic, a lack of memory, an
invalid command line); it sent no sign of life for too long; or the time limit has passed. All ways except the first
raise LabError.
"""

import os
import re
import selectors
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tests.lab.host.errors import HungGuest, LabError

TICK_S = 0.5
GOODBYE_S = 5.0  # time from the exit status to the end of QEMU; about 0.1 s
CHUNK_BYTES = 65536  # bytes per read of QEMU's output
MACHINE_LOG = "machine.log"
STEADY_SILENCE_S = 300.0
"""Maximum time between two signs of life with `--steady`, s. The guest's 5 s took more than 60 s on a busy host."""


@dataclass(frozen=True)
class Limits:
    total_s: float = 1200.0
    boot_s: float = 300.0
    """Maximum time from the start to the first sign of life, s; about 5 s on an idle host."""
    silence_s: float = 60.0
    """Maximum time between two signs of life, s. The guest sends one every 5 s."""
    restart_s: float = 30.0
    """Silence after which QEMU stops and continues the guest, s. Repeated after each such time."""


@dataclass(frozen=True)
class Folder:
    path: Path

    def read(self, name: str) -> str:
        try:
            return (self.path / name).read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return ""

    def age_s(self, name: str) -> float | None:
        try:
            return time.time() - (self.path / name).stat().st_mtime
        except FileNotFoundError:
            return None


def run(
    make_command: Callable[[tuple[int, int], int], list[str]], folder: Folder, limits: Limits,
    write: Callable[[bytes], object],
) -> int:  # fmt: skip
    """Run the command of `make_command(uart_fds, monitor_fd)`. Return the guest's exit status.

    `write` receives the guest's output immediately. Raises LabError if the guest has no exit status. QEMU ends with
    this call or with this process (`setpriv --pdeathsig`).
    """
    ends = socket.socketpair()
    monitor, far_monitor = socket.socketpair()
    fds, monitor_fd = (ends[0].fileno(), ends[1].fileno()), far_monitor.fileno()
    try:
        with open(folder.path / "qemu.log", "wb") as errors:
            process = subprocess.Popen(
                ["setpriv", "--pdeathsig", "KILL", *make_command(fds, monitor_fd)], stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE, stderr=errors, pass_fds=(*fds, monitor_fd),
                start_new_session=True,  # Ctrl-C only reaches the runner, which then ends QEMU
            )  # fmt: skip
    finally:
        for end in (*ends, far_monitor):
            end.close()
    try:
        _watch(process, folder, limits, write, monitor)
        process.wait(GOODBYE_S)
    except HungGuest:
        examine(monitor, folder.path / MACHINE_LOG)
        raise
    except subprocess.TimeoutExpired:
        pass  # the exit status of the guest decides
    finally:
        process.kill()
        process.wait()
        monitor.close()
        if process.stdout:
            process.stdout.close()
    return _status(folder, process.returncode)


def _watch(
    process: subprocess.Popen[bytes], folder: Folder, limits: Limits, write: Callable[[bytes], object],
    monitor: socket.socket,
) -> None:  # fmt: skip
    """Return when QEMU has closed its output, or when the exit status exists. Raises LabError after a time limit."""
    assert process.stdout is not None
    start_s = restarted_s = time.monotonic()
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while True:
            if selector.select(TICK_S):
                data = os.read(process.stdout.fileno(), CHUNK_BYTES)
                if not data:
                    return
                write(data)
            if (folder.age_s("status") or 0.0) > GOODBYE_S:
                return
            now_s = time.monotonic()
            _check_limits(folder, limits, now_s - start_s)
            if min(folder.age_s("alive") or 0.0, now_s - restarted_s) > limits.restart_s:
                restarted_s = now_s
                stop_and_continue(monitor)


def _check_limits(folder: Folder, limits: Limits, elapsed_s: float) -> None:
    if elapsed_s > limits.total_s:
        raise LabError(f"expected the end of the guest within {limits.total_s:.0f} s{_hint(folder)}")
    silence_s = folder.age_s("alive")
    if silence_s is None and elapsed_s > limits.boot_s:
        raise LabError(f"hung guest: expected its start within {limits.boot_s:.0f} s{_hint(folder)}")
    if silence_s is not None and silence_s > limits.silence_s:
        raise HungGuest(f"hung guest: no sign of life for {silence_s:.0f} s{_hint(folder)}")


def _hint(folder: Folder) -> str:
    found = cause(folder.read("console.log"))
    return f" ({found})" if found else ""


def _status(folder: Folder, qemu_status: int) -> int:
    """Return the guest's exit status. Raises LabError with the cause if there is no status."""
    console = folder.read("console.log")
    problem = folder.read("problem").strip()
    if problem:
        raise LabError(problem)
    status = folder.read("status").strip()
    if status.isdigit():
        if int(status) != 0 and out_of_memory(console):
            raise LabError(str(cause(console)))
        return int(status)
    qemu = folder.read("qemu.log").strip().splitlines()
    if qemu_status != 0 and qemu:
        raise LabError(f"QEMU failed: {qemu[-1]}")
    raise LabError(cause(console) or f"the guest ended without a result; last console line: {last_line(console)}")


def to_terminal(data: bytes) -> None:
    sys.stdout.buffer.write(data)
    sys.stdout.buffer.flush()


# --- known causes in the console log of a guest without a result --------------------------------------------------

CAUSES = (
    (r"Kernel panic - not syncing: System is deadlocked on memory", "guest out of memory"),
    (r"VFS: Unable to mount root fs|Cannot open root device", "guest could not mount the host's root over 9p"),
    (r"Requested init .* failed|No working init found", "guest could not start its init"),
    (r"Out of memory: Killed process", "guest out of memory"),
    (r"soft lockup|rcu_preempt detected stalls|blocked for more than", "guest kernel stuck"),
    (r"BUG: |Oops: |general protection fault", "kernel fault in the guest"),
    (r"Kernel panic", "kernel panic in the guest"),
    (r"lab init failed", "guest set-up failed"),
)
"""Patterns of console lines with their meaning, the most significant pattern first."""

KILLED = re.compile(r"Out of memory: Killed process")


def cause(console: str) -> str | None:
    for pattern, meaning in CAUSES:
        line = next((line for line in console.splitlines() if re.search(pattern, line)), None)
        if line is not None:
            return f"{meaning}: {_bare(line)}"
    return None


def out_of_memory(console: str) -> bool:
    """Return whether the guest's kernel killed a process because memory was full."""
    return KILLED.search(console) is not None


def last_line(console: str) -> str:
    lines = [line for line in console.splitlines() if line.strip()]
    return _bare(lines[-1]) if lines else "no output on the console"


def _bare(line: str) -> str:
    """Return a console line without time stamp and control characters, at most 160 characters."""
    plain = re.sub(r"^\[ *[\d.]+\](\[[^]]*\])? *", "", line.strip())
    return "".join(character for character in plain if character.isprintable())[:160]


# --- the monitor of QEMU ------------------------------------------------------------------------------------------

QUESTIONS = ("info status", "info registers", "info lapic", "info pic")
PROMPT = b"(qemu) "
ANSWER_S = 10.0
PANIC_S = 60.0
"""Maximum time of a panic, s. A panic that prints a hundred tasks takes a few seconds."""


def stop_and_continue(monitor: socket.socket) -> None:
    """Stop the guest and continue it, which wakes QEMU's processor thread. `examine` skips the replies."""
    print("lab: the guest is silent; QEMU stops and continues it", file=sys.stderr, flush=True)
    with suppress(OSError):  # QEMU has ended or does not read
        monitor.sendall(b"stop\ncont\n", socket.MSG_DONTWAIT)


def examine(monitor: socket.socket, log: Path) -> None:
    """Examine a hung guest: write all commands to QEMU's monitor and their replies to `log`.

    The last command is a non-maskable interrupt, which the kernel of the guest always accepts (`PANIC_BY_NMI` of the
    command line): it prints its tasks and timers on the console, and its panic ends QEMU. Return when QEMU has ended or
    does not reply.
    """
    with log.open("wb") as file, suppress(OSError):  # TimeoutError is an OSError
        monitor.settimeout(ANSWER_S)
        file.write(_answer(monitor))  # the banner
        for question in (*QUESTIONS, "nmi"):
            monitor.sendall(question.encode() + b"\n")
            _echo, _, answer = _answer(monitor).partition(b"\n")  # the echo has one line for each typed character
            file.write(question.encode() + b"\n" + answer)
            file.flush()
        monitor.settimeout(PANIC_S)
        while monitor.recv(4096):
            pass


def _answer(monitor: socket.socket) -> bytes:
    """Return all bytes up to the next prompt. Raises TimeoutError."""
    found = b""
    while not found.endswith(PROMPT):
        part = monitor.recv(65536)
        if not part:
            return found
        found += part
    return found
