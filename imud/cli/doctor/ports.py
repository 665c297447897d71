"""Checks of ports: access rights of the daemon, serial ports, other programs, latency timers.

The kernel can refuse a device node for two reasons. Mode and group cause EACCES: add the user to the group, or add a
udev rule. The device rules of the service's control group cause EPERM, also for root: add `DeviceAllow=` to the unit
(systemd.resource-control(5)). The checks compare the declarations. They open no node.
"""

import re
import stat
from collections.abc import Iterator
from fnmatch import fnmatch
from typing import Final, NamedTuple

from imud.cli.doctor.surroundings import DoctorFinding, Findings, Surroundings, error, not_checked, note, ok, warning
from imud.contracts.lines import DeviceLines, LineOptions
from imud.host.files import GROUP_ACCESS
from imud.links.device_node import holders_of
from imud.links.serial_port import list_ports, read_latency_timer_ms

# Start of a node's name, its class in /proc/devices, and its group in Debian or in 60-imud.rules
CLASSES: Final = (
    ("ttyUSB", "ttyUSB", "dialout"), ("ttyACM", "ttyACM", "dialout"), ("ttyAMA", "ttyAMA", "dialout"),
    ("ttyS", "ttyS", "dialout"), ("tty", "tty*", "dialout"), ("i2c-", "i2c", "i2c"), ("spidev", "spi", "spi"),
    ("gpiochip", "gpiochip", "gpio"),
)  # fmt: skip
SUBSYSTEMS: Final = {"dialout": "tty", "i2c": "i2c-dev", "spi": "spidev", "gpio": "gpio"}


class Person(NamedTuple):
    """User that opens the nodes."""

    name: str
    uid: int
    gids: frozenset[int]
    listed_gids: frozenset[int]  # Groups in /etc/group. A login session from before a change does not have a new group.


def rights(at: Surroundings) -> Findings:
    """Compare mode and group of each configured node with the user of the daemon."""
    person = daemon_user(at)
    for path in nodes(at):
        node = at.at(path)
        try:
            seen = node.stat()
        except FileNotFoundError:
            continue  # the checks "ports" and "bus nodes" report it
        if person is None:
            yield not_checked(f"{path}: the user of the daemon is not in /etc/passwd", "check the node with `ls -lL`")
        elif _may_open(person, seen.st_mode, seen.st_uid, seen.st_gid):
            yield ok(f"user {person.name} can open {path}")
        else:
            yield _refused(at, path, person, seen.st_gid, seen.st_mode)


def _refused(at: Surroundings, path: str, person: Person, gid: int, mode: int) -> DoctorFinding:
    """Return the finding for a refused node. The next step is the group of the node, or a udev rule.

    A udev rule is needed if the group is root or has no access.
    """
    group = _names_of(at, "group").get(gid, "")
    wanted = next((group for begin, _, group in CLASSES if _name(at, path).startswith(begin)), "dialout")
    seen = f"user {person.name} cannot open {path}: the node belongs to group {group or gid}, EACCES"
    if gid == 0 or mode & GROUP_ACCESS != GROUP_ACCESS:
        rule = f'SUBSYSTEM=="{SUBSYSTEMS[wanted]}", KERNEL=="{_kind(_name(at, path))}", GROUP="{wanted}", MODE="0660"'
        return error(seen, f"add the udev rule {rule} in /etc/udev/rules.d; then `sudo udevadm trigger`")
    if gid in person.listed_gids:
        return error(f"{seen}; the login session is older than the group membership", "log out and log in again")
    again = "restart imud" if at.installed else "log in again"
    return error(seen, f"`sudo usermod --append --groups {group or gid} {person.name}`, then {again}")


def _kind(name: str) -> str:
    """Return the pattern of similar nodes, for example `ttyUSB*` for `ttyUSB0`."""
    pattern = re.sub(r"[0-9].*", "*", name)
    return name if fnmatch("tty", pattern) else pattern  # /dev/tty must stay open for all users


def unit_rules(at: Surroundings) -> Findings:
    """Compare DeviceAllow= of the unit with the configured nodes."""
    if not at.installed:
        return
    policy = at.unit_value("DevicePolicy") or "auto"
    allowed = [line.split() for line in at.unit.get("DeviceAllow", []) if line.split()]
    if policy == "auto" and not allowed:
        if nodes(at):
            yield ok("imud.service does not restrict device nodes")
        return
    classes = at.text("/proc/devices") or ""
    for path in nodes(at):
        own = _class(at, path)
        # systemd accepts a device that matches any entry
        entries = [entry for entry in allowed if _matches(entry[0], path, own, at)]
        # without permissions, an entry allows rwm
        if not any({"r", "w"} <= set(entry[1] if len(entry) > 1 else "rwm") for entry in entries):
            yield error(
                f"DeviceAllow= of imud.service does not allow {path}: opening the node fails with EPERM for every "
                "group",
                f"`sudo systemctl edit imud`, add `[Service]` and `DeviceAllow=char-{own} rw`, restart imud",
            )
        elif entries[0][0].startswith("char-") and classes and not _known(own, classes):
            yield warning(
                f"the kernel does not know the device class {own} yet, so DeviceAllow= of imud.service has no effect",
                f"load the kernel module of {path} at boot (/etc/modules-load.d), then restart imud",
            )
        else:
            yield ok(f"DeviceAllow= of imud.service allows {path}")


