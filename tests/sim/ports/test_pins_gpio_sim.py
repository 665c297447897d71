"""Files of gpio-sim lines: output values in the format of the kernel, and rising edges of SIN."""

from collections.abc import Callable
from pathlib import Path

import pytest

from imud.model.units import NS_PER_MS
from imud.sim.ports.pins import PullFile, SinFile, pull_files
from imud.sim.sensor import Pin, PinEdge


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
