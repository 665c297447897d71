"""Surroundings of a test: hostile processes, ports for servers, and simulated hosts for `imud doctor`.

A daemon must withstand processes of other users, which only root can start, and pipes without a reader.
"""

import os
import select
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import takewhile
from pathlib import Path
from random import SystemRandom
from typing import Final

import pytest

from imud.cli.doctor.surroundings import CommandOutput, DaemonReply, DoctorCheck, DoctorFinding, Surroundings
from imud.config.host_values import HostFinding
from imud.contracts.status import CKernelStatus, DeviceStatus
from imud.model.errors import LinkMissing
from imud.utc.system_clock import KernelClock
from tests.support.files import ROOT

DAEMON_UID: Final = 65534
HOSTILE_UID: Final = 65533

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can run a process as another user")


BECOME: Final = """
import os
os.setgroups([])
os.setgid({uid})
os.setuid({uid})
"""


@contextmanager
def python_as(uid: int, program: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run a Python program as user `uid`, without groups. Kill it at the end.

    The program changes to this user after its imports, because the interpreter may be in a home directory of another
    user.
    """
    lines = program.strip().splitlines()
    imports = list(takewhile(lambda line: not line or line.startswith(("import ", "from ")), lines))
    text = "\n".join((*imports, BECOME.format(uid=uid), *lines[len(imports) :]))
    command = [sys.executable, "-X", "dev", "-c", text, *arguments]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def pipe(*, full: bool = False) -> Iterator[tuple[int, int]]:
    """Yield both ends of a pipe, the reading end first. `full` fills the pipe. The caller may close the ends."""
    reader, writer = os.pipe()
    if full:
        os.set_blocking(writer, False)
        with suppress(BlockingIOError):
            while True:
                os.write(writer, b"-" * 4096)
        os.set_blocking(writer, True)
    try:
        yield reader, writer
    finally:
        for descriptor in (reader, writer):
            with suppress(OSError):
                os.close(descriptor)


def read_until(descriptor: int, end: bytes) -> bytes:
    data = b""
    while end not in data:
        assert select.select([descriptor], [], [], 60)[0], data[-200:]
        data += os.read(descriptor, 65536)
    return data


LOWEST_PORT: Final = 15000  # Lowest port of a test. Usual ports of servers, for example 1883, 2947 and 9090, are lower.
PORT_TRIES_MAX: Final = 100  # attempts to find an unused port


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """Return an unused port of 127.0.0.1 for a server of a test.

    The port is below `net.ipv4.ip_local_port_range`. The kernel may assign a port of that range to any connection
    before the server uses it, and a client could connect to itself (RFC 9293, section 3.5). The port is random, so that
    parallel tests use different ports.
    """
    above = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    assert above > LOWEST_PORT + PORT_TRIES_MAX, "net.ipv4.ip_local_port_range leaves no ports for servers"
    for _ in range(PORT_TRIES_MAX):
        port = SystemRandom().randrange(LOWEST_PORT, above)
        with socket.socket(socket.AF_INET, kind) as one, suppress(OSError):
            one.bind(("127.0.0.1", port))
            return port
    raise AssertionError(f"no free port in {PORT_TRIES_MAX} tries")


class Machine:
    """A simulated host: a file tree, the output of commands, the state of a daemon."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.outputs: dict[str, CommandOutput | OSError] = {}
        self.status: list[DeviceStatus] | Exception = LinkMissing("no daemon at /run/imud/imud.sock")
        self.pages: dict[tuple[str, int, str], str] = {}
        self.c_kernel: CKernelStatus | None = CKernelStatus(True)
        self.clock = KernelClock(True, 50, 1000)
        self.sync_s: list[float] = []  # times of the next writes
        self.host_findings: list[HostFinding] = []
        self.uid = 1000
        self.gids: frozenset[int] = frozenset({1000})
        self.boot_utc_ns = 0
        self.on_pause: Callable[[], None] = lambda: None
        self.paused_s = 0.0

    def write(self, path: str, text: str = "") -> Path:
        file = self.root / path.lstrip("/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        return file

    def configure(self, *devices: str, more: str = "") -> None:
        """Write the configuration with devices as YAML flow mappings: `bow: {driver: …}`."""
        lines = ["devices:" if devices else "devices: {}", *(f"  {device}" for device in devices)]
        self.write("/etc/imud.yaml", more + "\n".join(lines) + "\n")

    def port(self, name: str, *, gid: int = 20, mode: int = 0o660) -> Path:
        """Make a serial port with hardware. Its group is `gid` if the test may set it."""
        self.write(f"/sys/class/tty/{name}/device/uevent")
        node = self.write(f"/dev/{name}")
        node.chmod(mode)
        return node

    def hold(self, name: str, program: str, pid: int = 10, command: str = "") -> None:
        """Make a process that has a port open. `command` is its command line, with spaces between the arguments."""
        self.write(f"/proc/{pid}/comm", program + "\n")
        self.write(f"/proc/{pid}/cmdline", (command or program).replace(" ", "\0"))
        self.write(f"/proc/{pid}/fd/0")
        (self.root / f"proc/{pid}/fd/3").symlink_to((self.root / "dev" / name).resolve())

    def unit(self, *lines: str) -> None:
        """Set the output of `systemctl show` for an existing unit."""
        self.outputs["systemctl show"] = CommandOutput(0, "\n".join(("LoadState=loaded", *lines)), "")

    def prints(self, command: str, text: str, status: int = 0, complaint: str = "") -> None:
        self.outputs[command] = CommandOutput(status, text, complaint)

    def run(self, words: Sequence[str]) -> CommandOutput:
        line = " ".join(words)
        for begin, output in self.outputs.items():
            if line.startswith(begin):
                if isinstance(output, OSError):
                    raise output
                return output
        raise FileNotFoundError(2, "No such file or directory", words[0])

    def fetch(self, address: str, port: int, path: str) -> str:
        if (address, port, path) not in self.pages:
            raise ConnectionRefusedError(111, "Connection refused")
        return self.pages[address, port, path]

    def ask(self) -> DaemonReply:
        if isinstance(self.status, Exception):
            raise self.status
        return DaemonReply(self.status, self.c_kernel)

    def pause(self, seconds: float) -> None:
        self.paused_s += seconds
        self.on_pause()

    def surroundings(self) -> Surroundings:
        times_s = iter(self.sync_s)
        return Surroundings(
            Path("/etc/imud.yaml"), self.ask, root=self.root, run=self.run, fetch=self.fetch,
            clock=lambda: self.clock, sync_s=lambda _folder: next(times_s), uid=self.uid, gids=self.gids,
            boot_utc_ns=lambda: self.boot_utc_ns, pause=self.pause, host_findings=lambda _config: self.host_findings,
        )  # fmt: skip

    def find(self, check: DoctorCheck) -> list[DoctorFinding]:
        return list(check.run(self.surroundings()))

    def told(self, check: DoctorCheck) -> list[tuple[str, str]]:
        return [(str(finding.severity), f"{finding.seen} → {finding.advice}") for finding in self.find(check)]

    def tells(self, check: DoctorCheck, severity: str, *words: str) -> None:
        """Assert that a check has one finding, with this severity and these words in any case."""
        ((got, text),) = self.told(check)
        assert got == severity, text
        for word in words:
            assert word.lower() in text.lower()