def nodes(at: Surroundings) -> list[str]:
    """Return the paths of all configured device nodes without duplicates."""
    return list(dict.fromkeys(_nodes(at)))


def _nodes(at: Surroundings) -> Iterator[str]:
    for device in at.config.devices if at.config else ():
        settings = device.link_settings
        for key in ("port", "line"):
            if isinstance(path := getattr(settings, key, None), str) and device.link != "replay":
                yield path
        if device.link == "i2c":
            yield f"/dev/i2c-{getattr(settings, 'bus', 1)}"
        if device.lines is not None:
            yield from _chips(device.lines)


def _chips(lines: DeviceLines) -> Iterator[str]:
    for name in lines.__struct_fields__:
        line = getattr(lines, name)
        if isinstance(line, LineOptions) and line.chip.removeprefix("/dev/").startswith("gpiochip"):
            yield f"/dev/{line.chip.removeprefix('/dev/')}"


def daemon_user(at: Surroundings) -> Person | None:
    """Return the user of the service with the groups of the unit. Without a service, return the current user."""
    users = entries(at, "passwd")
    if at.installed:
        wanted = at.unit_value("User") or "root"
        entry = next((entry for entry in users if wanted in (entry[0], entry[2])), None)
    else:
        entry = next((entry for entry in users if entry[2] == str(at.uid)), None)
    if entry is None:
        return None
    name = entry[0]
    gids = {int(entry[3])}
    named = (
        {at.unit_value("Group"), *" ".join(at.unit.get("SupplementaryGroups", [])).split()} if at.installed else set()
    )
    for group in entries(at, "group"):
        if group[0] in named or group[2] in named or name in group[3].split(","):
            gids.add(int(group[2]))
    own = frozenset(gids)
    return Person(name, int(entry[2]), own if at.installed else at.gids, own)


def _may_open(person: Person, mode: int, uid: int, gid: int) -> bool:
    # root ignores mode and group
    if person.uid == 0:
        return True
    if uid == person.uid:
        return mode & (stat.S_IRUSR | stat.S_IWUSR) == stat.S_IRUSR | stat.S_IWUSR
    if gid in person.gids:
        return mode & GROUP_ACCESS == GROUP_ACCESS
    return mode & (stat.S_IROTH | stat.S_IWOTH) == stat.S_IROTH | stat.S_IWOTH


def entries(at: Surroundings, database: str) -> list[list[str]]:
    """Return the valid lines of /etc/passwd or /etc/group, split into fields."""
    lines = [line.split(":") for line in (at.text(f"/etc/{database}") or "").splitlines()]
    return [
        line
        for line in lines
        if len(line) >= 4 and line[2].isdecimal() and (database == "group" or line[3].isdecimal())
    ]


def _names_of(at: Surroundings, database: str) -> dict[int, str]:
    return {int(entry[2]): entry[0] for entry in entries(at, database)}


def _name(at: Surroundings, path: str) -> str:
    return at.at(path).resolve().name


def _class(at: Surroundings, path: str) -> str:
    name = _name(at, path)
    return next((own for begin, own, _ in CLASSES if name.startswith(begin)), "*")


def _matches(entry: str, path: str, own: str, at: Surroundings) -> bool:
    if entry.startswith("char-"):
        return fnmatch(own, entry.removeprefix("char-"))
    return entry in (path, f"/dev/{_name(at, path)}")


def _known(own: str, classes: str) -> bool:
    listed = (words[1] for line in classes.splitlines() if len(words := line.split()) == 2 and words[0].isdecimal())
    return any(fnmatch(name, own) for name in listed)


LATENCY_MS: Final = 1  # Minimum latency timer of FTDI adapters, ms. imud sets it if it has the permission.
STABLE: Final = "/dev/serial/"
LATENCY_RULE: Final = 'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"'


def serial_paths(at: Surroundings) -> list[str]:
    """Return the configured serial ports without duplicates."""
    ports = {getattr(one.link_settings, "port", "") for one in at.devices("uart")}
    lines = {getattr(one.link_settings, "line", "") for one in at.devices("rs485")}
    return [path for path in nodes(at) if path in ports | lines]


