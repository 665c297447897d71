"""The daemon under test. The test starts, kills, stops and observes it. A `Life` is one process from start to end."""

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
from tests.support.daemon_process import wait_until

START_LIMIT_S: Final = 60.0  # start of the daemon under emulation
BACK_LIMIT_S: Final = 120.0
"""Maximum time until all devices run again after the last fault, s. The slowest detection waits for 15 s of silence."""
ANSWER_LIMIT_S: Final = 30.0  # reply on the socket
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
        """The state at the start. The recorder receives every later sample."""
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
        assert not self._thread.is_alive(), "expected the end of the recorder's connection"
        self._client.close()

    def _run(self) -> None:
        with suppress(ImudError):  # the daemon has ended
            while True:
                message = self._client.next_message(Watch.NAMES, None)
                if isinstance(message, bytes):
                    self._slots.append(message)
                else:
                    self._others.append(message)


def _first_samples(rings: Path, name: str, newest_seq: int) -> list[Sample]:
    """Return the samples 1 to `newest_seq` of a newly started daemon from its ring."""
    with Ring(name, directory=str(rings), from_oldest=True) as ring:
        found = [sample for sample in ring.read().samples if sample.seq <= newest_seq]
    assert [sample.seq for sample in found] == list(range(1, newest_seq + 1)), (
        f"{name}: expected the samples 1 to {newest_seq} in its ring"
    )
    return found


class Life:
    def __init__(self, folder: Path, config: Path) -> None:
        self.socket = folder / "imud.sock"
        self.socket.unlink(missing_ok=True)
        self._log = (folder / "log").open("a")
        argv = [sys.executable, "-m", "imud", "run", "--config", str(config)]
        if memory_control():  # the kernel charges memory to the group of the process at the time of the allocation
            CGROUP.mkdir(exist_ok=True)
            argv = ["sh", "-c", f'echo $$ >{CGROUP}/cgroup.procs && exec "$@"', "sh", *argv]
        self.process = subprocess.Popen(argv, stderr=self._log, stdin=subprocess.DEVNULL)
        wait_until(lambda: self.socket.exists() or self.process.poll() is not None, "the socket", START_LIMIT_S)
        assert self.process.poll() is None, "cannot start the daemon: it ended before it opened its socket"
        self.recorder = Recorder(self.socket, folder)
        self.descriptors = self.threads = 0

    def snapshot(self) -> Snapshot:
        """Return the present state of every device. Raises ImudError or TimeoutError."""
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
            assert monotonic() < end, f"expected all devices to run within {BACK_LIMIT_S:g} s, got: {away}"
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
        """Reduce the memory limit of the daemon's cgroup until the kernel kills the daemon."""
        with suppress(OSError):  # EBUSY and similar errors: only the end of the process matters
            (CGROUP / "memory.max").write_text(TOO_LITTLE)
        try:
            self._gone(-signal.SIGKILL)
        finally:
            (CGROUP / "memory.max").write_text("max")

    def terminate(self) -> None:
        self.process.terminate()
        self._gone(0)
        assert not self.socket.exists(), "expected the daemon to remove its socket"

    def destroy(self) -> None:
        self.process.kill()
        self.process.wait(START_LIMIT_S)
        self.recorder.close()
        self._log.close()

    def _gone(self, expected: int) -> None:
        status = self.process.wait(START_LIMIT_S)
        self.recorder.close()
        self._log.close()
        assert status == expected, f"expected exit status {expected} of the daemon, got {status}"


def memory_control() -> bool:
    """Return whether this system supports memory limits for processes. Switch the support on."""
    root = CGROUP.parent
    if "memory" not in (root / "cgroup.controllers").read_text().split():
        return False
    (root / "cgroup.subtree_control").write_text("+memory")
    return True


def _snapshot(client: Client) -> Snapshot:
    at_ns = monotonic_ns()
    devices = msgspec.convert(client.status()["devices"], list[DeviceStatus])
    return Snapshot({device.name: device for device in devices}, at_ns)
