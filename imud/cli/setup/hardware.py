"""Detection of attached devices for `imud setup`, and changes that make ports and CAN interfaces usable.

imud listens only on serial ports that no other program uses: root can open a port that another program has opened
exclusively, and would steal its bytes. imud does not use a port with a console until the user names the port. For ports
of the running daemon, imud reads the status of the daemon, so that the daemon continues to run.
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
from imud.device.settings import printable_identity
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.modbus.registers import FACTORY_BAUD, FACTORY_ID
from imud.formats.modbus import SLAVES
from imud.host.netlink import absence, can_interfaces
from imud.links import LINKS
from imud.links.device_node import holders_of
from imud.links.serial_port import list_ports
from imud.model.errors import DeviceRefused, LinkError, TransferError
from imud.model.options import wrong_values

# Links with several devices. No program uses such a link exclusively.
SHARED: Final = ("socketcan", "rs485", "i2c", "spi")
MODEM_MANAGER: Final = ", which searches for modems on new ports for 30 s: run imud setup again after that"
CONSOLE: Final = "the port is a console of the kernel"
ABSENT: Final = "no such port or interface: is the adapter plugged in, is the name correct?"
OTHER: Final = "this is not a serial port of a hardware device"


class Attached(msgspec.Struct, frozen=True, omit_defaults=True):
    """A port, or a device on a bus."""

    place: str  # stable name of the port, or the interface, for the configuration
    node: str  # short name of the port's node, for messages; for a bus the same as `place`
    title: str = ""  # product name of the adapter, or state of the bus
    driver: str = ""  # driver of the detected device; empty if there is none
    device: str = ""  # address on a bus, for example `node 8`
    baud: int = 0  # baud rate or bit rate, bit/s
    # Keys of the device in the configuration
    keys: dict[str, Any] = {}  # msgspec copies a mutable default
    configured: str = ""  # name of the device in the configuration; empty if it is not configured
    problem: str = ""  # reason why imud found no device


class Finders(NamedTuple):
    """Functions that search for devices. Each function raises ImudError."""

    # Listens on ports and interfaces, and sends requests to the ports and interfaces in the set
    listen: Callable[[Sequence[str], set[str]], list[ProbeReport]]
    # Sends a request to each address of an RS-485 bus with this baud rate (0: factory setting)
    scan_rs485: Callable[[str, int], list[Attached]]
    # Sends requests on a bus of the kind `i2c` or `spi`, with its number or node
    ask_bus: Callable[[str, str], list[Attached]]


class Wanted(NamedTuple):
    """Ports and buses to search. Empty: listen on all ports and interfaces."""

    places: tuple[str, ...] = ()  # ports and interfaces to search; empty for all
    active: tuple[str, ...] = ()  # ports and interfaces to send requests to
    rs485: tuple[tuple[str, int], ...] = ()
    buses: tuple[tuple[str, str], ...] = ()


class PortNow(NamedTuple):
    """State of a serial port before the search."""

    place: str
    node: str
    title: str
    console: bool  # whether the port is a console of the kernel
    holders: str  # programs that use the port, if this user can see them
    configured: str


def ports_now(at: Surroundings) -> list[PortNow]:
    """Return the state of all serial ports without opening a port."""
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
    """Search for attached devices. Raises ImudError.

    `example`: nodes that only the example configuration names. `freed`: nodes without a console after the next boot.
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
        # opening the port would steal bytes from this program
        elif others:
            waits = MODEM_MANAGER if port.holders.startswith("ModemManager") else ""
            found.append(msgspec.structs.replace(here, problem=f"in use by {', '.join(others)}{waits}"))
        elif port.console and node not in freed:
            problem = f"{CONSOLE}; if a device is connected to it, name the port: `imud setup {node}`"
            found.append(msgspec.structs.replace(here, problem=problem))
        else:
            listen.append(port.place)
    for name in can_interfaces(at.at("/sys"), down=True):
        if chosen and name not in chosen:
            continue
        if absence(name, at.at("/sys")):
            found.append(Attached(name, name, problem=f"the interface is down; bring it up with --can {name}=BITRATE"))
        else:
            listen.append(name)
    found += _not_attached(at, wanted, ports)
    # compare nodes: a port has several names
    active = {listened for listened in listen if _node(at, listened) in {_node(at, one) for one in wanted.active}}
    reports = finders.listen(listen, active) if listen else []
    heard = [_heard(at, report, ports) for report in reports]
    for path, baud in wanted.rs485:
        found += finders.scan_rs485(path, baud)
    for kind, bus in wanted.buses:
        found += finders.ask_bus(kind, bus)
    return _known(at, sorted([*found, *heard], key=lambda one: one.node))


def _not_attached(at: Surroundings, wanted: Wanted, ports: Iterable[str]) -> list[Attached]:
    """Return the named places that are not existing ports or interfaces."""
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
    """Return the node of a port for any of its names. Return the name of an interface unchanged."""
    return at.outside(at.at(place).resolve()) if place.startswith("/") else place


