"""Faults for `imud doctor`, caused on the buses of the kernel and diagnosed next to the real daemon.

The kernel module of the lab sets the error counters of a CAN controller (README.md). Bytes of a UART at a wrong rate
come from the simulator behind a pseudo-terminal.
"""

import errno
import os
import re
import select
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Final
from urllib.request import urlopen

import msgspec
import pytest
import serial

import imud
from imud.contracts.status import DeviceState, DeviceStatus
from tests.lab.bus import Bus
from tests.lab.can_interface import CanInterface
from tests.lab.gpio_chip import GpioChip
from tests.lab.imu61x_bus import on_i2c, on_spi, registers
from tests.lab.imu_process import running_imu, tell, tty
from tests.lab.serial_port import PseudoTerminal, pseudo_terminal
from tests.lab.test_gpio_lines import INTERRUPTS
from tests.lab.tool import running, tool
from tests.lab.wire import I2cTransfer, Refuse, SpiTransfer
from tests.support.daemon_process import RunningDaemon, running_daemon, wait_until, write_config
from tests.support.files import ROOT, hi91

LIMIT_S: Final = 150.0
STATUS: Final = {"error": 2, "warning": 1}
"""Exit status by severity (docs/doctor.md); 0 for all other severities."""
ORDINARY_USER: Final = (
    "setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "--inh-caps=+dac_read_search",
    "--ambient-caps=+dac_read_search",
)  # fmt: skip
"""Runs a program as `nobody` without groups. It may read all files: the interpreter may be in root's home."""


class Found(msgspec.Struct, frozen=True):
    severity: str
    seen: str
    advice: str


class CheckOutcome(msgspec.Struct, frozen=True):
    name: str
    findings: list[Found]


class Diagnosis(msgspec.Struct, frozen=True):
    status: int
    complete: bool
    verdict: str
    checks: list[CheckOutcome]

    def of(self, severity: str) -> list[tuple[str, str]]:
        return [
            (check.name, found.seen) for check in self.checks for found in check.findings if found.severity == severity
        ]

    def advice(self, check: str, severity: str, seen: str, advice: str = "") -> str:
        found = [one for each in self.checks if each.name == check for one in each.findings]
        fitting = [one for one in found if one.severity == severity and seen in one.seen and advice in one.advice]
        assert fitting, f"{check}: expected {severity} with {seen!r} and the step {advice!r}, got {found}"
        return fitting[0].advice

    def has(self, check: str, severity: str, seen: str, advice: str = "") -> None:
        self.advice(check, severity, seen, advice)


def diagnose(config: Path, socket: Path, *prefix: str) -> Diagnosis:
    """Run `imud doctor` after the words `prefix`. Check that the exit status matches the worst finding."""
    doctor = (sys.executable, "-m", "imud", "doctor", "--json", "--socket", str(socket), "--config", str(config))
    result = subprocess.run([*prefix, *doctor], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert not result.stderr, result.stderr
    found = msgspec.json.decode(result.stdout, type=Diagnosis)
    severities = [one.severity for check in found.checks for one in check.findings]
    assert result.returncode == found.status == max(STATUS.get(severity, 0) for severity in severities)
    return found


pytestmark = pytest.mark.timeout(600)

METRICS_PORT = 19322
DEAF_RATE_HZ = 10
ANSWERED_AFTER_S = 60
"""Time in imud.cli.doctor.daemon, s: a device without a reply for this time does not receive requests."""
DIALOUT = 20


@contextmanager
def daemon(folder: Path, devices: dict[str, object], **more: object) -> Iterator[RunningDaemon]:
    with running_daemon(folder, devices, limit_s=LIMIT_S, python=(), **more) as made:
        yield made


def doctor(made: RunningDaemon, *prefix: str) -> Diagnosis:
    return diagnose(made.folder / "imud.yaml", made.socket, *prefix)


def wait_for(made: RunningDaemon, name: str, holds: Callable[[DeviceStatus], object], what: str) -> None:
    wait_until(lambda: bool(holds(made.statuses()[name])), f"{name}: {what}", LIMIT_S)


def wait_running(made: RunningDaemon, *names: str) -> None:
    for name in names:
        wait_for(made, name, lambda one: one.state is DeviceState.RUNNING, "samples")


@contextmanager
def simulator(*options: str) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "imud.sim", "--boot", "0", *options]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        try:
            yield process
        finally:
            process.communicate(timeout=LIMIT_S)


