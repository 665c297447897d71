"""GPIO lines of imud on gpio-sim, with the real behavior of the kernel.

The second part is a real daemon with a simulated device behind a pty. The processor of the lab is emulated, and time
stamps are late by milliseconds. These tests therefore check only the pairs of edges and samples.
"""

import asyncio
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle, islice, pairwise
from math import degrees
from pathlib import Path
from threading import Event as Flag
from threading import Thread
from time import monotonic_ns
from urllib.request import urlopen

import pytest

from imud.contracts.lines import Edge, InputOptions, OutputOptions, ResetOptions, TriggerStamp
from imud.contracts.status import DeviceStatus, LinesStatus
from imud.lines.gpio import KERNEL_EVENTS, GpioInput, GpioOutput
from imud.lines.reset import reset
from imud.lines.sync import ALARM_STATUS
from imud.lines.trigger import Trigger
from imud.model.errors import LinkBusy, LinkDenied, LinkError, LinkMissing
from imud.model.event import EventKind
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.lab.gpio_chip import GpioChip, simulated_chip
from tests.lab.imu_process import Pulse, running_imu, tell, tty
from tests.lab.tool import running, tool
from tests.support.daemon_process import RunningDaemon, running_daemon, wait_until
from tests.support.event_loops import in_loop

pytestmark = pytest.mark.timeout(600)

INTERRUPTS = Path("/proc/interrupts")
LIMIT_S = 150.0
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


METRICS_PORT = 19321
SAMPLES = 70
FOLLOWS = 8
"""Number of samples at 20 Hz after which the level of the alarm line is in the samples."""
ANSWERS = 15
LATE_NS = 25 * NS_PER_MS
"""A quarter of a period, ns. Sometimes the emulated processor stops for longer, and no pairing is possible."""


@contextmanager
def daemon(folder: Path, lines: Mapping[str, object], **more: object) -> Iterator[RunningDaemon]:
    device = {"driver": "hipnuc-uart", "uart": {"port": str(tty(folder)), "baud": 115200}, "lines": lines, **more}
    metrics = {"port": METRICS_PORT}
    with running_daemon(folder, {"bow": device}, limit_s=LIMIT_S, python=(), metrics=metrics) as made:
        yield made


def lines_of(made: RunningDaemon) -> LinesStatus:
    lines = made.statuses()["bow"].lines
    assert lines is not None
    return lines


def wait_for(made: RunningDaemon, holds: Callable[[DeviceStatus], object], what: str) -> None:
    wait_until(lambda: bool(holds(made.statuses()["bow"])), what, LIMIT_S)


def wait_open(made: RunningDaemon, chip: GpioChip, *keys: str) -> None:
    wait_until(
        lambda: all(f'"imud bow {key}"' in tool("gpioinfo", chip.path.name) for key in keys), "the lines", LIMIT_S
    )
    assert lines_of(made).problems == {}


def collect(made: RunningDaemon, enough: Callable[[list[Sample]], bool]) -> list[Sample]:
    samples: list[Sample] = []
    with made.client() as client:
        for sample in client.watch(["bow"], timeout_s=LIMIT_S):
            samples.append(sample)
            if enough(samples):
                return samples
    raise AssertionError


