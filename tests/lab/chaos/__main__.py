"""`make chaos`: random faults of all kinds on a real daemon in the lab's kernel, from a seed, then the check.

    python -m tests.lab.chaos --seed N --seconds S      in the guest, as root
    python -m tests.lab.chaos --seed N --short          two rounds with each kind of fault once

Faults are in rounds of ROUND_S. After each round, every device must run again, each ledger must balance, and the losses
must be the true losses (the rule is in tests/lab/chaos/account.py). The numbers of descriptors and threads must not be
larger than at the start. The check also runs before each kill of the daemon. The program prints the faults, the counts
of each device, and a result. The exit status is 0 only without a violation.
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, monotonic_ns, sleep
from typing import Final

from imud.model.ledger import lost
from imud.model.sample import Sample
from tests.lab.chaos import account as accounts
from tests.lab.chaos.account import Account, Hole, Interval
from tests.lab.chaos.daemon import Life, Snapshot, memory_control
from tests.lab.chaos.far_side import FarSide
from tests.lab.chaos.faults import Fault, Planned, all_faults, plan, plan_short, play
from tests.lab.chaos.polls import Answer
from tests.lab.tool import tool
from tests.support.daemon_process import wait_until, write_config

CI_SECONDS: Final = 45.0  # three rounds
STATE_SIZE: Final = "64k"  # size of the file system of the state directory
CATCH_UP_S: Final = 30.0
CALM_S: Final = 1.0
"""Time after all devices run again, s: pending connections are closed and the clocks have processed all samples."""
NEVER_NS: Final = 1 << 62
SPARE: Final = {"driver": "hipnuc-uart", "uart": {"port": "/dev/imud-chaos-nothing", "baud": 115200}}


class Chaos:
    def __init__(self, far: FarSide, folder: Path, state: Path) -> None:
        self.far, self.state = far, state
        self.violations: list[str] = []
        self.accounts: dict[str, Account] = {name: Account() for name in far.devices()}
        self.lives = 0
        self._folder = folder
        self._outages: dict[str, list[Interval]] = {name: [] for name in far.devices()}
        self.write_config(0)
        self.life = self._born()

    # --- Scene -------------------------------------------------------------------------------------------------------

    def write_config(self, variant: int) -> None:
        spare = {"spare": SPARE} if variant == 1 else {}
        more = {"log_level": "info" if variant else "warning", "state_dir": str(self.state)}
        file = write_config(self._folder, {**self.far.devices(), **spare}, metrics={"enabled": False}, **more)
        if variant < 0:
            file.write_text("devices: [nothing: {here: is")

    def next_life(self, end: Callable[[Life], None]) -> None:
        self.audit(f"before the end of life {self.lives}")
        end(self.life)
        self.life = self._born()

    def begin(self, item: Planned) -> None:
        self.outage_begins(item.fault)
        item.fault.begin(self, item.lasts_s)

    def end(self, fault: Fault) -> None:
        fault.end(self)
        self.outage_ends(fault)

    def outage_begins(self, fault: Fault) -> None:
        for name in fault.outage:
            self._outages[name].append(Interval(monotonic_ns(), NEVER_NS, fault.restarts))

    def outage_ends(self, fault: Fault) -> None:
        for name in fault.outage:
            begin = self._outages[name].pop()
            self._outages[name].append(begin._replace(end_ns=monotonic_ns()))

    # --- audits ------------------------------------------------------------------------------------------------------

    def settle(self, what: str) -> None:
        self.far.thread.check()
        try:
            self.life.wait_running()
        except AssertionError as error:
            self._violated(what, str(error))
        sleep(CALM_S)
        if not self.life.descriptors:
            self.life.descriptors, self.life.threads = self.life.usage()
        else:
            self._compare_usage(what)

    def audit(self, what: str) -> None:
        before, now = self.life.recorder.begin, self._counted_snapshot(what)
        received = self._received(before, now, what)
        for name, samples in received.items():
            first = before.devices[name].newest_seq
            if problem := accounts.open_ledger(now.devices[name]):
                self._violated(what, f"{name}: {problem}")
            for fault in accounts.sequence_faults(samples, first + (not samples or samples[0].seq > first)):
                self._violated(what, f"{name}: {fault}")
            if name in self.far.truth:
                self._audit_sender(name, samples, before, now, what)
            else:
                self._audit_polled(name, samples, before, now, what)
        if self.life.recorder.dropped:
            self._violated(what, f"the recorder was too slow: the daemon dropped {self.life.recorder.dropped} samples")
        self._outages = {name: [i for i in times if i.end_ns == NEVER_NS] for name, times in self._outages.items()}

    def _audit_sender(self, name: str, samples: list[Sample], before: Snapshot, now: Snapshot, what: str) -> None:
        is_learning = name in self.far.noise
        was = before.devices[name].ledger
        if is_learning:  # imud counts a gap only after it knows the rate
            before_them = self.life.recorder.before[name]
            samples = [*before_them, *(sample for sample in samples if sample.seq > len(before_them))]
            was = dict.fromkeys(was, 0)
        found = self.far.truth[name].numbers_of(samples)
        true = [(sample, number) for sample, number in zip(samples, found, strict=True) if number is not None]
        self._refuse_strange(name, [s.seq for s, number in zip(samples, found, strict=True) if number is None], what)
        outages = self._outages[name]
        numbers = [number for _, number in true]
        holes = accounts.find_holes([s for s, _ in true], numbers, outages, learns=is_learning)
        self._book(name, samples, holes, was, now, what)

    def _audit_polled(self, name: str, samples: list[Sample], before: Snapshot, now: Snapshot, what: str) -> None:
        """Compare the deadlines of a polled device with its samples, and its replies with the causes in the ledger."""
        log, was, is_now = self.far.polls[name], before.devices[name], now.devices[name]
        self._refuse_strange(name, log.strange(samples), what)
        troubles = [*self._outages[name], *log.troubles(before.at_ns, now.at_ns)]
        holes = accounts.find_holes(samples, log.numbers_of(samples, troubles), troubles)
        begin_ns = samples[0].t_ns if samples else now.at_ns
        if not was.newest_seq and any(trouble.begin_ns < begin_ns for trouble in troubles):
            missing = round((begin_ns - before.at_ns) / log.period_ns)
            holes.append(accounts.Hole(missing, is_certain=False, is_open=True))
        if samples and any(trouble.end_ns > samples[-1].t_rx_ns for trouble in troubles):
            missing = round((now.at_ns - samples[-1].t_ns) / log.period_ns)
            holes.append(accounts.Hole(missing, is_certain=False, unknown_most=0, is_open=True))
        self._book(name, samples, holes, was.ledger, now, what)
        assert was.polling is not None
        assert is_now.polling is not None
        gone = is_now.polling.vanished - was.polling.vanished + 1
        asked = [a for a in log.between(before.at_ns, now.at_ns) if a.is_sample]
        for answer, cause in ((Answer.DAMAGED, "lost_crc"), (Answer.REFUSED, "lost_gap_device")):
            true, counted = sum(a.answer is answer for a in asked), is_now.ledger[cause] - was.ledger[cause]
            if not 0 <= true - counted <= gone and name in self.far.registers:
                self._violated(
                    what,
                    f"{name}: expected {true} {answer.value} reads as {cause}, got {counted}; missing {gone - 1} times",
                )

    def _refuse_strange(self, name: str, seqs: Sequence[int], what: str) -> None:
        if seqs:
            self._violated(what, f"{name}: {len(seqs)} samples that the device did not measure, the first is {seqs[0]}")

    def _book(
        self, name: str, samples: list[Sample], holes: list[Hole], was: Mapping[str, int], now: Snapshot, what: str
    ) -> None:
        is_now = now.devices[name].ledger
        count, outages = is_now["samples"] - was["samples"], len(self._outages[name])
        unknown = is_now["lost_unknown"] - was["lost_unknown"]
        result = accounts.account(count, holes, lost(is_now) - lost(was), unknown, outages)
        self.accounts[name] += result
        if not result.balanced:
            self._show_holes(name, samples, holes)
            uncertain = [hole.missing for hole in holes if not hole.is_certain]
            causes = {cause: is_now[cause] - was[cause] for cause in is_now if is_now[cause] > was[cause]}
            causes = {cause: count for cause, count in causes.items() if cause.startswith("lost_")}
            self._violated(what, f"{name}: {result}, uncertain holes {uncertain}, {causes}")

    def _show_holes(self, name: str, samples: list[Sample], holes: list[Hole]) -> None:
        for sample, after, hole in zip(samples, [*samples[1:], None], holes, strict=False):
            if hole.missing or not hole.is_certain:
                t_ns, t_dev = sample.t_ns - samples[0].t_ns, (sample.t_dev_ns, after and after.t_dev_ns)
                print(f"  {name}: {t_ns / 1e9:.3f} s, after sample {sample.seq}: {hole}, device time {t_dev}")
                if name in self.far.polls and after is not None:
                    print("    transfers:", self.far.polls[name].shown(sample.t_ns, after.t_rx_ns))

    def _counted_snapshot(self, what: str) -> Snapshot:
        """Return the state when the ledger contains the missed deadlines. imud adds them ten times per second."""
        found: list[Snapshot] = []

        def counted() -> bool:
            found[:] = [self.life.snapshot()]
            devices = found[0].devices.values()
            return all(d.polling is None or d.polling.missed == d.ledger["lost_queue"] for d in devices)

        try:
            wait_until(counted, "missed deadlines in the ledger", CATCH_UP_S)
        except AssertionError as error:
            self._violated(what, str(error))
        return found[0]

    def _received(self, before: Snapshot, now: Snapshot, what: str) -> dict[str, list[Sample]]:
        """Return the samples between two states, after the recorder received them, with the previous sample if it
        exists."""
        newest = {name: now.devices[name].newest_seq for name in self.accounts}
        first = {name: before.devices[name].newest_seq for name in self.accounts}

        def chosen() -> dict[str, list[Sample]]:
            found = self.life.recorder.samples()
            return {name: [s for s in found[name] if first[name] <= s.seq <= newest[name]] for name in newest}

        def complete() -> bool:
            return all(
                sum(s.seq > first[n] for s in samples) == newest[n] - first[n] for n, samples in chosen().items()
            )

        try:
            wait_until(complete, "all samples of the ledger", CATCH_UP_S)
        except AssertionError as error:
            self._violated(what, str(error))
        return chosen()

    def _compare_usage(self, what: str) -> None:
        allowed = (self.life.descriptors, self.life.threads)
        try:
            wait_until(lambda: all(a <= b for a, b in zip(self.life.usage(), allowed, strict=True)), "", CATCH_UP_S)
        except AssertionError:
            self._violated(
                what, f"expected at most {allowed} descriptors and threads, as at the start, got {self.life.usage()}"
            )

    def _violated(self, what: str, words: str) -> None:
        self.violations.append(f"{what}: {words}")
        print(f"VIOLATION {self.violations[-1]}", flush=True)

    def _born(self) -> Life:
        self.lives += 1
        return Life(self._folder, self._folder / "imud.yaml")


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    folder.mkdir()
    tool("mount", "-t", "tmpfs", "-o", f"size={STATE_SIZE}", "tmpfs", str(folder))
    try:
        yield folder
    finally:
        tool("umount", str(folder))


def show(chaos: Chaos, made: Counter[str], faults: list[Fault]) -> None:
    print("\nfault                             times")
    for fault in faults:
        print(f"  {fault.name:32}{made[fault.name]:5}")
    print(f"  {'total':32}{made.total():5}, lives of the daemon {chaos.lives}")
    print("\ndevice    samples   true holes   lost by ledger   by the rule   gaps unknown   by the rule   outages")
    for name, sum_ in chaos.accounts.items():
        bounds = f"{sum_.least}" if sum_.least == sum_.most else f"{sum_.least} to {sum_.most}"
        print(
            f"  {name:8}{sum_.samples:7}{sum_.holes:13}{sum_.lost:17}{bounds:>14}"
            f"{sum_.unknown:15}{f'0 to {sum_.unknown_most}':>14}{sum_.outages:10}"
        )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="make chaos", description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument(
        "--seed", type=int, default=time.time_ns() % 1_000_000, help="seed of the plan (default: from the clock)"
    )
    parser.add_argument(
        "--seconds", type=float, default=CI_SECONDS,
        help="duration of the faults in the guest's time, s (default: %(default)g)",
    )  # fmt: skip
    parser.add_argument("--short", action="store_true", help="run two rounds with each kind of fault once")
    options = parser.parse_args(arguments)
    how = "--short" if options.short else f"--seconds {options.seconds:g}"
    print(f'chaos: repeat with ARGS="--seed {options.seed} {how}"', flush=True)
    with_memory = memory_control()
    if not with_memory:
        print("chaos: this kernel has no memory controller; skipping 'out of memory'")
    faults = all_faults(with_memory=with_memory)
    rounds = plan_short(options.seed, faults) if options.short else plan(options.seed, options.seconds, faults)
    made: Counter[str] = Counter()
    begin_s = monotonic()
    with tempfile.TemporaryDirectory(prefix="chaos-") as name, small_disk(Path(name) / "state") as state:
        folder = Path(name)
        with FarSide(folder, options.seed) as far:
            chaos = Chaos(far, folder, state)
            try:
                chaos.settle("start")
                for number, planned in enumerate(rounds, 1):
                    made.update(item.fault.name for item in planned)
                    play(planned, chaos.begin, chaos.end)
                    chaos.settle(f"after round {number}")
                    print(
                        f"round {number}: {len(planned)} faults, violations {len(chaos.violations)}, "
                        f"{monotonic() - begin_s:.0f} s, {chaos.life.rss_kb() / 1024:.1f} MB",
                        flush=True,
                    )
                chaos.audit("end")
                chaos.life.terminate()
            finally:
                chaos.life.destroy()
        log = (folder / "log").read_text()
    if "Traceback" in log or chaos.violations:
        print("\n".join(["", "the daemon's log:", *log.splitlines()]))
    if "Traceback" in log:
        chaos.violations.append("the daemon's log contains a traceback")
    show(chaos, made, faults)
    print("\n" + "\n".join(chaos.violations or ["passed"]))
    return 1 if chaos.violations else 0


if __name__ == "__main__":
    sys.exit(main())