@contextmanager
def working(step: Callable[[Event], None]) -> Iterator[None]:
    ended = Event()
    thread = Thread(target=step, args=(ended,))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(LIMIT_S)


def echo(far: PseudoTerminal) -> Callable[[Event], None]:
    def step(ended: Event) -> None:
        while not ended.is_set():
            if select.select([far.far_fd], [], [], 0.05)[0]:
                far.write(os.read(far.far_fd, 4096))

    return step


def one_way(path: Path) -> Callable[[Event], None]:
    def step(ended: Event) -> None:
        number = 0
        with serial.Serial(str(path), 115200, write_timeout=1) as port:
            while not ended.wait(1 / DEAF_RATE_HZ):
                number += 1
                # QEMU takes no byte while the port at the other end is closed
                with suppress(serial.SerialTimeoutException):
                    port.write(hi91(number * 1000 // DEAF_RATE_HZ))
            port.reset_output_buffer()

    return step


def uart(port: Path | str, baud: int = 115200) -> dict[str, object]:
    return {"driver": "hipnuc-uart", "uart": {"port": str(port), "baud": baud}}


def modbus(line: Path) -> dict[str, object]:
    return {"driver": "hipnuc-modbus", "rs485": {"line": str(line), "baud": 115200, "address": 80}}


def test_the_package_is_that_of_this_tree() -> None:
    assert Path(imud.__file__).is_relative_to(ROOT)


@pytest.mark.thorough
def test_healthy_devices_then_a_newer_file_then_no_daemon(
    can_pair: tuple[CanInterface, CanInterface], i2c: Bus[I2cTransfer], spi8: Bus[SpiTransfer], tmp_path: Path
) -> None:
    i2c.attach(0x18, on_i2c(registers()))
    spi8.attach(0, on_spi(registers()))
    devices: dict[str, object] = {
        "bow": uart(tty(tmp_path)),
        "mast": {"driver": "imu61x-can", "socketcan": {"interface": "can0"}},
        "keel": {"driver": "imu61x-i2c", "i2c": {"bus": 0, "rate_hz": 10}},
        "deck": {"driver": "imu61x-spi", "spi": {"port": "/dev/spidev0.0", "rate_hz": 10}},
    }
    metrics = {"port": METRICS_PORT}
    with (
        simulator("--path", str(tty(tmp_path)), "--rate", "10"),
        simulator("--device", "imu61x-can", "--interface", "can1", "--rate", "10"),
        daemon(tmp_path, devices, metrics=metrics) as made,
    ):
        wait_running(made, *devices)
        found = doctor(made)
        assert found.of("error") == []
        # possible findings of an emulated system after other tests
        allowed = {"clock", "processor", "kernel log", "CAN state"}
        assert {check for check, _ in found.of("warning")} <= allowed
        found.has("clock", "warning", "synchronised", "chrony")
        found.has("service", "not checked", "does this host use systemd?")
        for check, seen in {
            "configuration": "is valid", "socket": "the daemon replies", "ports": "exists",
            "rights": "user root can open ", "ports taken": "no other program uses ",
            "serial data": "bow: ", "CAN interfaces": "can0 is up", "CAN state": "can0 is ERROR-ACTIVE",
            "CAN bit rate": "can0 has 500000 bit/s", "bus nodes": "/dev/i2c-0 exists", "I2C": "keel: ",
            "SPI": "deck: ", "stale configuration": "the daemon uses the configuration in",
        }.items():  # fmt: skip
            found.has(check, "ok", seen)
        found.has("Prometheus", "note", "no scrape of 127.0.0.1 port", "docs/monitoring.md")
        with urlopen(f"http://127.0.0.1:{METRICS_PORT}/metrics", timeout=LIMIT_S) as answer:
            assert answer.read()
        write_config(tmp_path, {**devices, "stern": uart("/dev/ttyUSB9")}, metrics=metrics)
        found = doctor(made)
        found.has("Prometheus", "ok", "1 scrapes")
        found.has("stale configuration", "warning", "contains bow, deck, keel, mast, stern", "systemctl reload imud")
        found.has("ports", "error", "/dev/ttyUSB9 does not exist; ports of this host: ", "imud probe")
    found = doctor(made)
    found.has("socket", "error", str(made.socket), "systemctl start imud")
    for check in ("devices", "serial data", "I2C", "SPI"):
        found.has(check, "not checked", "the daemon does not reply")
    assert not found.complete


@pytest.mark.thorough
def test_mistakes_and_a_port_that_is_the_console(tmp_path: Path) -> None:
    """No daemon runs, because no process may open that port."""
    config = write_config(tmp_path, {"bow": uart("/dev/ttyS0")})
    found = diagnose(config, tmp_path / "imud.sock")
    found.has("ports taken", "error", "/dev/ttyS0 is a console of the kernel", "remove `console=ttyS0`")
    found.has("socket", "error", "imud.sock", "--socket")
    write_config(tmp_path, {"bow": {"driver": "hipnuc-uart", "uart": {"prot": "/dev/ttyS1"}}})
    found = diagnose(config, tmp_path / "imud.sock")
    found.has("configuration", "error", "prot", "imud check")
    found.has("stale configuration", "not checked", "cannot compare the running daemon")


@pytest.mark.thorough
def test_serial_ports(uarts: tuple[Path, Path], tmp_path: Path) -> None:
    """Check with one daemon: silence, noise, wrong baud rate, used port, one-way wires, and RS-485 without a device."""
    near, far = uarts
    with ExitStack() as stack:
        quiet, bits, held, line, loop = (stack.enter_context(pseudo_terminal()) for _ in range(5))
        holder = stack.enter_context(port_held(held.path))
        stack.enter_context(simulator("--path", str(tty(tmp_path)), "--rate", "20", "--baud", "115200"))
        stack.enter_context(working(one_way(far)))
        stack.enter_context(working(echo(loop)))
        taken = stack.enter_context(socket.create_server(("127.0.0.1", METRICS_PORT)))
        devices: dict[str, object] = {
            "quiet": uart(quiet.path), "bits": uart(bits.path), "held": uart(held.path),
            "slow": uart(tty(tmp_path), 9600), "deaf": uart(near), "line": modbus(line.path),
            "loop": modbus(loop.path),
        }  # fmt: skip
        made = stack.enter_context(daemon(tmp_path, devices, metrics={"port": taken.getsockname()[1]}))
        wait_for(made, "bits", lambda one: one.state is DeviceState.SEARCHING, "its port is open")
        bits.write(b"\x55" * 40)
        for name, enough in {"bits": 40, "slow": 400}.items():
            wait_for(made, name, lambda one, least=enough: one.ledger["bytes_in"] >= least, "bytes")  # type: ignore[misc]  # a lambda's default
        for name in ("line", "loop"):
            wait_for(made, name, lambda one: one.serial_line and one.serial_line.timeouts > 3, "requests")
        enough_samples = 1.1 * ANSWERED_AFTER_S * DEAF_RATE_HZ
        wait_for(made, "deaf", lambda one: one.ledger["samples"] > enough_samples, "a minute of samples")
        found = doctor(made)
        assert found.status == 2
        found.has("serial data", "error", "quiet: no byte arrives on", "Are TX and RX swapped")
        found.has("serial data", "error", "bits: only 40 bytes arrived", "echoes of imud's requests")
        found.has("serial data", "error", "slow: ", "set `baud: auto`")
        found.has("serial data", "warning", "deaf sends samples, but never replied", "connect TX of the adapter to RX")
        found.has("RS-485", "error", "no byte arrived on", "A and B (swapped?)")
        found.has("RS-485", "error", "echoes of its requests on", "`direction`")
        found.has("ports taken", "error", f"{held.path} is open in another program: ", "stop the program")
        assert any(f"pid {holder.pid}" in seen for _, seen in found.of("error"))
        found.has("devices", "error", "held: ", "see the findings about its port, bus and lines")
        found.has("Prometheus", "error", "metrics do not reply at 127.0.0.1", "does another program use the port?")
        check_rights(made, near)


def check_rights(made: RunningDaemon, port: Path) -> None:
    """Check a port that a normal user may not open. It belongs to root, then to a group, then to all users."""
    before = port.stat()
    try:
        os.chmod(port, 0o600)
        os.chown(port, 0, 0)
        found = doctor(made, *ORDINARY_USER)
        refused = f"user nobody cannot open {port}: the node belongs to group "
        found.has("rights", "error", f"{refused}root, EACCES", 'udev rule SUBSYSTEM=="tty", KERNEL=="')
        found.has("socket", "not checked", "", "join the group and log in again")
        found.has(
            "ports taken", "not checked", f"cannot check whether another program uses {port}", "run `sudo imud doctor`"
        )
        os.chmod(port, 0o660)
        os.chown(port, 0, DIALOUT)
        found = doctor(made, *ORDINARY_USER)
        found.has("rights", "error", f"{refused}dialout, EACCES", "usermod --append --groups dialout nobody`")
        member = [f"--groups={DIALOUT}" if word == "--clear-groups" else word for word in ORDINARY_USER]
        doctor(made, *member).has("rights", "ok", f"user nobody can open {port}")
    finally:
        os.chown(port, before.st_uid, before.st_gid)
        os.chmod(port, before.st_mode & 0o777)


@contextmanager
def port_held(path: Path) -> Iterator["subprocess.Popen[str]"]:
    """Run a program with exclusive access to the port, like terminal programs."""
    code = f"import serial, time\nport = serial.Serial({str(path)!r}, exclusive=True)\nprint(1, flush=True)\n"
    with running(sys.executable, "-c", code + "time.sleep(3600)") as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "1\n"
        yield process


def test_can(can_pair: tuple[CanInterface, CanInterface], tmp_path: Path) -> None:
    near, _ = can_pair
    with daemon(tmp_path, {"mast": {"driver": "imu61x-can", "socketcan": {"interface": near.name}}}) as made:
        wait_for(made, "mast", lambda one: one.state is DeviceState.SEARCHING, "the interface is open")
        with near.error_counters(128, 0):
            found = doctor(made)
            found.has("CAN bit rate", "error", "mast: no frame arrives at 500000", "try 125000, 250000, 1000000")
            found.has("CAN state", "error", "tx 128, rx 0", "no other node acknowledges")
        with near.error_counters(0, 127):
            found = doctor(made)
            found.has("CAN state", "error", "tx 0, rx 127", "a terminator is missing, or the bit rate is wrong")
        with simulator("--device", "imu61x-can", "--interface", "can1", "--rate", "10"):
            wait_running(made, "mast")
            found = doctor(made)
            found.has("CAN state", "ok", f"{near.name} is ERROR-ACTIVE")
            found.has("CAN state", "note", "does not restart after bus-off", "restart-ms 100")
            check_states(made, near)
        wait_for(made, "mast", lambda one: one.state is not DeviceState.RUNNING, "its module is gone")
        with near.error_counters(128, 0):
            found = doctor(made)
            found.has("CAN state", "error", "tx 128", "no other node acknowledges")
            found.has("CAN bit rate", "error", "mast: no frame arrives at 500000", "power and wiring of the device")
        near.down()
        found = doctor(made)
        found.has("CAN interfaces", "error", f"{near.name} is down", f"ip link set {near.name} up type can bitrate")
        tool("ip", "link", "set", near.name, "type", "can", "bitrate", "100000")
        near.up()
        doctor(made).has("CAN bit rate", "warning", "100000 bit/s, which no supported device uses", "one of 125000")


def check_states(made: RunningDaemon, near: CanInterface) -> None:
    """Check a controller that becomes error-passive and bus-off, and recovers after the advised commands."""
    near.enter("error-passive")
    doctor(made).has("CAN state", "warning", f"{near.name} is ERROR-PASSIVE", "120 Ω at both ends")
    near.enter("error-active")
    near.enter("bus-off")
    found = doctor(made)
    advice = found.advice("CAN state", "error", f"{near.name} is BUS-OFF")
    commands = re.findall(r"`sudo (ip .*?)`", advice)
    assert len(commands) == 2, advice
    assert "restart-ms 100`; check: 120 Ω at both ends" in advice
    found.has("kernel log", "warning", "errors of CAN controllers", "terminators, bit rate and wiring")
    for command in commands:
        tool(*command.split())  # the kernel refuses restart-ms while the interface is up
    wait_running(made, "mast")
    doctor(made).has("CAN state", "warning", f"{near.name} was bus-off ", "120 Ω at both ends")


@pytest.mark.thorough
def test_i2c_and_spi(i2c: Bus[I2cTransfer], spi8: Bus[SpiTransfer], spi16: Bus[SpiTransfer], tmp_path: Path) -> None:
    """Check silent addresses and chip selects, failed or damaged transfers, swapped bytes, missing nodes."""
    damaged = registers()
    i2c.attach(0x19, refusing(on_i2c(registers()), 10))
    i2c.attach(0x1A, on_i2c(damaged))
    shifted = registers(modes=frozenset({3}))
    spi8.attach(1, exchanged(on_spi(registers())))
    spi16.attach(0, on_spi(shifted))

    def on(bus: int, address: int) -> dict[str, object]:
        return {"driver": "imu61x-i2c", "i2c": {"bus": bus, "address": address, "rate_hz": 10}}

    def at(port: str, **more: object) -> dict[str, object]:
        return {"driver": "imu61x-spi", "spi": {"port": port, "rate_hz": 10, **more}}

    devices: dict[str, object] = {
        "absent": on(0, 0x18), "flaky": on(0, 0x19), "noisy": on(0, 0x1A), "nowhere": on(7, 0x18),
        "dumb": at("/dev/spidev0.0"), "mixed": at("/dev/spidev0.1"), "late": at("/dev/spidev1.0", mode=0),
        "away": at("/dev/spidev7.0"),
    }  # fmt: skip
    with daemon(tmp_path, devices) as made:
        wait_running(made, "noisy")
        damaged.faults.flips = 2
        wait_for(made, "noisy", lambda one: one.ledger["frames_bad_crc"] > 0, "a damaged answer")
        wait_for(made, "flaky", lambda one: one.polling and one.polling.failed > 1, "failed transfers")
        for name in ("absent", "dumb", "mixed", "late"):
            wait_for(made, name, lambda one: one.problem, "a reason")
        wait_running(made, "flaky", "noisy")
        found = doctor(made)
    assert found.status == 2
    found.has(
        "bus nodes", "error", "/dev/i2c-7 does not exist; existing nodes of this kind: /dev/i2c-0", "modprobe i2c-dev"
    )
    found.has(
        "bus nodes", "error", "/dev/spidev7.0 does not exist; existing nodes of this kind: /dev/spidev0.0", "spi=on"
    )
    found.has("I2C", "error", "absent: no samples on", "If no device replies at address 0x18")
    found.has("I2C", "warning", "transfers failed", "pull-ups of 2 to 5 kΩ")
    found.has("I2C", "warning", "replies were damaged", "a lower bus clock")
    found.has("SPI", "error", "dumb: no samples on", "if all bytes are 00: check MISO and power")
    found.has("SPI", "error", "mixed: no samples on", "the two bytes of each word are swapped")
    found.has("SPI", "error", "late: no samples on", "shifted by one bit; imud uses the configured mode 0")


def refusing(answer: Callable[[I2cTransfer], bytes], every: int) -> Callable[[I2cTransfer], bytes]:
    number = 0

    def device(transfer: I2cTransfer) -> bytes:
        nonlocal number
        number += 1
        if number % every == 0:
            raise Refuse(errno.EIO)
        return answer(transfer)

    return device


def exchanged(answer: Callable[[SpiTransfer], bytes]) -> Callable[[SpiTransfer], bytes]:
    def device(transfer: SpiTransfer) -> bytes:
        data = answer(transfer)
        return bytes(data[place ^ 1] for place in range(len(data)))

    return device


@pytest.mark.thorough
def test_lines_and_restarts(gpio_chip: GpioChip, tmp_path: Path) -> None:
    """SOUT, PPS and ALARM are not connected. The device restarts by itself."""
    lines = {"sout": {"line": "SOUT"}, "pps": {"line": "PPS"}, "alarm": {"line": "ALARM"}}
    devices: dict[str, object] = {"bow": {**uart(tty(tmp_path)), "lines": lines}}
    with ExitStack() as stack:
        imu = stack.enter_context(running_imu(tmp_path, gpio_chip, {}, "--rate", "20"))
        tell(tmp_path, "CONFIG PMUX5 Y,-89,89,0,1")  # the device never leaves this range
        made = stack.enter_context(daemon(tmp_path, devices))
        wait_for(made, "bow", lambda one: one.ledger["samples"] > 250, "enough samples")
        found = doctor(made)
        found.has("lines", "warning", "bow: sout: no edge in", "is the wire connected to this GPIO")
        found.has("lines", "warning", "bow: pps: no pulse in", "does the receiver have a fix?")
        found.has("lines", "note", "bow: alarm: no edge so far", "tilt the device beyond a limit")
        assert imu.process.stdin is not None
        for number in range(1, 4):
            seen = made.statuses()["bow"].ledger["samples"]
            # the device time cannot distinguish two restarts that follow each other directly
            wait_for(made, "bow", lambda one, least=seen + 20: one.ledger["samples"] >= least, "samples")  # type: ignore[misc]  # a lambda's default
            imu.process.stdin.write("reboot\n")
            imu.process.stdin.flush()
            wait_for(made, "bow", lambda one, least=number: one.clock.resets >= least, "the restart in the status")  # type: ignore[misc]  # a lambda's default
        wait_for(made, "bow", lambda one: any(why.code == "restarts" for why in one.reasons), "the reason")
        doctor(made).has("devices", "warning", "bow: The device restarted 3 times", "supply voltage")


@pytest.mark.thorough
def test_a_line_of_another_program(gpio_chip: GpioChip, tmp_path: Path) -> None:
    devices: dict[str, object] = {"bow": {**uart(tty(tmp_path)), "lines": {"alarm": {"line": "ALARM"}}}}
    with running("gpiomon", gpio_chip.path.name, str(gpio_chip.names.index("ALARM"))):
        wait_until(lambda: "gpiomon" in INTERRUPTS.read_text(encoding="ascii"), "gpiomon has its interrupt")
        with daemon(tmp_path, devices) as made:
            wait_for(made, "bow", lambda one: one.lines and one.lines.problems, "the line is busy")
            found = doctor(made)
            found.has("lines", "error", "is in use by gpiomon", "`gpioinfo` lists the lines and their users")
            found.has("ports", "error", f"{tty(tmp_path)} does not exist", "")
