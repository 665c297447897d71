"""A real daemon, a simulated device behind a pty, and its pins on lines of gpio-sim.

The processor of the lab is emulated, and time stamps are late by milliseconds. The tests therefore check only the pairs
of edges and samples.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice, pairwise
from math import degrees
from pathlib import Path
from threading import Event as Flag
from threading import Thread
from urllib.request import urlopen

import pytest

from imud.contracts.status import DeviceStatus, LinesStatus
from imud.lines.sync import ALARM_STATUS
from imud.model.event import EventKind
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.lab.gpio_chip import GpioChip
from tests.lab.imu_process import Pulse, running_imu, tell, tty
from tests.lab.test_gpio_lines import INTERRUPTS, rising_edges
from tests.lab.tool import running, tool
from tests.lab.waiting import wait_until
from tests.support.daemon_process import RunningDaemon, running_daemon

pytestmark = pytest.mark.timeout(600)

LIMIT_S = 150.0
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
