"""Nine devices on one virtual bus and one daemon: no lost or mixed samples, also after an interface was down.

`imud demo` and `imud probe` on a virtual bus with devices of every protocol, as processes of their own.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep

import pytest

from imud.client.connection import Client, Watch
from imud.contracts.status import DeviceState, DeviceStatus
from imud.formats.slot import SLOT_BYTES, SLOT_FIELDS, decode_slot
from imud.model.sample import Sample
from tests.lab.can_interface import CanInterface
from tests.lab.can_traffic import Against, Module, fleet, traffic
from tests.lab.tool import demo
from tests.support.daemon_process import RunningDaemon, running_daemon

SECONDS = float(os.environ.get("IMUD_LAB_SECONDS", "6"))  # duration of the measurement
RATE_HZ = float(os.environ.get("IMUD_LAB_RATE_HZ", "20"))
"""Rate in whole hertz, with a period in whole milliseconds."""
LATENCY_MS = float(os.environ.get("IMUD_LAB_LATENCY_MS", "50"))  # latency of the client
LIMIT_S = 60.0
ASK_S = 0.5
EDGE_S = 0.5
"""Tolerance of start and end of the reading time, s. No sample between them may be missing."""
SPARE_S = 120.0
ID_AT = next(field.offset for field in SLOT_FIELDS if field.name == "device_id")
LOSSES = ("lost_gap_device", "lost_crc", "lost_overrun", "lost_queue")


def collect(client: Client, seconds: float) -> dict[str, list[Sample]]:
    watch = client.watch(encoding="binary", latency_ms=LATENCY_MS)
    names = {number: name for name, number in watch.device_ids.items()}
    taken: list[bytes] = []
    end = monotonic() + seconds
    while monotonic() < end:
        message = client.next_message(Watch.NAMES, LIMIT_S)
        assert isinstance(message, bytes), message  # no sample was dropped
        taken.append(message)
    client.unwatch()
    found: dict[str, list[Sample]] = {name: [] for name in names.values()}
    for slots in taken:
        for start in range(0, len(slots), SLOT_BYTES):
            slot = slots[start : start + SLOT_BYTES]
            number = int.from_bytes(slot[ID_AT : ID_AT + 2], "little")
            found[names[number]].append(decode_slot(slot, names[number]))
    return found


def wait_until_all(daemon: RunningDaemon, state: DeviceState) -> None:
    end = monotonic() + LIMIT_S
    while {status.state for status in daemon.statuses().values()} != {state}:
        assert monotonic() < end, {name: (s.state, s.problem) for name, s in daemon.statuses().items()}
        sleep(ASK_S)


def closes(status: DeviceStatus) -> bool:
    ledger = status.ledger
    bytes_known = sum(ledger[f"bytes_{name}"] for name in ("in_good_frames", "in_bad_frames", "skipped", "pending"))
    frames_known = sum(ledger[f"frames_{name}"] for name in ("in_samples", "in_replies", "ignored", "pending"))
    return ledger["bytes_in"] == bytes_known and ledger["frames_good"] == frames_known


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def losses(status: DeviceStatus) -> int:
    return sum(status.ledger[name] for name in LOSSES)


@pytest.mark.thorough
@pytest.mark.timeout(1800)
def test_nine_devices_on_one_bus(vcan: CanInterface, tmp_path: Path) -> None:
    modules = fleet()
    devices = {module.name: module.config(vcan.name) for module in modules}
    outputs = {"log_level": "info", "shm": {"enabled": False}, "metrics": {"enabled": False}}
    with (
        traffic(vcan.name, modules, RATE_HZ, SECONDS + SPARE_S) as bus,
        running_daemon(tmp_path, devices, limit_s=LIMIT_S, python=(), **outputs) as daemon,
    ):
        begin_ns = bus.begin()
        wait_until_all(daemon, DeviceState.RUNNING)
        before, used_s = daemon.statuses(), [cpu_s(pid) for pid in (daemon.process.pid, bus.pid)]
        with daemon.client() as client:
            found = collect(client, SECONDS)
        used_s = [cpu_s(pid) - was for pid, was in zip((daemon.process.pid, bus.pid), used_s, strict=True)]
        after = daemon.statuses()
        show(modules, before, after, found)
        count = sum(len(samples) for samples in found.values())
        print(
            f"  CPU of the guest: daemon {used_s[0] / SECONDS:.0%}, {used_s[0] / count * 1e6:.0f} us per sample, "
            f"player {used_s[1] / SECONDS:.0%}; latency_ms {LATENCY_MS:g}"
        )
        for number, module in enumerate(modules):
            status, samples = after[module.name], found[module.name]
            assert closes(status), status.ledger
            assert losses(status) == losses(before[module.name]), status.ledger
            assert status.ledger["frames_ignored"] == before[module.name].ledger["frames_ignored"]
            assert [s.seq for s in samples] == list(range(samples[0].seq, samples[0].seq + len(samples)))
            assert len(samples) == pytest.approx(SECONDS * RATE_HZ, abs=EDGE_S * RATE_HZ)
            against = Against(number, samples[0], RATE_HZ, begin_ns)
            assert [s.seq for s in samples if not against.is_true(s)] == []
        vcan.down()
        wait_until_all(daemon, DeviceState.MISSING)
        vcan.up()
        wait_until_all(daemon, DeviceState.RUNNING)
        for module in modules:
            status = daemon.statuses()[module.name]
            assert closes(status), status.ledger
            assert status.connects == 2
        with daemon.client() as client:
            again = collect(client, 2.0)
        for number, module in enumerate(modules):
            whole = next(s for s in again[module.name] if s.gyro_rad_s and s.accel_m_s2 and s.quat_wxyz)
            against = Against(number, whole, RATE_HZ, begin_ns)
            assert all(against.is_true(s) for s in again[module.name])
        assert bus.end() > 0  # frames rejected while the bus was down


def show(
    modules: list[Module], before: dict[str, DeviceStatus], after: dict[str, DeviceStatus],
    found: dict[str, list[Sample]],
) -> None:  # fmt: skip
    print(f"\n{len(modules)} devices at {RATE_HZ:g} Hz for {SECONDS:g} s")
    for module in modules:
        was, now, samples = before[module.name].ledger, after[module.name].ledger, found[module.name]
        frames = now["frames_good"] - was["frames_good"]
        late_ms = sorted((s.t_rx_ns - s.t_ns) / 1e6 for s in samples)
        print(
            f"  {module.name:20} {len(samples):6} samples {frames:7} frames, lost {losses(after[module.name])}, "
            f"ignored {now['frames_ignored'] - was['frames_ignored']}; from instant to last frame "
            f"p50 {late_ms[len(late_ms) // 2]:.1f} ms, max {late_ms[-1]:.1f} ms"
        )


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
        assert f"link      running; {vcan.name}, driver {driver}" in printed
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
