"""Input of the checks of `imud doctor`: files, output of commands, status of the daemon, clocks.

The checks change nothing, except for a small temporary file that measures the speed of the storage. They open no serial
port: opening a port raises DTR, which resets some boards, and blocks the port for the daemon.
"""

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import StrEnum
from functools import cached_property
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from imud import config
from imud.client.connection import Client
from imud.config import host_values
from imud.config.host_values import Host, HostFinding
from imud.config.model import Config, DeviceConfig
from imud.contracts.status import CKernelStatus, DeviceStatus
from imud.host.files import read_regular
from imud.model.errors import ConfigError, ImudError, LinkMissing
from imud.model.units import NS_PER_S
from imud.utc.system_clock import KernelClock, kernel_clock

COMMAND_S: Final = 5.0  # Time limit of a command, s. Each command usually ends in less than 1 s.
# Folders of system commands. The PATH of some users and services does not contain them.
SYSTEM_PATH: Final = "/usr/sbin:/usr/bin:/sbin:/bin"
OUTPUT_CHARACTERS_MAX: Final = 1 << 20  # maximum length of the used end of a command's output, characters
TEXT_BYTES_MAX: Final = 65536  # maximum length of the used start of a file, bytes
FETCH_S: Final = 3.0
FETCH_BYTES_MAX: Final = 65536
SYNC_BYTES: Final = 4096  # size of the file that measures the storage, bytes: one block of a file system
UNIT: Final = "imud.service"


class CommandOutput(NamedTuple):
    """Output of a command."""

    status: int  # exit status
    text: str  # standard output
    complaint: str  # last line of standard error


# Runs a command. Raises FileNotFoundError if it is not installed, TimeoutError if it takes too long.
Run = Callable[[Sequence[str]], CommandOutput]
# Requests address, port and path by HTTP. Returns the body of a reply with status 200. Raises OSError.
Fetch = Callable[[str, int, str], str]


class DaemonReply(NamedTuple):
    """Part of the reply to `status` that the checks use."""

    devices: list[DeviceStatus]
    c_kernel: CKernelStatus | None = None  # None: the daemon is of an older version


def host_findings_now(config: Config) -> Iterator[HostFinding]:
    """Yield the values of a configuration that do not fit this host now."""
    return host_values.findings(config, Host(time.time()))


