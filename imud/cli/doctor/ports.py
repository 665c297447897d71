"""Checks of rights: whether the user of the daemon may open the nodes of the configuration, by group and by unit.

Two things can refuse a node. Its mode and group do, with EACCES; a group for the user, or a udev rule, helps.
The device rules of the service's control group do with EPERM, for root too; only `DeviceAllow=` in the unit helps
(systemd.resource-control(5)). Both are judged from what is declared, and no node is opened.
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

CLASSES: Final = (
    ("ttyUSB", "ttyUSB", "dialout"), ("ttyACM", "ttyACM", "dialout"), ("ttyAMA", "ttyAMA", "dialout"),
    ("ttyS", "ttyS", "dialout"), ("tty", "tty*", "dialout"), ("i2c-", "i2c", "i2c"), ("spidev", "spi", "spi"),
    ("gpiochip", "gpiochip", "gpio"),
)  # fmt: skip
"""Beginning of a node's name, its class in /proc/devices, and the group that Debian or 60-imud.rules gives it to."""
SUBSYSTEMS: Final = {"dialout": "tty", "i2c": "i2c-dev", "spi": "spidev", "gpio": "gpio"}


class Person(NamedTuple):
    """The user that opens the nodes."""

    name: str
    uid: int
    gids: frozenset[int]
    listed_gids: frozenset[int]
    """Groups by /etc/group, which a session from before a change does not have yet."""


def rights(at: Surroundings) -> Findings:
    """Compare mode and group of each configured node with the daemon's user."""
    person = daemon_user(at)
    for path in nodes(at):
        node = at.at(path)
        try:
            seen = node.stat()
        except FileNotFoundError:
            continue  # reported by the checks of ports and buses
        if person is None:
            yield not_checked(f"{path}: the user of the daemon is not in /etc/passwd", "look at `ls -lL` of the node")
        elif _may_open(person, seen.st_mode, seen.st_uid, seen.st_gid):
            yield ok(f"{path} may be opened by user {person.name}")
        else:
            yield _refused(at, path, person, seen.st_gid, seen.st_mode)


def _refused(at: Surroundings, path: str, person: Person, gid: int, mode: int) -> DoctorFinding:
    """Say how the user gets access: by the node's group, or where that is root or may not either, by a udev rule."""
    group = _names_of(at, "group").get(gid, "")
    wanted = next((group for begin, _, group in CLASSES if _name(at, path).startswith(begin)), "dialout")
    seen = f"{path} may not be opened by user {person.name}: the node belongs to group {group or gid}, EACCES"
    if gid == 0 or mode & GROUP_ACCESS != GROUP_ACCESS:
        rule = f'SUBSYSTEM=="{SUBSYSTEMS[wanted]}", KERNEL=="{_kind(_name(at, path))}", GROUP="{wanted}", MODE="0660"'
        return error(seen, f"add the udev rule {rule} in /etc/udev/rules.d; then `sudo udevadm trigger`")
    if gid in person.listed_gids:
        return error(f"{seen} of a session that began before the user joined it", "log out and in again")
    again = "restart imud" if at.installed else "log in again"
    return error(seen, f"`sudo usermod --append --groups {group or gid} {person.name}`, then {again}")


def _kind(name: str) -> str:
    """Pattern of the nodes of the same kind, `ttyUSB*` for `ttyUSB0`; never one that has /dev/tty, of all users."""
    pattern = re.sub(r"[0-9].*", "*", name)
    return name if fnmatch("tty", pattern) else pattern


def unit_rules(at: Surroundings) -> Findings:
    """Compare the unit's DeviceAllow= with the configured nodes."""
    if not at.installed:
        return
    policy = at.unit_value("DevicePolicy") or "auto"
    allowed = [line.split() for line in at.unit.get("DeviceAllow", []) if line.split()]
    if policy == "auto" and not allowed:
        if nodes(at):
            yield ok("imud.service restricts no devices")
        return
    classes = at.text("/proc/devices") or ""
    for path in nodes(at):
        own = _class(at, path)
        entries = [entry for entry in allowed if _matches(entry[0], path, own, at)]
        if not any({"r", "w"} <= set(entry[1] if len(entry) > 1 else "rwm") for entry in entries):
            yield error(
                f"{path} is not allowed by the unit's DeviceAllow=: opening it fails with EPERM, whatever its group",
                f"`sudo systemctl edit imud`, add `[Service]` and `DeviceAllow=char-{own} rw`, restart imud",
            )
        elif entries[0][0].startswith("char-") and classes and not _known(own, classes):
            yield warning(
                f"the kernel has no devices of the class {own} yet: DeviceAllow= of imud.service took no effect for it",
                f"have its module loaded at boot (/etc/modules-load.d), then restart imud, for {path}",
            )
        else:
            yield ok(f"{path} is allowed by DeviceAllow= of imud.service")


def nodes(at: Surroundings) -> list[str]:
    """Return the paths of all device nodes that the configuration names, each once."""
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
    """The user of the service, with the groups that the unit adds; without a service the one that asks."""
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
    if person.uid == 0:
        return True
    if uid == person.uid:
        return mode & (stat.S_IRUSR | stat.S_IWUSR) == stat.S_IRUSR | stat.S_IWUSR
    if gid in person.gids:
        return mode & GROUP_ACCESS == GROUP_ACCESS
    return mode & (stat.S_IROTH | stat.S_IWOTH) == stat.S_IROTH | stat.S_IWOTH


