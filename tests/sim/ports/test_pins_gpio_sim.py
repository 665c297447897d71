"""Files of gpio-sim lines: output values in the format of the kernel, and rising edges of SIN."""

from collections.abc import Callable
from pathlib import Path

import pytest

from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.ports.pins import PullFile, SimulatedLines, SinFile, pull_files
from imud.sim.sensor import Pin, PinEdge
from tests.support.simulated_modules import FAST, HipnucUartBench


def test_pull_files_are_written_as_the_kernel_wants(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).write_bytes(b"")
    files = pull_files(f"sout={tmp_path / 'a'},alarm={tmp_path / 'b'}")
    assert set(files) == {Pin.SOUT, Pin.ALARM}
    files[Pin.SOUT](0, True)
    assert (tmp_path / "a").read_bytes() == b"pull-up"
    files[Pin.SOUT](0, False)
    assert (tmp_path / "a").read_bytes() == b"pull-uppull-down"
    assert (tmp_path / "b").read_bytes() == b""
    for file in files.values():
        file.close()
        file.close()
    with pytest.raises(FileNotFoundError):
        PullFile(tmp_path / "missing" / "pull")


@pytest.mark.parametrize("text", ["led=/tmp/x", "sout", "sout=", "=x"])
def test_other_pins_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected NAME=PATH with one of sout, sout_div, alarm"):
        pull_files(text)


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
    sin = SinFile(value(1), module)
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
    files, truth = pull_files(f"sout={tmp_path / 'pull'}"), (tmp_path / "truth").open("w")
    lines = SimulatedLines(bench.module, files, None, truth, value(0))
    now_ns = bench.now_ns
    for _ in range(40):
        next_ns = lines.next_ns(now_ns)
        assert now_ns < next_ns <= now_ns + 4 * NS_PER_MS  # SIN is read every 4 ms
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

    bare = SimulatedLines(bench.module, {})
    bare.step(now_ns)
    assert (bare.next_ns(5), bare.summary()) == (5 + NS_PER_S, {})
    bare.close()
    with pytest.raises(ValueError, match="expected a device with simulated pins"):
        SimulatedLines(object(), files)  # type: ignore[arg-type]  # not a simulated device
