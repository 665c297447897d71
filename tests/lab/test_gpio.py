"""gpio-sim through Debian's gpiod tools (v1) and the gpiod binding (v2)."""

import time
from datetime import timedelta
from pathlib import Path

import gpiod
from gpiod.line import Bias, Clock, Direction, Edge, Value

from tests.lab.gpio_chip import GpioChip
from tests.lab.tool import running, tool
from tests.lab.waiting import wait_until

INTERRUPTS = Path("/proc/interrupts")
EDGE_LIMIT = timedelta(seconds=10)


def test_gpioinfo_shows_the_names(gpio_chip: GpioChip) -> None:
    listing = tool("gpioinfo", gpio_chip.path.name)
    assert all(f'"{name}"' in listing for name in gpio_chip.names if name)
    assert tool("gpiofind", "ALARM").split() == [gpio_chip.path.name, "3"]


def test_gpioget_reads_what_the_test_drives(gpio_chip: GpioChip) -> None:
    levels = []
    for level in (True, False):
        gpio_chip.drive("ALARM", level)
        levels.append(tool("gpioget", gpio_chip.path.name, "3").strip())
    assert levels == ["1", "0"]


def test_gpiomon_sees_edges(gpio_chip: GpioChip) -> None:
    """gpiomon's own stamps, CLOCK_MONOTONIC in this kernel, lie between before and after."""
    monitor_line = ("gpiomon", "--line-buffered", "--num-events=2", "--format=%e %o %s %n", gpio_chip.path.name, "0")
    with running(*monitor_line) as monitor:
        assert monitor.stdout is not None
        # gpiomon uses the first version of the kernel's interface, which announces the line before its edges are armed.
        wait_until(lambda: "gpiomon" in INTERRUPTS.read_text(encoding="ascii"), "gpiomon has its interrupt")
        before_ns = time.monotonic_ns()
        rows = []
        for level in (True, False):
            gpio_chip.drive("SOUT", level)
            rows.append([int(word) for word in monitor.stdout.readline().split()])
    after_ns = time.monotonic_ns()
    assert [row[:2] for row in rows] == [[1, 0], [0, 0]]
    first_ns, second_ns = (seconds * 1_000_000_000 + nanoseconds for _, _, seconds, nanoseconds in rows)
    assert before_ns < first_ns < second_ns < after_ns


def test_binding_gets_edges_with_kernel_stamps(gpio_chip: GpioChip) -> None:
    settings = gpiod.LineSettings(edge_detection=Edge.BOTH, event_clock=Clock.MONOTONIC)
    with gpiod.request_lines(str(gpio_chip.path), consumer="lab", config={"PPS": settings}) as lines:
        before_ns = time.monotonic_ns()
        first, second = (_edge(gpio_chip, lines, level) for level in (True, False))
        after_ns = time.monotonic_ns()
    assert (first.event_type, second.event_type) == (first.Type.RISING_EDGE, second.Type.FALLING_EDGE)
    assert (first.line_seqno, second.line_seqno) == (1, 2)
    assert before_ns < first.timestamp_ns < second.timestamp_ns < after_ns


def _edge(chip: GpioChip, lines: gpiod.LineRequest, level: bool) -> gpiod.EdgeEvent:
    """Drives PPS and waits for the event: the kernel reads the direction of a both-edges event after it happened."""
    chip.drive("PPS", level)
    assert lines.wait_edge_events(EDGE_LIMIT)
    (event,) = lines.read_edge_events()
    return event


def test_pulse_train_is_counted(gpio_chip: GpioChip) -> None:
    """Each pulse waits for the one before: the interrupt's thread makes one event of several quick edges."""
    settings = gpiod.LineSettings(edge_detection=Edge.RISING, event_clock=Clock.MONOTONIC)
    events = []
    with gpiod.request_lines(str(gpio_chip.path), consumer="lab", config={"PPS": settings}) as lines:
        for _ in range(10):
            events.append(_edge(gpio_chip, lines, True))
            gpio_chip.drive("PPS", False)
    stamps_ns = [event.timestamp_ns for event in events]
    assert [event.line_seqno for event in events] == list(range(1, 11))
    assert stamps_ns == sorted(set(stamps_ns))


def test_test_reads_an_output(gpio_chip: GpioChip) -> None:
    settings = gpiod.LineSettings(direction=Direction.OUTPUT, output_value=Value.ACTIVE, bias=Bias.DISABLED)
    with gpiod.request_lines(str(gpio_chip.path), consumer="lab", config={"SIN": settings}) as lines:
        assert gpio_chip.level("SIN")
        lines.set_value("SIN", Value.INACTIVE)
        assert not gpio_chip.level("SIN")
