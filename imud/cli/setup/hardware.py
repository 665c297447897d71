"""What is attached to this machine, and what imud already knows of it.

A serial port is listened to only where nobody has it open: root may open what another program has for itself, and would
take bytes from it, and a port with a console is not for sensors until its user says so. What the running daemon has is
taken from its status, so that it goes on.
"""

import asyncio
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatch
from typing import Any, Final, NamedTuple

import msgspec

from imud.cli.doctor.surroundings import Surroundings
from imud.cli.modbus import opened, scan
from imud.cli.probe import ProbeReport, examine_all
from imud.cli.setup.changes import Change, CommandChange, FileChange, Words, content_of
from imud.config.model import DeviceConfig
from imud.contracts.driver import CanDriver, PolledDriver, of_kind
from imud.contracts.link import PolledLink
from imud.contracts.script import run_transfer_script
from imud.device.identity import printable_identity
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.modbus.registers import FACTORY_BAUD, FACTORY_ID
from imud.formats.modbus import SLAVES
from imud.links import LINKS
from imud.links.device_node import holders_of
from imud.links.netlink import absence, can_interfaces
from imud.links.serial_port import list_ports
from imud.model.errors import DeviceRefused, LinkError, TransferError
from imud.model.options import wrong_values

SHARED: Final = ("socketcan", "rs485", "i2c", "spi")
"""Links on which several devices may be, and which nobody has for himself."""
MODEM_MANAGER: Final = ", which looks for modems on new ports for half a minute: run this again then"
CONSOLE: Final = "a console of the kernel is on it"
ABSENT: Final = "it is not there: is it plugged in, and is the name right?"
OTHER: Final = "it is no serial port with hardware behind it"


class Attached(msgspec.Struct, frozen=True, omit_defaults=True):
    """A port, or a device of a bus."""

    place: str
    """The port by its stable name, or the interface, for the configuration."""
    node: str
    """The port's node, short and for people; of a bus the same as `place`."""
    title: str = ""
    """Product name of the adapter, state of the bus."""
    driver: str = ""
    """What was found there; empty for nothing."""
    device: str = ""
    """Address on a bus, for example `node 8`."""
    baud: int = 0
    """bit/s."""
    keys: dict[str, Any] = {}  # msgspec copies a mutable default
    """Keys of the device in the configuration."""
    configured: str = ""
    """Name of the configured device that has it."""
    problem: str = ""
    """Why nothing was found, or could not be looked for."""


class Finders(NamedTuple):
    """How devices are looked for. Each raises ImudError."""

    listen: Callable[[Sequence[str], set[str]], list[ProbeReport]]
    """Listens on ports and interfaces; those of the set may be sent queries."""
    scan_rs485: Callable[[str, int], list[Attached]]
    """Asks at every address of a line with this rate (0 for that of the factory)."""
    ask_bus: Callable[[str, str], list[Attached]]
    """Asks on a bus by its kind, `i2c` or `spi`, and its number or node."""


class Wanted(NamedTuple):
    """What the user asked for; nothing means all ports and interfaces, listened to."""

    places: tuple[str, ...] = ()
    """Only these ports and interfaces."""
    active: tuple[str, ...] = ()
    """Those that may be sent queries."""
    rs485: tuple[tuple[str, int], ...] = ()
    buses: tuple[tuple[str, str], ...] = ()


class PortNow(NamedTuple):
    """A serial port before anything is listened to."""

    place: str
    node: str
    title: str
    console: bool
    """Whether the kernel writes its messages to it."""
    holders: str
    """Programs that have it open, as far as they can be seen."""
    configured: str


def ports_now(at: Surroundings) -> list[PortNow]:
    """Look at all serial ports without opening one."""
    consoles = (at.text("/sys/class/tty/console/active") or "").split()
    found = []
    for port in list_ports(at.at("/dev"), at.at("/sys")):
        node = at.outside(port.node)
        found.append(
            PortNow(
                at.outside(port.path), node, port.title, node.removeprefix("/dev/") in consoles,
                holders_of(port.node, at.at("/proc")), _configured_on(at, node),
            )
        )  # fmt: skip
    return found


