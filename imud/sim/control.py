"""The main loop of a simulator's process, and the commands on its stdin (`imud.sim.__main__` lists them)."""

import argparse
import json
import os
import select
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from imud.contracts.registry import problems_of
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim import CAN_SIMULATORS, SIMULATORS
from imud.sim.physics import GRAVITY_M_S2, MOTIONS
from imud.sim.ports.arrival import BARE_UART, USB_1MS, USB_16MS
from imud.sim.ports.can_port import CanPort
from imud.sim.ports.pins import SIN_LOOK_NS, SimulatedLines
from imud.sim.ports.pty import SimulatedPort
from imud.sim.sensor import SimulatorOptions

COMMAND_BYTES_MAX: Final = 4096


class BadCommand(ValueError):
    """A line on stdin that is not a command."""


class StandardInputControl:
    """Main loop of a simulated port: waits for deadlines, bytes and commands on stdin."""

    def __init__(
        self,
        port: SimulatedPort | CanPort,
        now_ns: Callable[[], int],
        lines: SimulatedLines | None = None,
        *,
        stays: bool = False,
    ) -> None:
        """`now_ns` is CLOCK_MONOTONIC. `stays`: the end of stdin does not end the simulator."""
        self._stays = stays
        self._port = port
        self._lines = lines
        self._now_ns = now_ns
        self._text = b""
        self._running = self._listens = True

    def run(self) -> None:
        """Run until the command `quit` or the end of stdin (unless `stays`)."""
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
            watched = [commands] * self._listens + [node.fileno()] * is_open
            ready = select.select(watched, [], [], max(wait_ns, 0) / NS_PER_S)[0]
            readable = not is_open or node.fileno() in ready  # a program can write and close the port
            if commands in ready:
                self._on_input(os.read(commands, COMMAND_BYTES_MAX))

    def _on_input(self, data: bytes) -> None:
        if not data:
            self._running, self._listens = self._stays, False
        *lines, self._text = (self._text + data).split(b"\n")
        for line in lines:
            try:
                self._run_command(line.decode(errors="replace").split())
            except BadCommand as error:
                print(f"imud sim: {error}", file=sys.stderr, flush=True)

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


ADAPTERS: Final = {profile.name: profile for profile in (BARE_UART, USB_1MS, USB_16MS)}
DEVICE: Final = "hipnuc-uart"  # driver of the device that is simulated by default


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of `python -m imud.sim`."""
    parser = argparse.ArgumentParser("python -m imud.sim", description="A simulated sensor on a pseudo-terminal.")
    add_arguments(parser)
    return parser


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a simulator."""
    default = SimulatorOptions()
    add = parser.add_argument
    add(
        "--device",
        action="append",
        type=simulated,
        metavar="NAME[:NODE]",
        help=f"device to simulate (default: {DEVICE}), one of {', '.join(sorted([*SIMULATORS, *CAN_SIMULATORS]))}; "
        "repeat the option for several devices on one CAN interface",
    )
    add("--node", type=int, default=default.node, metavar="N", help="node, address or first identifier on a CAN bus")
    add("--at-once", action="store_true", help="send the CAN frames of one instant together, not at the bit rate")
    add("--rate", type=float, default=default.rate_hz, metavar="HZ", help="samples per second (%(default)s)")
    add(
        "--baud",
        type=int,
        default=0,
        help="baud rate of the port, bit/s (default: the slowest usual rate that carries the samples)",
    )
    add("--message", default="", help="message to send (default: factory setting)")
    add("--motion", choices=sorted(MOTIONS), default=default.motion, help="known motion (%(default)s)")
    add("--gravity", type=float, default=GRAVITY_M_S2, metavar="M_S2", help="local gravity (%(default)s m/s²)")
    add("--noise", action=argparse.BooleanOptionalAction, default=True, help="sensor noise and bias")
    add("--skew-ppm", type=float, default=default.skew_ppm, metavar="PPM", help="crystal skew (%(default)s)")
    add("--firmware", type=int, default=0, metavar="N", help="firmware version, for example 156 or 169")
    add("--boot", type=float, default=default.boot_ms / 1000, metavar="S", help="silence after power-on (%(default)s)")
    add("--processing-us", type=float, default=default.processing_ns / 1000, metavar="US",
        help="time from sample to wire (%(default)s)")  # fmt: skip
    add(
        "--adapter",
        choices=list(ADAPTERS),
        default=BARE_UART.name,
        help="adapter with its delay (%(default)s)",
    )
    add("--faults", default="", metavar="KIND=P,…", help="probability per burst: cut flip drop insert delay unplug …")
    add("--pins", default="", metavar="NAME=PATH,…", help="pins by name (sout sout_div alarm), each on a `pull` file "
        "of a gpio-sim line")  # fmt: skip
    add("--pin-faults", default="", metavar="KIND=P,…", help="probability per pulse: lose_pulse lose_edge extra")
    add("--pin-settle", type=float, default=0.0, metavar="MS", help="wait this time after each rising edge")
    add("--pin-truth", type=Path, metavar="FILE", help="write edges, CSV: pin,level,due_ns,sample_ns,step_ns")
    add("--sin", type=Path, metavar="PATH", help="SIN: the `value` file of a gpio-sim line, read every "
        f"{SIN_LOOK_NS / NS_PER_MS:g} ms")  # fmt: skip
    add("--seed", type=int, default=default.seed, help="seed of noise and faults (%(default)s)")
    add("--interface", default="", metavar="NAME", help="interface of CAN devices (default: the first that is up)")
    add("--path", type=Path, help="device node to create (default: a temporary node)")
    add("--truth", type=Path, metavar="FILE", help="write true sample times, CSV: sample_ns,device_ms,written_ns")
    add("--rest", action="store_const", const="still", dest="motion", help="a device at rest, as --motion still")
    add("--variant", default="", metavar="NAME", help="behavior that the manual does not define (unknown NAME: a list)")


def simulated(text: str) -> tuple[str, int]:
    """Return name and node of NAME or NAME:NODE. The default node is 0. Raises ArgumentTypeError."""
    name, _, node = text.partition(":")
    known = sorted([*SIMULATORS, *CAN_SIMULATORS])
    problems = [problem for table in (SIMULATORS, CAN_SIMULATORS) if (problem := problems_of(table).get(name))]
    if problems and name not in known:
        raise argparse.ArgumentTypeError("; ".join(problems))
    if name not in known or (node and not node.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected one of {', '.join(known)}, with or without :NODE, got {text!r}")
    return name, int(node or 0)


def module_options(options: argparse.Namespace, node: int) -> SimulatorOptions:
    """Return the options of one device. `node` 0 means all devices."""
    return SimulatorOptions(
        rate_hz=options.rate,
        baud=options.baud,
        message=options.message,
        motion=options.motion,
        gravity_m_s2=options.gravity,
        noise="real" if options.noise else "none",
        skew_ppm=options.skew_ppm,
        firmware=options.firmware,
        boot_ms=round(options.boot * 1e3),
        processing_ns=round(options.processing_us * 1e3),
        seed=options.seed,
        node=node or options.node,
        at_once=options.at_once,
        variant=options.variant,
    )
