"""Latency from the port to a client at 1 kHz on a busy host, for different scheduling settings of the service.

    writer, SCHED_FIFO ──pty──▶ kernel worker ──▶ imud, the setting under test ──▶ reader, SCHED_FIFO

A computing program runs on each core. Another program writes to the disk. Each program has a session of its own, like a
service of systemd. A kernel worker moves the bytes of a pty. It competes with these programs as a normal task. The
bytes of a UART need no such worker. To measure only imud, the workers, the writer and the reader run with SCHED_FIFO.

The first line shows the remaining delay of the kernel: a program with SCHED_FIFO that only waits for a timer of 1 kHz.
With the preemption mode `none`, a write to the disk can block this program for milliseconds. The output contains the
preemption mode if the kernel reports it.

`python -m tests.bench.busy [ROUNDS]` needs root. It prints one line for each setting and round. `--short` runs each
setting for 2 s.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from time import sleep

from tests.bench.rig import CORES, Load, Process, configuration, start_readers, start_writer, wait_for

HOG = "while True: pass"
TIMER = """
import sys, time
late_ns, due_ns = [], time.monotonic_ns()
for _ in range(int(sys.argv[1])):
    due_ns += 1_000_000
    time.sleep(max(0, due_ns - time.monotonic_ns()) / 1e9)
    late_ns.append(time.monotonic_ns() - due_ns)
late_ns.sort()
print(*(late_ns[int(len(late_ns) * share)] / 1e3 for share in (0.5, 0.99, 0.99999)))
"""
DISK = """
import os, sys
data = os.urandom(1 << 20)
while True:
    with open(sys.argv[1], "wb", buffering=0) as file:
        for _ in range(64): file.write(data)
        os.fsync(file.fileno())
"""
DAEMON = "import os, runpy; os.setsid(); runpy.run_module('imud', run_name='__main__')"
FIFO_OF_OTHERS = 40  # real-time priority of writer and reader, above imud's 10
ROUNDS = 3


@dataclass(frozen=True)
class Setting:
    name: str
    nice: int = 0
    policy: int = os.SCHED_OTHER
    priority: int = 0
    weight: bool = False
    """CPUWeight=: share of the processors relative to other services; simulated with the nice value of the session."""


SETTINGS = (
    Setting("default"), Setting("Nice=-15", nice=-15), Setting("CPUWeight=10000", weight=True),
    Setting("CPUSchedulingPolicy=rr, 10", policy=os.SCHED_RR, priority=10),
)  # fmt: skip


@dataclass(frozen=True)
class Seen:
    p50_us: float
    p99_us: float
    max_us: float
    lost: int


@contextmanager
def busy(folder: Path) -> Iterator[None]:
    """Run a computing program on each core and a program that writes to `folder`."""
    programs = [[sys.executable, "-c", HOG] for _ in CORES] + [[sys.executable, "-c", DISK, str(folder / "file")]]
    lived = ["setpriv", "--pdeathsig", "KILL"]  # the kernel kills the programs if this process ends
    running = [subprocess.Popen([*lived, *argv], start_new_session=True) for argv in programs]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def timer(seconds: float) -> Seen:
    """Measure the delay of a program that waits for a timer of 1 kHz, with the policy of writer and reader."""
    argv = ["chrt", "--fifo", str(FIFO_OF_OTHERS), sys.executable, "-c", TIMER, str(int(seconds * 1000))]
    printed = subprocess.run(argv, stdout=subprocess.PIPE, text=True, check=True).stdout
    p50_us, p99_us, max_us = map(float, printed.split())
    return Seen(p50_us, p99_us, max_us, 0)


def run(setting: Setting, load: Load) -> Seen:
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-busy-") as name, ExitStack() as stack:
        folder = Path(name)
        writer = start_writer(stack, folder, load, cores=set(CORES))
        ports = writer.line().split()
        file = configuration(folder, ports, replace(load, shm=True))
        server = stack.enter_context(Process(set(CORES), "-c", DAEMON, "run", "-c", str(file)))
        wait_for(folder / "s")
        sleep(1.0)
        reader = start_readers(stack, folder, load, set(CORES))
        for other in (writer, reader):
            os.sched_setscheduler(other.popen.pid, os.SCHED_FIFO, os.sched_param(FIFO_OF_OTHERS))
        # apply the setting now: the threads of the daemon exist
        apply(setting, server.popen.pid)
        stack.enter_context(workers_first())
        writer.say("go")
        refused = int(writer.line())
        reader.say("end")
        figures = json.loads(reader.line())
    lost = refused + figures["gaps"] + load.frames - figures["samples"]
    return Seen(figures["p50_us"], figures["p99_us"], figures["max_us"], lost)


def apply(setting: Setting, pid: int) -> None:
    """Apply the setting to all threads of the daemon, as systemd does for the process before its start."""
    for task in map(int, os.listdir(f"/proc/{pid}/task")):
        os.setpriority(os.PRIO_PROCESS, task, setting.nice)
        os.sched_setscheduler(task, setting.policy, os.sched_param(setting.priority))
    autogroup = Path(f"/proc/{pid}/autogroup")
    if setting.weight and autogroup.exists():
        # autogroup is the nice value of a session, -19 the largest weight
        autogroup.write_text("-19")


@contextmanager
def workers_first() -> Iterator[None]:
    """Run the kernel's unbound workers, which move the bytes of a pty, before all programs, like an interrupt."""
    workers = unbound_workers()
    _schedule(workers, os.SCHED_FIFO, FIFO_OF_OTHERS + 1)
    try:
        yield
    finally:
        _schedule(workers, os.SCHED_OTHER, 0)


def unbound_workers() -> list[int]:
    """Return the process ids of the kernel's unbound workers with normal priority."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            # kernel threads have an empty command line; kworker/uN… is not bound to a core
            if (folder / "comm").read_text().startswith("kworker/u") and not (folder / "cmdline").read_text():
                found.append(int(folder.name))
    return found


def _schedule(pids: Sequence[int], policy: int, priority: int) -> None:
    for pid in pids:
        with suppress(OSError):  # the worker has ended
            os.sched_setscheduler(pid, policy, os.sched_param(priority))


def preemption() -> str:
    """Describe the preemption of the kernel: the active mode, or the version text with the build options."""
    with suppress(OSError):
        return f"preemption: {Path('/sys/kernel/debug/sched/preempt').read_text().strip()}"
    return f"preemption: mode not readable (debugfs), uname -v: {os.uname().version}"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.busy")
    parser.add_argument("rounds", nargs="?", type=int, default=ROUNDS)
    parser.add_argument("--short", action="store_true")
    args = parser.parse_args()
    seconds = 2.0 if args.short else 8.0
    print(preemption())
    with tempfile.TemporaryDirectory(dir="/var/tmp", prefix="imud-busy-") as name, busy(Path(name)):
        print(f"{'a timer alone, fifo':32} {timer(seconds)}", flush=True)
        for number in range(args.rounds):
            # reverse the order in each second round, so that a drift of the load does not favor a setting
            for setting in SETTINGS if number % 2 == 0 else reversed(SETTINGS):
                print(f"{setting.name:32} {run(setting, Load(seconds=seconds))}", flush=True)


if __name__ == "__main__":
    main()
