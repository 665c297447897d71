"""Pins change lines at the due time and lose the edges of a fault. The same seed gives the same edges.
Files of gpio-sim lines: output values in the format of the kernel, and rising edges of SIN."""

import asyncio
from collections.abc import Callable
from io import StringIO
from itertools import pairwise
from pathlib import Path
from zlib import crc32

import pytest

from imud.contracts.lines import Edge, InputOptions, OutputOptions
from imud.model.errors import LinkError
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.ports import pins as pin_ports
from imud.sim.ports.faults import FaultKind, FaultRates, Faults
from imud.sim.ports.pins import MemoryInput, MemoryLines, PinFaultRates, PinFaults, Pins
from imud.sim.sensor import Pin, PinEdge
from tests.support.event_loops import in_loop
from tests.support.simulated_modules import FAST, HipnucUartBench


class Line:
    def __init__(self) -> None:
        self.edges: list[tuple[int, bool]] = []

    def __call__(self, t_ns: int, rising: bool) -> None:
        self.edges.append((t_ns, rising))


def run(faults: PinFaults | None, steps: int = 5000, step_ns: int = 200_000) -> tuple[Line, Pins, HipnucUartBench]:
    bench, line = HipnucUartBench(FAST), Line()
    bench.module.pins(bench.now_ns)
    pins = Pins(bench.module, {Pin.SOUT: line}, faults)
    for _ in range(steps):
        bench.now_ns += step_ns
        pins.step(bench.now_ns)
        assert not line.edges or line.edges[-1][0] <= bench.now_ns
    return line, pins, bench


def test_every_edge_comes_once_in_order() -> None:
    line, pins, _ = run(None)
    assert len(line.edges) == pytest.approx(2000, abs=3) == pins.edges
    assert all(after[0] > before[0] and after[1] is not before[1] for before, after in pairwise(line.edges))
    assert pins.summary() == {"pin_edges": pins.edges}
    memory_line = MemoryInput()
    memory_line.open()
    bench, truth = HipnucUartBench(FAST), StringIO()
    pins = Pins(bench.module, {Pin.SOUT: memory_line.edge}, truth=truth)
    for _ in range(100):
        bench.now_ns += NS_PER_MS
        pins.step(bench.now_ns)
    text = truth.getvalue()
    assert text.startswith("pin,level,due_ns,sample_ns,step_ns\nsout,1,1235068925104,1235068880104,1235069890123\n")
    assert (pins.edges, text.count("\n"), crc32(text.encode())) == (198, 199, 3932825069)
    assert not memory_line.level()


def test_next_ns_names_the_next_edge_even_one_that_a_fault_made() -> None:
    line, pins, bench = run(PinFaults(5, PinFaultRates(extra=1.0)), steps=1)
    seen = 0
    for _ in range(200):
        next_ns = pins.next_ns()
        assert next_ns is not None
        assert next_ns > bench.now_ns
        bench.now_ns = next_ns
        pins.step(next_ns)
        assert all(t_ns == next_ns for t_ns, _ in line.edges[seen:])
        seen = len(line.edges)
    assert seen > 100
    rates = PinFaultRates(lose_pulse=0.1, lose_edge=0.05, extra=0.05)
    assert run(PinFaults(7, rates))[0].edges == run(PinFaults(7, rates))[0].edges
    assert run(PinFaults(7, rates))[0].edges != run(PinFaults(8, rates))[0].edges


def test_lost_pulses_lose_both_edges_and_are_known() -> None:
    faults = PinFaults(1, PinFaultRates(lose_pulse=0.1))
    line, pins, bench = run(faults)
    assert 70 <= faults.counts["lose_pulse"] <= 130
    assert all(after[1] is not before[1] for before, after in pairwise(line.edges))
    whole, _, _ = run(None)
    missing = {t_ns for t_ns, rising in whole.edges if rising} - {t_ns for t_ns, rising in line.edges if rising}
    assert len(missing) == faults.counts["lose_pulse"] == len(faults.lost)
    processing_ns = bench.module.hardware.processing_ns - 80_000
    assert {(sample_ns or 0) + processing_ns for _, sample_ns in faults.lost} == missing
    assert pins.summary()["pin_fault_lose_pulse"] == faults.counts["lose_pulse"]


