"""`python -m imud.sim` as a process."""

import csv
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from unittest.mock import Mock

import pytest

from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.__main__ import main
from imud.sim.ports.can_port import CanPort
from imud.sim.ports.pins import PinFaultRates, pin_rates
from tests.support.daemon_process import LIMIT_S

pytestmark = pytest.mark.live
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Start]:
    started: list[subprocess.Popen[str]] = []

    def begin(*arguments: str, program: Sequence[str] = ("imud.sim",)) -> subprocess.Popen[str]:
        command, pipe = [sys.executable, "-m", *program, "--boot", "0", *arguments], subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        started.append(process)
        return process

    yield begin
    for process in started:
        if process.poll() is None:
            process.communicate(timeout=LIMIT_S)  # the process ends with its standard input and removes its files


def path_of(process: "subprocess.Popen[str]") -> Path:
    assert process.stdout
    return Path(process.stdout.readline().strip())


def command(process: "subprocess.Popen[str]", line: str) -> None:
    assert process.stdin
    process.stdin.write(line + "\n")
    process.stdin.flush()


def read(fd: int, wanted: int) -> list[Measurement]:
    codec = DRIVER.make_codec(Ledger(), DRIVER.settings())
    found: list[Measurement] = []
    while len(found) < wanted:
        assert select.select([fd], [], [], LIMIT_S)[0], "nothing came"
        found += [event for event in codec.feed(os.read(fd, 4096)) if isinstance(event, Measurement)]
    return found


def drain(fd: int) -> None:
    """Read to the end of the file, or to EIO if the far end closes during a read."""
    with suppress(OSError):
        while os.read(fd, 4096):
            pass


def test_frames_commands_and_the_end(start: Start, tmp_path: Path) -> None:
    truth = tmp_path / "truth.csv"
    process = start("--rate", "500", "--path", str(tmp_path / "tty"), "--truth", str(truth), "--skew-ppm", "0")
    path = path_of(process)
    assert path == tmp_path / "tty"
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    found = read(fd, 100)
    ticks = [measurement.dev_ticks or 0 for measurement in found]
    steps = {after - before for before, after in pairwise(ticks)}
    assert min(steps) == 2
    assert all(step % 2 == 0 for step in steps)  # a slow reader loses frames: the terminal is full
    text = b""
    while b"BL_VER=109\r\nOK\r\n" not in text:
        os.write(fd, b"LOG VERSION\r\n")  # again, because a full terminal can lose the reply too
        for _ in range(20):
            assert select.select([fd], [], [], LIMIT_S)[0], "nothing came"
            text += os.read(fd, 4096)
    newest = read(fd, 1)[0].dev_ticks or 0
    command(process, "reboot")
    while (tick := read(fd, 1)[0].dev_ticks or 0) >= newest:
        newest = tick
    command(process, "dance")
    command(process, "unplug soon")
    command(process, "stats")
    assert process.stdout
    assert json.loads(process.stdout.readline())["bytes_written"] > 100 * 82
    out, err = process.communicate("quit\n", timeout=LIMIT_S)
    os.close(fd)
    assert process.returncode == 0
    assert json.loads(out)["frames_sent"] > 100
    assert "dance" in err
    assert "soon" in err
    assert not path.is_symlink()
    sampled = {int(line.split(",")[1]) for line in truth.read_text().splitlines()[2:]}
    assert sampled & set(ticks)  # `sampled` does not contain frames that a full terminal accepted in part


def test_unplug_closes_the_port_and_a_new_one_appears(start: Start) -> None:
    process = start()
    path = path_of(process)
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    read(fd, 5)
    command(process, "unplug 0.05")
    drain(fd)
    with pytest.raises(OSError, match="Input/output error"):
        os.write(fd, b"anybody there?")
    os.close(fd)
    command(process, "stats")
    assert process.stdout
    assert json.loads(process.stdout.readline())["unplugs"] == 1
    process.communicate("", timeout=LIMIT_S)  # the process ends with its standard input
    assert process.returncode == 0
    assert pin_rates("") == PinFaultRates()
    assert pin_rates("lose_pulse=0.1,extra=0.02") == PinFaultRates(lose_pulse=0.1, extra=0.02)