def look(
    at: Surroundings, wanted: Wanted, finders: Finders, *, example: Iterable[str] = (), freed: Iterable[str] = ()
) -> list[Attached]:
    """Find what is attached. Raises ImudError.

    `example` has nodes that are configured by an example only; `freed` those whose console goes with the next start.
    """
    found, listen = [], []
    lines = [path for path, _ in wanted.rs485]
    chosen = {_node(at, place) for place in (*wanted.places, *wanted.active)}
    ports = {port.node: port for port in ports_now(at)}
    for node, port in ports.items():
        if (chosen and node not in chosen) or node in {_node(at, line) for line in lines}:
            continue
        configured = "" if node in example else port.configured
        here = Attached(port.place, node, port.title, configured=configured)
        others = [one for one in port.holders.split(", ") if one]
        if here.configured:
            found.append(_as_configured(at, here))
        elif others:
            waits = MODEM_MANAGER if port.holders.startswith("ModemManager") else ""
            found.append(msgspec.structs.replace(here, problem=f"it is in use by {', '.join(others)}{waits}"))
        elif port.console and node not in freed:
            found.append(msgspec.structs.replace(here, problem=f"{CONSOLE}: name the port if a sensor is wired to it"))
        else:
            listen.append(port.place)
    for name in can_interfaces(at.at("/sys"), down=True):
        if chosen and name not in chosen:
            continue
        if absence(name, at.at("/sys")):
            found.append(
                Attached(name, name, problem=f"it is down: `--can {name}=500000` brings it up, with its bit rate")
            )
        else:
            listen.append(name)
    found += _not_attached(at, wanted, ports)
    active = {listened for listened in listen if _node(at, listened) in {_node(at, one) for one in wanted.active}}
    reports = finders.listen(listen, active) if listen else []
    heard = [_heard(at, report, ports) for report in reports]
    for path, baud in wanted.rs485:
        found += finders.scan_rs485(path, baud)
    for kind, bus in wanted.buses:
        found += finders.ask_bus(kind, bus)
    return _known(at, sorted([*found, *heard], key=lambda one: one.node))


def _not_attached(at: Surroundings, wanted: Wanted, ports: Iterable[str]) -> list[Attached]:
    """What is named as a port or an interface and is neither: not there, or something else."""
    lines = {_node(at, path) for path, _ in wanted.rs485}
    known = {*ports, *lines, *can_interfaces(at.at("/sys"), down=True)}
    found = []
    for place in dict.fromkeys((*wanted.places, *wanted.active)):
        if _node(at, place) not in known:
            there = place.startswith("/") and at.at(place).exists()
            problem = OTHER if there else ABSENT
            found.append(Attached(place, place, problem=problem))
    return found


def _node(at: Surroundings, place: str) -> str:
    """The node of a port by any of its names; an interface stays as it is."""
    return at.outside(at.at(place).resolve()) if place.startswith("/") else place


def _configured_on(at: Surroundings, node: str) -> str:
    for device in at.config.devices if at.config else ():
        path = getattr(device.link_settings, "port", "") or getattr(device.link_settings, "line", "")
        if path and _node(at, path) == node:
            return device.name
    return ""


def _as_configured(at: Surroundings, here: Attached) -> Attached:
    """What the daemon says of a port that it has."""
    status = at.status_of(here.configured)
    if status is None:
        return here
    running = status.driver if status.state == "running" else ""
    return msgspec.structs.replace(here, driver=running, problem=status.problem)


def _heard(at: Surroundings, report: ProbeReport, ports: Mapping[str, PortNow]) -> Attached:
    """A report of detection with the keys that a configuration needs."""
    if "/" in report.port:
        node = _node(at, report.port)
        keys: dict[str, Any] = {"driver": report.driver, "uart": {"port": report.port}}
        title = report.title or (ports[node].title if node in ports else "")
    else:
        node, title = report.port, report.title
        keys = {"driver": report.driver, "socketcan": {"interface": report.port}}
        option, _, number = report.device.partition(" ")
        driver = DRIVERS.get(report.driver)
        if isinstance(driver, CanDriver) and option in driver.settings.__struct_fields__ and number.isdecimal():
            keys = {"driver": report.driver, "options": {option: int(number)}, "socketcan": keys["socketcan"]}
    return Attached(
        report.port, node, title, report.driver, report.device, report.baud,
        keys if report.driver else {}, problem=report.problem,
    )  # fmt: skip


