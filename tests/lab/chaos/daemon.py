"""The daemon under test: started, killed, starved, and looked at from outside; one `Life` from start to death."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from time import monotonic, monotonic_ns, sleep
from typing import Final, NamedTuple

import msgspec

from imud.client.connection import Client, Watch
from imud.client.ring import Ring
from imud.contracts.status import DeviceState, DeviceStatus
from imud.formats.slot import SLOT_BYTES, SLOT_FIELDS, decode_slot
from imud.model.errors import ImudError
from imud.model.sample import Sample
from tests.lab.waiting import wait_until

START_LIMIT_S: Final = 60.0
BACK_LIMIT_S: Final = 120.0
"""For all devices to run again after the last fault; the slowest search takes 15 s of silence."""
ANSWER_LIMIT_S: Final = 30.0
CGROUP: Final = Path("/sys/fs/cgroup/imud-chaos")
TOO_LITTLE: Final = "4M"
ID_AT: Final = next(field.offset for field in SLOT_FIELDS if field.name == "device_id")


class Snapshot(NamedTuple):
    devices: Mapping[str, DeviceStatus]
    at_ns: int
    """CLOCK_MONOTONIC before the request, ns."""


class Recorder:
    """Receives every sample of one life in a thread. It decodes samples only on request.

    Synchronization: the thread appends to a list that other threads only read.
    """

    def __init__(self, path: Path, rings: Path) -> None:
        self._client = Client(path, timeout_s=ANSWER_LIMIT_S)
        self._watch = self._client.watch(encoding="binary")
        self._newest = self._client.poll()
        self.begin = _snapshot(self._client)
        """The state at a moment from which on every sample is received."""
        self.before: Final = {name: _first_samples(rings, name, d.newest_seq) for name, d in self.begin.devices.items()}
        self._slots: list[bytes] = []
        self._others: list[object] = []
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    def samples(self) -> dict[str, list[Sample]]:
        names = {status.device_id: name for name, status in self.begin.devices.items()}
        found: dict[str, list[Sample]] = {name: [] for name in names.values()}
        for slots in list(self._slots):
            for at in range(0, len(slots), SLOT_BYTES):
                slot = slots[at : at + SLOT_BYTES]
                number = int.from_bytes(slot[ID_AT : ID_AT + 2], "little")
                if number in names:
                    found[names[number]].append(decode_slot(slot, names[number]))
        for sample in self._newest:
            received = found[sample.device]
            if not received or received[0].seq > sample.seq:
                received.insert(0, sample)
        return found

    @property
    def dropped(self) -> list[object]:
        return [message for message in self._others if isinstance(message, dict) and message.get("method") == "dropped"]

    def close(self) -> None:
        self._thread.join(ANSWER_LIMIT_S)
        assert not self._thread.is_alive(), "the recorder's connection did not end"
        self._client.close()

    def _run(self) -> None:
        with suppress(ImudError):  # the daemon is gone
            while True:
                message = self._client.next_message(Watch.NAMES, None)
                if isinstance(message, bytes):
                    self._slots.append(message)
                else:
                    self._others.append(message)


def _first_samples(rings: Path, name: str, newest_seq: int) -> list[Sample]:
    """Samples 1 to `newest_seq` of a daemon that has just started, out of its ring."""
    with Ring(name, directory=str(rings), from_oldest=True) as ring:
        found = [sample for sample in ring.read().samples if sample.seq <= newest_seq]
    assert [sample.seq for sample in found] == list(range(1, newest_seq + 1)), f"{name}: its ring has not {newest_seq}"
    return found


class Life:
    def __init__(self, folder: Path, config: Path) -> None:
        self.socket = folder / "imud.sock"
        self.socket.unlink(missing_ok=True)
        self._log = (folder / "log").open("a")
        argv = [sys.executable, "-m", "imud", "run", "--config", str(config)]
        if memory_control():  # memory counts for the group that a process is in when it asks for it
            CGROUP.mkdir(exist_ok=True)
            argv = ["sh", "-c", f'echo $$ >{CGROUP}/cgroup.procs && exec "$@"', "sh", *argv]
        self.process = subprocess.Popen(argv, stderr=self._log, stdin=subprocess.DEVNULL)
        wait_until(lambda: self.socket.exists() or self.process.poll() is not None, "the socket", START_LIMIT_S)
        assert self.process.poll() is None, "the daemon ended at its start"
        self.recorder = Recorder(self.socket, folder)
        self.descriptors = self.threads = 0

    def snapshot(self) -> Snapshot:
        """The state of every device now. Raises ImudError, TimeoutError."""
        with Client(self.socket, timeout_s=ANSWER_LIMIT_S) as client:
            return _snapshot(client)

    def wait_running(self) -> Snapshot:
        """Wait until every device runs. Raises AssertionError with the other devices."""
        end = monotonic() + BACK_LIMIT_S
        while True:
            found = self.snapshot()
            away = {
                n: f"{s.state}: {s.problem}" for n, s in found.devices.items() if s.state is not DeviceState.RUNNING
            }
            if not away:
                return found
            assert monotonic() < end, f"not back within {BACK_LIMIT_S:g} s: {away}"
            sleep(0.5)

    def usage(self) -> tuple[int, int]:
        proc = Path(f"/proc/{self.process.pid}")
        return len(os.listdir(proc / "fd")), len(os.listdir(proc / "task"))

    def rss_kb(self) -> int:
        return int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") // 1024

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def kill(self) -> None:
        self.process.kill()
        self._gone(-signal.SIGKILL)

    def run_out_of_memory(self) -> None:
        """Take its memory away by its cgroup until the kernel kills it."""
        with suppress(OSError):  # EBUSY and similar errors: only the end of the process matters
            (CGROUP / "memory.max").write_text(TOO_LITTLE)
        try:
            self._gone(-signal.SIGKILL)
        finally:
            (CGROUP / "memory.max").write_text("max")

    def terminate(self) -> None:
        self.process.terminate()
        self._gone(0)
        assert not self.socket.exists(), "the socket was left behind"

    def destroy(self) -> None:
        self.process.kill()
        self.process.wait(START_LIMIT_S)
        self.recorder.close()
        self._log.close()

    def _gone(self, expected: int) -> None:
        status = self.process.wait(START_LIMIT_S)
        self.recorder.close()
        self._log.close()
        assert status == expected, f"the daemon ended with {status}, expected {expected}"


def memory_control() -> bool:
    """Whether processes can be put under a limit of memory here; switches it on."""
    root = CGROUP.parent
    if "memory" not in (root / "cgroup.controllers").read_text().split():
        return False
    (root / "cgroup.subtree_control").write_text("+memory")
    return True


def _snapshot(client: Client) -> Snapshot:
    at_ns = monotonic_ns()
    devices = msgspec.convert(client.status()["devices"], list[DeviceStatus])
    return Snapshot({device.name: device for device in devices}, at_ns)
