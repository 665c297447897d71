"""`make chaos`: random faults of all kinds on a real daemon in the lab's kernel, from a seed, then the account.

    python -m tests.lab.chaos --seed N --seconds S      in the guest, as root

Faults come in rounds of ROUND_S. After each round every device must run again, each ledger close, the losses be the
true ones (tests/lab/chaos/account.py has the rule), and descriptors and threads be no more than in the beginning. A
daemon that is killed is audited right before. Prints the faults made, the account per device, and a verdict; the exit
status is 0 only without any violation.
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, monotonic_ns, sleep
from typing import Final

from imud.sample import Sample
from tests.lab.chaos import account as accounts
from tests.lab.chaos.account import Account, Interval
from tests.lab.chaos.daemon import Life, Snapshot, memory_control
from tests.lab.chaos.far_side import FarSide
from tests.lab.chaos.faults import Fault, Planned, all_faults, plan
from tests.lab.tool import tool
from tests.lab.waiting import wait_until
from tests.support.daemon_process import write_config

CI_SECONDS: Final = 45.0
STATE_SIZE: Final = "64k"
CATCH_UP_S: Final = 30.0
CALM_S: Final = 1.0
"""After all devices run again: connections that asked are closed, and the clocks have seen what came."""
NEVER_NS: Final = 1 << 62
SPARE: Final = {"driver": "hipnuc-uart", "uart": {"port": "/dev/imud-chaos-nothing", "baud": 115200}}


class Chaos:
    """One run (`Scene` of the faults)."""

    def __init__(self, far: FarSide, folder: Path, state: Path) -> None:
        self.far, self.state = far, state
        self.violations: list[str] = []
        self.accounts: dict[str, Account] = {name: Account() for name in far.devices()}
        self.lives = 0
        self._folder = folder
        self._outages: dict[str, list[Interval]] = {name: [] for name in far.devices()}
        self._polled_before: dict[str, tuple[int, int]] = {}
        self.write_config(0)
        self.life = self._born()

    # --- Scene -------------------------------------------------------------------------------------------------------

    def write_config(self, variant: int) -> None:
        """Write the configuration: 0 the usual, 1 with another device and level, -1 a bad one."""
        spare = {"spare": SPARE} if variant == 1 else {}
        more = {"log_level": "info" if variant else "warning", "state_dir": str(self.state)}
        file = write_config(self._folder, {**self.far.devices(), **spare}, metrics={"enabled": False}, **more)
        if variant < 0:
            file.write_text("devices: [nothing: {here: is")

    def next_life(self, end: Callable[[Life], None]) -> None:
        """Audit the daemon, end it and start another."""
        self.audit(f"before the end of life {self.lives}")
        end(self.life)
        self.life = self._born()

    def outage_begins(self, fault: Fault) -> None:
        """Note it for the devices that it concerns."""
        for name in fault.outage:
            self._outages[name].append(Interval(monotonic_ns(), NEVER_NS))

    def outage_ends(self, fault: Fault) -> None:
        """The same."""
        for name in fault.outage:
            begin = self._outages[name].pop()
            self._outages[name].append(Interval(begin.begin_ns, monotonic_ns()))

    # --- audits ------------------------------------------------------------------------------------------------------

    def settle(self, what: str) -> None:
        """Wait until every device runs, then hold the daemon to all that it promises."""
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
        """Add up the present life; it must be followed by another, or by the end."""
        before, now = self.life.recorder.begin, self.life.snapshot()
        samples = self._received(before, now, what)
        for name in self.accounts:
            if problem := accounts.open_ledger(now.devices[name]):
                self._violated(what, f"{name}: {problem}")
            for fault in accounts.sequence_faults(samples[name], before.devices[name].newest_seq + 1):
                self._violated(what, f"{name}: {fault}")
            if name in self.far.truth:
                self._audit_sender(name, samples[name], before, now, what)
            elif name in self.far.polled:
                self._audit_polled(name, before, now, what)
            else:
                self.accounts[name] += Account(len(samples[name]), outages=len(self._outages[name]))
        if self.life.recorder.dropped:
            self._violated(what, f"the recorder was too slow: {self.life.recorder.dropped}")
        self._outages = {name: [i for i in times if i.end_ns == NEVER_NS] for name, times in self._outages.items()}

    def _audit_sender(self, name: str, samples: list[Sample], before: Snapshot, now: Snapshot, what: str) -> None:
        found = self.far.truth[name].numbers_of(samples)
        strange = [sample.seq for sample, number in zip(samples, found, strict=True) if number is None]
        if strange:
            self._violated(what, f"{name}: {len(strange)} samples that the device never took, first {strange[0]}")
        true = [(sample, number) for sample, number in zip(samples, found, strict=True) if number is not None]
        lost = accounts.losses(now.devices[name].ledger) - accounts.losses(before.devices[name].ledger)
        numbers = [number for _, number in true]
        learns = name in self.far.noise
        result = accounts.account([s for s, _ in true], numbers, lost, self._outages[name], learns=learns)
        self._book(name, result, what)

    def _audit_polled(self, name: str, before: Snapshot, now: Snapshot, what: str) -> None:
        """Every burst that was answered is a sample, or one that was the same as before, or a damaged frame."""
        bus = self.far.polled[name]
        good, damaged = self._polled_before[name]
        was, is_now = before.devices[name].ledger, now.devices[name].ledger
        polling, earlier = now.devices[name].polling, before.devices[name].polling
        assert polling is not None
        assert earlier is not None
        bad = sum(is_now[key] - was[key] for key in is_now if key.startswith("frames_bad"))
        taken = is_now["samples"] - was["samples"] + polling.stale - earlier.stale
        answered, hit = bus.good - good, bus.damaged - damaged
        count = len(self._outages[name]) + 1
        if not 0 <= answered - taken <= count or not hit - count <= bad <= hit + count:
            self._violated(
                what, f"{name}: {answered} bursts answered, {hit} answers damaged, the ledger has {taken} and {bad}, "
                f"outages {count - 1}",
            )  # fmt: skip
        queue = is_now["lost_queue"] - was["lost_queue"]
        missed = polling.missed - earlier.missed
        self._book(name, Account(is_now["samples"] - was["samples"], missed, queue, count - 1), what)

    def _book(self, name: str, result: Account, what: str) -> None:
        self.accounts[name] += result
        if not result.balanced:
            self._violated(
                what, f"{name}: the ledger says {result.lost} lost, the truth {result.holes}, outages {result.outages}"
            )

    def _received(self, before: Snapshot, now: Snapshot, what: str) -> dict[str, list[Sample]]:
        """The samples between two states, once the recorder has them."""
        newest = {name: now.devices[name].newest_seq for name in self.accounts}
        first = {name: before.devices[name].newest_seq for name in self.accounts}

        def chosen() -> dict[str, list[Sample]]:
            found = self.life.recorder.samples()
            return {name: [s for s in found[name] if first[name] < s.seq <= newest[name]] for name in newest}

        def complete() -> bool:
            return all(len(samples) >= newest[name] - first[name] for name, samples in chosen().items())

        try:
            wait_until(complete, "the samples that the ledger has", CATCH_UP_S)
        except AssertionError as error:
            self._violated(what, str(error))
        return chosen()

    def _compare_usage(self, what: str) -> None:
        allowed = (self.life.descriptors, self.life.threads)
        try:
            wait_until(lambda: all(a <= b for a, b in zip(self.life.usage(), allowed, strict=True)), "", CATCH_UP_S)
        except AssertionError:
            self._violated(what, f"descriptors and threads {self.life.usage()}, in the beginning {allowed}")

    def _violated(self, what: str, words: str) -> None:
        self.violations.append(f"{what}: {words}")
        print(f"VIOLATION {self.violations[-1]}", flush=True)

    def _born(self) -> Life:
        self.lives += 1
        self._polled_before = {name: (bus.good, bus.damaged) for name, bus in self.far.polled.items()}
        return Life(self._folder, self._folder / "imud.yaml")


def play(chaos: Chaos, planned: list[Planned], made: Counter[str]) -> None:
    """One round: each fault begins and ends when it is due."""
    begin_s = monotonic()
    going: list[tuple[float, Fault]] = []
    todo = list(planned)
    while todo or going:
        due_s, is_end = min([(end, True) for end, _ in going] + [(item.begin_s, False) for item in todo[:1]])
        sleep(max(begin_s + due_s - monotonic(), 0))
        if is_end:
            fault = next(fault for end, fault in going if end == due_s)
            going.remove((due_s, fault))
            fault.end(chaos)
            chaos.outage_ends(fault)
        else:
            item = todo.pop(0)
            made[item.fault.name] += 1
            chaos.outage_begins(item.fault)
            item.fault.begin(chaos, item.lasts_s)
            going.append((monotonic() - begin_s + item.lasts_s, item.fault))


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """A file system of STATE_SIZE."""
    folder.mkdir()
    tool("mount", "-t", "tmpfs", "-o", f"size={STATE_SIZE}", "tmpfs", str(folder))
    try:
        yield folder
    finally:
        tool("umount", str(folder))


def show(chaos: Chaos, made: Counter[str], faults: list[Fault]) -> None:
    """The tables."""
    print("\nfault                             times")
    for fault in faults:
        print(f"  {fault.name:32}{made[fault.name]:5}")
    print(f"  {'in all':32}{made.total():5}, lives of the daemon {chaos.lives}")
    print("\ndevice    samples   lost by ledger   true holes   difference   outages (allowed)   unheard in outages")
    for name, sum_ in chaos.accounts.items():
        print(
            f"  {name:8}{sum_.samples:7}{sum_.lost:17}{sum_.holes:13}{sum_.lost - sum_.holes:+13}"
            f"{sum_.outages:20}{sum_.unheard:21}"
        )


def main(arguments: list[str] | None = None) -> int:
    """Run; return the exit status."""
    parser = argparse.ArgumentParser(prog="make chaos", description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--seed", type=int, default=time.time_ns() % 1_000_000, help="of the plan (by the clock)")
    parser.add_argument(
        "--seconds", type=float, default=CI_SECONDS, help="of faults, in the guest's time (%(default)g)"
    )
    options = parser.parse_args(arguments)
    print(f'chaos: repeat with ARGS="--seed {options.seed} --seconds {options.seconds:g}"', flush=True)
    with_memory = memory_control()
    if not with_memory:
        print("chaos: no memory controller in this kernel: 'out of memory' is left out")
    faults = all_faults(with_memory=with_memory)
    made: Counter[str] = Counter()
    begin_s = monotonic()
    with tempfile.TemporaryDirectory(prefix="chaos-") as name, small_disk(Path(name) / "state") as state:
        folder = Path(name)
        with FarSide(folder, options.seed) as far:
            chaos = Chaos(far, folder, state)
            try:
                chaos.settle("start")
                for number, planned in enumerate(plan(options.seed, options.seconds, faults), 1):
                    play(chaos, planned, made)
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
        print("\n".join(["", "the daemon's log:", *log.splitlines()[-60:]]))
    if "Traceback" in log:
        chaos.violations.append("a traceback in the daemon's log")
    show(chaos, made, faults)
    print("\n" + "\n".join(chaos.violations or ["passed"]))
    return 1 if chaos.violations else 0


if __name__ == "__main__":
    sys.exit(main())
