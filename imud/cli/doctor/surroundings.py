"""What the checks of `imud doctor` look at: files below one root, the output of commands, the daemon, the clocks.

Nothing here changes anything, but for the file of a few bytes by which the speed of the storage is measured. No serial
port is opened: that raises DTR, which resets some boards, and takes the port from the daemon for a moment.
"""

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from functools import cached_property
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from imud import config
from imud.cli.arguments import statuses
from imud.client.connection import Client
from imud.config.model import Config, DeviceConfig
from imud.contracts.status import DeviceStatus
from imud.model.errors import ConfigError, ImudError, LinkMissing
from imud.model.units import NS_PER_S
from imud.utc.system_clock import KernelClock, kernel_clock

COMMAND_S: Final = 5.0
"""Limit of the time that a command may take; each answers within a fraction of a second."""
SYSTEM_PATH: Final = "/usr/sbin:/usr/bin:/sbin:/bin"
"""Where commands of the system are, for users and services that have no such path."""
OUTPUT_CHARACTERS_MAX: Final = 1 << 20
"""Of a command's output that are looked at, from its end."""
TEXT_BYTES_MAX: Final = 65536
"""Of a file that are looked at."""
FETCH_S: Final = 3.0
FETCH_BYTES_MAX: Final = 65536
SYNC_BYTES: Final = 4096
"""Size of the file that is written and synchronised: a block of a file system."""
UNIT: Final = "imud.service"


class CommandOutput(NamedTuple):
    """What a command that ended wrote."""

    status: int
    """Exit status."""
    text: str
    """Standard output."""
    complaint: str
    """Standard error, its last line."""


Run = Callable[[Sequence[str]], CommandOutput]
"""Runs a command. Raises FileNotFoundError where it is not installed, TimeoutError where it takes too long."""
Fetch = Callable[[str, int, str], str]
"""Reads address, port, path by HTTP; returns the body of status 200. Raises OSError."""


