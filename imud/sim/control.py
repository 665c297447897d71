"""The main loop of a simulator's process, and the commands on its stdin (`imud.sim.__main__` lists them)."""

import json
import os
import select
import sys
from collections.abc import Callable
from typing import Final

from imud.sim.ports.can_port import CanPort
from imud.sim.ports.gpio_sim import SimulatedLines
from imud.sim.ports.pty import SimulatedPort
from imud.units import NS_PER_S

COMMAND_BYTES_MAX: Final = 4096


class BadCommand(ValueError):
    """A line on stdin that is no command."""


class StandardInputControl:
    """Main loop of a simulated port: waits for deadlines, bytes and commands on stdin."""

    def __init__(
        self,
        port: SimulatedPort | CanPort,
        now_ns: Callable[[], int],
        lines: SimulatedLines | None = None,
    ) -> None:
        """`now_ns` is CLOCK_MONOTONIC."""
        self._port = port
        self._lines = lines
        self._now_ns = now_ns
        self._text = b""
        self._running = True

    def run(self) -> None:
        """Run until the command `quit` or the end of stdin."""
        port, node, commands = self._port, self._port.node, sys.stdin.fileno()
        readable = True
        while self._running:
            now_ns = self._now_ns()
            next_ns = now_ns + NS_PER_S
            if self._lines is not None:
                self._lines.step(now_ns)
                next_ns = self._lines.next_ns(now_ns)
            port.step(now_ns, readable)
            is_open = node.is_open
            wait_ns = min(port.next_ns(now_ns), next_ns) - self._now_ns()
            # select, because epoll and poll round up to milliseconds
            watched = [commands, node.fileno()] if is_open else [commands]
            ready = select.select(watched, [], [], max(wait_ns, 0) / NS_PER_S)[0]
            readable = not is_open or node.fileno() in ready  # a program may write and be gone
            if commands in ready:
                self._on_input(os.read(commands, COMMAND_BYTES_MAX))

    def _on_input(self, data: bytes) -> None:
        if not data:
            self._running = False
        *lines, self._text = (self._text + data).split(b"\n")
        for line in lines:
            try:
                self._run_command(line.decode(errors="replace").split())
            except BadCommand as error:
                print(f"imud.sim: {error}", file=sys.stderr, flush=True)

    def _run_command(self, words: list[str]) -> None:
        port, now_ns = self._port, self._now_ns()
        match words:
            case ["unplug", seconds]:
                port.unplug(now_ns, _duration_ns(seconds))
            case ["reboot"]:
                port.module.reboot(now_ns)
            case ["mark"]:
                port.module.mark(now_ns)
            case ["stats"]:
                print(json.dumps(port.summary() | (self._lines.summary() if self._lines else {})), flush=True)
            case ["quit"]:
                self._running = False
            case []:
                pass
            case _:
                raise BadCommand(f"{' '.join(words)!r}: expected unplug SECONDS, reboot, mark, stats or quit")


def _duration_ns(text: str) -> int:
    try:
        return round(float(text) * NS_PER_S)
    except (ValueError, OverflowError):
        raise BadCommand(f"unplug {text!r}: expected seconds") from None
