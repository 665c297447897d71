"""Wire to client at 1 kHz on a busy machine: what the scheduling settings of a service bring, in turns.

    writer, SCHED_FIFO ──pty──▶ kernel worker ──▶ imud, the setting under test ──▶ reader, SCHED_FIFO

On every core a program computes without end, another writes to disk without end, and each is a session of its own, as
the services of systemd are. A pty's bytes pass through a kernel worker, which competes with the programs as an ordinary
task; those of a UART do not, so that the workers run at SCHED_FIFO while this measures, as do writer and reader: the
figures are to be imud's. What is left is the kernel's own, and is measured first: how late a program at SCHED_FIFO runs
that only waits for a timer of 1 kHz (in the preemption mode `none` a write to disk goes on for milliseconds); the mode
is printed, as far as it can be known.

It needs root. `python -m tests.bench.busy [ROUNDS]` prints a line for each setting and round. `--short` plays 2 s of
each.
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
LOCK = "import ctypes; ctypes.CDLL(None).mlockall(3)"
DAEMON = "import os, runpy; os.setsid(); runpy.run_module('imud', run_name='__main__')"
FIFO_OF_OTHERS = 40
ROUNDS = 3


@dataclass(frozen=True)
class Setting:
    name: str
    nice: int = 0
    policy: int = os.SCHED_OTHER
    priority: int = 0
    core: bool = False
    """CPUAffinity= with one core, which the others have too."""
    lock: bool = False
    """mlockall, which no directive does."""
    weight: bool = False
    """CPUWeight=: a share of the processors that counts among services, here by the session's own nice value."""


SETTINGS = (
    Setting("default"),
    Setting("Nice=-15", nice=-15),
    Setting("CPUWeight=10000", weight=True),
    Setting("Nice=-15, CPUWeight=10000", nice=-15, weight=True),
    Setting("CPUSchedulingPolicy=rr, 10", policy=os.SCHED_RR, priority=10),
    Setting("CPUSchedulingPolicy=fifo, 10", policy=os.SCHED_FIFO, priority=10),
    Setting("fifo, 10 and one core", policy=os.SCHED_FIFO, priority=10, core=True),
    Setting("fifo, 10 and mlockall", policy=os.SCHED_FIFO, priority=10, lock=True),
    Setting("default and mlockall", lock=True),
)


@dataclass(frozen=True)
class Seen:
    p50_us: float
    p99_us: float
    max_us: float
    lost: int


@contextmanager
def busy(folder: Path) -> Iterator[None]:
    """Every core has a program that computes, and one more writes to `folder`."""
    programs = [[sys.executable, "-c", HOG] for _ in CORES] + [[sys.executable, "-c", DISK, str(folder / "file")]]
    lived = ["setpriv", "--pdeathsig", "KILL"]  # none outlives this process
    running = [subprocess.Popen([*lived, *argv], start_new_session=True) for argv in programs]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def timer(seconds: float) -> Seen:
    """How late a program that waits for a timer of 1 kHz runs, at the policy of writer and reader."""
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
        command = f"{LOCK}; {DAEMON}" if setting.lock else DAEMON
        server = stack.enter_context(Process(set(CORES), "-c", command, "run", "-c", str(file)))
        wait_for(folder / "s")
        sleep(1.0)
        reader = start_readers(stack, folder, load, set(CORES))
        for other in (writer, reader):
            os.sched_setscheduler(other.popen.pid, os.SCHED_FIFO, os.sched_param(FIFO_OF_OTHERS))
        apply(setting, server.popen.pid)
        stack.enter_context(workers_first())
        writer.say("go")
        refused = int(writer.line())
        reader.say("end")
        figures = json.loads(reader.line())
    lost = refused + figures["gaps"] + load.frames - figures["samples"]
    return Seen(figures["p50_us"], figures["p99_us"], figures["max_us"], lost)


def apply(setting: Setting, pid: int) -> None:
    """Set all threads of the daemon as systemd would have set its process before the start."""
    for task in map(int, os.listdir(f"/proc/{pid}/task")):
        os.setpriority(os.PRIO_PROCESS, task, setting.nice)
        os.sched_setscheduler(task, setting.policy, os.sched_param(setting.priority))
        os.sched_setaffinity(task, {CORES[-1]} if setting.core else set(CORES))
    autogroup = Path(f"/proc/{pid}/autogroup")
    if setting.weight and autogroup.exists():
        autogroup.write_text("-19")


@contextmanager
def workers_first() -> Iterator[None]:
    """The kernel's unbound workers, which pass a pty's bytes on, run before the programs, as an interrupt would."""
    workers = unbound_workers()
    _schedule(workers, os.SCHED_FIFO, FIFO_OF_OTHERS + 1)
    try:
        yield
    finally:
        _schedule(workers, os.SCHED_OTHER, 0)


def unbound_workers() -> list[int]:
    """Process numbers of the kernel's unbound workers with ordinary priority."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if (folder / "comm").read_text().startswith("kworker/u") and not (folder / "cmdline").read_text():
                found.append(int(folder.name))
    return found


def _schedule(pids: Sequence[int], policy: int, priority: int) -> None:
    for pid in pids:
        with suppress(OSError):  # it has ended
            os.sched_setscheduler(pid, policy, os.sched_param(priority))


def preemption() -> str:
    """What can be known of the kernel's preemption: the mode in force, or what it was built with."""
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
            for setting in SETTINGS if number % 2 == 0 else reversed(SETTINGS):
                print(f"{setting.name:32} {run(setting, Load(seconds=seconds))}", flush=True)


if __name__ == "__main__":
    main()