class Surroundings:
    """This machine, or a test's. Everything that costs time is asked once. Synchronization: one thread."""

    def __init__(
        self,
        config_file: Path,
        ask: Callable[[], list[DeviceStatus]],
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
    ) -> None:
        """`ask` returns the status of the daemon's devices, and raises ImudError or TimeoutError where it has none.

        `sync_s` measures the time of writing to a folder; `boot_utc_ns` is UTC at zero of CLOCK_MONOTONIC;
        `pause` waits so many seconds.
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
        self._ask = ask

    # --- files --------------------------------------------------------------------------------------------------------

    def at(self, path: str | Path) -> Path:
        """Return where an absolute path lies below the root."""
        return self.root / str(path).lstrip("/")

    def outside(self, path: str | Path) -> str:
        """Return a path below the root as it is without one."""
        return str(path).removeprefix(str(self.root).rstrip("/"))

    def text(self, path: str | Path) -> str | None:
        """Return the content of a file without blanks around it; None where it cannot be read."""
        try:
            with self.at(path).open("rb") as file:
                return file.read(TEXT_BYTES_MAX).decode("utf-8", "replace").strip(" \n\t\0")
        except OSError:
            return None

    # --- configuration ------------------------------------------------------------------------------------------------

    @cached_property
    def _loaded(self) -> tuple[Config | None, str]:
        try:
            return config.load(self.at(self.config_file), missing="give the file with --config"), ""
        except ConfigError as error:
            return None, str(error)

    @property
    def config(self) -> Config | None:
        """The configuration; None where it cannot be used."""
        return self._loaded[0]

    @property
    def config_problem(self) -> str:
        """Why it cannot be used, a line per problem."""
        return self._loaded[1]

    def devices(self, link: str) -> list[DeviceConfig]:
        """Return the configured devices on links of this kind."""
        return [device for device in self.config.devices if device.link == link] if self.config else []

    # --- the daemon ---------------------------------------------------------------------------------------------------

    @cached_property
    def _answer(self) -> tuple[list[DeviceStatus] | None, Exception | None]:
        try:
            return self._ask(), None
        except (ImudError, TimeoutError, msgspec.ValidationError) as error:
            return None, error

    def status_now(self) -> list[DeviceStatus]:
        """Ask the daemon for the status of every device. Raises ImudError, TimeoutError, msgspec.ValidationError."""
        return self._ask()

    @property
    def status(self) -> list[DeviceStatus] | None:
        """Status of every device; None where the daemon does not answer."""
        return self._answer[0]

    @property
    def status_error(self) -> Exception | None:
        """Why there is no status."""
        return self._answer[1]

    @property
    def daemon_down(self) -> bool:
        """Whether there is no daemon at the socket, rather than one that may not be asked."""
        return isinstance(self.status_error, LinkMissing)

    def status_of(self, name: str) -> DeviceStatus | None:
        """Return the status of one device."""
        return next((status for status in self.status or () if status.name == name), None)

    @cached_property
    def unit(self) -> dict[str, list[str]]:
        """Properties of imud.service; empty where there is no systemd. A property may have several values."""
        try:
            output = self.run(["systemctl", "show", UNIT])
        except OSError:
            return {}
        found: dict[str, list[str]] = {}
        for line in output.text.splitlines() if output.status == 0 else ():
            name, _, value = line.partition("=")
            found.setdefault(name, []).append(value)
        return found

    def unit_value(self, name: str) -> str:
        """Return one property of imud.service; empty where it is not known."""
        return next(iter(self.unit.get(name, [])), "")

    @property
    def installed(self) -> bool:
        """Whether systemd knows imud.service."""
        return self.unit_value("LoadState") == "loaded"


def run_command(words: Sequence[str], limit_s: float | None = None) -> CommandOutput:
    """Run a command with the C locale, for COMMAND_S or `limit_s` at most.

    Raises FileNotFoundError, TimeoutError, OSError.
    """
    limit_s = COMMAND_S if limit_s is None else limit_s
    path = f"{os.environ.get('PATH', '')}:{SYSTEM_PATH}"
    try:
        done = subprocess.run(
            list(words), stdin=subprocess.DEVNULL, capture_output=True, timeout=limit_s, check=False,
            env=os.environ | {"LC_ALL": "C", "SYSTEMD_COLORS": "0", "PATH": path},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise TimeoutError(f"{words[0]} did not end within {limit_s:g} s") from None
    text = done.stdout.decode("utf-8", "replace")[-OUTPUT_CHARACTERS_MAX:]
    complaint = done.stderr.decode("utf-8", "replace").strip().splitlines()
    return CommandOutput(done.returncode, text, complaint[-1] if complaint else "")


def fetch_over_http(address: str, port: int, path: str) -> str:
    """Read a page by HTTP. Raises OSError."""
    connection = HTTPConnection(address, port, timeout=FETCH_S)
    try:
        connection.request("GET", path)
        response = connection.getresponse()
        body = response.read(FETCH_BYTES_MAX)
    except HTTPException as error:
        raise OSError(f"{type(error).__name__}: no HTTP server answers there") from error
    finally:
        connection.close()
    if response.status != 200:
        raise OSError(f"expected HTTP status 200 for {path}, got {response.status}")
    return body.decode("utf-8", "replace")


def measure_sync_s(folder: Path) -> float:
    """Write a small file, wait until it is on the medium, remove it; return the time, s. Raises OSError."""
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".imud-doctor-") as file:
        begin_ns = time.monotonic_ns()
        file.write(bytes(SYNC_BYTES))
        file.flush()
        os.fsync(file.fileno())
        return (time.monotonic_ns() - begin_ns) / NS_PER_S


def ask_daemon(socket: str) -> list[DeviceStatus]:
    """Ask the daemon for the status of every device. Raises ImudError, TimeoutError, msgspec.ValidationError."""
    with Client(socket) as client:
        return statuses(client)


class Severity(StrEnum):
    """What a finding means."""

    OK = "ok"
    """Looked at, and in order."""
    NOTE = "note"
    """Nothing wrong, but good to know."""
    WARNING = "warning"
    """imud works, but not as well as it could."""
    ERROR = "error"
    """A device or an output does not work."""
    NOT_CHECKED = "not checked"
    """It could not be looked at; `seen` says why."""


class DoctorFinding(msgspec.Struct, frozen=True):
    """One thing that a check found."""

    severity: Severity
    seen: str
    """What was seen, for a person; with the device, port or interface that it is about."""
    advice: str = ""
    """What to do next; empty where there is nothing to do."""


Findings = Iterator[DoctorFinding]


class DoctorCheck(NamedTuple):
    """One row of the list of checks."""

    name: str
    """Short, unique, for people and for programs that read `--json`."""
    run: Callable[[Surroundings], Findings]
    """Yields what it found; nothing where the configuration has nothing that it is about.

    Raises OSError, ValueError and ImudError where it cannot look."""


def ok(seen: str) -> DoctorFinding:
    """Looked at, and in order."""
    return DoctorFinding(Severity.OK, seen)


def note(seen: str, advice: str = "") -> DoctorFinding:
    """Good to know."""
    return DoctorFinding(Severity.NOTE, seen, advice)


def warning(seen: str, advice: str) -> DoctorFinding:
    """Not as good as it could be."""
    return DoctorFinding(Severity.WARNING, seen, advice)


def error(seen: str, advice: str) -> DoctorFinding:
    """Something does not work."""
    return DoctorFinding(Severity.ERROR, seen, advice)


def not_checked(why: str, advice: str = "") -> DoctorFinding:
    """It could not be looked at, for this reason."""
    return DoctorFinding(Severity.NOT_CHECKED, why, advice)
