"""`make attack`: hostile clients next to a 1 kHz device and a good client. Exit status 1 if a limit was exceeded.

`python -m tests.attack [--short] [--scheduling unit|real-time] [--seconds S] [NAME …]`. Traffic stays on UNIX sockets
of a folder of its own, and on the loopback address.
"""

import argparse
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf
from time import monotonic, sleep
from typing import Final

from tests.attack.attacks import ATTACKS, Attack, Done
from tests.attack.hostile import Deeds
from tests.attack.stage import CLIENTS, GOOD_UID, HOSTILE_UIDS, LOST_SETTLE_S, PRIORITY, AttackedDaemon, Scheduling
from tests.support.results import ProgramRun, Row, Table, add_json, printed

P99_LIMIT_MS: Final = 5.0
"""Maximum of the 99th percentile of two delays, ms: replies to the good client, and its samples after their arrival."""
RSS_LIMIT_MB: Final = 64 * 1.048576
"""Maximum memory above idle, MB: `socket.memory_mb`, the limit for all queued data of clients."""
WAKERS_PER_USER: Final = 4 * 128
"""Maximum number of `notify` descriptors of one user: 4 × `socket.clients_per_user` (docs/socket.md)."""
HOSTILE_USERS: Final = 2
FDS_OTHERS: Final = 64
"""Maximum number of other descriptors: 32 scrapes, 5 of a reconnected device, clients of this program."""
FDS_LIMIT: Final = CLIENTS + HOSTILE_USERS * WAKERS_PER_USER + FDS_OTHERS
"""Maximum number of descriptors above idle: hostile clients, their users' `notify` descriptors, and others."""
FDS_LEFT_LIMIT: Final = 4
"""Maximum number of descriptors above the number before the attack. More descriptors are a leak."""
LEDGER_TOLERANCE: Final = 1
"""Maximum difference between the losses in the ledger and the frames that the port rejected, samples."""


@dataclass
class Measured:
    deeds: Deeds
    samples: int = 0
    lost: int = 0
    dropped: int = 0
    """Number of these samples that the daemon reports as dropped."""
    reply_p50_ms: float = 0.0
    reply_p99_ms: float = 0.0
    reply_max_ms: float = 0.0
    sample_p99_ms: float = 0.0
    above_mb: float = 0.0
    fds: int = 0
    fds_left: int = 0
    cpu_share: float = 0.0
    refused: int = 0
    evicted: int = 0
    failed: int = 0
    port_refused: int = 0
    """Number of frames for which the device's port had no room: the true losses."""
    ledger_lost: int = 0
    ledger_unknown: int = 0
    """Number of gaps of unknown size in the ledger."""
    stops: int = 0


def exceeded(seen: Measured, *, delays: bool = True) -> list[str]:
    """Return the exceeded limits. Include limits of delays only if `delays` is True.

    An attack that stops the daemon causes losses and delays. In this case, the losses must be equal to the frames that
    the port rejected.
    """
    starves = seen.stops > 0
    p99_limit_ms = P99_LIMIT_MS if delays and not starves else inf
    problems = [
        f"{name} {value:.4g}{unit}, expected at most {limit:.4g}{unit}"
        for name, value, limit, unit in (
            ("p99 of the good client's replies", seen.reply_p99_ms, p99_limit_ms, " ms"),
            ("p99 of the good client's samples", seen.sample_p99_ms, p99_limit_ms, " ms"),
            ("memory above idle", seen.above_mb, RSS_LIMIT_MB, " MB"),
            ("descriptors above idle", seen.fds, FDS_LIMIT, ""),
            ("descriptors left over", seen.fds_left, FDS_LEFT_LIMIT, ""),
            ("errors in the daemon while a client was served", seen.failed, 0, ""),
        )
        if value > limit
    ]
    if not seen.samples:
        problems.append("the good client received no samples")
    return problems + _losses(seen, starves)


