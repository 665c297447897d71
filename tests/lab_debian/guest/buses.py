"""The daemon on I2C, SPI and GPIO nodes of the kernel of Debian, and its feed to chronyd, confined by its unit.

These buses have no devices: the test checks that the daemon opens the nodes and reports the missing devices. The kernel
of the lab (`make lab`) has devices on such buses.
"""

import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.lab_debian.guest import system
from tests.lab_debian.guest.checks import Checks, Failed, expect, wait_until

NODES = {
    "x86_64": ("ttyUSB0", "ttyS1", "i2c-0", "spidev*", "gpiochip0"),
    "aarch64": ("ttyUSB0", "ttyAMA0", "gpiochip0"),
}
"""Patterns of names in /dev by machine, one for each kind of node that README.md promises (What the guest has)."""
SPI = Path("/sys/bus/spi")
CHIP = Path("/dev/gpiochip0")
FREE_LINE = """
import gpiod
with gpiod.Chip('/dev/gpiochip0') as chip:
    print(next(line for line in range(chip.get_info().num_lines) if not chip.get_line_info(line).used))
"""
CHRONY_SOCKET = "/run/chrony.imud.sock"
CHRONY = Path("/etc/systemd/system/chrony.service")
CHRONY_FILES = {
    "/etc/chrony/conf.d/imud.conf": f"refclock SOCK {CHRONY_SOCKET} refid IMUD poll 3\n",
    "/etc/systemd/system/chrony.service.d/imud.conf": f"[Service]\nExecStartPost=+/bin/chown imud {CHRONY_SOCKET}\n",
    "/etc/default/chrony": 'DAEMON_OPTS="-F 1 -x"\n',  # -x: do not change the guest's clock
}
PULSES = 12
FEED = f"""
import sys, time
sys.path[:0] = [{{path!r}}]
from imud.utc.pps import ChronyFeed
feed = ChronyFeed({CHRONY_SOCKET!r}, lambda: time.time_ns() - time.monotonic_ns())
for _ in range({PULSES}):
    time.sleep(1 - time.time() % 1)
    feed.send_pulse(time.monotonic_ns(), round(time.time()))
print(feed.sent, feed.refused, feed.problem)
"""


def make_nodes() -> None:
    """Create a node for each kind of bus for which Debian's kernel has a driver of QEMU's machine (machine.py)."""
    system.must("modprobe", "i2c-dev")
    system.run("modprobe", "i2c-stub", "chip_addr=0x18")
    for module in ("pcengines-apuv2", "parport_pc", "spi-butterfly"):
        system.run("modprobe", module)
    for found in SPI.glob("devices/*"):
        if not (found / "driver").exists():
            (found / "driver_override").write_text("spidev")
            (SPI / "drivers/spidev/bind").write_text(found.name)
    system.must("udevadm", "settle")


def is_there(checks: Checks, pattern: str, what: str) -> bool:
    """Return whether a matching node exists. Fail a check if README.md promises the node; otherwise print a note."""
    if any(Path("/dev").glob(pattern)):
        return True
    if pattern in NODES[platform.machine()]:
        with checks(what):
            raise Failed(f"expected a node /dev/{pattern} (README.md), got none")
    else:
        checks.skip(what, "this system has no such node")
    return False


def check(checks: Checks, _host: system.Host) -> None:
    make_nodes()
    check_i2c(checks)
    check_gpio(checks)
    check_spi(checks)
    check_chrony(checks)


@contextmanager
def further_device(text: str) -> Iterator[str]:
    """Add a device to the configuration during the block. Yield the problem that the daemon reports for it."""
    before = system.CONFIG.read_text()
    since = system.mark()
    system.configure(before + text)
    system.start_service()
    wait_until(lambda: (system.device("keel") or {}).get("problem"), "a problem of the device")
    problem: str = (system.device("keel") or {})["problem"]
    try:
        if "cannot open" in problem or "cannot open" in system.journal(since):
            raise Failed(problem)
        yield problem
    finally:
        system.configure(before)
        system.must("systemctl", "reload", system.UNIT)
        system.wait_streaming("usb")


