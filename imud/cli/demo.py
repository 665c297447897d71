"""`imud demo`: run the daemon with a simulated device behind a pty or a CAN interface, and show its samples.

The demo uses three processes: the simulator, `imud run`, and this client. At the end, the client prints the rate, the
latency and the ledger.
"""

import argparse
import os
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from time import monotonic, monotonic_ns, sleep
from typing import TextIO

import msgspec

from imud.bridges.status import closes
from imud.cli.arguments import CliCommand, add_duration, finite, statuses
from imud.cli.status import block
from imud.client.connection import Client
from imud.contracts.driver import CanDriver, PolledDriver
from imud.drivers import DRIVERS
from imud.model.errors import ImudError, LinkMissing
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US, RAD_PER_DEG
from imud.sim import CAN_SIMULATORS, SIMULATORS
from imud.sim.control import DEVICE, simulated
from imud.sim.ports.can_port import default_interface

DRAW_NS = NS_PER_S // 10
LATENCIES_KEPT = 100_000  # number of newest latencies in the percentiles
CLEAR_LINE = "\x1b[2K"
UP = "\x1b[{}A"


class View:
    """View of the samples: counts samples and latencies, and draws the newest sample ten times per second."""

    def __init__(self, out: TextIO, *, live: bool) -> None:
        self.samples = 0
        self.missed = 0
        self._out = out
        self._live = live
        self._drawn_lines = 0
        self._due_ns = 0
        self._first_ns = 0
        self._last: Sample | None = None
        self._seqs: dict[str, int] = {}  # sequence number of the newest sample of each device
        self._latencies_ns: deque[int] = deque(maxlen=LATENCIES_KEPT)

    def add(self, sample: Sample) -> None:
        """Count one sample. Draw the sample if the next redraw is due."""
        now_ns = monotonic_ns()
        if self._last is None:
            self._first_ns = sample.t_ns
        self.missed += sample.seq - self._seqs.get(sample.device, sample.seq - 1) - 1
        self._seqs[sample.device] = sample.seq
        self.samples += 1
        self._last = sample
        self._latencies_ns.append(now_ns - sample.t_rx_ns)
        if self._live and now_ns >= self._due_ns:
            self._due_ns = now_ns + DRAW_NS
            self._draw(sample)

    def end(self) -> None:
        """Keep the last drawing on the terminal."""
        self._drawn_lines = 0  # the next output does not move the cursor up
        self._out.flush()

    def account(self) -> str:
        """Format the rate, the lost samples and the latency of this client."""
        if self._last is None:
            return "  client    no sample arrived"
        span_ns = self._last.t_ns - self._first_ns
        # n samples of a device span n - 1 periods
        rate = (self.samples + self.missed - len(self._seqs)) * NS_PER_S / span_ns if span_ns else 0.0
        ordered = sorted(self._latencies_ns)
        at = {
            share: ordered[min(len(ordered) - 1, int(share * len(ordered)))] / NS_PER_US for share in (0.5, 0.99, 1.0)
        }
        return (
            f"  client    {self.samples} samples at {rate:.2f} Hz, {self.missed} lost; delay from port to client "
            f"p50 {at[0.5]:.0f} µs, p99 {at[0.99]:.0f} µs, max {at[1.0]:.0f} µs"
        )

    def _draw(self, sample: Sample) -> None:
        lines = picture(sample)
        up = UP.format(self._drawn_lines) if self._drawn_lines else ""
        self._out.write(up + "".join(f"{CLEAR_LINE}{line}\n" for line in lines))
        self._out.flush()
        self._drawn_lines = len(lines)


def picture(sample: Sample) -> list[str]:
    """Format a sample in everyday units."""
    degrees, rates = _in(sample.euler_rad, RAD_PER_DEG), _in(sample.gyro_rad_s, RAD_PER_DEG)
    return [
        f"{sample.device} #{sample.seq}   time stamp by {sample.sync}, ±{sample.t_err_ns / NS_PER_MS:.3f} ms",
        f"  roll pitch yaw  {degrees} °",
        f"  gyro            {rates} °/s",
        f"  accel           {_in(sample.accel_m_s2, 1.0)} m/s²",
        f"  mag             {_in(sample.mag_t, 1e-6)} µT",
    ]


def _in(vector: tuple[float, float, float] | None, unit: float) -> str:
    return " ".join(f"{value / unit:9.3f}" for value in vector) if vector else "        -"


Devices = dict[str, dict[str, object]]  # configuration of each device, by name