def ports_present(at: Surroundings) -> Findings:
    """Check that each configured port exists. If one is missing, list the existing ports."""
    there = list_ports(at.at("/dev"), at.at("/sys"))
    names = ", ".join(at.outside(port.path) for port in there) or "none"
    paths = serial_paths(at)
    for path in paths:
        node = at.at(path)
        if not node.exists():
            yield error(f"{path} does not exist; ports of this host: {names}", _absent(path, bool(there)))
        elif path.startswith(("/dev/ttyUSB", "/dev/ttyACM")):
            stable = next((at.outside(port.path) for port in there if at.outside(port.node) == path), path)
            # a name in /dev/serial does not change with the order of plugging in
            if stable.startswith(STABLE):
                yield note(
                    f"{path} can get another number when the adapter is plugged in again",
                    f"use the name {stable} in the configuration",
                )
            else:
                yield ok(f"{path} exists")
        else:
            yield ok(f"{path} exists")
    if not paths:
        yield ok(f"no serial port is configured; ports of this host: {names}")


def _absent(path: str, others: bool) -> str:
    # the UART of a Raspberry Pi is disabled by default
    if path.startswith("/dev/serial0") or "ttyAMA" in path:
        return "enable the UART: `enable_uart=1` in /boot/firmware/config.txt, or raspi-config; then restart the host"
    if others:
        return "is the cable plugged in, does the device use another of these ports? `imud probe` listens to all ports"
    return "is the cable plugged in, is it a charging cable without data? `sudo dmesg --follow`, then plug it in again"


def ports_taken(at: Surroundings) -> Findings:
    """Look for other programs that use a configured port, and for a login console on the port."""
    consoles = (at.text("/sys/class/tty/console/active") or "").split()
    for path in serial_paths(at):
        node = at.at(path)
        if not node.exists():
            continue
        name = node.resolve().name
        # writing to a console would mix kernel messages with requests
        if name in consoles:
            yield error(
                f"{path} is a console of the kernel: the kernel writes messages to it, and it can offer a login",
                f"remove `console={name}` (or serial0) from the kernel command line, "
                f"`sudo systemctl disable --now serial-getty@{name}`",
            )
        # without root, /proc shows only programs of this user
        others = [one for one in holders_of(str(node), at.at("/proc")).split(", ") if one and not _is_daemon(one)]
        taken = [one for one in at.status or () if "is in use by" in one.problem and path in one.problem]
        if others:
            yield error(
                f"{path} is open in another program: {', '.join(others)}",
                "stop the program; imud then opens the port without a restart",
            )
        elif taken:
            yield error(taken[0].problem, "stop the program" if at.uid == 0 else "`sudo imud doctor` shows the program")
        elif at.uid == 0 or _runs_on(at, path):
            yield ok(f"no other program uses {path}")
        else:
            yield not_checked(
                f"cannot check whether another program uses {path}: this user cannot see programs of other users",
                "run `sudo imud doctor`",
            )


def _runs_on(at: Surroundings, path: str) -> bool:
    """Return whether a device runs on this port. imud then uses the port exclusively."""
    return any(
        status.state == "running"
        for one in (*at.devices("uart"), *at.devices("rs485"))
        if path in (getattr(one.link_settings, "port", ""), getattr(one.link_settings, "line", ""))
        and (status := at.status_of(one.name)) is not None
    )


def _is_daemon(holder: str) -> bool:
    return holder.startswith(("imud run ", "imud demo "))


def modem_manager(at: Surroundings) -> Findings:
    """Check that ModemManager does not run. It opens new USB ports and sends modem commands."""
    usb = [path for path in serial_paths(at) if at.at(path).resolve().name.startswith(("ttyUSB", "ttyACM"))]
    if not usb:
        return
    state = at.run(["systemctl", "is-active", "ModemManager.service"]).text.strip()
    if state == "active":
        yield warning(
            "ModemManager runs: it can open new USB ports and send modem commands to the device",
            'udev rule `SUBSYSTEM=="tty", ENV{ID_MM_DEVICE_IGNORE}="1"`, or '
            "`sudo systemctl disable --now ModemManager`",
        )
    elif not state:
        yield not_checked("systemctl does not report whether ModemManager runs")
    else:
        yield ok("ModemManager does not run")


def latency_timer(at: Surroundings) -> Findings:
    """Check the latency timers of USB adapters."""
    for path in serial_paths(at):
        timer_ms = read_latency_timer_ms(str(at.at(path)), at.at("/sys"))
        if timer_ms is None:
            continue
        if timer_ms > LATENCY_MS:
            yield warning(
                f"the latency timer of the adapter of {path} delays bytes by up to {timer_ms} ms",
                f"add the udev rule {LATENCY_RULE} in /etc/udev/rules.d, then plug the adapter in again",
            )
        else:
            yield ok(f"the latency timer of {path} is {timer_ms} ms")
