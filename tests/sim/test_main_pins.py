"""`python -m imud.sim --pins … --sin …`, with plain files for those of a gpio-sim chip."""

import csv
import json
import os
import select
from pathlib import Path

import pytest

from imud.sim.ports.pins import PinFaultRates, pin_rates
from tests.sim.test_main import LIMIT_S, Start, command, path_of, read, start

__all__ = ["start"]


def lines(tmp_path: Path, *names: str) -> str:
    """`--pins` for files of these names."""
    for name in names:
        (tmp_path / name).touch()
    return ",".join(f"{name}={tmp_path / name}" for name in names)


def edges(tmp_path: Path) -> list[dict[str, str]]:
    with (tmp_path / "pins.csv").open() as file:
        return list(csv.DictReader(file))


def test_pins_move_in_step_with_frames(start: Start, tmp_path: Path) -> None:
    pins = lines(tmp_path, "sout", "sout_div")
    truth = tmp_path / "truth.csv"
    process = start(
        "--rate", "100", "--pins", pins, "--pin-truth", str(tmp_path / "pins.csv"), "--truth", str(truth),
        "--pin-settle", "0.5",
    )  # fmt: skip
    fd = os.open(path_of(process), os.O_RDWR | os.O_NOCTTY)
    read(fd, 30)
    os.close(fd)
    process_out, problems = process.communicate(timeout=LIMIT_S)
    summary = json.loads(process_out.splitlines()[-1])
    noted = edges(tmp_path)
    assert len(noted) == summary["pin_edges"]
    rises = [int(edge["sample_ns"]) for edge in noted if edge["pin"] == "sout" and edge["level"] == "1"]
    sent = [int(row.split(",")[0]) for row in truth.read_text().splitlines()[2:]]
    assert set(sent) <= set(rises)
    divided = [int(edge["sample_ns"]) for edge in noted if edge["pin"] == "sout_div" and edge["level"] == "1"]
    assert divided == rises[7::8]
    assert all(int(edge["step_ns"]) >= int(edge["due_ns"]) for edge in noted)
    sout = [int(edge["step_ns"]) for edge in noted if edge["pin"] == "sout"]
    assert any(rise_ns < fall_ns for rise_ns, fall_ns in zip(sout[::2], sout[1::2], strict=False))  # each by itself
    assert (tmp_path / "sout").read_bytes().startswith(b"pull-uppull-downpull-up")
    assert problems == ""


def test_pulses_are_lost_when_told_so(start: Start, tmp_path: Path) -> None:
    process = start(
        "--rate", "200", "--pins", lines(tmp_path, "sout"), "--pin-faults", "lose_pulse=1",
        "--pin-truth", str(tmp_path / "pins.csv"),
    )  # fmt: skip
    fd = os.open(path_of(process), os.O_RDWR | os.O_NOCTTY)
    read(fd, 10)
    command(process, "stats")
    assert process.stdout
    assert select.select([process.stdout], [], [], LIMIT_S)[0]
    counted = json.loads(process.stdout.readline())
    os.close(fd)
    assert counted["pin_edges"] == 0
    assert counted["pin_fault_lose_pulse"] >= 10
    process.communicate(timeout=LIMIT_S)
    assert edges(tmp_path) == []


def test_a_rise_on_sin_is_answered(start: Start, tmp_path: Path) -> None:
    sin = tmp_path / "value"
    sin.write_text("0\n")
    process = start("--rate", "1", "--sin", str(sin), "--baud", "115200")
    fd = os.open(path_of(process), os.O_RDWR | os.O_NOCTTY)
    os.write(fd, b"LOG HI91 ONMARK 1\r\n")
    heard = b""
    while b"OK\r\n" not in heard:
        assert select.select([fd], [], [], LIMIT_S)[0]
        heard += os.read(fd, 4096)
    for _ in range(3):
        sin.write_text("1\n")
        assert len(read(fd, 1)) == 1
        sin.write_text("0\n")
        os.write(fd, b"LOG VERSION\r\n")  # its answer comes after another look at SIN
        heard = b""
        while b"BL_VER" not in heard:
            assert select.select([fd], [], [], LIMIT_S)[0]
            heard += os.read(fd, 4096)
        while select.select([fd], [], [], 0.05)[0]:
            os.read(fd, 4096)
    os.close(fd)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--pins", "tx=/tmp/x"), "expected NAME=PATH with one of sout, sout_div, alarm"),
        (("--pins", "sout=/nowhere/pull"), "/nowhere/pull"),
        (("--device", "imu61x-uart", "--pins", "sout=/dev/null"), "this device has none that are simulated"),
        (("--pins", "sout=/dev/null", "--pin-faults", "lose=1"), "expected one of lose_pulse, lose_edge, extra"),
        (("--pins", "sout=/dev/null", "--pin-faults", "extra=x"), "expected a number, got 'x'"),
        (("--pins", "sout=/dev/null", "--pin-faults", "extra=2"), "expected a probability"),
    ],
)
def test_what_cannot_be_is_named(start: Start, arguments: tuple[str, ...], named: str) -> None:
    process = start(*arguments)
    _, problems = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 2
    assert named in problems
    assert "Traceback" not in problems


def test_rates_of_pins_by_name() -> None:
    assert pin_rates("") == PinFaultRates()
    assert pin_rates("lose_pulse=0.1,extra=0.02") == PinFaultRates(lose_pulse=0.1, extra=0.02)