def _configured_on(at: Surroundings, node: str) -> str:
    for device in at.config.devices if at.config else ():
        path = getattr(device.link_settings, "port", "") or getattr(device.link_settings, "line", "")
        if path and _node(at, path) == node:
            return device.name
    return ""


def _as_configured(at: Surroundings, here: Attached) -> Attached:
    """Add the status of the daemon to a configured port."""
    status = at.status_of(here.configured)
    if status is None:
        return here
    running = status.driver if status.state == "running" else ""
    return msgspec.structs.replace(here, driver=running, problem=status.problem)


def _heard(at: Surroundings, report: ProbeReport, ports: Mapping[str, PortNow]) -> Attached:
    """Convert a report of the detection, with the keys for the configuration."""
    if "/" in report.port:
        node = _node(at, report.port)
        keys: dict[str, Any] = {"driver": report.driver, "uart": {"port": report.port}}
        title = report.title or (ports[node].title if node in ports else "")
    else:
        node, title = report.port, report.title
        keys = {"driver": report.driver, "socketcan": {"interface": report.port}}
        option, _, number = report.device.partition(" ")
        driver = DRIVERS.get(report.driver)
        # `node 8` becomes the option `node: 8`
        if isinstance(driver, CanDriver) and option in driver.settings.__struct_fields__ and number.isdecimal():
            keys = {"driver": report.driver, "options": {option: int(number)}, "socketcan": keys["socketcan"]}
    return Attached(
        report.port, node, title, report.driver, report.device, report.baud,
        keys if report.driver else {}, problem=report.problem,
    )  # fmt: skip


def _known(at: Surroundings, found: Sequence[Attached]) -> list[Attached]:
    """Add the names of the configured devices to the devices on buses."""
    # exact matches first; after that, `driver: auto` gets the first device that is still free
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
    """Return whether a configured device is this device: equal driver and addresses, or `auto` if not `exact`."""
    keys = one.keys.get(device.link)
    if keys is None:
        return False
    link = msgspec.to_builtins(device.link_settings)
    options = msgspec.to_builtins(device.options) if device.options is not None else {}
    pairs = [(link.get(key), value) for key, value in keys.items()]
    pairs += [(options.get(key), value) for key, value in one.keys.get("options", {}).items()]
    # `auto` matches any driver if not `exact`
    pairs.append((device.driver, one.driver))
    return all(have == value or (not exact and have in ("auto", None)) for have, value in pairs)


MODBUS: Final = "hipnuc-modbus"
REPLY_MS: Final = 20  # maximum wait for the reply of a device, ms


def listen(places: Sequence[str], active: set[str]) -> list[ProbeReport]:
    """Listen on all ports and interfaces at the same time. Send requests to the ports and interfaces in `active`."""
    return asyncio.run(examine_all(list(places), active, {}))


def scan_rs485(path: str, baud: int) -> list[Attached]:
    """Send a request to each address of an RS-485 bus. `baud`: 0 for the factory setting."""
    rate = baud or FACTORY_BAUD
    # most devices have the factory address
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
        Attached(path, path, baud=rate, problem="no device replies: check the wires, the termination and the baud rate")
    ]


def ask_bus(kind: str, bus: str) -> list[Attached]:
    """Try every driver for an I2C or SPI bus at all its addresses or in all its modes."""
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
            if kind == "spi":  # a chip select has one device: do not try the other mode
                return found
    return found or [Attached(link.title, link.title, problem="; ".join(dict.fromkeys(problems)))]


FINDERS = Finders(listen, scan_rs485, ask_bus)

# Kernel command lines of a Raspberry Pi, newer releases first
COMMAND_LINES: Final = ("/boot/firmware/cmdline.txt", "/boot/cmdline.txt")
ALIASES: Final = ("serial0", "serial1")  # additional names of UARTs on a Raspberry Pi
NETWORKS: Final = "/etc/systemd/network"
NETWORKD: Final = "systemd-networkd.service"
WAIT_ONLINE: Final = "systemd-networkd-wait-online.service"
# Other network managers: unit and name
OTHERS: Final = (("NetworkManager.service", "NetworkManager"), ("networking.service", "ifupdown"))
BITRATE_DEFAULT: Final = 500_000
BITRATE_MAX: Final = 1_000_000
VIRTUAL: Final = "/sys/devices/virtual/net"


