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
    pty, before = PtyPort(), len(open_descriptors())
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


def test_only_what_was_counted_since_the_start_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    assert serial_port.relative(START, START) == KernelCounters()
    # one value contains overruns of the UART's FIFO (9 - 7) and of the tty's buffer (22 - 17)
    assert serial_port.relative(START, LATER) == KernelCounters(overrun=7, framing=1, parity=3, break_=4)
    before = (*[0] * 6, 0x7FFF_FFFF, *[0] * 13)
    after = (*[0] * 6, -0x8000_0000, *[0] * 13)
    assert serial_port.relative(before, after).framing == 1
    port = PtyPort()
    assert serial_port.TtyCounters(port.master).read() == KernelCounters()
    port.unplug()
    monkeypatch.setattr(fcntl, "ioctl", lambda _fd, _request, buffer: buffer.__setitem__(6, 5))
    assert serial_port.read_counters(0) == (*[0] * 6, 5, *[0] * 13)
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


FTDI = {"manufacturer": "FTDI", "product": "FT232R USB UART", "serial": "A1"}
PORT = {"product": "FT2232H", "serial": "A1"}


@pytest.mark.parametrize(
    ("texts", "links", "expected"),
    [
        ({0: FTDI}, {"by-id/FTDI": 0, "by-path/pci-0": 0}, [("serial/by-id/FTDI", 0, "FTDI FT232R USB UART A1")]),
        ({0: {"product": "x"}, 1: {}}, {"by-path/pci-0": 0}, [("serial/by-path/pci-0", 0, "x"), ("ttyUSB1", 1, "")]),
        # equal adapters without serial numbers: one by-id name, of the adapter that was plugged in last
        ({0: {"product": "CH340"}, 1: {"product": "CH340"}}, {"by-id/CH340": 1, "by-path/pci-0": 0, "by-path/pci-1": 1},
         [("serial/by-path/pci-0", 0, "CH340"), ("serial/by-path/pci-1", 1, "CH340")]),
        # the ports of one adapter
        ({0: PORT, 1: PORT}, {"by-id/if00": 0, "by-id/if01": 1, "by-path/pci-0": 0, "by-path/pci-1": 1},
         [("serial/by-id/if00", 0, "FT2232H A1"), ("serial/by-id/if01", 1, "FT2232H A1")]),
        ({10: {}, 2: {}, 1: {}}, {}, [(f"ttyUSB{n}", n, "") for n in (1, 2, 10)]),  # the natural order
    ],
)  # fmt: skip
def test_adapters_are_listed_by_their_lasting_names(
    dev: Path, sys: Path, texts: dict[int, dict[str, str]], links: dict[str, int], expected: list[tuple[str, int, str]]
) -> None:
    """The name is the link by-id, else the link by-path, else the node."""
    for number, text in texts.items():
        usb(dev, sys, f"ttyUSB{number}", **text)
    for name, number in links.items():
        (dev / "serial" / name).symlink_to(f"../../ttyUSB{number}")
    found = [serial_port.SerialPort(f"{dev}/{path}", f"{dev}/ttyUSB{n}", title) for path, n, title in expected]
    assert serial_port.list_ports(dev, sys) == found


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


def test_this_machine_and_one_without_ports_can_be_listed(tmp_path: Path) -> None:
    assert serial_port.list_ports(tmp_path / "dev", tmp_path / "sys") == []
    assert all(Path(port.node).exists() for port in serial_port.list_ports())
