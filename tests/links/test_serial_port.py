"""Serial port: error messages, latency timers of adapters from a simulated /sys, and error counters of the kernel."""

import errno
import fcntl
import os
import termios
from pathlib import Path

import pytest

from imud.contracts.status import KernelCounters
from imud.links import serial_port
from imud.links.device_node import PROC
from imud.model.errors import LinkBusy, LinkDenied, LinkError, LinkMissing
from imud.model.units import NS_PER_MS
from tests.support.leaks import open_descriptors
from tests.support.pty_port import PtyPort, unprivileged

START = (0, 0, 0, 0, 1000, 0, 5, 7, 11, 13, 17, *[0] * 9)
"""Counters cts dsr rng dcd rx tx, then frame overrun parity brk buf_overrun, in the order of linux/serial.h."""
LATER = (0, 0, 0, 0, 2000, 0, 6, 9, 14, 17, 22, *[0] * 9)


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.ENOENT, LinkMissing), (errno.ENXIO, LinkMissing), (errno.ENODEV, LinkMissing),
        (errno.EACCES, LinkDenied), (errno.EPERM, LinkDenied), (errno.EBUSY, LinkBusy), (errno.EAGAIN, LinkBusy),
        (errno.EIO, LinkError), (errno.EINVAL, LinkError),
    ],
)  # fmt: skip
def test_each_number_has_its_error_which_names_the_port(number: int, kind: type[LinkError], tmp_path: Path) -> None:
    for error in (OSError(number, "text"), termios.error(number, "text")):
        explained = serial_port.port_problem(error, "/dev/ttyS9", tmp_path)
        assert type(explained) is kind
        assert "/dev/ttyS9" in str(explained)
    assert "in use by another program" in str(
        serial_port.port_problem(OSError(errno.EBUSY, ""), "/dev/ttyS9", tmp_path)
    )
    assert "no such thing" in str(serial_port.port_problem(ValueError("no such thing"), "/dev/ttyS9", tmp_path))


def test_an_open_port_has_one_descriptor_and_leaves_none() -> None:
    pty = PtyPort()
    before = len(open_descriptors())
    port = serial_port.open_port(str(pty.path), 115200, PROC)
    assert len(open_descriptors()) == before + 1
    port.close()
    port.close()
    assert len(open_descriptors()) == before
    os.chmod(pty.path, 0o666)
    with unprivileged():  # no lock and no exclusive mode remain; root can open a port in exclusive mode
        again = serial_port.open_port(str(pty.path), 115200, PROC)
        again.baudrate = 9600
        again.close()
        killed = os.open(pty.path, os.O_RDWR | os.O_NOCTTY)
        fcntl.ioctl(killed, termios.TIOCEXCL)
        os.close(killed)  # as the kernel closes the port of a killed program
        with pytest.raises(
            LinkBusy, match=r"; stop it first, or start the program again that made the pseudo-terminal"
        ):
            serial_port.open_port(str(pty.path), 115200, PROC)
    pty.unplug()


def timer_of(sys: Path, node: str) -> Path:
    path = sys / "class" / "tty" / node / "device" / "latency_timer"
    path.parent.mkdir(parents=True)
    return path


@pytest.mark.parametrize(("node", "hold_ms"), [("ttyUSB0", 16), ("ttyACM3", 1), ("ttyS0", 0), ("ttyAMA0", 0), ("7", 0)])
def test_without_a_timer_the_kind_of_port_decides(tmp_path: Path, node: str, hold_ms: int) -> None:
    assert serial_port.hold_ns(f"/dev/{node}", tmp_path) == hold_ms * NS_PER_MS


def test_the_timer_is_found_through_a_link(tmp_path: Path) -> None:
    timer_of(tmp_path, "ttyUSB4").write_text("4\n")
    node, link = tmp_path / "ttyUSB4", tmp_path / "by-id"
    node.touch()
    link.symlink_to(node)
    assert serial_port.hold_ns(str(link), tmp_path) == 4 * NS_PER_MS
    (tmp_path / "class/tty/ttyUSB4/device/latency_timer").write_text("?\n")
    assert serial_port.read_latency_timer_ms("/dev/ttyUSB4", tmp_path) is None


def test_only_what_was_counted_since_the_start_is_reported() -> None:
    assert serial_port.relative(START, START) == KernelCounters()
    # one value contains overruns of the UART's FIFO (9 - 7) and of the tty's buffer (22 - 17)
    assert serial_port.relative(START, LATER) == KernelCounters(overrun=7, framing=1, parity=3, break_=4)
    before = (*[0] * 6, 0x7FFF_FFFF, *[0] * 13)
    after = (*[0] * 6, -0x8000_0000, *[0] * 13)
    assert serial_port.relative(before, after).framing == 1
    port = PtyPort()
    assert serial_port.TtyCounters(port.master).read() == KernelCounters()
    port.unplug()
    answers = iter([START, LATER, None])
    counters = serial_port.TtyCounters(0, lambda _fd: next(answers))
    assert counters.read() == counters.read() == serial_port.relative(START, LATER)