def check_i2c(checks: Checks) -> None:
    if not is_there(checks, "i2c-0", "the daemon opens an I2C bus"):
        return
    with (
        checks("the daemon opens an I2C bus and reports a missing device, not a missing permission"),
        further_device("  keel:\n    driver: imu61x-i2c\n    i2c: {bus: 0, address: 24, rate_hz: 1}\n") as problem,
    ):
        checks.note(problem)


def check_gpio(checks: Checks) -> None:
    """Check an output line of a chip without interrupts."""
    if not is_there(checks, CHIP.name, "the daemon drives a GPIO line"):
        return
    with checks("a GPIO chip belongs to its group"):
        expect("group and mode", (CHIP.group(), CHIP.stat().st_mode & 0o777), ("gpio", 0o660))
    with checks("the daemon drives a GPIO line, and names the line without interrupts"):
        line = int(system.must(system.PYTHON, "-c", FREE_LINE))
        lines = f"lines: {{reset: {{line: {line}, chip: gpiochip0}}}}"
        with further_device(f"  keel:\n    driver: imu61x-uart\n    uart: {{port: /dev/ttyS7}}\n    {lines}\n"):
            wait_until(lambda: (system.device("keel") or {}).get("lines"), "the lines of the device")
            expect("problems of lines", (system.device("keel") or {})["lines"]["problems"], {})
            held = [text for text in system.must("gpioinfo").splitlines() if "imud" in text]
            expect("lines that imud holds", len(held), 1)
            checks.note(held[0])


def check_spi(checks: Checks) -> None:
    if not is_there(checks, "spidev*", "the daemon opens an SPI bus"):
        return
    nodes = sorted(Path("/dev").glob("spidev*"))
    with checks("an SPI bus belongs to its group"):
        expect("group and mode", (nodes[0].group(), nodes[0].stat().st_mode & 0o777), ("spi", 0o660))
    text = f"  keel:\n    driver: imu61x-spi\n    spi: {{port: {nodes[0]}, mode: 0, rate_hz: 1}}\n"
    with (
        checks("the daemon transfers on an SPI bus and reports a missing device, not a missing permission"),
        further_device(text) as problem,
    ):
        checks.note(problem)


def check_chrony(checks: Checks) -> None:
    """Check that Debian's chronyd, with its own unit, accepts the samples of the confined user."""
    with checks("chronyd accepts pulses of a program that is confined like the unit"), configured_chronyd():
        code = FEED.format(
            path=system.must(system.PYTHON, "-c", "import imud, os; print(os.path.dirname(imud.__path__[0]))").strip()
        )
        expect("sent, refused", system.confined(code, *system.confinement()).strip(), f"{PULSES} 0")
        wait_until(
            lambda: "IMUD" in reached(), f"expected pulses at chronyd, got {system.run('chronyc', 'sources').stdout}"
        )


@contextmanager
def configured_chronyd() -> Iterator[None]:
    """Run chronyd with the configuration of docs/time.md during the block, then remove it."""
    CHRONY.unlink(missing_ok=True)  # the lab masks this unit
    for name, text in CHRONY_FILES.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(text)
    system.must("systemctl", "daemon-reload")
    try:
        system.must("systemctl", "start", "chrony.service")
        yield
    finally:
        system.run("systemctl", "stop", "chrony.service")
        Path(CHRONY_SOCKET).unlink(missing_ok=True)  # chronyd 4.3 does not remove its socket
        for name in CHRONY_FILES:
            Path(name).unlink()
        Path(CHRONY_SOCKET).unlink(missing_ok=True)  # chronyd has dropped root and cannot remove its socket
        system.must("systemctl", "daemon-reload")


def reached() -> list[str]:
    """Return the sources of chronyd with received samples: their reach is not zero."""
    rows = [row.split(",") for row in system.run("chronyc", "-c", "sources").stdout.splitlines()]
    return [row[2] for row in rows if len(row) > 5 and int(row[5], 8)]
