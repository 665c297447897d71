"""Table: the attacks. Another one is a function that is given the stage and is a row of ATTACKS."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from time import monotonic, sleep

from tests.attack import starvation
from tests.attack.hostile import KINDS
from tests.attack.stage import HOSTILE_UIDS, READ_GID, AttackedDaemon
from tests.bench.rig import REST_CORES

CLIENTS = 256
SHARED_MEMORY = """
import sys, time
from pathlib import Path
from tests.attack.shared_memory import attack
end_s = time.monotonic() + float(sys.argv[3])
print(attack(Path(sys.argv[1]), int(sys.argv[2]), lambda: time.monotonic() > end_s))
"""
SHORT = ("nested", "empty-lines", "field-orders", "rates", "statuses", "watch-unread", "connects")
"""Kinds of hostile clients in the short form, one of each sort."""


def hostile(stage: AttackedDaemon, seconds: float, kind: str) -> list[str]:
    """Hostile clients, half of them of one user and half of another where this process may become others."""
    children = []
    for number, uid in enumerate(HOSTILE_UIDS):
        argv = [
            sys.executable, "-m", "tests.attack.hostile", kind, "--socket", str(stage.socket),
            "--clients", str(CLIENTS // len(HOSTILE_UIDS)), "--seconds", str(seconds), "--seed", str(number),
        ]  # fmt: skip
        if os.geteuid() == 0:
            argv += ["--uid", str(uid), "--gid", str(READ_GID)]
        child = subprocess.Popen(argv, stdout=subprocess.PIPE, text=True)
        os.sched_setaffinity(child.pid, REST_CORES)
        children.append(child)
    problems = []
    for child in children:
        child.communicate(timeout=seconds + 30)
        if child.returncode:
            problems.append(f"hostile process ended with {child.returncode}")
    return problems


def replug(stage: AttackedDaemon, seconds: float) -> list[str]:
    """All descriptors that clients can get, then a device is unplugged and plugged in again."""
    children = []
    for uid in HOSTILE_UIDS:
        argv = [
            sys.executable, "-m", "tests.attack.hostile", "wakers", "--socket", str(stage.socket),
            "--clients", str(CLIENTS // len(HOSTILE_UIDS)), "--seconds", str(seconds),
        ]  # fmt: skip
        if os.geteuid() == 0:
            argv += ["--uid", str(uid), "--gid", str(READ_GID)]
        children.append(subprocess.Popen(argv, stdout=subprocess.DEVNULL))
    sleep(seconds / 2)
    problems = [] if stage.replug() else ["the device that was plugged in again was not opened"]
    for child in children:
        child.wait(timeout=seconds + 30)
    return problems


def shared_memory(stage: AttackedDaemon, seconds: float) -> list[str]:
    """Another user in the directory of the rings; left out, and said so, where this process may not become one."""
    if os.geteuid():
        print("shared-memory: left out, only root can act as another user", flush=True)
        return []
    child = subprocess.run(
        [sys.executable, "-c", SHARED_MEMORY, str(stage.folder), str(HOSTILE_UIDS[0]), str(seconds)],
        stdout=subprocess.PIPE, text=True, timeout=seconds + 30, check=False,
    )  # fmt: skip
    return [] if child.returncode == 0 and int(child.stdout) else [f"hostile process ended with {child.returncode}"]


def reloads(stage: AttackedDaemon, seconds: float) -> list[str]:
    """A flood of SIGHUP."""
    end_s = monotonic() + seconds
    while monotonic() < end_s and stage.alive:
        os.kill(stage.pid, signal.SIGHUP)
        sleep(0.005)
    return []


def starved(stage: AttackedDaemon, seconds: float) -> list[str]:
    """SIGSTOP and CPU hogs. Samples are lost then; tests/attack/test_starvation.py proves that the ledger has them."""
    return [] if starvation.attack(stage.pid, seconds) else ["the daemon was never stopped"]


def calm(_stage: AttackedDaemon, seconds: float) -> list[str]:
    """No attack: what the machine itself does."""
    sleep(seconds)
    return []


@dataclass(frozen=True)
class Attack:
    """A row of the table."""

    run: Callable[[AttackedDaemon, float], list[str]]
    """Attacks for so many seconds; returns what went wrong."""
    short: bool = True
    """Whether it is in the short form."""
    starves: bool = False
    """Whether it takes the processor away: losses and delays are its aim then, and have no bound."""


ATTACKS: dict[str, Attack] = {
    "calm": Attack(calm),
    **{kind: Attack(partial(hostile, kind=kind), kind in SHORT) for kind in KINDS},
    "mix": Attack(partial(hostile, kind="mix")),
    "replug": Attack(replug),
    "shared-memory": Attack(shared_memory),
    "reloads": Attack(reloads),
    "starved": Attack(starved, starves=True),
}