METRICS_ADDRESS = "127.0.0.1"
METRICS_PORT = 9321
START_LIMIT_S = 10.0
STOP_LIMIT_S = 5.0
FOUND_LIMIT_S = 10.0  # Time limit of the detection, s. Detection takes less than 2 s on an idle host.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--device",
        action="append",
        type=wanted_device,
        metavar="NAME[:NODE]",
        help=f"simulated device (default: {DEVICE}), one of {', '.join(sorted([*SIMULATORS, *CAN_SIMULATORS]))}; "
        "repeat for several devices on one CAN interface; "
        "imu61x-i2c and imu61x-spi: a real device, with --bus or --port",
    )
    parser.add_argument("--bus", type=int, metavar="N", help="I2C bus of a real device, for example 1 for /dev/i2c-1")
    parser.add_argument(
        "--port", metavar="NODE", help="SPI bus and chip select of a real device, for example /dev/spidev0.0"
    )
    parser.add_argument(
        "--interface", metavar="NAME", help="CAN interface of CAN devices (default: the first interface that is up)"
    )
    add_duration(parser, "stop after this time (default: at Ctrl-C)")
    parser.add_argument(
        "--rate", type=finite, default=100.0, metavar="HZ", help="samples per second (default: %(default)s)"
    )
    parser.add_argument("--plain", action="store_true", help="print the summary at the end, no live view")


def run(args: argparse.Namespace) -> int:
    """Run the demo. Return 0 if samples arrived and the ledger balances, otherwise 1."""
    wanted: list[tuple[str, int]] = args.device or [(DEVICE, 0)]
    if any(bus_of(name) for name, _ in wanted):
        return run_on_bus(wanted, args)
    on_can = [name in CAN_SIMULATORS for name, _ in wanted]
    if len(wanted) > 1 and not all(on_can):
        raise ImudError("several devices: expected CAN devices only; simulate one device of another kind at a time")
    if len({*wanted}) < len(wanted):
        raise ImudError("expected different devices, for example --device imu61x-can:101 --device imu61x-can:201")
    interface = (args.interface or default_interface()) if all(on_can) else ""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-demo-")))
        stack.enter_context(simulator(folder, wanted, args.rate, interface))
        names = ["demo"] if len(wanted) == 1 else [f"{name}-{node}" if node else name for name, node in wanted]
        found = (device(folder, name, interface, node) for name, node in wanted)
        return watch_daemon(stack, folder, dict(zip(names, found, strict=True)), args)


def wanted_device(text: str) -> tuple[str, int]:
    """Parse `--device` to name and node. Raises ArgumentTypeError if the device or the node is unknown."""
    return (text, 0) if bus_of(text) else simulated(text)


def bus_of(name: str) -> str:
    """Return `i2c` or `spi` if the driver uses such a bus, which has no simulator. Otherwise return an empty string."""
    driver = DRIVERS.get(name)
    return driver.link if isinstance(driver, PolledDriver) and driver.link in ("i2c", "spi") else ""


def run_on_bus(wanted: list[tuple[str, int]], args: argparse.Namespace) -> int:
    """Run the daemon with a real device on an I2C or SPI bus of this host. Return the exit status."""
    name, bus = wanted[0][0], bus_of(wanted[0][0])
    if len(wanted) > 1:
        raise ImudError(f"expected {name} as the only device, got {len(wanted)} devices")
    key, value = ("bus", args.bus) if bus == "i2c" else ("port", args.port)
    if value is None:
        example = "--bus 1" if bus == "i2c" else "--port /dev/spidev0.0"
        raise ImudError(f"cannot simulate {name}; name the bus of a real device, for example {example}")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-demo-")))
        real: dict[str, object] = {"driver": name, bus: {key: value, "rate_hz": args.rate}}
        return watch_daemon(stack, folder, {"demo": real}, args)


def watch_daemon(stack: ExitStack, folder: Path, devices: Devices, args: argparse.Namespace) -> int:
    """Start the daemon, print commands that use the daemon, and show the samples. Return the exit status."""
    port = free_port()
    stack.enter_context(daemon(folder, devices, port))
    path = folder / "imud.sock"
    words = commands(folder, next(iter(devices)), port)
    print(f"socket of the daemon: {path}; try in another terminal:\n{words}\n", flush=True)
    return show(path, args)


