"""What a hung guest does: QEMU's monitor is asked, and the guest's kernel says what its tasks wait for.

Questions and answers go to a file. The last command is a non-maskable interrupt, which the guest's kernel takes
whatever it does (`PANIC_BY_NMI` of the command line): it prints its tasks and timers on the console, and its panic
ends QEMU.
"""

import socket
from contextlib import suppress
from pathlib import Path

QUESTIONS = ("info status", "info registers", "info lapic", "info pic")
PROMPT = b"(qemu) "
ANSWER_S = 10.0
PANIC_S = 60.0
"""A panic that prints a hundred tasks takes a few seconds."""


def examine(monitor: socket.socket, log: Path) -> None:
    """Ask everything; return when QEMU ended, or when it does not answer."""
    with log.open("wb") as file, suppress(OSError):  # a timeout is one too
        monitor.settimeout(ANSWER_S)
        file.write(_answer(monitor))  # the banner
        for question in (*QUESTIONS, "nmi"):
            monitor.sendall(question.encode() + b"\n")
            _echo, _, answer = _answer(monitor).partition(b"\n")  # the echo has a line for each key that is pressed
            file.write(question.encode() + b"\n" + answer)
            file.flush()
        monitor.settimeout(PANIC_S)
        while monitor.recv(4096):
            pass


def _answer(monitor: socket.socket) -> bytes:
    """All up to the next prompt. Raises TimeoutError."""
    found = b""
    while not found.endswith(PROMPT):
        part = monitor.recv(65536)
        if not part:
            return found
        found += part
    return found
