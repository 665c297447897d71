"""Starts writer, server and readers as processes, the server alone on one core, and measures the cost of the server."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import NamedTuple

import msgspec

from imud.cli.arguments import statuses
from imud.client.connection import Client
from imud.contracts.status import DeviceStatus

CORES = sorted(os.sched_getaffinity(0))
SERVER_CORE = {CORES[-1]}  # the server has a core of its own
REST_CORES = set(CORES[:-1]) or SERVER_CORE  # writer and readers use the other cores
START_LIMIT_S = 120.0  # a busy host starts processes slowly
END_S = 0.2
"""Time between the end of the CPU measurement and the last frame, s. The writer has to keep its deadlines, and this
process may wake up late."""


@dataclass(frozen=True)
class Load:
    devices: int = 1
    clients: int = 1
    encoding: str = "binary"
    rate_hz: float = 1000.0
    seconds: float = 5.0
    warm_s: float = 3.0  # time before the measurement, s: the clock computes its first fits, and the caches fill
    bare: bool = False
    latency_ms: float | None = None  # latency that clients and shared memory request, ms; None for their defaults
    client_hz: float | None = None  # sample rate that a client requests, Hz; None for all samples
    phases: int = 1
    apart: int = 0  # number of frames between the starts of two devices; 0 starts all devices at the same time
    recorded: bool = False

    @property
    def frames(self) -> int:
        return int((self.warm_s + self.seconds) * self.rate_hz)


@dataclass(frozen=True)
class Outcome:
    cpu_us_per_sample: float
    cpu_share: float
    p50_us: float
    p99_us: float
    gaps: int
    refused: int
    rss_mb: float
    statuses: tuple[DeviceStatus, ...]

    @property
    def lost(self) -> int:
        """Return the number of samples that the first client did not receive or that the daemon reports as lost."""
        return (
            self.gaps
            + self.refused
            + sum(sum(v for k, v in s.ledger.items() if k.startswith("lost_")) for s in self.statuses)
        )


class Process:
    def __init__(self, cores: set[int], *argv: str) -> None:
        self.popen = subprocess.Popen(
            [sys.executable, *argv], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            cwd=Path(__file__).parents[2],
        )  # fmt: skip
        os.sched_setaffinity(self.popen.pid, cores)

    def line(self) -> str:
        assert self.popen.stdout is not None
        text = self.popen.stdout.readline()
        if not text:
            raise RuntimeError(f"expected a line from {self.popen.args!r}, got exit status {self.popen.wait()}")
        return text.strip()

    def say(self, text: str) -> None:
        assert self.popen.stdin is not None
        self.popen.stdin.write(text + "\n")
        self.popen.stdin.flush()

    def __enter__(self) -> "Process":
        return self

    def __exit__(self, *_: object) -> None:
        self.popen.terminate()
        self.popen.communicate(timeout=10)


def cpu_ns(pid: int) -> int:
    total = 0
    # the CPU time of all threads, ns; more precise than the ticks of /proc/PID/stat
    for task in Path(f"/proc/{pid}/task").iterdir():
        total += int((task / "schedstat").read_text().split()[0])
    return total


def rss_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6


def configuration(folder: Path, ports: Sequence[str], load: Load) -> Path:
    devices = {
        f"d{i}": {"driver": "hipnuc-uart", "identify": False, "uart": {"port": port, "baud": 921600}}
        for i, port in enumerate(ports)
    }
    tree = {
        "log_level": "error", "state_dir": str(folder), "socket": {"path": str(folder / "s")},
        "shm": {"directory": str(folder)} | ({} if load.latency_ms is None else {"latency_ms": load.latency_ms}),
        "metrics": {"port": 0},
        "recorder": {"enabled": load.recorded, "directory": str(folder / "recordings")},
        "devices": devices,
    }  # fmt: skip
    file = folder / "imud.yaml"
    file.write_bytes(msgspec.json.encode(tree))  # each JSON text is a YAML text
    return file


def wait_for(path: Path) -> None:
    end = monotonic() + START_LIMIT_S
    while not path.exists():
        if monotonic() > end:
            raise TimeoutError(f"expected {path} within {START_LIMIT_S} s")
        sleep(0.01)


def start_server(stack: ExitStack, folder: Path, ports: Sequence[str], load: Load) -> Process:
    path = folder / "s"
    if load.bare:
        args = [str(path), load.encoding, str(load.latency_ms or 0.0), *ports]
        server = stack.enter_context(Process(SERVER_CORE, "-m", "tests.bench.bare_loop", *args))
        server.line()
        return server
    file = configuration(folder, ports, load)
    server = stack.enter_context(Process(SERVER_CORE, "-m", "imud", "run", "-c", str(file)))
    wait_for(path)
    end = monotonic() + START_LIMIT_S
    with Client(str(path)) as client:
        while any(status.state != "searching" for status in statuses(client)):
            if monotonic() > end:
                raise TimeoutError(f"expected all devices in the state searching within {START_LIMIT_S} s")
            sleep(0.05)
    return server


def start_writer(stack: ExitStack, folder: Path, load: Load, *options: str) -> Process:
    (folder / "times").write_bytes(bytes(8 * load.frames))
    args = ["--devices", str(load.devices), "--rate", str(load.rate_hz), "--frames", str(load.frames)]
    args += ["--phases", str(load.phases), "--apart", str(load.apart), "--times", str(folder / "times"), *options]
    return stack.enter_context(Process(REST_CORES, "-m", "tests.bench.writer", *args))


def start_readers(stack: ExitStack, folder: Path, load: Load) -> Process:
    args = ["--socket", str(folder / "s"), "--clients", str(load.clients), "--encoding", load.encoding]
    args += ["--times", str(folder / "times"), "--frames", str(load.frames)]
    args += ["--skip", str(int(load.warm_s * load.rate_hz))]
    wanted = {"rate_hz": load.client_hz, "latency_ms": load.latency_ms}
    args += ["--watch", json.dumps({name: value for name, value in wanted.items() if value is not None})]
    args += ["--bare"] * load.bare
    readers = stack.enter_context(Process(REST_CORES, "-m", "tests.bench.readers", *args))
    readers.line()
    return readers


class Used(NamedTuple):
    cpu_ns: int
    elapsed_s: float
    refused: int


def measure_cpu(load: Load, writer: Process, pid: int) -> Used:
    """Start the writer. Return the cost of process `pid` during the measurement."""
    writer.say("go")
    sleep(load.warm_s)
    before_ns, begun = cpu_ns(pid), monotonic()
    sleep(load.seconds - END_S)
    used_ns, elapsed = cpu_ns(pid) - before_ns, monotonic() - begun
    refused = int(writer.line())
    sleep(0.05)  # wait for the last samples
    return Used(used_ns, elapsed, refused)


def run(load: Load) -> Outcome:
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-bench-") as name, ExitStack() as stack:
        folder = Path(name)
        writer = start_writer(stack, folder, load)
        ports = writer.line().split()
        server = start_server(stack, folder, ports, load)
        readers = start_readers(stack, folder, load)
        pid = server.popen.pid
        used = measure_cpu(load, writer, pid)
        memory_mb = rss_mb(pid)
        statuses = () if load.bare else tuple(ask(folder / "s"))
        readers.say("end")
        figures = json.loads(readers.line())
        if load.clients and not figures["samples"]:
            raise RuntimeError("expected samples at the first client, got none")
    # device n starts n * apart frames later and sends fewer frames
    total = load.frames * load.devices - load.apart * sum(range(load.devices))
    counted = used.elapsed_s * load.rate_hz * load.devices
    return Outcome(
        cpu_us_per_sample=used.cpu_ns / 1e3 / counted, cpu_share=used.cpu_ns / 1e9 / used.elapsed_s,
        p50_us=figures["p50_us"], p99_us=figures["p99_us"],
        # a client with `rate_hz` receives only a part of the samples
        gaps=figures["gaps"] + total - figures["samples"] if load.clients and load.client_hz is None else 0,
        refused=used.refused, rss_mb=memory_mb, statuses=statuses,
    )  # fmt: skip


def ask(path: Path) -> list[DeviceStatus]:
    with Client(str(path)) as client:
        return statuses(client)
