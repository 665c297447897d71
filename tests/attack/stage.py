"""The daemon under attack: `imud run` with a 1 kHz device and three idle ones, and a well-behaved client."""

import grp
import json
import os
import pty
import tempfile
import tty
from contextlib import ExitStack
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Self

import msgspec

from imud.cli.arguments import statuses
from imud.client import Client
from tests.bench.rig import REST_CORES, SERVER_CORE, Process, cpu_ns, rss_mb, wait_for

HOSTILE_UIDS = (65_534, 65_533)
READ_GID, CONTROL_GID = 65_534, 1
RATE_HZ = 1000
PRIORITY = 10
"""Real-time; above that of programs that ask for the least, with which it would take turns of 100 ms."""
SETTLE_S = 3.0
"""The clock's first fits, and caches."""
IDLE_DEVICES = 3
REPLUG_LIMIT_S = 5.0
CLIENTS_MAX = 320
"""Room for 256 hostile clients beside the reserved places."""


def before_others(pid: int) -> bool:
    """Let a process run before those of the machine that have nothing to do with this, real-time; whether it may be."""
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            os.sched_setscheduler(int(task.name), os.SCHED_RR, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    return True


class IdlePort:
    """A port that a device has and that can be unplugged: a link to a pseudo-terminal."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fds: tuple[int, int] = (-1, -1)
        self.plug()

    def plug(self) -> None:
        """Make the port."""
        self._fds = pty.openpty()
        tty.setraw(self._fds[1])
        self.path.symlink_to(os.ttyname(self._fds[1]))

    def unplug(self) -> None:
        """Take it away."""
        self.path.unlink()
        for fd in self._fds:
            os.close(fd)


class AttackedDaemon:
    """A running daemon in a folder of its own. Use as a context."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._stack = ExitStack()
        self.undisturbed = True
        """Whether daemon, device and good client run before other programs of the machine, hostile clients included."""

    def __enter__(self) -> Self:
        stack = self._stack
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-attack-")))
        self.folder.chmod(0o755)
        self.socket = self.folder / "s"
        frames = int(self._seconds * RATE_HZ)
        (self.folder / "times").write_bytes(bytes(8 * frames))
        self._writer = stack.enter_context(
            Process(
                REST_CORES, "-m", "tests.bench.writer", "--rate", str(RATE_HZ), "--frames", str(frames),
                "--times", str(self.folder / "times"),
            )
        )  # fmt: skip
        self.idle = [IdlePort(self.folder / f"port{number}") for number in range(1, 1 + IDLE_DEVICES)]
        file = self._configure(self._writer.line())
        self._daemon = stack.enter_context(Process(SERVER_CORE, "-m", "imud", "run", "-c", str(file)))
        wait_for(self.socket)
        self._writer.say("go")
        self.good = stack.enter_context(Process(REST_CORES, "-m", "tests.attack.good_client", str(self.socket)))
        self.good.line()
        for process in (self._writer, self._daemon, self.good):
            self.undisturbed = self.undisturbed and before_others(process.popen.pid)
        sleep(SETTLE_S)
        self.figures()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def pid(self) -> int:
        """The daemon's process."""
        return self._daemon.popen.pid

    @property
    def alive(self) -> bool:
        """Whether the daemon runs."""
        return self._daemon.popen.poll() is None

    @property
    def rss_mb(self) -> float:
        """The daemon's resident memory."""
        return rss_mb(self.pid)

    @property
    def fds(self) -> int:
        """The daemon's open descriptors."""
        return len(os.listdir(f"/proc/{self.pid}/fd"))

    @property
    def cpu_ns(self) -> int:
        """CPU time of the daemon so far."""
        return cpu_ns(self.pid)

    def figures(self) -> dict[str, Any]:
        """What the good client saw since the last call."""
        self.good.say("report")
        found = json.loads(self.good.line())
        assert isinstance(found, dict)
        return found

    def status(self) -> dict[str, Any]:
        """The state of the socket."""
        with Client(str(self.socket)) as client:
            found = client.call("status")["socket"]
        assert isinstance(found, dict)
        return found

    def replug(self) -> bool:
        """Unplug an idle device and plug it in again; whether the daemon opens it."""
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

    def _configure(self, port: str) -> Path:
        paths = [port, *(str(port.path) for port in self.idle)]
        devices = {
            f"d{number}": {"driver": "hipnuc-uart", "identify": False, "uart": {"port": path, "baud": 921600}}
            for number, path in enumerate(paths)
        }
        groups = {"group": grp.getgrgid(READ_GID).gr_name, "control_group": grp.getgrgid(CONTROL_GID).gr_name}
        if os.geteuid():
            groups = {"group": grp.getgrgid(os.getegid()).gr_name}
        tree = {
            "log_level": "warning",
            "state_dir": str(self.folder),
            "socket": {"path": str(self.socket), "clients_max": CLIENTS_MAX, **groups},
            "shm": {"directory": str(self.folder)},
            "metrics": {"port": 0},
            "devices": devices,
        }
        file = self.folder / "imud.yaml"
        file.write_bytes(msgspec.json.encode(tree))  # JSON is YAML
        return file