@pytest.fixture
def dev(tmp_path: Path) -> Path:
    for folder in ("dev/serial/by-id", "dev/serial/by-path", "sys/class/tty"):
        (tmp_path / folder).mkdir(parents=True)
    return tmp_path / "dev"


@pytest.fixture
def sys(dev: Path) -> Path:
    return dev.with_name("sys")


def native(dev: Path, sys: Path, name: str, kind: str) -> None:
    """Create a port of the 8250 or PL011 driver with its `type`."""
    (dev / name).touch()
    (sys / "class" / "tty" / name).mkdir()
    (sys / "class" / "tty" / name / "type").write_text(f"{kind}\n")


def usb(dev: Path, sys: Path, name: str, **texts: str) -> None:
    """Create a USB adapter like /sys: the tty's device is below the interface, which is below the USB device."""
    (dev / name).touch()
    device = sys / "devices" / "usb1" / f"1-{name}"
    port = device / "1.0" / name
    port.mkdir(parents=True)
    for key, text in texts.items():
        (device / key).write_text(f"{text}\n")
    (sys / "class" / "tty" / name).mkdir()
    (sys / "class" / "tty" / name / "device").symlink_to(port)


def test_an_adapter_is_listed_by_its_lasting_name(dev: Path, sys: Path) -> None:
    usb(dev, sys, "ttyUSB0", manufacturer="FTDI", product="FT232R USB UART", serial="A1")
    (dev / "serial" / "by-id" / "usb-FTDI").symlink_to("../../ttyUSB0")
    (dev / "serial" / "by-path" / "pci-0").symlink_to("../../ttyUSB0")
    expected = serial_port.SerialPort(f"{dev}/serial/by-id/usb-FTDI", f"{dev}/ttyUSB0", "FTDI FT232R USB UART A1")
    assert serial_port.list_ports(dev, sys) == [expected]


def test_without_by_id_the_path_and_then_the_node_is_the_name(dev: Path, sys: Path) -> None:
    usb(dev, sys, "ttyUSB0", product="adapter")
    usb(dev, sys, "ttyUSB1")
    (dev / "serial" / "by-path" / "pci-0").symlink_to("../../ttyUSB0")
    assert serial_port.list_ports(dev, sys) == [
        serial_port.SerialPort(f"{dev}/serial/by-path/pci-0", f"{dev}/ttyUSB0", "adapter"),
        serial_port.SerialPort(f"{dev}/ttyUSB1", f"{dev}/ttyUSB1", ""),
    ]


def test_equal_adapters_without_serial_numbers_are_named_by_their_sockets(dev: Path, sys: Path) -> None:
    """Both adapters have the same by-id name, which refers to the adapter that was plugged in last."""
    for name in ("ttyUSB0", "ttyUSB1"):
        usb(dev, sys, name, product="CH340")
        (dev / "serial" / "by-path" / f"pci-{name[-1]}").symlink_to(f"../../{name}")
    (dev / "serial" / "by-id" / "usb-1a86_CH340").symlink_to("../../ttyUSB1")
    assert [port.path for port in serial_port.list_ports(dev, sys)] == [f"{dev}/serial/by-path/pci-{n}" for n in (0, 1)]


def test_ports_of_one_adapter_keep_their_names(dev: Path, sys: Path) -> None:
    for number in (0, 1):
        usb(dev, sys, f"ttyUSB{number}", product="FT2232H", serial="A1")
        (dev / "serial" / "by-id" / f"usb-FT2232H-if0{number}").symlink_to(f"../../ttyUSB{number}")
        (dev / "serial" / "by-path" / f"pci-{number}").symlink_to(f"../../ttyUSB{number}")
    assert [port.path for port in serial_port.list_ports(dev, sys)] == [
        f"{dev}/serial/by-id/usb-FT2232H-if0{n}" for n in (0, 1)
    ]


def test_ports_without_hardware_and_other_terminals_are_left_out(dev: Path, sys: Path) -> None:
    native(dev, sys, "ttyS0", "4")
    native(dev, sys, "ttyS4", "0")
    native(dev, sys, "ttyAMA0", "32")
    for name in ("tty0", "tty63", "ttyprintk"):
        native(dev, sys, name, "4")
    assert [port.node for port in serial_port.list_ports(dev, sys)] == [f"{dev}/ttyAMA0", f"{dev}/ttyS0"]
    usb(dev, sys, "ttyUSB0")
    (dev / "ttyUSB0").unlink()
    assert [port.node for port in serial_port.list_ports(dev, sys)] == [f"{dev}/ttyAMA0", f"{dev}/ttyS0"]


def test_the_order_is_the_natural_one(dev: Path, sys: Path) -> None:
    for number in (10, 2, 1):
        usb(dev, sys, f"ttyUSB{number}")
    assert [port.node[-2:] for port in serial_port.list_ports(dev, sys)] == ["B1", "B2", "10"]


def test_this_machine_and_one_without_ports_can_be_listed(tmp_path: Path) -> None:
    assert serial_port.list_ports(tmp_path / "dev", tmp_path / "sys") == []
    assert all(Path(port.node).exists() for port in serial_port.list_ports())