@pytest.mark.parametrize(
    "losses",
    [
        pytest.param(("--pin-faults", "lose_pulse=0.1"), id="pulses"),
        pytest.param(("--faults", "lose=0.1"), id="frames", marks=pytest.mark.thorough),
    ],
)
def test_every_sample_gets_its_own_pulse(gpio_chip: GpioChip, tmp_path: Path, losses: tuple[str, str]) -> None:
    with daemon(tmp_path, {"sout": {"line": "SOUT"}}) as made:
        wait_open(made, gpio_chip, "sout")
        with running_imu(tmp_path, gpio_chip, {"sout": "SOUT"}, "--rate", "10", *losses) as imu:
            samples = collect(made, lambda got: sum(s.edge_seq is not None for s in got) >= SAMPLES)
            imu.stop()
        seen = lines_of(made).edges["sout"]
        clock = made.statuses()["bow"].clock
    truth, pulses = imu.truth(), imu.pulses("sout")
    assert seen == len(pulses), "the kernel made one of two edges"
    own = {pulse.sample_ns: number for number, pulse in enumerate(pulses, 1)}
    begin = next(i for i, sample in enumerate(samples) if sample.edge_seq is not None)
    right = found = lost = 0
    for sample in samples[begin:]:
        number = own.get(instant(truth, sample))
        if stalled(pulses, instant(truth, sample)):
            continue
        if number is None:
            lost += 1
            assert sample.edge_seq is None
        else:
            assert sample.edge_seq in (number, None)
            right += sample.edge_seq is not None
            found += 1
    print(f"{right} of {found} samples paired, {lost} without a pulse, {len(samples) - begin} in all")
    assert found > SAMPLES // 2
    assert right > 0.8 * found
    assert bool(lost) == ("lose_pulse=0.1" in losses)
    assert (clock.samples_unpaired if lost else clock.edges_unpaired) > 0
    assert {sample.sync for sample in samples[begin:] if sample.edge_seq is not None} == {Sync.EDGE}
    assert all(before.t_ns < after.t_ns for before, after in pairwise(samples))


def stalled(pulses: list[Pulse], sample_ns: int) -> bool:
    return any(pulse.late_ns > LATE_NS for pulse in pulses if abs(pulse.sample_ns - sample_ns) < 3 * 100 * NS_PER_MS)


