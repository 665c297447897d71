"""Table of the attacks. An attack is a function with the stage as argument and a row of ATTACKS."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from random import Random
from time import monotonic, sleep
from typing import Final

from tests.attack import rings
from tests.attack.hostile import KINDS, Deeds
from tests.attack.stage import CLIENTS, HOSTILE_UIDS, PIPE_BYTES, READ_GID, AttackedDaemon
from tests.support.daemon_process import LIMIT_S

SHORT = (
    "nested", "empty-lines", "field-orders", "rates", "statuses", "watch-unread", "connects", "event-storm", "scrapes",
)  # fmt: skip
"""Kinds of hostile clients in the short form, one kind for each part of the daemon."""
MANY_DEVICES = 100  # devices in the attacks with a large daemon
HANG_UPS_S = 0.005  # time between two SIGHUP
STARVE_S, STARVE_SEED = 4.0, 5
"""Duration of the attack, s, and seed of the stops. The second stop takes 2 s, more than a port can buffer."""
LINE_BYTES = 512
"""Maximum length of a log message, bytes. A pipe with less room accepts no further message."""
STOPS_S: Final = (0.05, 0.2, 0.7, 2.0)
"""Durations of the stops, s: shorter and longer than the buffer of a terminal lasts at 1 kHz (50 ms) and than the
maximum delay of a frame (500 ms)."""
BETWEEN_S: Final = (0.02, 0.3, 1.0)  # time between two stops, s
HOG: Final = "while True: pass"


@dataclass
class Done:
    problems: list[str] = field(default_factory=list)
    deeds: Deeds = field(default_factory=Deeds)
    stops: int = 0


def start(stage: AttackedDaemon, seconds: float, kind: str) -> list[subprocess.Popen[str]]:
    children = []
    for number, uid in enumerate(HOSTILE_UIDS):
        argv = [
            sys.executable, "-m", "tests.attack.hostile", kind, "--socket", str(stage.socket),
            "--metrics-port", str(stage.metrics_port), "--nice", str(stage.scheduling.hostile_nice),
            "--clients", str(CLIENTS // len(HOSTILE_UIDS)), "--seconds", str(seconds), "--seed", str(number),
        ]  # fmt: skip
        if os.geteuid() == 0:
            argv += ["--uid", str(uid), "--gid", str(READ_GID)]
        child = subprocess.Popen(argv, stdout=subprocess.PIPE, text=True)
        os.sched_setaffinity(child.pid, stage.scheduling.hostile_cores)
        children.append(child)
    return children


def end(children: list[subprocess.Popen[str]], seconds: float) -> Done:
    done = Done()
    for child in children:
        out, _ = child.communicate(timeout=seconds + 30)
        if child.returncode:
            done.problems.append(f"a hostile process failed with exit status {child.returncode}")
        else:
            done.deeds += Deeds(**json.loads(out))
    if not done.deeds.connections:
        done.problems.append("no hostile client could connect")
    return done


def hostile(stage: AttackedDaemon, seconds: float, kind: str) -> Done:
    return end(start(stage, seconds, kind), seconds)


def replug(stage: AttackedDaemon, seconds: float) -> Done:
    """Let clients use all descriptors that they can get. Then unplug a device and plug it in again."""
    children = start(stage, seconds, "wakers")
    sleep(seconds / 2)
    plugged = stage.replug()
    done = end(children, seconds)
    if not plugged:
        done.problems.append("the daemon did not open the reconnected device")
    return done


def hang_ups(stage: AttackedDaemon, seconds: float) -> int:
    end_s, count = monotonic() + seconds, 0
    while monotonic() < end_s and stage.alive:
        stage.signal(signal.SIGHUP)
        count += 1
        sleep(HANG_UPS_S)
    return count


def reloads(stage: AttackedDaemon, seconds: float) -> Done:
    return Done(deeds=Deeds(requests=hang_ups(stage, seconds)))


def event_flood(stage: AttackedDaemon, seconds: float) -> Done:
    """Reload continuously. Each reload is an event for all hostile clients."""
    children = start(stage, seconds, "event-watch")
    count = hang_ups(stage, seconds)
    done = end(children, seconds)
    done.deeds += Deeds(requests=count)
    return done


def unread_log(stage: AttackedDaemon, seconds: float) -> Done:
    seen = stage.log.spoilt
    stage.spoil_configuration()
    stage.log.stop_reading()
    done = reloads(stage, seconds)
    waiting_bytes = stage.log.waiting_bytes
    stage.log.read_on()
    stage.change()
    end_s = monotonic() + LIMIT_S
    while stage.log.spoilt == seen and monotonic() < end_s:
        sleep(0.01)
    if waiting_bytes < PIPE_BYTES - LINE_BYTES:
        done.problems.append(f"expected a full log, got {waiting_bytes} bytes of {PIPE_BYTES}")
    if stage.log.spoilt == seen:
        done.problems.append("expected log messages of the daemon, got none")
    return done


def shared_memory(stage: AttackedDaemon, seconds: float, sticky: bool) -> Done:
    if os.geteuid():
        print("shared memory: skipped, because only root can become another user", flush=True)
        sleep(seconds)
        return Done()
    problems, acts = rings.attack(stage, HOSTILE_UIDS[0], seconds, sticky)
    return Done(problems, Deeds(clients=1, requests=acts))


def starved(stage: AttackedDaemon, seconds: float) -> Done:
    before = stage.port_refused
    stops = starve(stage.pid, max(seconds, STARVE_S), STARVE_SEED)
    problems = (
        []
        if stops and stage.port_refused > before
        else ["expected frames that the port rejected, got none: no stop was long enough"]
    )
    return Done(problems, Deeds(requests=stops), stops)


def starve(pid: int, seconds: float, seed: int) -> int:
    """Stop a process with signals and limit its CPU time. Return the number of stops."""
    random, end, stops = Random(seed), monotonic() + seconds, 0
    hogs = [_hog(cpu) for cpu in os.sched_getaffinity(pid)]
    try:
        while (left := end - monotonic()) > 0:
            os.kill(pid, signal.SIGSTOP)
            stops += 1
            try:
                sleep(min(random.choice(STOPS_S), left))
            finally:
                os.kill(pid, signal.SIGCONT)
            sleep(random.choice(BETWEEN_S))
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    return stops


def _hog(cpu: int) -> subprocess.Popen[bytes]:
    hog = subprocess.Popen([sys.executable, "-S", "-c", HOG], stdin=subprocess.DEVNULL)
    os.sched_setaffinity(hog.pid, {cpu})
    return hog


def calm(_stage: AttackedDaemon, seconds: float) -> Done:
    sleep(seconds)
    return Done()


@dataclass(frozen=True)
class Attack:
    run: Callable[[AttackedDaemon, float], Done]
    short: bool = True
    devices: int = 0


ATTACKS: dict[str, Attack] = {
    "calm": Attack(calm), **{kind: Attack(partial(hostile, kind=kind), kind in SHORT) for kind in KINDS},
    "mix": Attack(partial(hostile, kind="mix")), "replug": Attack(replug),
    "shared-memory": Attack(partial(shared_memory, sticky=False)),
    "sticky-memory": Attack(partial(shared_memory, sticky=True)), "reloads": Attack(reloads),
    "event-flood": Attack(event_flood), "unread-log": Attack(unread_log),
    "schemas-100": Attack(partial(hostile, kind="schemas"), devices=MANY_DEVICES),
    "statuses-100": Attack(partial(hostile, kind="statuses"), devices=MANY_DEVICES),
    "mix-100": Attack(partial(hostile, kind="mix"), False, devices=MANY_DEVICES), "starved": Attack(starved),
}  # fmt: skip
