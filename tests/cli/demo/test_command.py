"""`imud demo`: three real processes, and the account at the end."""

import io
import itertools
import re
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import msgspec
import pytest

from imud.cli import main
from imud.cli.demo.view import View
from imud.sample import Sample, Sync


@pytest.mark.parametrize(
    ("device", "product"), [("hipnuc-uart", "HI14R3"), ("imu61x-uart", "IMU61x"), ("hipnuc-modbus", "HI14R2N")]
)
def test_samples_flow_and_the_ledger_closes(device: str, product: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--device", device, "--duration", "1", "--rate", "200", "--plain"]) == 0
    out = capfd.readouterr().out
    assert "the ledger closes to zero" in out
    assert re.search(r"client +\d+ samples at \d+\.\d+ Hz, 0 missed", out)
    assert product in out or "not known" in out
    folder = re.search(r"daemon at (\S+)/imud.sock", out)
    assert folder is not None
    assert not Path(folder[1]).exists()


def test_the_commands_it_prints_reach_it_from_another_directory() -> None:
    argv = [sys.executable, "-m", "imud", "demo", "--plain"]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as demo:
        try:
            assert demo.stdout is not None
            assert demo.stdout.readline().startswith("daemon at ")
            export, status, watch, clock, ring, scrape = (line.strip() for line in itertools.islice(demo.stdout, 6))
            reached = pasted(export, f"{watch} --count 3")
            assert reached.count("demo ") == 3
            assert "demo: running" in pasted(export, status)
            assert clock.endswith("imud clock")
            assert "verdict" in pasted(export, f"{clock} --duration 0.1")
            assert "accel_m_s2=" in pasted(export, ring)
            with urlopen(scrape.removeprefix("curl ")) as answer:
                assert b'imud_samples_total{device="demo"}' in answer.read()
        finally:
            demo.terminate()
            demo.communicate(timeout=10)
    assert demo.returncode == 0


def pasted(*lines: str) -> str:
    """What a shell prints that knows nothing of this directory and this environment."""
    script = "\n".join(["set -e", *lines])
    return subprocess.run(
        ["/bin/sh", "-c", script], cwd="/", env={}, capture_output=True, text=True, timeout=30, check=True
    ).stdout


def test_a_can_device_needs_an_interface(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("imud.sim.ports.can_port.can_interfaces", list)
    assert main(["demo", "--device", "imu61x-can", "--duration", "1"]) == 2
    assert "ip link add vcan0 type vcan" in capsys.readouterr().err


def sample(seq: int) -> Sample:
    t_ns = seq * 10_000_000
    return Sample("demo", seq, t_ns, 50_000, Sync.REGRESSION, t_ns + 100, 0, euler_rad=(0.1, 0, 0))


def test_view_counts_what_is_missing() -> None:
    view = View(io.StringIO(), live=False)
    for seq in (1, 2, 5):
        view.add(sample(seq))
    assert (view.samples, view.missed) == (3, 2)
    assert "3 samples at 100.00 Hz, 2 missed" in view.account()


def test_live_view_draws_in_place() -> None:
    out = io.StringIO()
    view = View(out, live=True)
    view.add(sample(1))
    first = out.getvalue()
    assert "demo #1" in first
    assert "5.730" in first  # 0.1 rad in degrees
    assert "\x1b[5A" not in first


def test_account_without_samples() -> None:
    assert "no sample arrived" in View(io.StringIO(), live=False).account()


def test_devices_that_cannot_be_together(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--device", "hipnuc-uart", "--device", "imu61x-can"]) == 2
    assert "one or more on a CAN bus" in capsys.readouterr().err
    assert main(["demo", "--device", "imu61x-can", "--device", "imu61x-can"]) == 2
    assert "devices that differ" in capsys.readouterr().err


def test_view_counts_what_is_missing_of_each_device() -> None:
    view = View(io.StringIO(), live=False)
    for name, seq in (("a", 1), ("b", 7), ("a", 2), ("b", 9)):
        view.add(msgspec.structs.replace(sample(seq), device=name))
    assert (view.samples, view.missed) == (4, 1)
