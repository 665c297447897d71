"""`make attack`: hostile clients beside a 1 kHz device and a good client; 1 when a bound was exceeded.

`python -m tests.attack [--short] [--seconds S] [NAME …]`. Traffic stays on UNIX sockets of a folder of its own.
"""

import argparse
import sys
import threading
from dataclasses import dataclass
from math import inf
from time import monotonic

from tests.attack.attacks import ATTACKS, Attack
from tests.attack.stage import AttackedDaemon

P99_LIMIT_MS = 5.0
RSS_LIMIT_MB = 64 * 1.048576
SHORT_S, LONG_S = 2.5, 8.0
HEAD = (
    f"{'attack':<15}{'samples':>8}{'lost':>6}{'p50 ms':>8}{'p99 ms':>8}{'max ms':>8}{'sample p99':>11}"
    f"{'RSS MB':>8}{'fds':>6}{'CPU %':>7}{'refused':>9}{'evicted':>8}"
)


@dataclass
class Peak:
    """The highest memory and count of descriptors while an attack runs."""

    rss_mb: float = 0.0
    fds: int = 0


def watch(stage: AttackedDaemon, peak: Peak, over: threading.Event) -> None:
    """Look at the daemon ten times a second."""
    while not over.wait(0.1):
        try:
            peak.rss_mb = max(peak.rss_mb, stage.rss_mb)
            peak.fds = max(peak.fds, stage.fds)
        except OSError:  # it is gone
            return


def attack(
    name: str, entry: Attack, stage: AttackedDaemon, seconds: float, idle_mb: float, p99_limit_ms: float
) -> list[str]:
    """Run one attack, print its row, return the bounds that were exceeded."""
    stage.figures()
    before, used_ns, begun_s = stage.status(), stage.cpu_ns, monotonic()
    peak, over = Peak(), threading.Event()
    watching = threading.Thread(target=watch, args=(stage, peak, over))
    watching.start()
    problems = entry.run(stage, seconds)
    over.set()
    watching.join()
    if not stage.alive:
        return ["the daemon ended"]
    share = (stage.cpu_ns - used_ns) / 1e9 / (monotonic() - begun_s)
    seen, after = stage.figures(), stage.status()
    above_mb = max(0.0, peak.rss_mb - idle_mb)
    print(
        f"{name:<15}{seen['samples']:>8}{seen['lost']:>6}{seen['reply_p50_ms']:>8.2f}{seen['reply_p99_ms']:>8.2f}"
        f"{seen['reply_max_ms']:>8.2f}{seen['sample_p99_ms']:>11.2f}{above_mb:>8.1f}{peak.fds:>6}{100 * share:>7.0f}"
        f"{after['refused'] - before['refused']:>9}{after['evicted'] - before['evicted']:>8}",
        flush=True,
    )
    if (seen["lost"] or seen["dropped"]) and not entry.starves:
        problems.append(f"{seen['lost']} samples lost, {seen['dropped']} of them dropped for the good client")
    if seen["reply_p99_ms"] > p99_limit_ms and not entry.starves:
        problems.append(f"p99 of the good client {seen['reply_p99_ms']:.2f} ms, expected at most {p99_limit_ms:g} ms")
    if above_mb > RSS_LIMIT_MB:
        problems.append(f"{above_mb:.1f} MB above idle, expected at most {RSS_LIMIT_MB:.1f}")
    if after["failed"] > before["failed"]:
        problems.append("an error in the daemon while a client was served")
    return problems


def main() -> int:
    """Run the attacks."""
    parser = argparse.ArgumentParser(prog="make attack")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(ATTACKS)}; all when left out")
    parser.add_argument("--short", action="store_true", help="at most a minute in all, delays not judged, for CI")
    parser.add_argument("--seconds", type=float, help="of each attack")
    args = parser.parse_args()
    unknown = [name for name in args.names if name not in ATTACKS]
    if unknown:
        parser.error(f"no attack named {unknown[0]!r}; there are: {', '.join(ATTACKS)}")
    chosen = {name: entry for name, entry in ATTACKS.items() if name in args.names or not args.names}
    if args.short:
        chosen = {name: entry for name, entry in chosen.items() if entry.short}
    seconds = args.seconds or (SHORT_S if args.short else LONG_S)
    limit_ms = inf if args.short else P99_LIMIT_MS
    if args.short:
        print("delays are printed and not judged in the short form: a gate does not depend on the machine's own stalls")
    problems: list[str] = []
    with AttackedDaemon(60 + (seconds + 15) * len(chosen)) as stage:
        idle_mb = stage.rss_mb
        others = (
            "run after daemon, device and good client"
            if stage.undisturbed
            else "compete for the CPU: delays are theirs too"
        )
        print(f"daemon idle: {idle_mb:.1f} MB, {stage.fds} descriptors; other programs {others}\n{HEAD}", flush=True)
        for name, entry in chosen.items():
            found = attack(name, entry, stage, seconds, idle_mb, limit_ms)
            if found and args.short and stage.alive:
                print(f"{name}: {'; '.join(found)}; once more, a stall of the machine does not come twice", flush=True)
                found = attack(name, entry, stage, seconds, idle_mb, limit_ms)
            problems += [f"{name}: {problem}" for problem in found]
            if not stage.alive:
                break
    print(*(problems or ["every bound kept"]), sep="\n")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
