"""CPU time of imud and gpsd: one device at 1 kHz, ten clients that receive all samples as JSON, alternating in one run.

gpsd receives attitude sentences ($OHPR) of about the size of an HI91 frame and sends ATT objects over TCP. imud
receives HI91 frames and uses its UNIX socket. Each client receives each sample immediately. In a third measurement,
imud holds samples for 10 ms; gpsd has no such function. The sentences are UDP datagrams: on a pseudo-terminal, gpsd
3.22 stops after the first read without bytes until another descriptor wakes it. The part needs gpsd (`make
bench-deps`). Without gpsd, it returns no rows.
"""

import json
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import monotonic, sleep

from tests.bench.rig import REST_CORES, SERVER_CORE, START_LIMIT_S, Load, Process, measure_cpu, run, start_writer
from tests.bench.rows import Row, at_most
from tests.support.surroundings import free_port

LOAD = Load(clients=10, encoding="json", warm_s=1.5)
ROUNDS = 3
HELD_MS = 10.0
RATIO_MOST = 0.7  # goal: CPU of imud / CPU of gpsd
HELD_RATIO_MOST = 0.25  # the same goal with a hold of HELD_MS
LOST_MOST = 0.01
"""Maximum share of samples that gpsd may drop for slow clients. With more drops, gpsd did less work than imud."""


def start_gpsd(stack: ExitStack, program: str, port: int, input_port: int) -> int:
    """Start gpsd alone on one core with UDP input. Return its process id. Raises TimeoutError if it does not start."""
    # -N: no background process, -n: read the input without clients
    command = [program, "-N", "-n", "-S", str(port), f"udp://127.0.0.1:{input_port}"]
    gpsd = subprocess.Popen(["taskset", "-c", str(*SERVER_CORE), *command], stderr=subprocess.DEVNULL)
    stack.callback(gpsd.wait)
    stack.callback(gpsd.terminate)
    end = monotonic() + START_LIMIT_S
    while monotonic() < end:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
        except OSError:
            sleep(0.05)
        else:
            return gpsd.pid
    raise TimeoutError(f"cannot start gpsd: expected an open port {port} within {START_LIMIT_S} s")


def gpsd_us(program: str, load: Load) -> float:
    """Return the CPU time of gpsd per sample, µs. Raises RuntimeError if the first client missed samples."""
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-bench-") as name, ExitStack() as stack:
        port, input_port = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_DGRAM)
        pid = start_gpsd(stack, program, port, input_port)
        writer = start_writer(stack, Path(name), load, "--udp", str(input_port))
        writer.line()
        arguments = ["--gpsd", str(port), "--clients", str(load.clients)]
        readers = stack.enter_context(Process(REST_CORES, "-m", "tests.bench.readers", *arguments))
        readers.line()
        used = measure_cpu(load, writer, pid)
        readers.say("end")
        got = json.loads(readers.line())["samples"]
    if used.refused or got < load.frames * (1 - LOST_MOST):
        raise RuntimeError(
            f"cannot measure gpsd: expected {load.frames} samples, got {got}; {used.refused} were not sent"
        )
    return used.cpu_ns / 1e3 / (used.elapsed_s * load.rate_hz)


def rows(*, quick: bool = False) -> Iterator[Row]:
    program = shutil.which("gpsd", path="/usr/sbin:/usr/local/sbin:/usr/bin")
    if program is None:
        print("# cannot find gpsd; try `make bench-deps` as root", flush=True)
        return
    load = replace(LOAD, seconds=2.0 if quick else 6.0)
    figures = [
        (gpsd_us(program, load), *(run(replace(load, latency_ms=held)).cpu_us_per_sample for held in (0.0, HELD_MS)))
        for _ in range(1 if quick else ROUNDS)
    ]
    theirs, at_once, held_cpu = zip(*figures, strict=True)
    name = f"1 kHz, {load.clients} json clients"
    yield Row(f"{name}, gpsd: CPU per sample", median(theirs), "µs")
    held = f"{name}, imud, latency {HELD_MS:g} ms"
    for words, ours, most in ((f"{name}, imud", at_once, RATIO_MOST), (held, held_cpu, HELD_RATIO_MOST)):
        yield Row(f"{words}: CPU per sample", median(ours), "µs")
        yield at_most(f"{words}: CPU / gpsd", median(a / b for a, b in zip(ours, theirs, strict=True)), "x", most)