def entries(at: Surroundings, database: str) -> list[list[str]]:
    """Lines of /etc/passwd or /etc/group that are whole."""
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


LATENCY_MS: Final = 1
"""Shortest latency timer of FTDI's adapters, which imud sets where it may."""
STABLE: Final = "/dev/serial/"
LATENCY_RULE: Final = 'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"'


def serial_paths(at: Surroundings) -> list[str]:
    """Return the configured serial ports, each once."""
    ports = {getattr(one.link_settings, "port", "") for one in at.devices("uart")}
    lines = {getattr(one.link_settings, "line", "") for one in at.devices("rs485")}
    return [path for path in nodes(at) if path in ports | lines]


def ports_present(at: Surroundings) -> Findings:
    """Look whether each configured port exists, and list those that do where one does not."""
    there = list_ports(at.at("/dev"), at.at("/sys"))
    names = ", ".join(at.outside(port.path) for port in there) or "none"
    paths = serial_paths(at)
    for path in paths:
        node = at.at(path)
        if not node.exists():
            yield error(f"{path} is not there; ports of this machine: {names}", _absent(path, bool(there)))
        elif path.startswith(("/dev/ttyUSB", "/dev/ttyACM")):
            stable = next((at.outside(port.path) for port in there if at.outside(port.node) == path), path)
            if stable.startswith(STABLE):
                yield note(f"{path} may have another number after replugging", f"name it {stable} in the configuration")
            else:
                yield ok(f"{path} is there")
        else:
            yield ok(f"{path} is there")
    if not paths:
        yield ok(f"no serial port is configured; ports of this machine: {names}")


def _absent(path: str, others: bool) -> str:
    if path.startswith("/dev/serial0") or "ttyAMA" in path:
        return (
            "enable the UART: `enable_uart=1` in /boot/firmware/config.txt, or raspi-config; then restart the machine"
        )
    if others:
        return "is another of these ports the one? Is its cable plugged in? `imud probe` listens to all of them"
    return "is the cable plugged in, is it more than a charging cable? `sudo dmesg --follow` while plugging it in"


def ports_taken(at: Surroundings) -> Findings:
    """Look for other programs that have a configured port open, and for a login console on it."""
    consoles = (at.text("/sys/class/tty/console/active") or "").split()
    for path in serial_paths(at):
        node = at.at(path)
        if not node.exists():
            continue
        name = node.resolve().name
        if name in consoles:
            yield error(
                f"{path} is a console of the kernel: it writes its messages and may offer a login there",
                f"remove `console={name}` (or serial0) from the kernel's command line, "
                f"`sudo systemctl disable --now serial-getty@{name}`",
            )
        others = [one for one in holders_of(str(node), at.at("/proc")).split(", ") if one and not _is_daemon(one)]
        taken = [one for one in at.status or () if "is in use by" in one.problem and path in one.problem]
        if others:
            yield error(
                f"{path} is open in {', '.join(others)}", "stop that program; imud opens the port by itself then"
            )
        elif taken:
            yield error(taken[0].problem, "stop that program" if at.uid == 0 else "`sudo imud doctor` sees which it is")
        elif at.uid == 0 or _runs_on(at, path):
            yield ok(f"{path} is used by no other program")
        else:
            yield not_checked(
                f"whether {path} is open elsewhere: programs of other users are hidden from this one",
                "`sudo imud doctor` sees them",
            )


def _runs_on(at: Surroundings, path: str) -> bool:
    """Whether a device runs on this port: imud has it exclusively then."""
    return any(
        status.state == "running"
        for one in (*at.devices("uart"), *at.devices("rs485"))
        if path in (getattr(one.link_settings, "port", ""), getattr(one.link_settings, "line", ""))
        and (status := at.status_of(one.name)) is not None
    )


def _is_daemon(holder: str) -> bool:
    return holder.startswith(("imud run ", "imud demo "))


def modem_manager(at: Surroundings) -> Findings:
    """Look whether ModemManager runs, which opens new USB ports and sends modem commands to them."""
    usb = [path for path in serial_paths(at) if at.at(path).resolve().name.startswith(("ttyUSB", "ttyACM"))]
    if not usb:
        return
    state = at.run(["systemctl", "is-active", "ModemManager.service"]).text.strip()
    if state == "active":
        yield warning(
            "ModemManager runs: it may open USB ports as they appear and send to the device",
            'udev rule `SUBSYSTEM=="tty", ENV{ID_MM_DEVICE_IGNORE}="1"`, or '
            "`sudo systemctl disable --now ModemManager`",
        )
    elif not state:
        yield not_checked("systemctl does not say whether ModemManager runs")
    else:
        yield ok("ModemManager does not run")


def latency_timer(at: Surroundings) -> Findings:
    """Look how long USB adapters hold bytes back."""
    for path in serial_paths(at):
        timer_ms = read_latency_timer_ms(str(at.at(path)), at.at("/sys"))
        if timer_ms is None:
            continue
        if timer_ms > LATENCY_MS:
            yield warning(
                f"the adapter of {path} holds bytes back for up to {timer_ms} ms (latency timer)",
                f"udev rule in /etc/udev/rules.d: {LATENCY_RULE}; then plug it in again",
            )
        else:
            yield ok(f"the latency timer of {path} is {timer_ms} ms")
