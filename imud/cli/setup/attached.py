"""What is attached to this machine, and what imud already knows of it.

A serial port is listened to only where nobody has it open: root may open what another program has for itself, and would
take bytes from it, and a port with a console is not for sensors until its user says so. What the running daemon has is
taken from its status, so that it goes on.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import msgspec

from imud.cli.doctor.surroundings import Surroundings
from imud.cli.probe.report import ProbeReport
from imud.config import DeviceConfig
from imud.contracts.can import CanDriver
from imud.devices import DRIVERS
from imud.links.can.netlink import absence, can_interfaces
from imud.links.device_node import holders_of
from imud.links.uart.port_list import list_ports

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