class Surroundings:
    """The host, or a simulated host of a test. Slow requests run once. Synchronization: one thread."""

    def __init__(
        self,
        config_file: Path,
        ask: Callable[[], DaemonReply],
        *,
        root: Path = Path("/"),
        run: Run | None = None,
        fetch: Fetch | None = None,
        clock: Callable[[], KernelClock] = kernel_clock,
        sync_s: Callable[[Path], float] | None = None,
        uid: int | None = None,
        gids: frozenset[int] | None = None,
        boot_utc_ns: Callable[[], int] = lambda: time.time_ns() - time.monotonic_ns(),
        pause: Callable[[float], None] = time.sleep,
        host_findings: Callable[[Config], Iterable[HostFinding]] | None = None,
    ) -> None:
        """`ask` returns the reply of the daemon; it raises ImudError or TimeoutError if the daemon does not reply.

        `sync_s` measures the time of a write to a folder, s. `boot_utc_ns` returns UTC when CLOCK_MONOTONIC was 0.
        `pause` waits for a time in seconds. `host_findings` returns the values that do not fit the host.
        """
        self.config_file = config_file
        self.root = root
        self.run = run or run_command
        self.fetch = fetch or fetch_over_http
        self.kernel_clock = clock
        self.sync_s = sync_s or measure_sync_s
        self.uid = os.geteuid() if uid is None else uid
        self.gids = frozenset({*os.getgroups(), os.getegid()}) if gids is None else gids
        self.boot_utc_ns = boot_utc_ns
        self.pause = pause
        self.host_findings = host_findings or host_findings_now
        self._ask = ask

    # --- files --------------------------------------------------------------------------------------------------------

    def at(self, path: str | Path) -> Path:
        """Return an absolute path below the root."""
        return self.root / str(path).lstrip("/")

    def outside(self, path: str | Path) -> str:
        """Return a path below the root without the root."""
        return str(path).removeprefix(str(self.root).rstrip("/"))

    def text(self, path: str | Path) -> str | None:
        """Return the content of a file without surrounding white space; None if imud cannot read the file."""
        try:
            # texts of the device tree end with NUL
            return read_regular(self.at(path), TEXT_BYTES_MAX).decode("utf-8", "replace").strip(" \n\t\0")
        except OSError:
            return None

    # --- configuration ------------------------------------------------------------------------------------------------

    @cached_property
    def _loaded(self) -> tuple[Config | None, str]:
        try:
            return config.load(self.at(self.config_file), missing="name the file with --config"), ""
        except ConfigError as error:
            return None, str(error)

    @property
    def config(self) -> Config | None:
        """Configuration; None if it is invalid."""
        return self._loaded[0]

    @property
    def config_problem(self) -> str:
        """Problems of the configuration, one per line."""
        return self._loaded[1]

    def devices(self, link: str) -> list[DeviceConfig]:
        """Return the configured devices with this kind of link."""
        return [device for device in self.config.devices if device.link == link] if self.config else []

    # --- the daemon ---------------------------------------------------------------------------------------------------

    @cached_property
    def _answer(self) -> tuple[DaemonReply | None, Exception | None]:
        try:
            return self._ask(), None
        except (ImudError, TimeoutError, msgspec.ValidationError) as error:
            return None, error

    def status_now(self) -> list[DeviceStatus]:
        """Request the status of all devices again. Raises ImudError, TimeoutError, msgspec.ValidationError."""
        return self._ask().devices

    @property
    def status(self) -> list[DeviceStatus] | None:
        """Status of all devices; None if the daemon does not reply."""
        reply = self._answer[0]
        return None if reply is None else reply.devices

    @property
    def c_kernel(self) -> CKernelStatus | None:
        """Use of the kernel in C by the daemon; None if it is unknown."""
        reply = self._answer[0]
        return None if reply is None else reply.c_kernel

    @property
    def status_error(self) -> Exception | None:
        """Reason why the status is unknown."""
        return self._answer[1]

    @property
    def daemon_down(self) -> bool:
        """Whether no daemon runs. False if a daemon runs but refuses this user."""
        return isinstance(self.status_error, LinkMissing)

    def status_of(self, name: str) -> DeviceStatus | None:
        """Return the status of one device; None if it is unknown."""
        return next((status for status in self.status or () if status.name == name), None)

    @cached_property
    def unit(self) -> dict[str, list[str]]:
        """Properties of imud.service; empty without systemd. A property can have several values."""
        try:
            output = self.run(["systemctl", "show", UNIT])
        except OSError:
            return {}
        found: dict[str, list[str]] = {}
        # the output has one line NAME=VALUE per property
        for line in output.text.splitlines() if output.status == 0 else ():
            name, _, value = line.partition("=")
            found.setdefault(name, []).append(value)
        return found

    def unit_value(self, name: str) -> str:
        """Return the first value of a property of imud.service; empty if it is unknown."""
        return next(iter(self.unit.get(name, [])), "")

    @property
    def installed(self) -> bool:
        """Whether systemd knows imud.service."""
        return self.unit_value("LoadState") == "loaded"


