"""The attack on shared memory next to a running daemon, with a reader that must not get false samples.

The directory is a directory of the daemon, or a sticky directory. In a sticky directory, the daemon changes the size of
its rings, so that names become free for the hostile user.
"""

import subprocess
import sys
from contextlib import closing
from dataclasses import dataclass, field
from threading import Event, Thread
from time import monotonic_ns, sleep
from typing import Final

from imud.client.ring import Ring
from imud.model.errors import ServerError
from tests.attack.shared_memory import DEVICES
from tests.attack.stage import SLOTS, AttackedDaemon

PRIVATE_MODE: Final = 0o755  # like /run/imud/shm
STICKY_MODE: Final = 0o1777  # like /dev/shm
OTHER_SLOTS: Final = 2 * SLOTS  # another size, so that the daemon creates the rings again
READ_S: Final = 0.02  # interval of reads
SETTLE_S: Final = 0.3
"""Time until new rings contain samples and a heartbeat, s."""
REMADE_MISSED_MAX: Final = 500
"""Maximum number of missed samples while the daemon creates all rings twice: half a second at 1 kHz."""
HOSTILE: Final = """
import sys, time
from pathlib import Path
from tests.attack.shared_memory import attack
end_s = time.monotonic() + float(sys.argv[3])
print(attack(Path(sys.argv[1]), int(sys.argv[2]), lambda: time.monotonic() > end_s))
"""


@dataclass
class Witness:
    stage: AttackedDaemon
    samples: int = 0
    missed: int = 0
    newest: int = 0
    refused: int = 0
    """Number of forged files that the reader rejected."""
    problems: list[str] = field(default_factory=list)
    over: Event = field(default_factory=Event)

    def run(self) -> None:
        try:
            with Ring(self.stage.rings / "imud.d0") as ring:
                self._follow(ring)
        except ServerError as error:
            self.problems.append(f"the reader failed: {error}")

    def _follow(self, ring: Ring) -> None:
        epoch, self.newest = ring.epoch, ring.newest_seq
        while not self.over.wait(READ_S):
            samples, missed = ring.read()
            self.samples += len(samples)
            self.missed += missed
            for sample in samples:
                if sample.seq <= self.newest:
                    self.problems.append(f"the reader received sample {sample.seq} after {self.newest}")
                self.newest = sample.seq
            self._open_foreign(epoch)
        if ring.epoch != epoch or not ring.alive(monotonic_ns()):
            self.problems.append("expected a ring with a current heartbeat at the end, got none")

    def _open_foreign(self, epoch: int) -> None:
        for name in DEVICES:
            try:
                with closing(Ring(self.stage.rings / f"imud.{name}")) as ring:
                    if ring.epoch != epoch:
                        self.problems.append(f"the reader accepted a forged ring of {name}")
            except ServerError as error:
                self.refused += "no such ring" not in str(error)


def attack(stage: AttackedDaemon, uid: int, seconds: float, sticky: bool) -> tuple[list[str], int]:
    """Let user `uid` attack the directory of the rings. Return the problems and the number of operations."""
    stage.rings.chmod(STICKY_MODE if sticky else PRIVATE_MODE)
    witness = Witness(stage)
    reading = Thread(target=witness.run)
    reading.start()
    child = subprocess.Popen(
        [sys.executable, "-c", HOSTILE, str(stage.rings), str(uid), str(seconds)], stdout=subprocess.PIPE, text=True
    )
    if sticky:
        sleep(seconds / 2)
        stage.change(slots=OTHER_SLOTS)
        sleep(SETTLE_S)
        stage.change()
    out, _ = child.communicate(timeout=seconds + 30)
    sleep(SETTLE_S)
    witness.over.set()
    reading.join()
    stage.rings.chmod(PRIVATE_MODE)
    problems = (
        []
        if child.returncode == 0 and int(out)
        else [f"the hostile process failed with exit status {child.returncode}"]
    )
    return problems + witness.problems + _judged(witness, sticky), int(out or 0)


def _judged(witness: Witness, sticky: bool) -> list[str]:
    problems = []
    if not witness.samples:
        problems.append("the reader received no samples")
    limit = REMADE_MISSED_MAX if sticky else 0
    if witness.missed > limit:
        problems.append(f"the reader missed {witness.missed} samples, expected at most {limit}")
    if sticky and not witness.refused:
        problems.append("expected forged files that the reader rejects, got none: the attack had no effect")
    return problems
