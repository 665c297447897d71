"""The guest's system for the checks: programs, units, users, the daemon's socket, the USB adapter."""

import json
import re
import socket
import subprocess
import time
from pathlib import Path
from typing import IO, Any

from tests.lab_debian.guest.checks import LIMIT_S, Failed, wait_until

SHARE = Path("/run/lab")
CONFIG = Path("/etc/imud.yaml")
EXAMPLE = Path("/run/example.yaml")
SOCKET = "/run/imud/imud.sock"
RINGS = Path("/run/imud/shm")
PYTHON = "/usr/lib/imud/bin/python3"
"""The interpreter of the package, with imud, clients and simulators."""
UNIT = "imud.service"
NODE = Path("/dev/ttyUSB0")
REQUESTS = "/dev/virtio-ports/requests"
FRESH_NS = 1_000_000_000  # maximum age of the newest sample


def run(*command: str, limit_s: float = LIMIT_S, user: str = "", text: str = "") -> subprocess.CompletedProcess[str]:
    """Run a program to its end, as `user` if given. Return both outputs as one."""
    words = ["runuser", "-u", user, "--", *command] if user else list(command)
    return subprocess.run(
        words, input=text, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=limit_s, check=False
    )


def must(*command: str, limit_s: float = LIMIT_S) -> str:
    result = run(*command, limit_s=limit_s)
    if result.returncode:
        raise Failed(f"{' '.join(command)} ended with {result.returncode}: {result.stdout.strip()[-1500:]}")
    return result.stdout


def shown(name: str, unit: str = UNIT) -> str:
    return must("systemctl", "show", "--value", "--property", name, unit).strip()


def pid() -> int:
    return int(shown("MainPID"))


def configure(text: str) -> None:
    CONFIG.write_text(text, encoding="utf-8")


def journal(since: str = "") -> str:
    """Return the messages of the service since a mark (`mark()`)."""
    must("journalctl", "--sync")
    after = ["--after-cursor", since] if since else []
    return must("journalctl", "--no-pager", "--output", "cat", "--unit", UNIT, *after)


def console() -> str:
    """Return the messages of kernel and systemd. The messages of systemd are here, not in the journal (machine.py)."""
    return (SHARE / "console.log").read_text("utf-8", "replace")


def mark() -> str:
    """Return the end of the journal, for `journal`."""
    must("journalctl", "--sync")
    last = must("journalctl", "--no-pager", "--lines", "1", "--output", "json", "--output-fields", "MESSAGE").strip()
    return str(json.loads(last)["__CURSOR"])


def ask(method: str, **params: object) -> Any:
    """Return the reply of the daemon to one request. Raises OSError without a daemon, Failed for an error."""
    with socket.socket(socket.AF_UNIX) as sock, sock.makefile("r", encoding="utf-8") as lines:
        sock.settimeout(LIMIT_S)
        sock.connect(SOCKET)
        request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        sock.sendall(json.dumps(request).encode() + b"\n")
        for line in lines:
            message = json.loads(line)
            if message.get("id") == 1:
                if "error" in message:
                    raise Failed(f"{method}: {message['error']}")
                return message["result"]
    raise Failed(f"{method}: the daemon closed the connection")


def device(name: str) -> dict[str, Any] | None:
    try:
        return next((found for found in ask("status")["devices"] if found["name"] == name), None)
    except OSError:
        return None


def streams(name: str) -> dict[str, Any] | None:
    """Return the status of the device if it runs and its newest sample is less than a second old; otherwise None."""
    found = device(name)
    if found is None or found["state"] != "running":
        return None
    try:
        newest = ask("poll", devices=[name])
    except OSError:
        return None
    fresh = any(newest["now_ns"] - sample["t_ns"] < FRESH_NS for sample in newest["samples"])
    return found if fresh else None


def wait_streaming(name: str, limit_s: float = LIMIT_S) -> dict[str, Any]:
    return wait_until(lambda: streams(name), f"samples of {name}: {(device(name) or {}).get('problem')}", limit_s)


def start_service() -> None:
    """Start the service again from any state."""
    run("systemctl", "reset-failed", UNIT)
    must("systemctl", "restart", UNIT, limit_s=400)


def ensure_running(text: str) -> None:
    """Let the service run with this configuration. An emulated start takes long, so restart only if needed."""
    if CONFIG.read_text(encoding="utf-8") != text or shown("ActiveState") != "active":
        configure(text)
        start_service()
    wait_streaming("usb")


class Host:
    def __init__(self) -> None:
        self._port: IO[bytes] = open(REQUESTS, "r+b", buffering=0)  # noqa: SIM115 - open as long as the run

    def ask(self, word: str) -> None:
        self._port.write(f"{word}\n".encode())
        reply = b""
        while not reply.endswith(b"\n"):
            reply += self._port.read(1)
        if reply != b"ok\n":
            raise Failed(f"{word}: expected ok from the lab, got {reply.decode()!r}")

    def unplug(self) -> None:
        self.ask("unplug")
        wait_until(lambda: not NODE.exists(), f"{NODE} gone")

    def plug(self) -> float:
        """Plug the adapter in. Return CLOCK_MONOTONIC when its node existed, s, within 5 ms."""
        self.ask("plug")
        give_up_s = time.monotonic() + LIMIT_S
        while not NODE.exists():
            if time.monotonic() > give_up_s:
                raise Failed(f"expected {NODE} after the adapter was plugged in")
            time.sleep(0.005)
        return time.monotonic()


def background(unit: str, *command: str, properties: tuple[str, ...] = ()) -> None:
    """Start a program as a transient service, so that later checks can stop it by name."""
    options = [word for text in properties for word in ("--property", text)]
    must("systemd-run", "--quiet", "--collect", f"--unit={unit}", *options, *command)


NOT_CONFINING = (
    *("Type", "Exec", "Restart", "Watchdog", "Notify", "User", "Group", "Timeout", "Runtime", "Success"),
    *("After", "Wants", "Before", "Condition", "StartLimit", "Description", "Documentation", "WantedBy"),
)
"""Prefixes of unit settings that a transient unit does not support or receives in another way."""


def confinement() -> list[str]:
    """Return the settings of the unit's [Service] section that confine the service, for a transient unit."""
    lines = must("systemctl", "cat", UNIT).splitlines()
    settings = [line for line in lines if re.match(r"[A-Z]\w+=", line) and not line.startswith(NOT_CONFINING)]
    return [one for line in settings for one in _single_networks(line)]


def _single_networks(setting: str) -> list[str]:
    """Return one setting for each network of a list: systemd-run accepts a word such as `localhost` only alone."""
    name, _, value = setting.partition("=")
    return [f"{name}={word}" for word in value.split()] if name.startswith("IPAddress") else [setting]


def confined(code: str, *properties: str, user: str = "imud") -> str:
    """Run Python code as the service's user and groups with further unit settings. Return its output."""
    options = [f"User={user}", f"Group={user}", *properties]
    words = [word for text in options for word in ("--property", text)]
    return run("systemd-run", "--quiet", "--wait", "--pipe", "--collect", *words, "/usr/bin/python3", "-c", code).stdout


def add_user(name: str, *groups: str) -> None:
    if run("id", name).returncode:
        must("useradd", "--create-home", name)
    for group in groups:
        must("usermod", "--append", "--groups", group, name)


def uptime_s() -> float:
    return float(Path("/proc/uptime").read_text().split()[0])
