"""The daemon under attack: `imud run` with a 1 kHz device and idle ones, and a well-behaved client."""

import fcntl
import grp
import json
import os
import pty
import resource
import signal
import subprocess
import sys
import tempfile
import termios
import threading
import tty
from contextlib import ExitStack, suppress
from enum import Enum
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Self

import msgspec

from imud.cli.arguments import statuses
from imud.client.connection import Client
from imud.model.ledger import lost
from tests.bench.rig import CORES, REST_CORES, SERVER_CORE, Process, cpu_ns, rss_mb, wait_for
from tests.support.surroundings import free_port

HOSTILE_UIDS = (65_534, 65_533)
GOOD_UID = 65_532
"""User id of a normal reader. It is not root, not the user of the daemon, and not a hostile user."""
READ_GID, CONTROL_GID = 65_534, 1
RATE_HZ = 1000
PRIORITY = 10
"""Real-time priority, above programs with the lowest priority. With an equal priority, turns would take 100 ms."""
SETTLE_S = 3.0  # time before the first figures, s
IDLE_DEVICES = 3
REPLUG_LIMIT_S = 5.0  # time to open a device again
CLIENTS = 256  # hostile clients at the same time
CLIENTS_MAX = 320
"""Maximum number of clients: 256 hostile clients and the reserved places."""
FDS_MAX = 16_384
PIPE_BYTES = 4096
"""Minimum size of a pipe, bytes. The log is full soon."""
FILL_S = 0.2  # time until the reader has processed its last data, s
SLOTS = 1024
"""Slots of a ring, 256 KiB of memory: some attacks use a hundred devices."""
LOST_SETTLE_S = 1.0
"""Time until the next sample shows a loss, s."""
QUIET_LIMIT_S = 10.0
"""Time until closed connections are gone, s, with the connections that wait for acceptance at 64 per second and
user."""
LOG_SPOILT = b"the old configuration stays active"
LOG_FILLER = b"-" * 63
LOG_EXPECTED = (b"no byte arrives on", LOG_SPOILT, LOG_FILLER, b" is missing (hung up)")
PROBLEMS = 20  # errors in the spoilt configuration


class Scheduling(Enum):
    """Scheduling of the daemon. Device and good client, which measure, have real-time priority in both cases."""

    UNIT = "unit"
    """Settings of the unit: default policy, nice 0, any core. Hostile clients have the same settings."""
    REAL_TIME = "real-time"
    """Real-time priority on its own core, hostile clients at nice 10 on the other cores: measures only the daemon."""

    @property
    def daemon_cores(self) -> set[int]:
        return set(CORES) if self is Scheduling.UNIT else SERVER_CORE

    @property
    def hostile_cores(self) -> set[int]:
        return set(CORES) if self is Scheduling.UNIT else REST_CORES

    @property
    def hostile_nice(self) -> int:
        return 0 if self is Scheduling.UNIT else 10