def free_console(at: Surroundings, node: str) -> tuple[list[Change], list[str]]:
    """Return the changes that remove the console from a UART, and notes for the user. Raises ChangeRefused, OSError."""
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
            changes.append(FileChange(f"no kernel messages on {node} after the next boot", file, after))
            notes.append(f"reboot the host after setup: until then, the kernel writes messages to {node}")
    elif name in consoles:
        notes.append(
            f"{node} stays a console of the kernel: remove `console={name}` from the kernel command line (often "
            "GRUB_CMDLINE_LINUX in /etc/default/grub, then `update-grub`), and reboot the host"
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
    """Return a kernel command line without the consoles on these ports."""
    words = line.split(" ")
    gone = [word for word in words if word.startswith("console=") and word.strip()[8:].partition(",")[0] in names]
    kept = [word for word in words if word not in gone]
    # keep the line end if the last word is removed
    end = "\n" if gone and gone[-1].endswith("\n") and not kept[-1].endswith("\n") else ""
    return " ".join(kept) + end


def raise_can(at: Surroundings, name: str, bitrate: int) -> tuple[list[Change], list[str]]:
    """Return the changes that bring a CAN interface up now and at every boot, and notes for the user.

    Return no changes if another file already configures the interface. Raises ChangeRefused, OSError.
    """
    if name not in can_interfaces(at.at("/sys"), down=True):
        there = ", ".join(can_interfaces(at.at("/sys"), down=True)) or "none"
        return [], [f"{name} does not exist; CAN interfaces of this host: {there}"]
    path = f"{NETWORKS}/80-imud-{name}.network"
    # a virtual interface refuses a bit rate
    own = network_file(name, 0 if at.at(f"{VIRTUAL}/{name}").exists() else bitrate)
    other = next((file for file in network_files(at) if file != path and _names(at, file, name)), None)
    if other is not None:
        return [], [f"{other} configures {name}, so imud does not change it; set the bit rate in this file"]
    if state(at, NETWORKD, "is-enabled") in ("", "not-found", "masked"):
        return [], [f"systemd-networkd is not installed or is masked, so imud does not change {name}; see docs/can.md"]
    changes: list[Change] = []
    notes: list[str] = []
    runs = state(at, NETWORKD, "is-active") == "active"
    if content_of(at, path) != own:
        then: tuple[Words, ...] = (("networkctl", "reload"),) if runs else ()
        changes.append(FileChange(f"bring {name} up at every boot", path, own, then))
    if not runs:
        manager = next((title for unit, title in OTHERS if state(at, unit, "is-active") == "active"), "")
        strangers = [file for file in network_files(at) if file != path]
        # enabling systemd-networkd would also activate these files
        if strangers:
            notes.append(
                f"systemd-networkd does not run, and would also use {', '.join(strangers)}: check these files, then "
                f"`systemctl enable --now {NETWORKD}`"
            )
            return changes, notes
        if manager:
            notes.append(
                f"{manager} manages the network, but cannot set CAN bit rates; systemd-networkd will run in addition, "
                f"for {name} only"
            )
        changes += _enable_networkd(name)
    if changes:
        changes.append(
            CommandChange(
                f"bring {name} up now", ("networkctl", "reconfigure", name), (("ip", "link", "set", name, "down"),),
                ("cat", f"/sys/class/net/{name}/flags"),
            )
        )  # fmt: skip
    return changes, notes


def _enable_networkd(name: str) -> Sequence[Change]:
    enabled = CommandChange(
        f"start systemd-networkd for {name}", ("systemctl", "enable", "--now", NETWORKD),
        (("systemctl", "disable", "--now", NETWORKD, "systemd-networkd.socket"),),
        ("systemctl", "is-enabled", NETWORKD),
    )  # fmt: skip
    not_waited_for = CommandChange(
        "do not wait for systemd-networkd at boot", ("systemctl", "disable", WAIT_ONLINE), (),
        ("true",), optional=True,
    )  # fmt: skip
    return enabled, not_waited_for


def network_file(name: str, bitrate: int) -> bytes:
    """Return the .network file of an interface. `bitrate`: 0 for a virtual interface."""
    lines = ["# Created by `imud setup`.", "[Match]", f"Name={name}", "", "[Link]", "RequiredForOnline=no"]
    if bitrate:
        lines += ["", "[CAN]", f"BitRate={bitrate}", "RestartSec=100ms"]
    return ("\n".join(lines) + "\n").encode()


def network_files(at: Surroundings) -> list[str]:
    """Return the .network files of the administrator."""
    return [at.outside(file) for file in sorted(at.at(NETWORKS).glob("*.network"))]


def _names(at: Surroundings, file: str, name: str) -> bool:
    """Return whether `Name=` in a .network file, with patterns, matches the interface."""
    lines = (line.partition("=") for line in (at.text(file) or "").splitlines())
    return any(fnmatch(name, one) for key, _, value in lines if key.strip() == "Name" for one in value.split())


def state(at: Surroundings, unit: str, question: str) -> str:
    """Return the output of `systemctl is-active` or `is-enabled`; empty without systemd."""
    try:
        return at.run(["systemctl", question, unit]).text.strip()
    except OSError:
        return ""
