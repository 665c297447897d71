"""GPIO lines of imud on gpio-sim, with the real behavior of the kernel."""

import asyncio
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle, islice
from pathlib import Path
from time import monotonic_ns

import pytest

from imud.contracts.lines import Edge, InputOptions, OutputOptions, ResetOptions, TriggerStamp
from imud.lines.gpio import KERNEL_EVENTS, GpioInput, GpioOutput
from imud.lines.reset import reset
from imud.lines.trigger import Trigger
from imud.model.errors import LinkBusy, LinkDenied, LinkError, LinkMissing
from imud.model.units import NS_PER_S
from tests.lab.gpio_chip import GpioChip, simulated_chip
from tests.lab.tool import running, tool
from tests.lab.waiting import wait_until
from tests.support.event_loops import in_loop

INTERRUPTS = Path("/proc/interrupts")
LIMIT_S = 30
TRIGGER_HZ = 10.0  # slow enough for the emulated processor
TRIGGERS = 20


class Watcher:
    def __init__(self, settings: InputOptions, purpose: str = "lab") -> None:
        self.line = GpioInput(settings, purpose)
        self.edges: list[Edge] = []
        self.ends: list[LinkError] = []
        self._news = asyncio.Event()

    def start(self) -> None:
        self.line.open()
        self.line.start(self._on_edges, self._on_end)

    def _on_edges(self, edges: Sequence[Edge]) -> None:
        self.edges += edges
        self._news.set()

    def _on_end(self, error: LinkError) -> None:
        self.ends.append(error)
        self._news.set()

    async def wait_for(self, count: int) -> None:
        async with asyncio.timeout(LIMIT_S):
            while len(self.edges) < count and not self.ends:
                self._news.clear()
                await self._news.wait()


@in_loop
async def test_edges_have_stamps_and_numbers(gpio_chip: GpioChip) -> None:
    watcher = Watcher(InputOptions(line="SOUT"))
    watcher.start()
    bounds_ns = [monotonic_ns()]
    for number, level in enumerate(islice(cycle((True, False)), 20), 1):
        gpio_chip.drive("SOUT", level)
        await watcher.wait_for(number)
        bounds_ns.append(monotonic_ns())
    watcher.line.close()
    assert [edge.number for edge in watcher.edges] == list(range(1, 21))
    assert [edge.rising for edge in watcher.edges] == [True, False] * 10
    for edge, before_ns, after_ns in zip(watcher.edges, bounds_ns, bounds_ns[1:], strict=False):
        assert before_ns < edge.t_ns < after_ns
    assert watcher.line.edges_lost == 0


@in_loop
async def test_drain_comes_before_the_loop(gpio_chip: GpioChip) -> None:
    watcher = Watcher(InputOptions(line="SOUT", active_low=True))
    watcher.start()
    watcher.line.drain()
    gpio_chip.drive("SOUT", True)

    def drained() -> bool:
        watcher.line.drain()
        return bool(watcher.edges)

    wait_until(drained, "the edge")
    assert [(edge.rising, edge.number) for edge in watcher.edges] == [(False, 1)]
    watcher.line.close()


@in_loop
async def test_overflow_is_counted(gpio_chip: GpioChip) -> None:
    """The kernel keeps only the newest edges if no program reads them. It can join two close edges."""
    watcher = Watcher(InputOptions(line="SOUT"))
    watcher.start()
    for level in islice(cycle((True, False)), 3 * KERNEL_EVENTS):
        gpio_chip.drive("SOUT", level)
    await watcher.wait_for(KERNEL_EVENTS)
    watcher.line.close()
    last = watcher.edges[-1].number
    assert len(watcher.edges) == KERNEL_EVENTS
    assert watcher.line.edges_lost == last - KERNEL_EVENTS > 0
    assert [edge.number for edge in watcher.edges] == list(range(last - KERNEL_EVENTS + 1, last + 1))


def test_level(gpio_chip: GpioChip) -> None:
    plain, inverted = GpioInput(InputOptions(line="ALARM")), GpioInput(InputOptions(line="PPS", active_low=True))
    levels = []
    for line, name in ((plain, "ALARM"), (inverted, "PPS")):
        line.open()
        for level in (True, False):
            gpio_chip.drive(name, level)
            levels.append(line.level())
        line.close()
    assert levels == [True, False, False, True]


