"""`imud sim`, `python -m imud.sim`: simulate a device on a pseudo-terminal, or several devices on a CAN interface.

The first line on stdout is the path of the port or the name of the interface. The process runs until SIGTERM or SIGINT;
`python -m imud.sim` also ends with stdin, so that it ends with the program that started it. Its last line contains the
counters as JSON. stdin accepts these lines:

    unplug SECONDS    remove the port for this time and cut the power of the device
    reboot            restart the device, keep the port
    mark              send a pulse to SIN/PPS, if the device has this input
    stats             print the counters as one line of JSON
    quit
"""

import argparse
import json
import signal
import sys
import tempfile
import time
from contextlib import ExitStack, closing, suppress
from pathlib import Path

from imud.model.errors import LinkError, reason_of
from imud.sim import CAN_SIMULATORS, SIMULATORS
from imud.sim.can_module import CanModules
from imud.sim.control import ADAPTERS, DEVICE, StandardInputControl, make_parser, module_options
from imud.sim.ports.can_port import CanPort, default_interface
from imud.sim.ports.faults import Faults, rates_from
from imud.sim.ports.pins import PinFaults, SimulatedLines, pin_rates, pull_files
from imud.sim.ports.pty import Adapter, PtyNode, SimulatedPort, sharpen_timers
from imud.sim.sensor import StreamModule


def main(arguments: list[str] | None = None) -> int:
    """Run `python -m imud.sim`. Return the exit status."""
    return run_simulator(make_parser().parse_args(arguments), stays=False)


def run_simulator(options: argparse.Namespace, *, stays: bool) -> int:
    """Simulate the devices of the options. Return the exit status. `stays`: the end of stdin does not end it."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # both signals end as KeyboardInterrupt
    now_ns = time.monotonic_ns()
    devices: list[tuple[str, int]] = options.device or [(DEVICE, 0)]
    if all(name in CAN_SIMULATORS for name, _ in devices):
        return _run_on_can(options, devices, now_ns, stays=stays)
    if len(devices) > 1:
        print("imud sim: expected one device on a terminal, or one or more devices on a CAN bus", file=sys.stderr)
        return 2
    ((name, node),) = devices
    try:
        module = SIMULATORS[name].make(module_options(options, node), now_ns)
        faults = Faults(options.seed, rates_from(options.faults)) if options.faults else None
        lines = _lines(options, module)
    except (ValueError, OSError) as error:
        file = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
        print(f"imud sim: {file}{reason_of(error)}", file=sys.stderr)
        return 2
    sharpen_timers()
    with closing(lines), ExitStack() as stack:
        truth = stack.enter_context(options.truth.open("w")) if options.truth else None
        path = options.path or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-sim-"))) / "tty"
        port = SimulatedPort(module, PtyNode(path), Adapter(ADAPTERS[options.adapter], now_ns), faults, truth)
        stack.callback(port.close)
        with suppress(KeyboardInterrupt):
            print(path, flush=True)
            StandardInputControl(port, time.monotonic_ns, lines, stays=stays).run()
        print(json.dumps(port.summary() | lines.summary()), flush=True)
    return 0


def _run_on_can(options: argparse.Namespace, devices: list[tuple[str, int]], now_ns: int, *, stays: bool) -> int:
    try:
        modules = [CAN_SIMULATORS[name].make(module_options(options, node), now_ns) for name, node in devices]
        port = CanPort(
            CanModules(modules) if len(modules) > 1 else modules[0], options.interface or default_interface()
        )
    except (ValueError, LinkError) as error:
        print(f"imud sim: {error}", file=sys.stderr)
        return 2
    sharpen_timers()
    with closing(port):
        with suppress(KeyboardInterrupt):
            print(port.interface, flush=True)
            StandardInputControl(port, time.monotonic_ns, stays=stays).run()
        print(json.dumps(port.summary()), flush=True)
    return 0


def _lines(options: argparse.Namespace, module: StreamModule) -> SimulatedLines:
    """Return the lines of the options. Raises ValueError for unknown pins or faults, OSError."""
    files = pull_files(options.pins, options.pin_settle / 1e3)
    faults = PinFaults(options.seed, pin_rates(options.pin_faults)) if files and options.pin_faults else None
    truth = options.pin_truth.open("w") if options.pin_truth else None
    return SimulatedLines(module, files, faults, truth, options.sin)


if __name__ == "__main__":
    sys.exit(main())
