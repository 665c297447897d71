"""Serial ports of this machine that may have a device, found without opening any of them.

Opening a port raises DTR and RTS, which resets some boards; /sys has all that is needed.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

NODE_KINDS: Final = ("ttyUSB", "ttyACM", "ttyAMA", "ttyS", "ttySC", "ttyTHS", "ttymxc", "ttyO")
"""USB adapters, USB virtual ports, PL011 (Raspberry Pi), 8250 and mini-UART, SC16IS7xx, Tegra, i.MX, OMAP."""
UNKNOWN_TYPE: Final = "0"
"""PORT_UNKNOWN of linux/serial_core.h: the driver made a node (ttyS4…) but found no UART."""
ALIAS_DIRECTORIES: Final = ("by-id", "by-path")


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port."""

    path: str
    """Device path for the configuration: the by-id name where there is one and it is this adapter's alone, else
    by-path, else the node."""
    node: str
    """The device node, for example `/dev/ttyUSB0`."""
    title: str
    """Manufacturer, product and serial number of a USB adapter; else empty."""


def list_ports(dev: Path = Path("/dev"), sys: Path = Path("/sys")) -> list[SerialPort]:
    """List all ports that have hardware, by node name in natural order.

    Of equal adapters without serial numbers, all have the same by-id name, and which of them it leads to changes with
    the order in which they were plugged in: they are named by the socket that they are in.
    """
    ids, paths = (_aliases(dev / "serial" / directory) for directory in ALIAS_DIRECTORIES)
    nodes = sorted(_nodes(dev, sys), key=lambda node: (node.name.rstrip("0123456789"), len(node.name), node.name))
    titles = {node.name: _usb_title(sys, node.name) for node in nodes}
    nameless = {title for name, title in titles.items() if title and name not in ids}
    found = []
    for node in nodes:
        title = titles[node.name]
        names = (paths, ids) if title in nameless else (ids, paths)
        path = next((known[node.name] for known in names if node.name in known), str(node))
        found.append(SerialPort(path, str(node), title))
    return found


def _nodes(dev: Path, sys: Path) -> Iterator[Path]:
    for entry in (sys / "class" / "tty").glob("tty*"):
        if entry.name.rstrip("0123456789") in NODE_KINDS and (dev / entry.name).exists() and _is_real(entry):
            yield dev / entry.name


def _is_real(entry: Path) -> bool:
    """Whether hardware was found: USB ports exist only with it; the others have `type` in /sys."""
    kind = _text(entry / "type")
    return kind != UNKNOWN_TYPE if kind else (entry / "device").exists()


def _aliases(directory: Path) -> dict[str, str]:
    """Stable names by node name."""
    found: dict[str, str] = {}
    for link in sorted(directory.glob("*")):
        found.setdefault(os.path.basename(os.path.realpath(link)), str(link))
    return found


def _usb_title(sys: Path, node: str) -> str:
    """From the USB device that the port hangs on: the nearest parent in /sys with a product name."""
    device = (sys / "class" / "tty" / node / "device").resolve()
    for parent in (device, *device.parents):
        if product := _text(parent / "product"):
            words = (_text(parent / "manufacturer"), product, _text(parent / "serial"))
            return " ".join(word for word in words if word)
        if parent == sys:
            break
    return ""


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
