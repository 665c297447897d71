"""The monitor of QEMU: it continues a stopped guest, and examines a hung guest.

The examination sends commands to the monitor, and the kernel of the guest prints the wait states of its tasks. A file
contains commands and replies. The last command is a non-maskable interrupt, which the kernel of the guest always
accepts (`PANIC_BY_NMI` of the command line): it prints its tasks and timers on the console, and its panic ends QEMU.
"""

import socket
import sys
from contextlib import suppress
from pathlib import Path

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
    """Send all commands. Return when QEMU has ended or does not reply."""
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
