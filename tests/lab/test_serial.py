"""Serial ports of the guest through pyserial: a pty, and two UARTs with the kernel's 8250 driver."""

import fcntl
import struct
from pathlib import Path

import pytest
import serial

from tests.lab.serial_port import PseudoTerminal

READ_LIMIT_S = 10.0
TIOCGICOUNT = 0x545D
ICOUNT = struct.Struct("=11i9i")  # cts dsr rng dcd rx tx frame overrun parity brk buf_overrun, reserved
ALL_BYTES = bytes(range(256))
TRIES = 3
"""QEMU's UART lost 23 bytes once, while the host was busy."""


def counters(port: serial.Serial) -> dict[str, int]:
    """The kernel's counters of a UART."""
    values = ICOUNT.unpack(fcntl.ioctl(port.fileno(), TIOCGICOUNT, bytes(ICOUNT.size)))
    names = ("cts", "dsr", "rng", "dcd", "rx", "tx", "frame", "overrun", "parity", "brk", "buf_overrun")
    return dict(zip(names, values, strict=False))


def test_pty_carries_every_byte_both_ways(pty: PseudoTerminal) -> None:
    with serial.Serial(str(pty.path), 115200, timeout=READ_LIMIT_S) as port:
        port.write(ALL_BYTES)
        assert pty.read(256) == ALL_BYTES
        pty.write(ALL_BYTES)
        assert port.read(256) == ALL_BYTES


def test_uarts_are_wired_to_each_other(uarts: tuple[Path, Path]) -> None:
    with (
        serial.Serial(str(uarts[0]), 921600, timeout=READ_LIMIT_S) as first,
        serial.Serial(str(uarts[1]), 921600, timeout=READ_LIMIT_S) as second,
    ):
        for _ in range(TRIES):
            before = counters(second)
            first.write(ALL_BYTES)
            received = second.read(256)
            second.write(received)
            assert first.read(len(received)) == received
            after = counters(second)
            counted = {name: after[name] - before[name] for name in after}
            if received == ALL_BYTES:
                break
            print(f"{len(received)} of 256 bytes came; the kernel counted {counted}")
    assert received == ALL_BYTES
    names = ("rx", "tx", "frame", "overrun")
    assert {name: counted[name] for name in names} == {"rx": 256, "tx": 256, "frame": 0, "overrun": 0}


def test_uart_is_a_real_port(uarts: tuple[Path, Path]) -> None:
    """What a pty refuses: the driver's type, its low-latency flag."""
    for path in uarts:
        assert (Path("/sys/class/tty") / path.name / "type").read_text(encoding="ascii").strip() == "4"
    with serial.Serial(str(uarts[0]), 115200) as port:
        port.set_low_latency_mode(True)


def test_pty_has_no_low_latency_mode(pty: PseudoTerminal) -> None:
    with serial.Serial(str(pty.path), 115200) as port, pytest.raises((OSError, ValueError)):
        port.set_low_latency_mode(True)
