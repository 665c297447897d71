"""The kernel's error counters."""

import pytest

from imud.contracts.status import KernelCounters
from imud.links.uart import tty_counters
from imud.links.uart.tty_counters import TtyCounters, relative
from tests.support.pty_port import PtyPort

START = (0, 0, 0, 0, 1000, 0, 5, 7, 11, 13, 17, *[0] * 9)
"""cts dsr rng dcd rx tx, then frame overrun parity brk buf_overrun as linux/serial.h orders them."""
LATER = (0, 0, 0, 0, 2000, 0, 6, 9, 14, 17, 22, *[0] * 9)


def test_only_what_was_counted_since_the_start_is_told() -> None:
    assert relative(START, START) == KernelCounters()
    # overruns of the UART's FIFO (9 - 7) and of the tty's buffer (22 - 17) are one figure
    assert relative(START, LATER) == KernelCounters(overrun=7, framing=1, parity=3, break_=4)


def test_counters_that_wrap_go_on() -> None:
    before = (*[0] * 6, 0x7FFF_FFFF, *[0] * 13)
    after = (*[0] * 6, -0x8000_0000, *[0] * 13)
    assert relative(before, after).framing == 1


def test_a_port_without_counters_has_zeros() -> None:
    port = PtyPort()
    assert TtyCounters(port.master).read() == KernelCounters()
    port.unplug()


def test_the_last_state_stays_when_the_port_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter([START, LATER, None])
    monkeypatch.setattr(tty_counters, "read_counters", lambda fd: next(answers))
    counters = TtyCounters(0)
    assert counters.read() == counters.read() == relative(START, LATER)