def _losses(seen: Measured, starves: bool) -> list[str]:
    problems = []
    if not starves and (seen.lost or seen.dropped or seen.port_refused):
        problems.append(
            f"{seen.lost} samples lost, {seen.dropped} of them dropped for the good client,"
            f" {seen.port_refused} rejected by the port"
        )
    if abs(seen.ledger_lost - seen.port_refused) > LEDGER_TOLERANCE:
        problems.append(
            f"the ledger has {seen.ledger_lost} lost samples, the port rejected {seen.port_refused}:"
            f" expected a difference of at most {LEDGER_TOLERANCE}"
        )
    if abs(seen.lost - seen.dropped - seen.port_refused) > LEDGER_TOLERANCE:
        problems.append(f"the good client missed {seen.lost} samples, the port rejected {seen.port_refused}")
    if seen.ledger_unknown:
        problems.append(f"{seen.ledger_unknown} gaps of unknown size, although the device sends its time")
    return problems


SHORT_S, LONG_S = 1.5, 8.0


@dataclass
class Peak:
    rss_mb: float = 0.0
    fds: int = 0


@contextmanager
def watching(stage: AttackedDaemon) -> Iterator[Peak]:
    peak, over = Peak(), threading.Event()

    def look() -> None:
        while not over.wait(0.1):
            try:
                peak.rss_mb = max(peak.rss_mb, stage.rss_mb)
                peak.fds = max(peak.fds, stage.fds)
            except OSError:  # the daemon has ended
                return

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield peak
    finally:
        over.set()
        thread.join()


def measure(entry: Attack, stage: AttackedDaemon, seconds: float, idle_mb: float) -> tuple[Measured, Done]:
    if entry.devices:
        stage.change(devices=entry.devices)
        idle_mb = stage.rss_mb
    stage.figures()
    before, (ledger_lost, unknown), refused = stage.status(), stage.losses(), stage.port_refused
    fds, used_ns, begun_s = stage.fds, stage.cpu_ns, monotonic()
    with watching(stage) as peak:
        done = entry.run(stage, seconds)
    if not stage.alive:
        raise ConnectionError("the daemon ended")
    share = (stage.cpu_ns - used_ns) / 1e9 / (monotonic() - begun_s)
    if done.stops or stage.port_refused > refused:
        sleep(LOST_SETTLE_S)
    seen, after, left = stage.figures(), stage.status(), stage.fds_above(fds, FDS_LEFT_LIMIT)
    ledger_after, unknown_after = stage.losses()
    measured = Measured(
        done.deeds, **{name: seen[name] for name in seen if name != "replies"},
        above_mb=max(0.0, peak.rss_mb - idle_mb), fds=max(0, peak.fds - fds), fds_left=max(0, left), cpu_share=share,
        **{name: after[name] - before[name] for name in ("refused", "evicted", "failed")},
        port_refused=stage.port_refused - refused, ledger_lost=ledger_after - ledger_lost,
        ledger_unknown=unknown_after - unknown, stops=done.stops,
    )  # fmt: skip
    if entry.devices:
        stage.change()
    return measured, done


def row(name: str, seen: Measured) -> Row:
    return {
        "attack": name, "clients": seen.deeds.clients, "connections": seen.deeds.connections,
        "requests": seen.deeds.requests, "sent, MB": seen.deeds.sent_bytes / 1e6, "samples": seen.samples,
        "lost": seen.lost, "rejected by the port": seen.port_refused, "lost in the ledger": seen.ledger_lost,
        "gaps of unknown size": seen.ledger_unknown, "reply p50, ms": seen.reply_p50_ms,
        "reply p99, ms": seen.reply_p99_ms, "reply max, ms": seen.reply_max_ms, "sample p99, ms": seen.sample_p99_ms,
        "memory above idle, MB": seen.above_mb, "descriptors": seen.fds, "left": seen.fds_left,
        "share of a core": seen.cpu_share, "refused": seen.refused, "evicted": seen.evicted,
    }  # fmt: skip


