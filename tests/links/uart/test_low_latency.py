"""How long adapters hold bytes back, from a made-up /sys."""

from pathlib import Path

import pytest

from imud.links.uart.low_latency import hold_ns, read_latency_timer_ms
from imud.units import NS_PER_MS


def timer_of(sys: Path, node: str) -> Path:
    path = sys / "class" / "tty" / node / "device" / "latency_timer"
    path.parent.mkdir(parents=True)
    return path


@pytest.mark.parametrize(("node", "hold_ms"), [("ttyUSB0", 16), ("ttyACM3", 1), ("ttyS0", 0), ("ttyAMA0", 0), ("7", 0)])
def test_without_a_timer_the_kind_of_port_decides(tmp_path: Path, node: str, hold_ms: int) -> None:
    assert hold_ns(f"/dev/{node}", tmp_path) == hold_ms * NS_PER_MS


def test_the_timer_is_believed_through_a_link(tmp_path: Path) -> None:
    timer_of(tmp_path, "ttyUSB4").write_text("4\n")
    node, link = tmp_path / "ttyUSB4", tmp_path / "by-id"
    node.touch()
    link.symlink_to(node)
    assert hold_ns(str(link), tmp_path) == 4 * NS_PER_MS


def test_a_timer_that_is_no_number_is_none(tmp_path: Path) -> None:
    timer_of(tmp_path, "ttyUSB4").write_text("?\n")
    assert read_latency_timer_ms("/dev/ttyUSB4", tmp_path) is None