def run_command(words: Sequence[str], limit_s: float | None = None) -> CommandOutput:
    """Run a command with the C locale. `limit_s`: time limit, default COMMAND_S.

    Raises FileNotFoundError, TimeoutError, OSError.
    """
    limit_s = COMMAND_S if limit_s is None else limit_s
    path = f"{os.environ.get('PATH', '')}:{SYSTEM_PATH}"
    try:
        done = subprocess.run(
            list(words), stdin=subprocess.DEVNULL, capture_output=True, timeout=limit_s, check=False,
            # the checks parse English output without colours
            env=os.environ | {"LC_ALL": "C", "SYSTEMD_COLORS": "0", "PATH": path},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise TimeoutError(f"the command {words[0]} did not end within {limit_s:g} s") from None
    text = done.stdout.decode("utf-8", "replace")[-OUTPUT_CHARACTERS_MAX:]
    complaint = done.stderr.decode("utf-8", "replace").strip().splitlines()
    return CommandOutput(done.returncode, text, complaint[-1] if complaint else "")


def fetch_over_http(address: str, port: int, path: str) -> str:
    """Request a page by HTTP. Return the body. Raises OSError."""
    connection = HTTPConnection(address, port, timeout=FETCH_S)
    try:
        connection.request("GET", path)
        response = connection.getresponse()
        body = response.read(FETCH_BYTES_MAX)
    except HTTPException as error:
        raise OSError(f"{type(error).__name__}: the program at this port is not an HTTP server") from error
    finally:
        connection.close()
    if response.status != 200:
        raise OSError(f"expected HTTP status 200 for {path}, got {response.status}")
    return body.decode("utf-8", "replace")


def measure_sync_s(folder: Path) -> float:
    """Write and synchronise a small file, then remove it. Return the time, s. Raises OSError."""
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".imud-doctor-") as file:
        begin_ns = time.monotonic_ns()
        file.write(bytes(SYNC_BYTES))
        file.flush()
        # without fsync, the write would end in the page cache
        os.fsync(file.fileno())
        return (time.monotonic_ns() - begin_ns) / NS_PER_S


def ask_daemon(socket: str) -> DaemonReply:
    """Request the status of the daemon. Raises ImudError, TimeoutError, msgspec.ValidationError."""
    with Client(socket) as client:
        reply = client.status()
    return msgspec.convert((reply["devices"], reply.get("c_kernel")), DaemonReply)


def file_of_daemon(socket: str) -> Path | None:
    """Return the configuration file of the running daemon; None if the daemon does not reply or has no file."""
    try:
        with Client(socket) as client:
            return Path(found) if (found := str(client.status().get("configuration", ""))) else None
    except (ImudError, OSError, msgspec.ValidationError):  # TimeoutError is an OSError
        return None


class Severity(StrEnum):
    """Severity of a finding."""

    OK = "ok"  # no problem
    NOTE = "note"  # information, not a problem
    WARNING = "warning"  # imud works, but with a disadvantage
    ERROR = "error"  # A device or an output does not work
    NOT_CHECKED = "not checked"  # the check could not run; `seen` is the reason


class DoctorFinding(msgspec.Struct, frozen=True):
    """One result of a check."""

    severity: Severity
    seen: str  # observation, with the name of the device, port or interface
    advice: str = ""  # next step; empty if no step is needed


Findings = Iterator[DoctorFinding]


class DoctorCheck(NamedTuple):
    """One row of the list of checks."""

    name: str  # unique short name, also in `--json`
    # Yields the findings; none if the configuration does not use the checked part. Raises OSError, ValueError and
    # ImudError if the check cannot run.
    run: Callable[[Surroundings], Findings]


def ok(seen: str) -> DoctorFinding:
    return DoctorFinding(Severity.OK, seen)


def note(seen: str, advice: str = "") -> DoctorFinding:
    return DoctorFinding(Severity.NOTE, seen, advice)


def warning(seen: str, advice: str) -> DoctorFinding:
    return DoctorFinding(Severity.WARNING, seen, advice)


def error(seen: str, advice: str) -> DoctorFinding:
    return DoctorFinding(Severity.ERROR, seen, advice)


def not_checked(reason: str, advice: str = "") -> DoctorFinding:
    return DoctorFinding(Severity.NOT_CHECKED, reason, advice)
