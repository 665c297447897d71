"""`python -m imud.sim`: a simulated device behind a pseudo-terminal, or one or more on a CAN interface, as a process.

The first line on stdout is the path to open, or the name of the interface. It runs until stdin ends, or SIGTERM or
SIGINT comes; its last line is what it counted, as JSON. Lines on stdin command it:

    unplug SECONDS    the port disappears and comes back, the module loses power
    reboot            the module starts anew, the port stays
    mark              a pulse on SIN/PPS, where the device has such an input
    stats             print what was counted so far, as JSON on one line
    quit
"""

import argparse
import json
import os
import select
import signal
import sys
import tempfile
import time
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Final

from imud.errors import LinkError
from imud.sim import CAN_SIMULATORS, SIMULATORS
from imud.sim.can_module import CanModules
from imud.sim.physics.motion import GRAVITY_M_S2, MOTIONS
from imud.sim.ports.arrival import BARE_UART, USB_1MS, USB_16MS
from imud.sim.ports.can_port import CanPort, default_interface
from imud.sim.ports.faults import Faults, rates_from
from imud.sim.ports.pin import PinModule
from imud.sim.ports.pins import PinFaults, Pins, SinFile, pin_rates, pull_files
from imud.sim.ports.pty import Adapter, PtyNode, SimulatedPort, sharpen_timers
from imud.sim.simulator import SimulatorOptions, StreamModule
from imud.units import NS_PER_MS, NS_PER_S

ADAPTERS: Final = {profile.name: profile for profile in (BARE_UART, USB_1MS, USB_16MS)}
DEVICE: Final = "hipnuc-uart"
"""What is simulated where nothing is said."""
COMMAND_BYTES_MAX: Final = 4096
SIN_LOOK_NS: Final = 4 * NS_PER_MS
"""How often SIN is looked at: a pulse has to be longer."""


class BadCommand(ValueError):
    """A line on stdin that is no command."""


def main(arguments: list[str] | None = None) -> int:
    """Run; return the exit code."""
    options = _parser().parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # both end as KeyboardInterrupt
    now_ns = time.monotonic_ns()
    devices: list[tuple[str, int]] = options.device or [(DEVICE, 0)]
    if all(name in CAN_SIMULATORS for name, _ in devices):
        return _run_on_can(options, devices, now_ns)
    if len(devices) > 1:
        print("imud.sim: expected one device behind a terminal, or one or more on a CAN bus", file=sys.stderr)
        return 2
    ((name, node),) = devices
    try:
        module = SIMULATORS[name].make(_module_options(options, node), now_ns)
        faults = Faults(options.seed, rates_from(options.faults)) if options.faults else None
        wires = SimulatedLines(options, module)
    except (ValueError, OSError) as error:
        print(f"imud.sim: {error}", file=sys.stderr)
        return 2
    sharpen_timers()
    with closing(wires), ExitStack() as stack:
        truth = stack.enter_context(options.truth.open("w")) if options.truth else None
        path = options.path or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-sim-"))) / "tty"
        port = SimulatedPort(module, PtyNode(path), Adapter(ADAPTERS[options.adapter], now_ns), faults, truth)
        stack.callback(port.close)
        with suppress(KeyboardInterrupt):
            print(path, flush=True)
            StandardInputControl(port, wires).run()
        print(json.dumps(port.summary() | wires.summary()), flush=True)
    return 0


def _run_on_can(options: argparse.Namespace, devices: list[tuple[str, int]], now_ns: int) -> int:
    try:
        modules = [CAN_SIMULATORS[name].make(_module_options(options, node), now_ns) for name, node in devices]
        port = CanPort(
            CanModules(modules) if len(modules) > 1 else modules[0], options.interface or default_interface()
        )
    except (ValueError, LinkError) as error:
        print(f"imud.sim: {error}", file=sys.stderr)
        return 2
    sharpen_timers()
    with closing(port):
        with suppress(KeyboardInterrupt):
            print(port.interface, flush=True)
            StandardInputControl(port).run()
        print(json.dumps(port.summary()), flush=True)
    return 0


class SimulatedLines:
    """The lines beside a device's data: its pins on the way out, SIN on the way in. Synchronization: one thread."""

    def __init__(self, options: argparse.Namespace, module: StreamModule) -> None:
        """Raises ValueError for pins that this device has not, OSError."""
        self._files = pull_files(options.pins, options.pin_settle / 1e3)
        self._truth = options.pin_truth.open("w") if options.pin_truth else None
        self._pins: Pins | None = None
        if self._files:
            if not isinstance(module, PinModule):
                raise ValueError("pins: this device has none that are simulated")
            faults = PinFaults(options.seed, pin_rates(options.pin_faults)) if options.pin_faults else None
            self._pins = Pins(module, self._files, faults, self._truth)
        self._sin = SinFile(options.sin, module) if options.sin else None

    def step(self, now_ns: int) -> None:
        """Do all that is due, right before the port does. Raises OSError."""
        if self._sin is not None:
            self._sin.look(now_ns)
        if self._pins is not None:
            self._pins.step(now_ns)

    def next_ns(self, now_ns: int) -> int:
        """When `step` is to be called again at the latest."""
        next_ns = self._pins.next_ns() if self._pins is not None else None
        latest_ns = now_ns + (SIN_LOOK_NS if self._sin is not None else NS_PER_S)
        return latest_ns if next_ns is None else min(next_ns, latest_ns)

    def summary(self) -> dict[str, int]:
        """Counters by name."""
        return self._pins.summary() if self._pins is not None else {}

    def close(self) -> None:
        """Let go of the files; may be called twice."""
        for file in self._files.values():
            file.close()
        if self._truth is not None:
            self._truth.close()