def test_bias(gpio_chip: GpioChip) -> None:
    line = GpioInput(InputOptions(line=4, chip=gpio_chip.path.name, bias="pull-up"))
    line.open()
    assert line.level()
    line.close()


@pytest.mark.parametrize("by", ["name", "number", "label", "path"])
def test_ways_to_name_a_line(gpio_chip: GpioChip, by: str) -> None:
    label = tool("gpiodetect").split("[")[1].split("]")[0]
    settings = {
        "name": InputOptions(line="ALARM"), "number": InputOptions(line=3, chip=gpio_chip.path.name),
        "label": InputOptions(line="ALARM", chip=label), "path": InputOptions(line=3, chip=str(gpio_chip.path)),
    }[by]  # fmt: skip
    line = GpioInput(settings, "bow alarm")
    line.open()
    assert line.title == f"{gpio_chip.path.name} line 3 (ALARM)"
    assert re.search(r'"ALARM"\s+"imud bow alarm"\s+input', tool("gpioinfo", gpio_chip.path.name))
    line.close()
    assert "imud" not in tool("gpioinfo", gpio_chip.path.name)


def test_a_name_on_two_chips(gpio_chip: GpioChip) -> None:
    with simulated_chip(["", "PPS"]) as other, pytest.raises(LinkError) as caught:
        GpioInput(InputOptions(line="PPS")).open()
    assert f"{gpio_chip.path.name} line 2 (PPS) and {other.path.name} line 1 (PPS)" in str(caught.value)


def test_a_busy_line_names_who_holds_it(gpio_chip: GpioChip) -> None:
    with running("gpiomon", gpio_chip.path.name, "3"):
        wait_until(lambda: "gpiomon" in INTERRUPTS.read_text(encoding="ascii"), "gpiomon has its interrupt")
        for line in (GpioInput(InputOptions(line="ALARM")), GpioOutput(OutputOptions(line="ALARM"))):
            with pytest.raises(LinkBusy, match=r"line 3 \(ALARM\) is in use by gpiomon: stop it"):
                line.open()


def test_a_user_without_the_right(gpio_chip: GpioChip) -> None:
    gpio_chip.path.chmod(0o600)
    GpioInput(InputOptions(line="ALARM")).close()
    os.seteuid(65534)
    try:
        with pytest.raises(LinkDenied, match="user nobody lacks the permission; the node must belong to group gpio"):
            GpioInput(InputOptions(line="ALARM")).open()
    finally:
        os.seteuid(0)


def test_errors_of_missing_lines(gpio_chip: GpioChip) -> None:
    with pytest.raises(LinkMissing, match=r"has no line 6: its lines are 0 to 5"):
        GpioInput(InputOptions(line=6, chip=gpio_chip.path.name)).open()
    with pytest.raises(LinkMissing, match=rf"gpiochip99 does not exist; existing chips: {gpio_chip.path.name} \("):
        GpioInput(InputOptions(line=0, chip="gpiochip99")).open()
    with pytest.raises(LinkMissing, match="null is missing, or is not a GPIO chip"):
        GpioInput(InputOptions(line=0, chip="/dev/null")).open()


@in_loop
async def test_a_chip_that_is_pulled_out_and_comes_back(gpio_chip: GpioChip) -> None:
    watcher, output = Watcher(InputOptions(line="PPS")), GpioOutput(OutputOptions(line="SIN"))
    watcher.start()
    output.open()
    gpio_chip.drive("PPS", True)
    await watcher.wait_for(1)
    gpio_chip.unplug()
    await watcher.wait_for(2)
    (end,) = watcher.ends
    assert isinstance(end, LinkMissing)
    assert "line 2 (PPS) is missing" in str(end)
    with pytest.raises(LinkMissing, match="SIN"):
        output.set(True)
    output.close()
    with pytest.raises(LinkMissing):
        watcher.line.open()
    gpio_chip.plug_in()
    watcher.ends.clear()
    wait_until(lambda: any(Path("/dev").glob("gpiochip*")), "the node of the chip")
    watcher.start()
    assert not watcher.line.level()
    watcher.line.close()