def _known(at: Surroundings, found: Sequence[Attached]) -> list[Attached]:
    """Mark the devices of buses that are configured; a configured `driver: auto` has the first that no other has."""
    free = [device for device in (at.config.devices if at.config else ()) if device.link in SHARED]
    marked: dict[int, str] = {}
    for exact in (True, False):
        for place, one in enumerate(found):
            if place in marked or not one.keys or one.configured:
                continue
            device = next((device for device in free if _is_of(device, one, exact=exact)), None)
            if device is not None:
                free.remove(device)
                marked[place] = device.name
    return [
        msgspec.structs.replace(one, configured=marked[place]) if place in marked else one
        for place, one in enumerate(found)
    ]


def _is_of(device: DeviceConfig, one: Attached, *, exact: bool) -> bool:
    """Whether a configured device is this one: the same driver and numbers, or by `auto`."""
    keys = one.keys.get(device.link)
    if keys is None:
        return False
    link = msgspec.to_builtins(device.link_settings)
    options = msgspec.to_builtins(device.options) if device.options is not None else {}
    pairs = [(link.get(key), value) for key, value in keys.items()]
    pairs += [(options.get(key), value) for key, value in one.keys.get("options", {}).items()]
    pairs.append((device.driver, one.driver))
    return all(have == value or (not exact and have in ("auto", None)) for have, value in pairs)


MODBUS: Final = "hipnuc-modbus"
REPLY_MS: Final = 20
"""Longest time to the reply of a module."""


def listen(places: Sequence[str], active: set[str]) -> list[ProbeReport]:
    """Listen on all ports and interfaces at the same time; those of `active` may be sent queries."""
    return asyncio.run(examine_all(list(places), active, {}))


def scan_rs485(path: str, baud: int) -> list[Attached]:
    """Ask at every address of a line; 0 is the rate of the factory."""
    rate = baud or FACTORY_BAUD
    order = list(dict.fromkeys([FACTORY_ID, *SLAVES]))
    try:
        with opened(path, rate, REPLY_MS) as link:
            modules = scan(link, rate, order)
    except LinkError as error:
        return [Attached(path, path, problem=str(error))]
    found = []
    for module in modules:
        keys = {"driver": MODBUS, "rs485": {"line": path, "baud": rate, "address": module.address}}
        where = f"address {module.address}"
        one = Attached(path, path, module.product, MODBUS, where, rate, keys)
        found.append(Attached(path, path, device=where, problem=module.problem) if module.problem else one)
    return found or [
        Attached(path, path, baud=rate, problem="no module answers: wiring, termination, or another rate?")
    ]


def ask_bus(kind: str, bus: str) -> list[Attached]:
    """Ask every driver of an I2C or SPI bus at every address or in every mode that it knows."""
    try:
        row = LINKS[kind]
        given = {"bus": int(bus)} if kind == "i2c" else {"port": bus}
        if wrong := wrong_values(row.settings, given):
            return [Attached(bus, bus, problem="; ".join(map(str, wrong)))]
        link = row.make_polled(msgspec.convert(given, row.settings))
        link.open()
    except (LinkError, ValueError) as error:
        return [Attached(bus, bus, problem=str(error))]
    try:
        return _answers(kind, bus, link)
    except LinkError as error:
        return [Attached(link.title, link.title, problem=str(error))]
    finally:
        link.close()


def _answers(kind: str, bus: str, link: PolledLink) -> list[Attached]:
    found, problems = [], []
    for driver in of_kind(DRIVERS.values(), PolledDriver):
        for target in driver.targets if driver.link == kind else ():
            try:
                link.select(target)
                who = printable_identity(run_transfer_script(driver.probe(driver.settings()), link.transfer))
            except (TransferError, DeviceRefused) as error:
                problems.append(f"{link.place(target)}: {error}")
                continue
            place = {"bus": int(bus), "address": target} if kind == "i2c" else {"port": bus}
            keys = {"driver": driver.name, kind: place}
            found.append(Attached(link.title, link.title, who.product, driver.name, link.place(target), keys=keys))
            if kind == "spi":  # a chip select has one device; the other mode is none
                return found
    return found or [Attached(link.title, link.title, problem="; ".join(dict.fromkeys(problems)))]


FINDERS = Finders(listen, scan_rs485, ask_bus)

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
