"""Table: the attacks. Another one is a function that is given the stage and is a row of ATTACKS."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from time import sleep

from tests.attack.hostile import KINDS
from tests.attack.stage import HOSTILE_UIDS, READ_GID, AttackedDaemon
from tests.bench.rig import REST_CORES

CLIENTS = 256
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


ATTACKS: dict[str, Attack] = {
    "calm": Attack(calm),
    **{kind: Attack(partial(hostile, kind=kind), kind in SHORT) for kind in KINDS},
    "mix": Attack(partial(hostile, kind="mix")),
    "replug": Attack(replug),
}