def test_single_edges_lost_extra_pulses_lost_frames_and_probabilities() -> None:
    faults = PinFaults(2, PinFaultRates(lose_edge=0.1))
    line, _, _ = run(faults)
    assert 150 <= faults.counts["lose_edge"] <= 250
    assert len(line.edges) == pytest.approx(2000 - faults.counts["lose_edge"], abs=3)
    assert any(after[1] is before[1] for before, after in pairwise(line.edges))
    faults = PinFaults(3, PinFaultRates(extra=0.1))
    line, _, _ = run(faults)
    assert 70 <= faults.counts["extra"] <= 130
    assert len(line.edges) == pytest.approx(2000 + 2 * faults.counts["extra"], abs=4)
    assert all(after[0] >= before[0] for before, after in pairwise(line.edges))
    _, rise, fall = PinFaults(3, PinFaultRates(extra=1.0)).pass_on(PinEdge(0, Pin.SOUT, False))
    assert (rise.rising, fall.rising, fall.due_ns - rise.due_ns) == (True, False, 80_000)
    assert pin_ports.pin_rates("lose_edge=0.5,extra=1") == PinFaultRates(lose_edge=0.5, extra=1.0)
    frame_faults, bursts = Faults(4, FaultRates(lose=0.1)), HipnucUartBench(FAST).wait(1000.0)
    arrived = [burst for burst in map(frame_faults.pass_on, bursts) if burst]
    assert 70 <= frame_faults.counts[FaultKind.LOSE] <= 130
    assert len(arrived) == len(bursts) - frame_faults.counts[FaultKind.LOSE]
    assert set(arrived) <= set(bursts)
    assert frame_faults.bursts_hit == frame_faults.counts[FaultKind.LOSE]
    assert PinFaultRates(lose_pulse=0.0, extra=1.0)
    for value in (-0.1, 1.1, float("nan")):
        with pytest.raises(ValueError, match="expected a probability"):
            PinFaultRates(lose_pulse=value)


@in_loop
async def test_a_line_in_memory_counts_lost_edges_and_ends_inactive() -> None:
    line, found = MemoryInput(), list[Edge]()
    line.open()
    line.edge(10, True)
    ends = list[LinkError]()
    line.start(found.extend, ends.append)
    assert (line.is_open, line.level(), line.fileno(), found) == (True, True, -1, [])
    await asyncio.sleep(0)
    assert found == [Edge(10, True, 1)]
    line.lose(2)
    line.edge(20, False)
    line.drain()
    line.pulse(30, 5)
    await asyncio.sleep(0)
    assert found[1:] == [Edge(20, False, 4), Edge(30, True, 5), Edge(35, False, 6)]
    assert line.edges_lost == 2
    line.vanish(gone := LinkError("gone"))
    line.edge(40, True)
    assert (ends, line.is_open, found[4:]) == ([gone], False, [])
    rising = MemoryLines(lambda: 7).input(InputOptions(chip="/dev/gpiochip0", line=1), "ready", True)
    rising.open_error = gone
    with pytest.raises(LinkError, match="gone"):
        rising.open()
    with pytest.raises(LinkError, match="ready is not open"):
        rising.level()
    rising.open_error = None
    rising.open()
    rising.pulse(50, 5)
    rising.start(found.extend, ends.append, watch=False)
    rising.edge(60, True)
    await asyncio.sleep(0)
    assert found[4:] == []
    rising.drain()
    assert found[4:] == [Edge(50, True, 1), Edge(60, True, 2)]
    output = MemoryLines(lambda: 7).output(OutputOptions(chip="/dev/gpiochip0", line=1), "reset")
    with pytest.raises(LinkError, match="reset is not open"):
        output.set(True)
    output.open()
    assert not output.active
    output.set(True)
    output.close()
    assert (output.history, output.is_open) == ([(7, True), (7, False)], False)
    output.close()


