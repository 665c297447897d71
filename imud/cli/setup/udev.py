"""Rules of udev for the USB adapters that imud uses: no holding back of bytes, no ModemManager.

One file has the lines of all adapters. Each line names its adapter by vendor, product and serial number, so that others
of the machine stay as they are. `ID_MM_DEVICE_IGNORE` is the property of ModemManager for devices that are no modems;
`latency_timer` is the attribute of the kernel's driver ftdi_sio, in ms.
"""

import re
from collections.abc import Sequence
from typing import Final, NamedTuple

from imud.cli.doctor.surroundings import Surroundings
from imud.cli.setup.changes import FileChange, Words, content_of

RULES: Final = "/etc/udev/rules.d/61-imud-setup.rules"
RULES_HEAD: Final = "# Made by `imud setup` for the adapters of its devices; `imud setup --undo` removes it."
FTDI: Final = "ftdi_sio"
MODEM_MANAGER: Final = "ModemManager.service"
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9_.:/ -]")


class UsbAdapter(NamedTuple):
    """The USB device that a serial port is of."""

    node: str
    """Of the port, for example `ttyUSB0`."""
    driver: str
    """The kernel's driver of the port."""
    vendor: str
    """Number of the vendor, four hexadecimal digits."""
    product: str
    serial: str
    """Serial number; empty where it has none."""


def usb_adapter(at: Surroundings, node: str) -> UsbAdapter | None:
    """Find the adapter of a port by its node; None for a port that is none of USB."""
    name = node.rpartition("/")[2]
    device = at.at(f"/sys/class/tty/{name}/device")
    if not device.exists():
        return None
    driver = (device / "driver").resolve().name if (device / "driver").exists() else ""
    real = device.resolve()
    for parent in (real, *real.parents):
        if vendor := at.text(at.outside(parent / "idVendor")):
            product, serial = (at.text(at.outside(parent / key)) or "" for key in ("idProduct", "serial"))
            return UsbAdapter(name, driver, vendor, product, serial)
        if parent == at.root:
            break
    return None


def rules(at: Surroundings, adapters: Sequence[UsbAdapter]) -> FileChange | None:
    """Return what these adapters need in the file of rules; None where it has all. Raises ChangeRefused, OSError."""
    before = (content_of(at, RULES) or b"").decode("utf-8", "replace")
    present = before.splitlines()
    ignore_modems = modem_manager_runs(at)
    wanted = [line for adapter in adapters for line in _lines(adapter, ignore_modems=ignore_modems)]
    missing = [line for line in dict.fromkeys(wanted) if line not in present]
    if not missing:
        return None
    lines = [*(present or [RULES_HEAD]), *missing]
    what = [
        words
        for word, words in (
            ("latency_timer", "adapters send bytes after 1 ms"),
            ("ID_MM_", "ModemManager leaves them alone"),
        )
        if any(word in line for line in missing)
    ]
    nodes = dict.fromkeys(f"--sysname-match={adapter.node}" for adapter in adapters)
    then: tuple[Words, ...] = (("udevadm", "control", "--reload"),)
    then += (
        ("udevadm", "trigger", "--action=add", "--subsystem-match=tty", "--subsystem-match=usb-serial", *nodes),
        ("udevadm", "settle", "--timeout=5"),
    )
    return FileChange(", ".join(what), RULES, ("\n".join(lines) + "\n").encode(), then)


def modem_manager_runs(at: Surroundings) -> bool:
    """Whether ModemManager runs, or will after the next start of the machine."""
    words = ["systemctl", "show", MODEM_MANAGER, "--property=LoadState,ActiveState,UnitFileState"]
    try:
        states = at.run(words).text.split()
    except OSError:
        return False
    return "LoadState=loaded" in states and ("ActiveState=active" in states or "UnitFileState=enabled" in states)


def _lines(adapter: UsbAdapter, *, ignore_modems: bool) -> list[str]:
    which = f'ATTRS{{idVendor}}=="{_pattern(adapter.vendor)}", ATTRS{{idProduct}}=="{_pattern(adapter.product)}"'
    if adapter.serial:
        which += f', ATTRS{{serial}}=="{_pattern(adapter.serial)}"'
    lines = []
    if adapter.driver == FTDI:
        lines.append(f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="{FTDI}", {which}, ATTR{{latency_timer}}="1"')
    if ignore_modems:
        properties = 'ENV{ID_MM_DEVICE_IGNORE}="1", ENV{ID_MM_PORT_IGNORE}="1"'
        lines.append(f'ACTION!="remove", SUBSYSTEM=="tty", {which}, {properties}')
    return lines


def _pattern(text: str) -> str:
    """A text as a pattern of udev: what means something there matches any character."""
    return _UNSAFE.sub("?", text)
