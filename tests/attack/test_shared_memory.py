"""The attack on shared memory, short: a daemon of an own user in a private and in a sticky directory."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from imud.client.ring import Ring
from tests.support.rings import DEVICE
from tests.support.surroundings import DAEMON_UID, HOSTILE_UID, needs_root, python_as

pytestmark = [needs_root, pytest.mark.timeout(40)]

ACTS: Final = 1500

HOSTILE: Final = """
import sys
from pathlib import Path
from tests.attack.shared_memory import attack
left = iter(range(int(sys.argv[3])))
print(attack(Path(sys.argv[1]), int(sys.argv[2]), lambda: next(left, None) is None))
"""

DAEMON: Final = """
import sys, time
from pathlib import Path
from tests.support.rings import Board
board = Board(Path(sys.argv[1]))
for number in range(3):
    board.publisher.add_device(f"other{number}", 4 + number)
print("ready", flush=True)
seq, end, slowest = 0, False, 0
while not end:
    start = time.monotonic_ns()
    seq += 1
    board.publish([seq])
    if seq % 20 == 0:
        board.tick(20_000_000)
    if seq % 100 == 0:
        board.publisher.add_device("a", 9)
    slowest = max(slowest, time.monotonic_ns() - start)
    time.sleep(0.001)
    end = Path(sys.argv[2]).exists()
board.tick(2_000_000_000)
print(seq, slowest, flush=True)
sys.stdin.read()
board.publisher.close()
"""


@pytest.fixture(name="folder")
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-attack-") as name:
        os.chmod(name, 0o755)
        yield Path(name)


@pytest.mark.parametrize("mode", [0o755, 0o1777])
def test_daemon_does_not_care(folder: Path, mode: int) -> None:
    """It lives, its ring holds every sample, and nothing but rings of its own is read from."""
    shm, end = folder / "shm", folder / "end"
    shm.mkdir()
    owner = DAEMON_UID if mode == 0o755 else 0
    os.chown(shm, owner, owner)
    shm.chmod(mode)
    with python_as(DAEMON_UID, DAEMON, str(shm), str(end)) as daemon:
        assert daemon.stdout is not None
        assert daemon.stdout.readline() == "ready\n"
        arguments = (str(shm), str(HOSTILE_UID), str(ACTS))
        with Ring(shm / f"imud.{DEVICE}", owner_uid=DAEMON_UID) as ring, python_as(0, HOSTILE, *arguments) as other:
            out, errors = other.communicate()
            assert (out, other.returncode) == (f"{ACTS}\n", 0), errors
            end.touch()
            seq, slowest_ns = (int(word) for word in daemon.stdout.readline().split())
            assert ring.newest_seq == seq
            assert not ring.reopen()  # it is the same ring as before
        assert slowest_ns < 1_000_000_000
        _, errors = daemon.communicate()
        assert daemon.returncode == 0, errors
    assert "Traceback" not in errors
    assert not os.listdir(shm)
