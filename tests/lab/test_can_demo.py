"""`imud demo` and `imud probe` on a virtual bus with devices of every protocol, all as processes of their own."""

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest

from tests.lab.can_interface import CanInterface
from tests.lab.demo import demo

LIMIT_S = 90.0
EVERY_PROTOCOL = {
    ("hipnuc-canopen", "node 8"): "hipnuc-canopen:8", ("hipnuc-canopen", "node 9"): "hipnuc-canopen:9",
    ("hipnuc-j1939", "address 10"): "hipnuc-j1939:10", ("hipnuc-nmea2000", "source 35"): "hipnuc-nmea2000:35",
    ("imu61x-can", "base_id 101"): "imu61x-can:101",
}  # fmt: skip


@contextmanager
def simulators(names: Sequence[str]) -> Iterator[None]:
    argv = [sys.executable, "-m", "imud.sim", "--at-once", "--boot", "0", "--rate", "10"]
    argv += [word for name in names for word in ("--device", name)]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert process.stdout.readline() == "vcan0\n"
        yield
        process.stdin.close()
        assert json.loads(process.stdout.read())["frames_refused"] == 0


@pytest.mark.timeout(240)
def test_demo_of_three_protocols_to_its_end(vcan: CanInterface) -> None:
    devices = ("--device", "hipnuc-canopen:8", "--device", "hipnuc-j1939:9", "--device", "imu61x-can")
    printed = demo(*devices, "--rate", "10", "--duration", "5")
    for driver in ("hipnuc-canopen", "hipnuc-j1939", "imu61x-can"):
        assert f"link      {vcan.name}, driver {driver}" in printed
    assert printed.count("lost 0 (device 0, damaged 0, overrun 0, queue 0)") == 3, printed
    assert printed.rstrip().endswith("the ledger balances"), printed


@pytest.mark.timeout(240)
def test_probe_lists_the_nodes_of_every_protocol(vcan: CanInterface) -> None:
    with simulators(list(EVERY_PROTOCOL.values())):
        argv = [sys.executable, "-m", "imud", "probe", "--json", vcan.name]
        ended = subprocess.run(argv, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    found = [json.loads(line) for line in ended.stdout.splitlines()]
    assert {(report["driver"], report["device"]) for report in found} == set(EVERY_PROTOCOL), ended.stdout