def test_the_command_survives_the_end_of_its_input(start: Start) -> None:
    process = start("--rest", program=("imud", "sim"))
    path = path_of(process)
    assert process.stdin is not None
    process.stdin.close()
    process.stdin = None
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    read(fd, 20)
    os.close(fd)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_it_well(start: Start, number: signal.Signals) -> None:
    process = start()
    path = path_of(process)
    process.send_signal(number)
    out, err = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, err) == (0, "")
    assert "frames_sent" in json.loads(out)
    assert not path.parent.exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--rate", "300"], "rate 300"), (["--faults", "flop=1"], "flop"),
        (["--variant", "odd"], "variant 'odd': expected one of as in the manual, "), (["--baud", "1200"], "baud 1200"),
        (["--device", "imu61x-can:101", "--device", "hipnuc-uart"], "one device on a terminal"),
        (["--device", "imu61x-can:x"], "with or without :NODE"),
        (["--device", "imu61x-can:9999", "--interface", "vcan0"], "node 9999"),
        (["--pins", "tx=/tmp/x"], "expected NAME=PATH with one of sout, sout_div, alarm"),
        (["--pins", "sout=/nowhere/pull"], "/nowhere/pull"),
        (["--device", "imu61x-uart", "--pins", "sout=/dev/null"], "got a device without pins"),
        (["--pins", "sout=/dev/null", "--pin-faults", "lose=1"], "expected one of lose_pulse, lose_edge, extra"),
        (["--pins", "sout=/dev/null", "--pin-faults", "extra=x"], "expected a number, got 'x'"),
        (["--pins", "sout=/dev/null", "--pin-faults", "extra=2"], "expected a probability"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # main leaves the file of a pin open
def test_bad_arguments_are_explained(
    arguments: list[str], named: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signal, "signal", lambda _number, _handler: None)
    with pytest.raises(SystemExit, match="2"):
        sys.exit(main(arguments))  # the parser exits
    out, err = capsys.readouterr()
    assert out == ""
    assert named in err


def lines(tmp_path: Path, *names: str) -> str:
    """Return `--pins` for files with these names."""
    for name in names:
        (tmp_path / name).touch()
    return ",".join(f"{name}={tmp_path / name}" for name in names)


def edges(tmp_path: Path) -> list[dict[str, str]]:
    with (tmp_path / "pins.csv").open() as file:
        return list(csv.DictReader(file))


def test_pins_move_in_step_with_frames(start: Start, tmp_path: Path) -> None:
    pins, truth = lines(tmp_path, "sout", "sout_div"), tmp_path / "truth.csv"
    process = start(
        "--rate", "100", "--pins", pins, "--pin-truth", str(tmp_path / "pins.csv"), "--truth", str(truth),
        "--pin-settle", "0.5",
    )  # fmt: skip
    fd = os.open(path_of(process), os.O_RDWR | os.O_NOCTTY)
    read(fd, 30)
    os.close(fd)
    process_out, problems = process.communicate(timeout=LIMIT_S)
    summary, noted = json.loads(process_out.splitlines()[-1]), edges(tmp_path)
    assert len(noted) == summary["pin_edges"]
    rises = [int(edge["sample_ns"]) for edge in noted if edge["pin"] == "sout" and edge["level"] == "1"]
    sent = [int(row.split(",")[0]) for row in truth.read_text().splitlines()[2:]]
    assert set(sent) <= set(rises)
    divided = [int(edge["sample_ns"]) for edge in noted if edge["pin"] == "sout_div" and edge["level"] == "1"]
    assert divided == rises[7::8]
    assert all(int(edge["step_ns"]) >= int(edge["due_ns"]) for edge in noted)
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
        os.write(fd, b"LOG VERSION\r\n")  # the reply arrives after the process has read SIN again
        heard = b""
        while b"BL_VER" not in heard:
            assert select.select([fd], [], [], LIMIT_S)[0]
            heard += os.read(fd, 4096)
        while select.select([fd], [], [], 0.05)[0]:
            os.read(fd, 4096)
    os.close(fd)


def test_devices_on_a_can_bus_run_until_quit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (near, far), (commands, write) = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM), os.pipe()
    near.setblocking(False)
    os.write(write, b"stats\nquit\n")
    os.close(write)
    monkeypatch.setattr(sys, "stdin", os.fdopen(commands))
    monkeypatch.setattr("imud.sim.__main__.signal", sharpened := Mock())
    for name, put in {
        "CanPort": lambda module, name: CanPort(module, name, open_socket=lambda _name: near),
        "sharpen_timers": sharpened.timers, "default_interface": lambda: "can7",
    }.items():  # fmt: skip
        monkeypatch.setattr(f"imud.sim.__main__.{name}", put)
    assert main(["--device", "hipnuc-canopen:8", "--device", "hipnuc-canopen:9"]) == 0
    interface, stats, summary = capsys.readouterr().out.splitlines()
    assert (interface, json.loads(stats).keys()) == ("can7", json.loads(summary).keys())
    assert (near.fileno(), sharpened.timers.call_count) == (-1, 1)
    far.close()
    sys.stdin.close()