def test_outputs_are_inactive_before_and_after(gpio_chip: GpioChip) -> None:
    """A released line of gpio-sim has the level of its pull. The pull replaces the resistor of a board."""
    gpio_chip.drive("RESET", True)
    for settings, name, inactive in (
        (OutputOptions(line="SIN"), "SIN", False),
        (ResetOptions(line="RESET"), "RESET", True),
    ):
        line = GpioOutput(settings)
        line.open()
        levels = [gpio_chip.level(name)]
        for active in (True, False, True):
            line.set(active)
            levels.append(gpio_chip.level(name))
        line.close()
        assert [*levels, gpio_chip.level(name)] == [inactive, not inactive, inactive, not inactive, inactive]


def test_open_drain(gpio_chip: GpioChip) -> None:
    """gpio-sim does not show the pull of a released line. The test therefore checks the request to the kernel."""
    line = GpioOutput(ResetOptions(line="RESET", open_drain=True))
    line.open()
    assert re.search(r"output\s+active-low \[used open-drain\]", tool("gpioinfo", gpio_chip.path.name))
    line.set(True)
    assert not gpio_chip.level("RESET")
    line.close()


@in_loop
async def test_reset(gpio_chip: GpioChip) -> None:
    gpio_chip.drive("RESET", True)
    line, levels = GpioOutput(ResetOptions(line="RESET")), list[bool]()
    line.open()

    async def sleep(_seconds: float) -> None:
        levels.append(gpio_chip.level("RESET"))

    await reset(line, ResetOptions(line="RESET"), sleep)
    line.close()
    assert levels == [False, True]


class WiredOutput(GpioOutput):
    def __init__(self, chip: GpioChip, settings: OutputOptions) -> None:
        super().__init__(settings, "bow sin")
        self._chip = chip

    def set(self, active: bool) -> None:
        super().set(active)
        self._chip.drive("PPS", self._chip.level("SIN"))


@in_loop
async def test_sin_has_its_period_and_its_stamps_are_true(gpio_chip: GpioChip) -> None:
    """gpiomon reads the same line. Its kernel time stamps must be within the errors of imud's time stamps."""
    line, stamps, enough = WiredOutput(gpio_chip, OutputOptions(line="SIN")), list[TriggerStamp](), asyncio.Event()

    def on_stamps(found: Sequence[TriggerStamp]) -> None:
        stamps.extend(found)
        if len(stamps) >= TRIGGERS:
            enough.set()

    with rising_edges(gpio_chip.path.name, gpio_chip.names.index("PPS")) as seen:
        line.open()
        trigger = Trigger(line, TRIGGER_HZ, monotonic_ns)
        trigger.start(on_stamps, lambda error: pytest.fail(str(error)))
        await asyncio.wait_for(enough.wait(), LIMIT_S)
        trigger.stop()
        line.close()
        seen_ns = list(islice(seen, len(stamps)))
    assert not gpio_chip.level("SIN")
    assert [stamp.number for stamp in stamps] == list(range(1, len(stamps) + 1))
    for stamp, t_ns in zip(stamps, seen_ns, strict=True):
        assert abs(t_ns - stamp.t_ns) <= stamp.err_ns
    period_ns = NS_PER_S / TRIGGER_HZ
    slots = [round((t_ns - seen_ns[0]) / period_ns) for t_ns in seen_ns]
    assert slots == sorted(set(slots))
    assert (seen_ns[-1] - seen_ns[0]) / slots[-1] == pytest.approx(period_ns, rel=0.03)
    counts = trigger.counts
    print(
        f"SIN at {TRIGGER_HZ} Hz: {counts.edges} edges, {counts.missed} missed, "
        f"{counts.mean_late_ns / 1e3:.0f} us late on average, {counts.worst_late_ns / 1e3:.0f} us at worst"
    )


@contextmanager
def rising_edges(chip: str, offset: int) -> Iterator[Iterator[int]]:
    """Return the kernel's time stamps of rising edges in the output of gpiomon."""
    command = ("gpiomon", "--line-buffered", "--rising-edge", "--format=%s %n", chip, str(offset))
    with running(*command) as monitor:
        assert monitor.stdout is not None
        wait_until(lambda: "gpiomon" in INTERRUPTS.read_text(encoding="ascii"), "gpiomon has its interrupt")
        yield (int(s) * NS_PER_S + int(n) for s, n in map(str.split, monitor.stdout))
