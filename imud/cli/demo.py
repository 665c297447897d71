"""`imud demo`: the real daemon on a simulated sensor behind a real pty or CAN interface, watched by a real client.

Three processes, as in life: the simulator plays the module, `imud run` owns its port, and this one is a client that
shows what arrives. At the end it prints rates, latency and the ledger.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import monotonic, sleep

import msgspec

from imud.cli.connect import statuses
from imud.cli.demo_view import View
from imud.cli.status import block, closes
from imud.client import Client
from imud.errors import ImudError, LinkMissing
from imud.sim import CAN_SIMULATORS, SIMULATORS
from imud.sim.can_port import default_interface

START_LIMIT_S = 10.0
STOP_LIMIT_S = 5.0
FOUND_LIMIT_S = 10.0
"""Cold detection takes under two seconds; a loaded machine gets five times that."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud demo`."""
    parser.add_argument(
        "--device", default="hipnuc-uart", choices=sorted([*SIMULATORS, *CAN_SIMULATORS]), help="default: %(default)s"
    )
    parser.add_argument("--interface", metavar="NAME", help="CAN interface of a CAN device (the first that is up)")
    parser.add_argument("--duration", type=float, metavar="S", help="stop after S seconds (default: at Ctrl-C)")
    parser.add_argument(
        "--rate", type=float, default=100.0, metavar="HZ", help="samples a second (default: %(default)s)"
    )
    parser.add_argument("--plain", action="store_true", help="no live view, only the account at the end")


def run(args: argparse.Namespace) -> int:
    """0 when samples flowed and the ledger closed."""
    interface = (args.interface or default_interface()) if args.device in CAN_SIMULATORS else ""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-demo-")))
        stack.enter_context(simulator(folder, args.device, args.rate, interface))
        stack.enter_context(daemon(folder, device(folder, args.device, interface)))
        return show(folder / "imud.sock", args)


def show(path: Path, args: argparse.Namespace) -> int:
    """Watch until the time is over or someone interrupts, then give account."""
    view = View(sys.stdout, live=not args.plain and sys.stdout.isatty())
    print(f"daemon at {path}; in another terminal: imud watch --socket {path}", flush=True)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with Client(str(path), timeout_s=FOUND_LIMIT_S) as client:
            until = monotonic() + args.duration if args.duration else None
            for sample in client.watch(encoding="binary"):
                view.add(sample)
                if until is not None and monotonic() >= until:
                    break
    except KeyboardInterrupt:
        pass
    with Client(str(path)) as client:
        status = statuses(client)[0]
    view.end()
    print(block(status))
    print(view.account())
    good = status.ledger["samples"] > 0 and view.samples > 0 and closes(status.ledger)
    print("the ledger closes to zero" if good else "FAILED: no samples, or a ledger that does not close")
    return 0 if good else 1


@contextmanager
def simulator(folder: Path, device: str, rate_hz: float, interface: str) -> Iterator[None]:
    """The simulated sensor, its port at `folder`/port, or on a CAN interface."""
    argv = [
        sys.executable,
        "-m",
        "imud.sim",
        "--device",
        device,
        "--rate",
        str(rate_hz),
        "--path",
        str(folder / "port"),
        "--interface",
        interface,
    ]
    with child(argv, "the simulator", stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        if not process.stdout.readline():
            raise ImudError(f"the simulator ended with status {process.wait()} before it had a port")
        yield


def device(folder: Path, name: str, interface: str) -> dict[str, object]:
    """Configuration of the device that is simulated."""
    if interface:
        return {"driver": name, "socketcan": {"interface": interface}}
    return {"driver": "auto", "uart": {"port": str(folder / "port"), "baud": "auto"}}


@contextmanager
def daemon(folder: Path, settings: dict[str, object]) -> Iterator[None]:
    """`imud run` on the simulated device, with everything it needs below `folder`."""
    tree = {
        "log_level": "error",
        "state_dir": str(folder),
        "socket": {"path": str(folder / "imud.sock")},
        "shm": {"directory": str(folder)},
        "metrics": {"port": 0},
        "devices": {"demo": settings},
    }
    file = folder / "imud.yaml"
    file.write_bytes(msgspec.json.encode(tree))  # JSON is YAML
    with child([sys.executable, "-m", "imud", "run", "--config", str(file)], "the daemon") as process:
        end = monotonic() + START_LIMIT_S
        while not (folder / "imud.sock").exists():
            if process.poll() is not None:
                raise ImudError(f"the daemon ended with status {process.returncode} at its start")
            if monotonic() > end:
                raise LinkMissing(f"the daemon opened no socket within {START_LIMIT_S:.0f} s")
            sleep(0.01)
        yield


@contextmanager
def child(argv: list[str], name: str, **options: int) -> Iterator[subprocess.Popen[str]]:
    """A child process that does not see our Ctrl-C and is ended with us."""
    environment = dict(os.environ, PYTHONUNBUFFERED="1")
    with subprocess.Popen(
        argv, stdin=subprocess.PIPE, text=True, env=environment, start_new_session=True, **options
    ) as process:  # type: ignore[call-overload]  # the overloads do not know a mapping of options
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(STOP_LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                print(f"{name} had to be killed", file=sys.stderr)
