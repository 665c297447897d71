"""`imud demo`: three real processes, and the account at the end."""

import itertools
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import pytest

from imud.cli import main
from imud.client import Client
from tests.support.daemon_process import LIMIT_S, wait_until


@contextmanager
def demo(*words: str) -> Iterator[subprocess.Popen[str]]:
    """The command as a process, ended by SIGTERM at the end of the block if it still runs."""
    argv = [sys.executable, "-m", "imud", "demo", "--plain", *words]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.terminate()
            process.communicate(timeout=LIMIT_S)


def folder_of(process: subprocess.Popen[str]) -> Path:
    """Where the daemon's socket is, once there is one."""
    assert process.stdout is not None
    found = re.match(r"daemon at (\S+)/imud.sock", process.stdout.readline())
    assert found is not None
    return Path(found[1])


@pytest.mark.parametrize(
    ("device", "product"), [("hipnuc-uart", "HI14R3"), ("imu61x-uart", "IMU61x"), ("hipnuc-modbus", "HI14R2N")]
)
def test_samples_flow_and_the_ledger_closes(device: str, product: str) -> None:
    with demo("--device", device, "--rate", "200") as process:
        folder = folder_of(process)
        with Client(folder / "imud.sock") as client:

            def watched_and_known() -> bool:
                state = client.status()
                watching = any(one["sent"] > 20 for one in state["socket"]["clients"])  # enough to show a rate
                return watching and state["devices"][0]["identity"].get("product", "").startswith(product)

            wait_until(watched_and_known, f"{product} is known and watched", 3 * LIMIT_S)
        process.terminate()
        out, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0
    assert "the ledger closes to zero" in out
    assert re.search(r"client +\d+ samples at \d+\.\d+ Hz, 0 missed", out)
    assert product in out
    assert not folder.exists()


def test_it_ends_after_its_duration(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--duration", "0.2", "--rate", "200", "--plain"]) == 0
    out = capfd.readouterr().out
    assert "the ledger closes to zero" in out
    folder = re.search(r"daemon at (\S+)/imud.sock", out)
    assert folder is not None
    assert not Path(folder[1]).exists()


def test_the_commands_it_prints_reach_it_from_another_directory() -> None:
    with demo() as process:
        folder_of(process)
        assert process.stdout is not None
        export, status, watch, clock, ring, scrape = (line.strip() for line in itertools.islice(process.stdout, 6))
        reached = pasted(export, f"{watch} --count 3")
        assert len(re.findall(r"^\d\d:\d\d:\d\d\.\d{3} ", reached, re.MULTILINE)) == 3
        assert "demo: running" in pasted(export, status)
        assert clock.endswith("imud clock")
        assert "verdict" in pasted(export, f"{clock} --duration 0.1")
        assert "accel_m_s2=" in pasted(export, ring)
        with urlopen(scrape.removeprefix("curl ")) as answer:
            assert b'imud_samples_total{device="demo"}' in answer.read()
    assert process.returncode == 0


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


def test_devices_that_cannot_be_together(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--device", "hipnuc-uart", "--device", "imu61x-can"]) == 2
    assert "one or more on a CAN bus" in capsys.readouterr().err
    assert main(["demo", "--device", "imu61x-can", "--device", "imu61x-can"]) == 2
    assert "devices that differ" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--device", "imu61x-i2c"], "imu61x-i2c is not simulated: say where a real one is, for example --bus 1"),
        (
            ["--device", "imu61x-spi", "--bus", "1"],
            "imu61x-spi is not simulated: say where a real one is, for example --port /dev/spidev0.0",
        ),
        (["--device", "imu61x-i2c", "--device", "imu61x-uart"], "expected imu61x-i2c alone, got 2 devices"),
    ],
)
def test_a_bus_must_be_named(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", *words]) == 2
    assert capsys.readouterr().err == f"imud demo: {said}\n"