def test_pull_files_are_written_as_the_kernel_wants_and_other_pins_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settles_s = list[float]()
    monkeypatch.setattr(pin_ports, "sleep", settles_s.append)
    for name in ("a", "b"):
        (tmp_path / name).write_bytes(b"")
    files = pin_ports.pull_files(f"sout={tmp_path / 'a'},alarm={tmp_path / 'b'}")
    assert set(files) == {Pin.SOUT, Pin.ALARM}
    files[Pin.SOUT](0, True)
    assert (tmp_path / "a").read_bytes() == b"pull-up"
    files[Pin.SOUT](0, False)
    assert (tmp_path / "a").read_bytes() == b"pull-uppull-down"
    assert ((tmp_path / "b").read_bytes(), settles_s) == (b"", [])
    (settling,) = pin_ports.pull_files(f"sout={tmp_path / 'a'}", 0.1).values()
    settling(0, True)
    settling(0, False)
    assert settles_s == [0.1]
    for file in (*files.values(), settling):
        file.close()
        file.close()
    with pytest.raises(FileNotFoundError):
        pin_ports.PullFile(tmp_path / "missing" / "pull")
    for text in ("led=/tmp/x", "sout", "sout=", "=x"):
        with pytest.raises(ValueError, match="expected NAME=PATH with one of sout, sout_div, alarm"):
            pin_ports.pull_files(text)


class Marked:
    def __init__(self) -> None:
        self.marks: list[int] = []

    def mark(self, now_ns: int) -> None:
        self.marks.append(now_ns)

    def pins(self, now_ns: int) -> list[PinEdge]:
        raise AssertionError(now_ns)

    def next_pin_ns(self) -> int | None:
        return None


@pytest.fixture
def value(tmp_path: Path) -> Callable[[int], Path]:
    def write(level: int) -> Path:
        (tmp_path / "value").write_text(f"{level}\n")
        return tmp_path / "value"

    return write


def test_sin_marks_on_rising_edges_only(value: Callable[[int], Path]) -> None:
    module = Marked()
    sin = pin_ports.SinFile(value(1), module)
    for number, level in enumerate([1, 0, 0, 1, 1, 0, 1]):
        value(level)
        sin.look(number * NS_PER_MS)
    assert module.marks == [3 * NS_PER_MS, 6 * NS_PER_MS]


def test_lines_deliver_edges_read_sin_and_write_the_truth(
    tmp_path: Path, value: Callable[[int], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pull").write_bytes(b"")
    bench, marks = HipnucUartBench(FAST), list[int]()
    monkeypatch.setattr(type(bench.module), "mark", lambda _module, now_ns: marks.append(now_ns))
    files, truth = pin_ports.pull_files(f"sout={tmp_path / 'pull'}"), (tmp_path / "truth").open("w")
    lines, now_ns = pin_ports.SimulatedLines(bench.module, files, None, truth, value(0)), bench.now_ns
    for _ in range(40):
        next_ns = lines.next_ns(now_ns)
        assert now_ns < next_ns <= now_ns + 4 * NS_PER_MS
        now_ns = next_ns
        lines.step(now_ns)
    value(1)
    lines.step(now_ns)
    assert marks == [now_ns]
    edges = lines.summary()["pin_edges"]
    assert edges >= 20
    lines.close()
    assert (tmp_path / "pull").read_bytes() == (b"pull-uppull-down" * edges)[: 7 * edges + 2 * (edges // 2)]
    rows = [line.split(",") for line in (tmp_path / "truth").read_text().splitlines()]
    assert rows[0] == ["pin", "level", "due_ns", "sample_ns", "step_ns"]
    assert [row[:2] for row in rows[1:3]] == [["sout", "1"], ["sout", "0"]]
    assert all(row[2] == row[4] for row in rows[1:])  # each edge was delivered when it was due
    assert len(rows) == edges + 1
    assert files[Pin.SOUT]._file.closed
    bare = pin_ports.SimulatedLines(bench.module, {})
    bare.step(now_ns)
    assert (bare.next_ns(5), bare.summary()) == (5 + NS_PER_S, {})
    bare.close()
    assert pin_ports.SimulatedLines(bench.module, {}, sin=value(0)).next_ns(5) == 5 + 4 * NS_PER_MS
    with pytest.raises(ValueError, match="expected a device with simulated pins"):
        pin_ports.SimulatedLines(object(), files)  # type: ignore[arg-type]  # not a simulated device
