"""Serial port: error messages, latency timers of adapters from a simulated /sys, and error counters of the kernel."""

import errno
import fcntl
import os
import termios
from pathlib import Path

import pytest

from imud.contracts.status import KernelCounters
from imud.links.device_node import PROC
from imud.links.serial_port import TtyCounters, hold_ns, open_port, port_problem, read_latency_timer_ms, relative
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
        explained = port_problem(error, "/dev/ttyS9", tmp_path)
        assert type(explained) is kind
        assert "/dev/ttyS9" in str(explained)
    assert "in use by another program" in str(port_problem(OSError(errno.EBUSY, ""), "/dev/ttyS9", tmp_path))
    assert "no such thing" in str(port_problem(ValueError("no such thing"), "/dev/ttyS9", tmp_path))


def test_an_open_port_has_one_descriptor_and_leaves_none() -> None:
    pty = PtyPort()
    before = len(open_descriptors())
    port = open_port(str(pty.path), 115200, PROC)
    assert len(open_descriptors()) == before + 1
    port.close()
    port.close()
    assert len(open_descriptors()) == before
    os.chmod(pty.path, 0o666)
    with unprivileged():  # no lock and no exclusive mode remain; root can open a port in exclusive mode
        again = open_port(str(pty.path), 115200, PROC)
        again.baudrate = 9600
        again.close()
        killed = os.open(pty.path, os.O_RDWR | os.O_NOCTTY)
        fcntl.ioctl(killed, termios.TIOCEXCL)
        os.close(killed)  # as the kernel closes the port of a killed program
        with pytest.raises(
            LinkBusy, match=r"; stop it first, or start the program again that made the pseudo-terminal"
        ):
            open_port(str(pty.path), 115200, PROC)
    pty.unplug()


def timer_of(sys: Path, node: str) -> Path:
    path = sys / "class" / "tty" / node / "device" / "latency_timer"
    path.parent.mkdir(parents=True)
    return path


@pytest.mark.parametrize(("node", "hold_ms"), [("ttyUSB0", 16), ("ttyACM3", 1), ("ttyS0", 0), ("ttyAMA0", 0), ("7", 0)])
def test_without_a_timer_the_kind_of_port_decides(tmp_path: Path, node: str, hold_ms: int) -> None:
    assert hold_ns(f"/dev/{node}", tmp_path) == hold_ms * NS_PER_MS


def test_the_timer_is_found_through_a_link(tmp_path: Path) -> None:
    timer_of(tmp_path, "ttyUSB4").write_text("4\n")
    node, link = tmp_path / "ttyUSB4", tmp_path / "by-id"
    node.touch()
    link.symlink_to(node)
    assert hold_ns(str(link), tmp_path) == 4 * NS_PER_MS
    (tmp_path / "class/tty/ttyUSB4/device/latency_timer").write_text("?\n")
    assert read_latency_timer_ms("/dev/ttyUSB4", tmp_path) is None


def test_only_what_was_counted_since_the_start_is_reported() -> None:
    assert relative(START, START) == KernelCounters()
    # one value contains overruns of the UART's FIFO (9 - 7) and of the tty's buffer (22 - 17)
    assert relative(START, LATER) == KernelCounters(overrun=7, framing=1, parity=3, break_=4)
    before = (*[0] * 6, 0x7FFF_FFFF, *[0] * 13)
    after = (*[0] * 6, -0x8000_0000, *[0] * 13)
    assert relative(before, after).framing == 1
    port = PtyPort()
    assert TtyCounters(port.master).read() == KernelCounters()
    port.unplug()
    answers = iter([START, LATER, None])
    counters = TtyCounters(0, lambda _fd: next(answers))
    assert counters.read() == counters.read() == relative(START, LATER)
