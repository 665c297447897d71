"""CPU time per received CAN frame: the receive path of imud and `recv` of python-can, on the same bus in one run.

The part needs a virtual CAN bus and the permission to create one. If this kernel has no virtual CAN bus, the kernel of
the lab measures (`make lab-deps`). The lab emulates the CPU, so only the ratio of both times is meaningful.
"""

import shlex
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import process_time_ns

import can
import msgspec

from imud.formats.can import pack_frame
from imud.links.socketcan import BATCH_FRAMES, BusState, FrameReader
from tests.bench.rows import Row, at_least

BUS = "vcanbench"
BATCHES = {"one at a time": 1, "ten waiting": 10, "a batch waiting": BATCH_FRAMES}  # frames in the socket before a read
FRAMES = 6000  # frames per batch size
RATIOS_REACHED = {1: 2.0, BATCH_FRAMES: 4.0}  # goals: python-can / imud by batch size
ROOT = Path(__file__).parents[2]
LAB_LIMIT_S = 600.0  # boot of the lab and the measurement


def measure(interface: str, waiting: int, frames: int) -> tuple[float, float]:
    with (
        socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW) as ours,
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as far,
        can.Bus(interface, "socketcan") as bus,
    ):
        ours.bind((interface,))
        far.bind((interface,))
        reader = FrameReader(ours, BusState("can0"))
        sent = [pack_frame(0x100 + number, False, bytes(8)) for number in range(waiting)]
        taken_ns = [0, 0]
        rounds = max(frames // waiting, 1)
        # the kernel queues each frame for both sockets
        for _ in range(rounds):
            for frame in sent:
                far.send(frame)
            begin_ns = process_time_ns()
            got = reader.read()
            middle_ns = process_time_ns()
            messages = [bus.recv(0) for _ in range(waiting)]
            taken_ns[0] += middle_ns - begin_ns
            taken_ns[1] += process_time_ns() - middle_ns
            assert [frame.can_id for frame in got] == [message.arbitration_id for message in messages if message]
    ours_us, theirs_us = (taken / rounds / waiting / 1e3 for taken in taken_ns)
    return ours_us, theirs_us


@contextmanager
def virtual_bus() -> Iterator[str]:
    """Create a virtual CAN interface. Raises CalledProcessError if the kernel or the permissions forbid it."""
    _ip("link", "add", "dev", BUS, "type", "vcan")
    try:
        _ip("link", "set", BUS, "up")
        yield BUS
    finally:
        _ip("link", "delete", BUS)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def here(*, quick: bool) -> list[Row]:
    found: list[Row] = []
    with virtual_bus() as bus:
        for words, waiting in BATCHES.items():
            ours_us, theirs_us = measure(bus, waiting, FRAMES // 10 if quick else FRAMES)
            found += [
                Row(f"CAN receive, {words}: CPU per frame", ours_us, "us"),
                Row(f"CAN receive, {words}: CPU per frame by python-can", theirs_us, "us"),
            ]
            ratio = Row(f"CAN receive, {words}: python-can / imud", theirs_us / ours_us, "x")
            reach = RATIOS_REACHED.get(waiting)
            found.append(ratio if reach is None else at_least(ratio.name, ratio.value, ratio.unit, reach))
    return found


def in_lab(why: str, *, quick: bool) -> list[Row]:
    """Return the rows that the lab's kernel measures. Without a lab, print the reason and return no rows."""
    command = shlex.join([".venv/bin/python", "-m", "tests.bench.can", *(["--quick"] if quick else [])])
    print(f"# cannot create a virtual CAN bus ({why}); the lab measures on an emulated CPU", flush=True)
    lab = [str(ROOT / "tests/lab/run"), "--steady", "--exec", command]
    done = subprocess.run(lab, cwd=ROOT, text=True, capture_output=True, timeout=LAB_LIMIT_S, check=False)
    if done.returncode:
        print(f"# cannot measure in the lab: {done.stderr.strip().splitlines()[-1:]}")
        return []
    line = next(line for line in done.stdout.splitlines() if line.startswith("["))
    return [row._replace(name=f"{row.name} (lab)") for row in msgspec.json.decode(line, type=list[Row])]


def rows(*, quick: bool = False) -> list[Row]:
    try:
        return here(quick=quick)
    except subprocess.CalledProcessError as error:
        return in_lab(error.stderr.decode().strip(), quick=quick)
    except OSError as error:
        return in_lab(str(error), quick=quick)


if __name__ == "__main__":
    print(msgspec.json.encode(here(quick="--quick" in sys.argv)).decode())