def instant(truth: Mapping[int, int], sample: Sample) -> int:
    assert sample.t_dev_ns is not None
    return truth[sample.t_dev_ns // NS_PER_MS]


@pytest.mark.thorough
def test_the_alarm_is_seen(gpio_chip: GpioChip, tmp_path: Path) -> None:
    """The device turns by 25° in both directions. The limit of its alarm is 5°."""
    with running_imu(tmp_path, gpio_chip, {"alarm": "ALARM"}, "--rate", "20", "--no-noise"):
        tell(tmp_path, "CONFIG PMUX5 Y,-5,5,0,1")
        with daemon(tmp_path, {"alarm": {"line": "ALARM"}}) as made:
            with made.client() as client:
                events = client.events(["bow"], timeout_s=LIMIT_S)
                alarm = next(event for event in events if event.kind is EventKind.ALARM)
            assert alarm.message.startswith("alarm")
            wait_for(made, lambda status: status.settings.get("alarm.y") == "-5° … 5°, on", "the settings")
            samples = collect(made, lambda got: got[-1].t_ns - got[0].t_ns > 12 * NS_PER_S)
            lines = lines_of(made)
            with urlopen(f"http://127.0.0.1:{METRICS_PORT}/metrics", timeout=LIMIT_S) as answer:
                metrics = answer.read().decode()
    assert lines.alarms > 1
    assert lines.problems == {}
    assert 'imud_alarm_active{device="bow"}' in metrics
    assert {bool((sample.status or 0) & ALARM_STATUS) for sample in samples} == {True, False}
    outside = [abs(degrees(sample.euler_rad[0])) > 5 for sample in samples if sample.euler_rad is not None]
    assert len(outside) == len(samples)
    for i in range(FOLLOWS, len(samples)):
        if len(set(outside[i - FOLLOWS : i + 1])) == 1:  # long enough for the level to be in the samples
            assert bool((samples[i].status or 0) & ALARM_STATUS) == outside[i]


def test_an_alarm_wire_that_is_not_connected_is_told(gpio_chip: GpioChip, tmp_path: Path) -> None:
    with running_imu(tmp_path, gpio_chip, {}, "--rate", "20"):
        tell(tmp_path, "CONFIG PMUX5 Y,-1,1,0,1")
        with daemon(tmp_path, {"alarm": {"line": "ALARM"}}) as made:
            wait_for(made, lambda status: status.lines and status.lines.problems, "the fault")
            assert "is the wire connected" in lines_of(made).problems["alarm"]


def test_a_line_that_another_program_holds_is_taken_later(gpio_chip: GpioChip, tmp_path: Path) -> None:
    lines = {"alarm": {"line": "ALARM"}, "sout": {"line": "SOUT"}}
    with running("gpiomon", gpio_chip.path.name, str(gpio_chip.names.index("ALARM"))) as monitor:
        wait_until(lambda: "gpiomon" in INTERRUPTS.read_text(encoding="ascii"), "gpiomon has its interrupt")
        with daemon(tmp_path, lines) as made:
            wait_for(made, lambda status: status.lines and status.lines.problems, "the line is busy")
            assert "is in use by gpiomon" in lines_of(made).problems["alarm"]
            with made.client() as client:
                events = client.events(["bow"], timeout_s=LIMIT_S)
                monitor.kill()
                told = next(event for event in events if event.kind is EventKind.LINK)
            assert told.message == "line alarm: watched again"
            wait_open(made, gpio_chip, "alarm", "sout")
            assert lines_of(made).alarm is False
    assert "imud" not in tool("gpioinfo", gpio_chip.path.name)


def test_the_line_of_a_rule(gpio_chip: GpioChip, tmp_path: Path) -> None:
    """The rule is active while the device is silent. It is active again at the stop of imud."""
    rule = {"measure": "silence_s", "above": 5, "hold_s": 0, "line": {"line": "SIN"}}
    rules = {"enabled": True, "rules": {"quiet": rule}}
    device = {"driver": "hipnuc-uart", "uart": {"port": str(tty(tmp_path)), "baud": 115200}}

    def wait_level(level: bool) -> None:
        wait_until(lambda: gpio_chip.level("SIN") is level, f"the level {level}", LIMIT_S)

    with running_daemon(tmp_path, {"bow": device}, limit_s=LIMIT_S, python=(), rules=rules):
        wait_until(lambda: "imud rule quiet" in tool("gpioinfo", gpio_chip.path.name), "the line", LIMIT_S)
        wait_level(True)
        with running_imu(tmp_path, gpio_chip, {}, "--rate", "20"):
            wait_level(False)
            assert "imud rule quiet" in tool("gpioinfo", gpio_chip.path.name), "imud still drives the line"
        wait_level(True)
    assert not gpio_chip.level("SIN")
    assert "imud" not in tool("gpioinfo", gpio_chip.path.name)


class Mirror:
    def __init__(self, chip: GpioChip) -> None:
        self._chip = chip
        self._end = Flag()
        self._thread = Thread(target=self._run)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        level = False
        while not self._end.wait(0.002):
            now = self._chip.level("SIN")
            if now != level:
                level = now
                self._chip.drive("PPS", level)


@pytest.mark.thorough
def test_frames_answer_the_triggers_on_sin(gpio_chip: GpioChip, tmp_path: Path) -> None:
    sin = {"line": "SIN", "rate_hz": 5, "pulse_ms": 80}
    with running_imu(tmp_path, gpio_chip, {}, "--rate", "10", "--sin", str(gpio_chip.value("SIN"))) as imu:
        tell(tmp_path, "LOG HI91 ONMARK 1")
        with (
            rising_edges(gpio_chip.path.name, gpio_chip.names.index("PPS")) as seen,
            Mirror(gpio_chip),
            daemon(tmp_path, {"sin": sin}) as made,
        ):
            samples = collect(made, lambda got: sum(s.edge_seq is not None for s in got) >= ANSWERS)
            status = made.statuses()["bow"]
            seen_ns = list(islice(seen, ANSWERS))
        assert not gpio_chip.level("SIN")
        assert "imud" not in tool("gpioinfo", gpio_chip.path.name)
        imu.stop()
    truth = imu.truth()
    answered = [sample for sample in samples if sample.edge_seq is not None]
    assert all(sample.sync is Sync.EDGE for sample in answered)
    period_ns = 200 * NS_PER_MS
    assert all(abs(instant(truth, sample) - sample.t_ns) < 0.45 * period_ns for sample in answered)
    numbers = [sample.edge_seq for sample in answered if sample.edge_seq is not None]
    assert numbers == sorted(set(numbers))
    assert status.lines is not None
    assert status.lines.triggers >= len(answered)
    slots = [round((t_ns - seen_ns[0]) / period_ns) for t_ns in seen_ns]
    assert slots == sorted(set(slots))
    assert (seen_ns[-1] - seen_ns[0]) / slots[-1] == pytest.approx(period_ns, rel=0.01)
    print(f"{len(answered)} of {len(samples)} samples paired; {status.lines}")