def before_others(pid: int) -> bool:
    """Give a process priority over unrelated processes of the host. Return whether the kernel permits it."""
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            os.sched_setscheduler(int(task.name), os.SCHED_RR, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    return True


class IdlePort:
    def __init__(self, path: Path) -> None:
        self.path = path
        self._fds: tuple[int, int] = (-1, -1)
        self.plug()

    def plug(self) -> None:
        self._fds = pty.openpty()
        tty.setraw(self._fds[1])
        self.path.symlink_to(os.ttyname(self._fds[1]))

    def unplug(self) -> None:
        self.path.unlink()
        for fd in self._fds:
            os.close(fd)


class LogPipe:
    """The standard error of the daemon: a pipe. An attack decides whether it is read."""

    def __init__(self) -> None:
        self._reader, self.writer = os.pipe()
        fcntl.fcntl(self.writer, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._reads = threading.Event()
        self._reads.set()
        self._thread = threading.Thread(target=self._pass_on, daemon=True)
        self.spoilt = 0
        """Number of lines that report a rejected configuration."""

    @property
    def waiting_bytes(self) -> int:
        size = fcntl.ioctl(self._reader, termios.FIONREAD, bytes(4))
        return int.from_bytes(size, sys.byteorder)

    def stop_reading(self) -> None:
        self._reads.clear()
        # the daemon's descriptor is blocking
        writer = os.open(f"/proc/self/fd/{self.writer}", os.O_WRONLY | os.O_NONBLOCK)
        try:
            end_s = monotonic() + FILL_S  # the reader processes its last data in one turn
            while monotonic() < end_s:
                with suppress(BlockingIOError):
                    os.write(writer, LOG_FILLER + b"\n")
                    continue
                sleep(0.01)
        finally:
            os.close(writer)

    def read_on(self) -> None:
        self._reads.set()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.read_on()
        os.close(self.writer)
        self._thread.join()
        os.close(self._reader)

    def _pass_on(self) -> None:
        rest = b""
        while data := os.read(self._reader, 65536):
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                self.spoilt += LOG_SPOILT in line
                if not any(expected in line for expected in LOG_EXPECTED):
                    print(line.decode(errors="backslashreplace"), file=sys.stderr, flush=True)
            self._reads.wait()


class Daemon(Process):
    def __init__(self, cores: set[int], file: Path, log: LogPipe) -> None:
        self.popen = subprocess.Popen(
            [sys.executable, "-m", "imud", "run", "-c", str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=log.writer, text=True, cwd=Path(__file__).parents[2],
        )  # fmt: skip
        os.sched_setaffinity(self.popen.pid, cores)


class AttackedDaemon:
    """A running daemon in a folder of its own. Use as a context."""

    def __init__(self, seconds: float, scheduling: Scheduling) -> None:
        self._seconds = seconds
        self._stack = ExitStack()
        self.scheduling = scheduling
        self.undisturbed = True
        """Whether device, good client and a real-time daemon have priority over other programs."""
        self.metrics_port = free_port()
        self.log = LogPipe()

    def __enter__(self) -> Self:
        raise_descriptors()
        try:
            self._start(self._stack)
        except BaseException:  # end all started processes
            self._stack.close()
            raise
        return self

    def _start(self, stack: ExitStack) -> None:
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-attack-")))
        self.folder.chmod(0o755)
        self.socket, self.rings, self._file = self.folder / "s", self.folder / "shm", self.folder / "imud.yaml"
        self.rings.mkdir(0o755)
        self._writer = self._start_device(stack)
        self.idle = [IdlePort(self.folder / f"port{number}") for number in range(1, 1 + IDLE_DEVICES)]
        self._ports = [self._writer.line(), *(str(port.path) for port in self.idle)]
        self._configure(self._ports)
        stack.enter_context(self.log)
        self._daemon = stack.enter_context(Daemon(self.scheduling.daemon_cores, self._file, self.log))
        wait_for(self.socket)
        self._writer.say("go")
        user = [str(GOOD_UID), str(READ_GID)] if os.geteuid() == 0 else []
        self.good = stack.enter_context(Process(REST_CORES, "-m", "tests.attack.good_client", str(self.socket), *user))
        self.good.line()
        preferred = [self._writer, self.good]
        if self.scheduling is Scheduling.REAL_TIME:
            preferred.append(self._daemon)
        for process in preferred:
            self.undisturbed = self.undisturbed and before_others(process.popen.pid)
        sleep(SETTLE_S)
        self.figures()

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def pid(self) -> int:
        return self._daemon.popen.pid

    @property
    def alive(self) -> bool:
        return self._daemon.popen.poll() is None

    @property
    def rss_mb(self) -> float:
        return rss_mb(self.pid)

    @property
    def fds(self) -> int:
        return len(os.listdir(f"/proc/{self.pid}/fd"))

    @property
    def cpu_ns(self) -> int:
        return cpu_ns(self.pid)

    def figures(self) -> dict[str, Any]:
        self.good.say("report")
        found = json.loads(self.good.line())
        assert isinstance(found, dict)
        return found

    @property
    def port_refused(self) -> int:
        return int.from_bytes((self.folder / "refused").read_bytes(), sys.byteorder)

    def losses(self) -> tuple[int, int]:
        """Return the lost samples of the 1 kHz device in the ledger, and the number of gaps of unknown size."""
        with Client(str(self.socket)) as client:
            ledger = next(found for found in statuses(client) if found.name == "d0").ledger
        return lost(ledger), ledger["lost_unknown"]

    def fds_above(self, before: int, limit: int) -> int:
        """Return the number of open descriptors above `before`, after it is at most `limit` or after a timeout."""
        end_s = monotonic() + QUIET_LIMIT_S
        while (above := self.fds - before) > limit and monotonic() < end_s:
            sleep(0.05)
        return above

    def signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def spoil_configuration(self) -> None:
        """Write a configuration that a reload rejects for many reasons. `change` repairs it."""
        self._file.write_bytes(msgspec.json.encode({f"no-such-key-{number}": 1 for number in range(PROBLEMS)}))

    def change(self, *, devices: int = 0, slots: int = SLOTS) -> None:
        """Reload with this number of additional idle devices and with rings of this size. Wait for the devices."""
        for number in range(len(self._ports) - 1 - IDLE_DEVICES, devices):
            port = IdlePort(self.folder / f"more{number}")
            self._ports.append(str(port.path))
        self._configure(self._ports[: 1 + IDLE_DEVICES + devices], slots)
        self.signal(signal.SIGHUP)
        end_s = monotonic() + REPLUG_LIMIT_S
        while monotonic() < end_s:
            with Client(str(self.socket)) as client:
                if len(statuses(client)) == 1 + IDLE_DEVICES + devices:
                    return
            sleep(0.05)
        raise TimeoutError(f"expected {devices} more devices within {REPLUG_LIMIT_S:g} s after the reload")

    def status(self) -> dict[str, Any]:
        with Client(str(self.socket)) as client:
            found = client.call("status")["socket"]
        assert isinstance(found, dict)
        return found

    def replug(self) -> bool:
        port = self.idle[0]
        port.unplug()
        gone = self._reaches("d1", "missing")
        port.plug()
        return gone and self._reaches("d1", "searching")

    def _reaches(self, device: str, state: str) -> bool:
        end_s = monotonic() + REPLUG_LIMIT_S
        with Client(str(self.socket)) as client:
            while monotonic() < end_s:
                if any(found.name == device and found.state == state for found in statuses(client)):
                    return True
                sleep(0.05)
        return False

    def _start_device(self, stack: ExitStack) -> Process:
        frames = int(self._seconds * RATE_HZ)
        (self.folder / "times").write_bytes(bytes(8 * frames))
        (self.folder / "refused").write_bytes(bytes(8))
        return stack.enter_context(
            Process(
                REST_CORES, "-m", "tests.bench.writer", "--rate", str(RATE_HZ), "--frames", str(frames),
                "--times", str(self.folder / "times"), "--refused", str(self.folder / "refused"),
            )
        )  # fmt: skip

    def _configure(self, ports: list[str], slots: int = SLOTS) -> None:
        devices = {
            f"d{number}": {"driver": "hipnuc-uart", "identify": False, "uart": {"port": path, "baud": 921600}}
            for number, path in enumerate(ports)
        }
        groups = {"group": grp.getgrgid(READ_GID).gr_name, "control_group": grp.getgrgid(CONTROL_GID).gr_name}
        if os.geteuid():
            groups = {"group": grp.getgrgid(os.getegid()).gr_name}
        tree = {
            "log_level": "warning", "state_dir": str(self.folder),
            "socket": {"path": str(self.socket), "clients_max": CLIENTS_MAX, **groups},
            "shm": {"directory": str(self.rings), "slots": slots, "group": groups["group"]},
            "metrics": {"port": self.metrics_port}, "devices": devices,
        }  # fmt: skip
        new = self._file.with_suffix(".new")
        new.write_bytes(msgspec.json.encode(tree))  # each JSON text is a YAML text
        new.replace(self._file)


def raise_descriptors() -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(FDS_MAX, hard), hard))