def attack(
    name: str, entry: Attack, stage: AttackedDaemon, seconds: float, idle_mb: float, rows: list[Row], *, delays: bool
) -> list[str]:
    try:
        seen, done = measure(entry, stage, seconds, idle_mb)
    except OSError:
        if stage.alive:
            raise
        return ["the daemon ended"]
    rows.append(row(name, seen))
    print(printed(rows[-1]), flush=True)
    return done.problems + exceeded(seen, delays=delays)


def describe(stage: AttackedDaemon, idle_mb: float, *, delays: bool) -> str:
    if stage.scheduling is Scheduling.UNIT:
        how = "default policy at nice 0 on any core, like the unit; hostile clients with the same settings"
    else:
        how = f"SCHED_RR {PRIORITY} on a core of its own; hostile clients at nice 10 on the others"
    measuring = f"SCHED_RR {PRIORITY}" if stage.undisturbed else "no real-time priority, so they add to the delays"
    users = (
        f"good client uid {GOOD_UID}, hostile clients uids {HOSTILE_UIDS[0]} and {HOSTILE_UIDS[1]}"
        if os.geteuid() == 0
        else "all clients with one user, because other users need root"
    )
    judged = f"p99 of replies and of samples {P99_LIMIT_MS:g} ms, " if delays else "no limit of delays (short form), "
    return (
        f"scheduling {stage.scheduling.value}: daemon {how}; device and good client: {measuring}\n"
        f"users: {users}\n"
        f"limits: no lost sample except during stops, ledger = port ± 1, {judged}"
        f"{RSS_LIMIT_MB:.0f} MB and {FDS_LIMIT} descriptors above idle, {FDS_LEFT_LIMIT} descriptors left\n"
        f"daemon idle: {idle_mb:.1f} MB, {stage.fds} descriptors; load of the host {os.getloadavg()[0]:.1f}"
    )


def run(
    chosen: dict[str, Attack], seconds: float, scheduling: Scheduling, rows: list[Row], *, short: bool
) -> list[str]:
    """Run the attacks, append a row for each attack to `rows`, and return the exceeded limits."""
    problems: list[str] = []
    with AttackedDaemon(60 + 2 * (seconds + 15) * len(chosen), scheduling) as stage:
        idle_mb = stage.rss_mb
        print(f"{describe(stage, idle_mb, delays=not short)}", flush=True)
        for name, entry in chosen.items():
            found = attack(name, entry, stage, seconds, idle_mb, rows, delays=not short)
            if found and short and stage.alive:
                print(f"{name}: {'; '.join(found)}; repeating, because the host may have stalled", flush=True)
                found = attack(name, entry, stage, seconds, idle_mb, rows, delays=not short)
            problems += [f"{name}: {problem}" for problem in found]
            if not stage.alive:
                break
    return problems


def main() -> int:
    parser = argparse.ArgumentParser(prog="make attack")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(ATTACKS)}; default: all")
    parser.add_argument("--short", action="store_true", help="run for at most 75 s, without limits of delays, for CI")
    parser.add_argument("--seconds", type=float, help="duration of each attack, s")
    parser.add_argument(
        "--scheduling", type=Scheduling, choices=list(Scheduling), default=Scheduling.REAL_TIME,
        metavar="unit|real-time",
        help="scheduling of the daemon: like the unit, or real-time on a core of its own (default)",
    )  # fmt: skip
    add_json(parser)
    args, program_run, rows = parser.parse_args(), ProgramRun(), list[Row]()
    unknown = [name for name in args.names if name not in ATTACKS]
    if unknown:
        parser.error(f"unknown attack {unknown[0]!r}; expected one of: {', '.join(ATTACKS)}")
    chosen = {name: entry for name, entry in ATTACKS.items() if name in args.names or not args.names}
    if args.short and not args.names:
        chosen = {name: entry for name, entry in chosen.items() if entry.short}
    seconds = args.seconds or (SHORT_S if args.short else LONG_S)
    problems = run(chosen, seconds, args.scheduling, rows, short=args.short)
    program_run.save(args.json, [Table("", rows)], problems)
    print(*(problems or ["no limit exceeded"]), sep="\n")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