def commands(folder: Path, device: str, port: int) -> str:
    """Return commands for another terminal. The commands work in any directory."""
    python = shlex.quote(sys.executable)
    beside = Path(sys.executable).with_name("imud")
    imud = shlex.quote(str(beside)) if beside.exists() else f"{python} -m imud"
    ring = f'from imud.client import Ring; print(Ring("{device}").latest())'
    lines = [
        f"export IMUD_SOCKET={shlex.quote(str(folder / 'imud.sock'))} IMUD_SHM={shlex.quote(str(folder))}",
        f"{imud} status",
        f"{imud} watch --rate 5",
        f"{imud} clock",
        f"{python} -c {shlex.quote(ring)}",
        f"curl http://{METRICS_ADDRESS}:{port}/metrics",
    ]
    return "\n".join(f"  {line}" for line in lines)


def free_port() -> int:
    """Return the documented port of the metrics if it is free, otherwise another free port."""
    # 0: the kernel selects a free port
    for port in (METRICS_PORT, 0):
        with suppress(OSError), socket.create_server((METRICS_ADDRESS, port)) as server:
            return int(server.getsockname()[1])
    return 0


def show(path: Path, args: argparse.Namespace) -> int:
    """Show samples until the duration ends or a signal arrives, then print the summary. Return the exit status."""
    view = View(sys.stdout, live=not args.plain and sys.stdout.isatty())
    # SIGTERM ends the demo like Ctrl-C, with the summary
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
    with Client(str(path)) as client:  # the first connection may contain unread samples
        found = statuses(client)
    view.end()
    for status in found:
        print(block(status))
    print(view.account())
    good = view.samples > 0 and all(status.ledger["samples"] > 0 and closes(status.ledger) for status in found)
    print("the ledger balances" if good else "FAILED: no samples arrived, or the ledger does not balance")
    return 0 if good else 1


@contextmanager
def simulator(folder: Path, devices: list[tuple[str, int]], rate_hz: float, interface: str) -> Iterator[None]:
    """Run the simulator during the context: one device with the port `folder`/port, or devices on a CAN interface."""
    argv = [
        sys.executable,
        "-m",
        "imud.sim",
        *(word for name, node in devices for word in ("--device", f"{name}:{node}" if node else name)),
        "--rate",
        str(rate_hz),
        "--path",
        str(folder / "port"),
        "--interface",
        interface,
    ]
    with child(argv, "the simulator", stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        if not process.stdout.readline():  # the simulator prints one line when its port exists
            raise ImudError(f"the simulator ended with status {process.wait()} before it opened its port")
        yield


def device(folder: Path, name: str, interface: str, node: int = 0) -> dict[str, object]:
    """Return the configuration of a simulated device."""
    if interface:
        driver = DRIVERS[name]
        options = msgspec.to_builtins(driver.node_settings(node)) if isinstance(driver, CanDriver) and node else {}
        return {"driver": name, "options": options, "socketcan": {"interface": interface}}
    if name == "hipnuc-modbus":
        return {"driver": name, "rs485": {"line": str(folder / "port")}}
    # the demo also shows the detection
    return {"driver": "auto", "uart": {"port": str(folder / "port"), "baud": "auto"}}


@contextmanager
def daemon(folder: Path, devices: Devices, port: int) -> Iterator[None]:
    """Run `imud run` during the context, with its files in `folder`."""
    tree = {
        # warnings would disturb the live view
        "log_level": "error",
        "state_dir": str(folder),
        "socket": {"path": str(folder / "imud.sock")},
        "shm": {"directory": str(folder)},
        "metrics": {"address": METRICS_ADDRESS, "port": port},
        "devices": devices,
    }
    file = folder / "imud.yaml"
    file.write_bytes(msgspec.json.encode(tree))  # JSON is YAML
    with child([sys.executable, "-m", "imud", "run", "--config", str(file)], "the daemon") as process:
        end = monotonic() + START_LIMIT_S
        # with its socket, the daemon accepts clients
        while not (folder / "imud.sock").exists():
            if process.poll() is not None:
                raise ImudError(f"the daemon ended during its start with status {process.returncode}")
            if monotonic() > end:
                raise LinkMissing(f"the daemon did not open its socket within {START_LIMIT_S:.0f} s")
            sleep(0.01)
        yield


@contextmanager
def child(argv: list[str], name: str, **options: int) -> Iterator[subprocess.Popen[str]]:
    """Run a child process during the context. The child does not receive Ctrl-C."""
    # unbuffered: this process reads the first line immediately
    environment = dict(os.environ, PYTHONUNBUFFERED="1")
    with subprocess.Popen(
        argv, stdin=subprocess.PIPE, text=True, env=environment, start_new_session=True, **options
    ) as process:  # type: ignore[call-overload]  # the overloads of Popen do not accept a mapping of options
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(STOP_LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                print(f"{name} did not stop within {STOP_LIMIT_S:.0f} s; imud killed it", file=sys.stderr)


DEMO = CliCommand(add_arguments, run)
