"""What stands between imud and a port: a console on a UART, a CAN interface that is down.

A UART's console has two parts: the kernel, by `console=` on its command line, and a login by serial-getty@.service. On
a Raspberry Pi the command line is a file of the boot partition; elsewhere a boot loader makes it, which is left alone.
A CAN interface is brought up by systemd-networkd, at every start.
"""

import os
from collections.abc import Sequence
from fnmatch import fnmatch
from typing import Final

from imud.cli.doctor.surroundings import Surroundings
from imud.cli.setup.changes import Change, CommandChange, FileChange, Words, content_of
from imud.links.can.netlink import can_interfaces

COMMAND_LINES: Final = ("/boot/firmware/cmdline.txt", "/boot/cmdline.txt")
"""Of a Raspberry Pi, newer releases first."""
ALIASES: Final = ("serial0", "serial1")
"""Names of UARTs on a Raspberry Pi."""
NETWORKS: Final = "/etc/systemd/network"
NETWORKD: Final = "systemd-networkd.service"
WAIT_ONLINE: Final = "systemd-networkd-wait-online.service"
OTHERS: Final = (("NetworkManager.service", "NetworkManager"), ("networking.service", "ifupdown"))
"""What else may manage the network: unit, and its name."""
BITRATE_DEFAULT: Final = 500_000
BITRATE_MAX: Final = 1_000_000
VIRTUAL: Final = "/sys/devices/virtual/net"


def free_console(at: Surroundings, node: str) -> tuple[list[Change], list[str]]:
    """Return what takes the console off a UART, and what only its user can do. Raises ChangeRefused, OSError."""
    name = node.removeprefix("/dev/")
    changes: list[Change] = []
    notes: list[str] = []
    consoles = (at.text("/sys/class/tty/console/active") or "").split()
    names = {name, *(alias for alias in ALIASES if os.path.basename(at.at(f"/dev/{alias}").resolve()) == name)}
    file = next((path for path in COMMAND_LINES if "root=" in (at.text(path) or "")), None)
    if file is not None:
        before = content_of(at, file) or b""
        after = without_console(before.decode(), names).encode()
        if after != before:
            changes.append(FileChange(f"no messages of the kernel on {node}, from the next start on", file, after))
            notes.append("restart the machine afterwards: until then the kernel still writes messages to it")
    elif name in consoles:
        notes.append(
            f"{node} stays a console of the kernel: take `console={name}` from the kernel's command line (often "
            "GRUB_CMDLINE_LINUX in /etc/default/grub, then `update-grub`), and restart the machine"
        )
    unit = f"serial-getty@{name}.service"
    active = state(at, unit, "is-active") == "active"
    if active or (name in consoles and state(at, unit, "is-enabled") != "masked"):
        undo: tuple[Words, ...] = (("systemctl", "unmask", unit),)
        undo += (("systemctl", "start", unit),) if active else ()
        changes.append(
            CommandChange(
                f"no login on {node}", ("systemctl", "mask", "--now", unit), undo, ("systemctl", "is-enabled", unit)
            )
        )
    return changes, notes


def without_console(line: str, names: set[str]) -> str:
    """A kernel's command line without the consoles on these ports."""
    words = line.split(" ")
    gone = [word for word in words if word.startswith("console=") and word.strip()[8:].partition(",")[0] in names]
    kept = [word for word in words if word not in gone]
    end = "\n" if gone and gone[-1].endswith("\n") and not kept[-1].endswith("\n") else ""
    return " ".join(kept) + end


def raise_can(at: Surroundings, name: str, bitrate: int) -> tuple[list[Change], list[str]]:
    """Return what brings a CAN interface up now and at every start, and what is to be known.

    No change where a file says so already. Raises ChangeRefused, OSError.
    """
    if name not in can_interfaces(at.at("/sys"), down=True):
        there = ", ".join(can_interfaces(at.at("/sys"), down=True)) or "none"
        return [], [f"{name} is not there; CAN interfaces of this machine: {there}"]
    path = f"{NETWORKS}/80-imud-{name}.network"
    own = network_file(name, 0 if at.at(f"{VIRTUAL}/{name}").exists() else bitrate)
    other = next((file for file in network_files(at) if file != path and _names(at, file, name)), None)
    if other is not None:
        return [], [f"{name} is configured by {other}: it is left as it is; its bit rate is written there"]
    if state(at, NETWORKD, "is-enabled") in ("", "not-found", "masked"):
        return [], [f"systemd-networkd is not installed here, or masked: {name} is left as it is; docs/can.md"]
    changes: list[Change] = []
    notes: list[str] = []
    runs = state(at, NETWORKD, "is-active") == "active"
    if content_of(at, path) != own:
        then: tuple[Words, ...] = (("networkctl", "reload"),) if runs else ()
        changes.append(FileChange(f"{name} comes up at every start", path, own, then))
    if not runs:
        manager = next((title for unit, title in OTHERS if state(at, unit, "is-active") == "active"), "")
        strangers = [file for file in network_files(at) if file != path]
        if strangers:
            notes.append(
                f"systemd-networkd does not run, and would also use {', '.join(strangers)}: look at them, then "
                f"`systemctl enable --now {NETWORKD}`"
            )
            return changes, notes
        if manager:
            notes.append(
                f"{manager} manages the network here, but no CAN bit rates; systemd-networkd runs beside it, for "
                f"{name} only"
            )
        changes += _enable_networkd(name)
    if changes:
        changes.append(
            CommandChange(
                f"{name} comes up now", ("networkctl", "reconfigure", name), (("ip", "link", "set", name, "down"),),
                ("cat", f"/sys/class/net/{name}/flags"),
            )
        )  # fmt: skip
    return changes, notes


def _enable_networkd(name: str) -> Sequence[Change]:
    enabled = CommandChange(
        f"systemd-networkd brings {name} up", ("systemctl", "enable", "--now", NETWORKD),
        (("systemctl", "disable", "--now", NETWORKD, "systemd-networkd.socket"),),
        ("systemctl", "is-enabled", NETWORKD),
    )  # fmt: skip
    not_waited_for = CommandChange(
        "the start of the machine does not wait for it", ("systemctl", "disable", WAIT_ONLINE), (),
        ("true",), optional=True,
    )  # fmt: skip
    return enabled, not_waited_for


def network_file(name: str, bitrate: int) -> bytes:
    """The .network file of an interface; 0 for a virtual one, which has no bit rate."""
    lines = ["# Made by `imud setup`.", "[Match]", f"Name={name}", "", "[Link]", "RequiredForOnline=no"]
    if bitrate:
        lines += ["", "[CAN]", f"BitRate={bitrate}", "RestartSec=100ms"]
    return ("\n".join(lines) + "\n").encode()


def network_files(at: Surroundings) -> list[str]:
    """The .network files of the administrator."""
    return [at.outside(file) for file in sorted(at.at(NETWORKS).glob("*.network"))]


def _names(at: Surroundings, file: str, name: str) -> bool:
    """Whether a .network file is for this interface: `Name=` with patterns."""
    lines = (line.partition("=") for line in (at.text(file) or "").splitlines())
    return any(fnmatch(name, one) for key, _, value in lines if key.strip() == "Name" for one in value.split())


def state(at: Surroundings, unit: str, question: str) -> str:
    """Answer of `systemctl is-active` or `is-enabled`; empty without systemd."""
    try:
        return at.run(["systemctl", question, unit]).text.strip()
    except OSError:
        return ""