class StandardInputControl:
    """Waits for time, bytes and commands, and moves the port along."""

    def __init__(self, port: SimulatedPort | CanPort, wires: SimulatedLines | None = None) -> None:
        self._port = port
        self._wires = wires
        self._text = b""
        self._running = True

    def run(self) -> None:
        """Run until told to quit or stdin ends."""
        port, node, commands = self._port, self._port.node, sys.stdin.fileno()
        readable = True
        while self._running:
            now_ns = time.monotonic_ns()
            next_ns = now_ns + NS_PER_S
            if self._wires is not None:
                self._wires.step(now_ns)
                next_ns = self._wires.next_ns(now_ns)
            port.step(now_ns, readable)
            is_open = node.is_open
            wait_ns = min(port.next_ns(now_ns), next_ns) - time.monotonic_ns()
            # select, because epoll and poll round up to milliseconds
            watched = [commands, node.fileno()] if is_open else [commands]
            ready = select.select(watched, [], [], max(wait_ns, 0) / NS_PER_S)[0]
            readable = not is_open or node.fileno() in ready  # a program may write and be gone
            if commands in ready:
                self._take_commands(os.read(commands, COMMAND_BYTES_MAX))

    def _take_commands(self, data: bytes) -> None:
        if not data:
            self._running = False
        *lines, self._text = (self._text + data).split(b"\n")
        for line in lines:
            try:
                self._obey(line.decode(errors="replace").split())
            except BadCommand as error:
                print(f"imud.sim: {error}", file=sys.stderr, flush=True)

    def _obey(self, words: list[str]) -> None:
        port, now_ns = self._port, time.monotonic_ns()
        match words:
            case ["unplug", seconds]:
                port.unplug(now_ns, _duration_ns(seconds))
            case ["reboot"]:
                port.module.reboot(now_ns)
            case ["mark"]:
                port.module.mark(now_ns)
            case ["stats"]:
                print(json.dumps(port.summary() | (self._wires.summary() if self._wires else {})), flush=True)
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


def _module_options(options: argparse.Namespace, node: int) -> SimulatorOptions:
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
    )


def simulated(text: str) -> tuple[str, int]:
    """Name and node of NAME or NAME:NODE, node 0 where none is given. Raises ArgumentTypeError."""
    name, _, node = text.partition(":")
    known = sorted([*SIMULATORS, *CAN_SIMULATORS])
    if name not in known or (node and not node.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected one of {', '.join(known)}, with or without :NODE, got {text!r}")
    return name, int(node or 0)


def _parser() -> argparse.ArgumentParser:
    default = SimulatorOptions()
    parser = argparse.ArgumentParser("python -m imud.sim", description="A simulated sensor behind a pseudo-terminal.")
    add = parser.add_argument
    add(
        "--device",
        action="append",
        type=simulated,
        metavar="NAME[:NODE]",
        help=f"what to simulate ({DEVICE}), one of {', '.join(sorted([*SIMULATORS, *CAN_SIMULATORS]))}; "
        "several times for several devices on one CAN interface",
    )
    add("--node", type=int, default=default.node, metavar="N", help="node, address or first identifier on a CAN bus")
    add("--at-once", action="store_true", help="CAN frames of one instant leave together, not paced by the bit rate")
    add("--rate", type=float, default=default.rate_hz, metavar="HZ", help="samples per second (%(default)s)")
    add("--baud", type=int, default=0, help="rate of the port (the slowest common one that carries the samples)")
    add("--message", default="", help="message to send (the factory's)")
    add("--motion", choices=sorted(MOTIONS), default=default.motion, help="known motion (%(default)s)")
    add("--gravity", type=float, default=GRAVITY_M_S2, metavar="M_S2", help="local gravity (%(default)s m/s²)")
    add("--noise", action=argparse.BooleanOptionalAction, default=True, help="sensor noise and bias")
    add("--skew-ppm", type=float, default=default.skew_ppm, metavar="PPM", help="crystal skew (%(default)s)")
    add("--firmware", type=int, default=0, metavar="N", help="firmware version, for example 156 or 169")
    add("--boot", type=float, default=default.boot_ms / 1000, metavar="S", help="silence after power-on (%(default)s)")
    add("--processing-us", type=float, default=default.processing_ns / 1000, metavar="US",
        help="time from sample to wire (%(default)s)")  # fmt: skip
    add("--adapter", choices=list(ADAPTERS), default=BARE_UART.name, help="how bytes are handed over (%(default)s)")
    add("--faults", default="", metavar="KIND=P,…", help="probability per burst: cut flip drop insert delay unplug …")
    add("--pins", default="", metavar="NAME=PATH,…", help="pins by name (sout sout_div alarm), each on a `pull` file "
        "of a gpio-sim line")  # fmt: skip
    add("--pin-faults", default="", metavar="KIND=P,…", help="probability per pulse: lose_pulse lose_edge extra")
    add("--pin-settle", type=float, default=0.0, metavar="MS", help="nothing else happens so long after a rising edge")
    add("--pin-truth", type=Path, metavar="FILE", help="write edges, CSV: pin,level,due_ns,sample_ns,step_ns")
    add("--sin", type=Path, metavar="PATH", help="SIN: the `value` file of a gpio-sim line, looked at every "
        f"{SIN_LOOK_NS / NS_PER_MS:g} ms")  # fmt: skip
    add("--seed", type=int, default=default.seed, help="seed of noise and faults (%(default)s)")
    add("--interface", default="", metavar="NAME", help="CAN interface, for CAN devices (the first that is up)")
    add("--path", type=Path, help="node to make (a temporary one)")
    add("--truth", type=Path, metavar="FILE", help="write true sample times, CSV: sample_ns,device_ms,written_ns")
    return parser


if __name__ == "__main__":
    sys.exit(main())
