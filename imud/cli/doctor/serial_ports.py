"""Checks of serial ports by the file system: there, free, no console on them, no bytes held back by the adapter."""

from typing import Final

from imud.cli.doctor.access import nodes
from imud.cli.doctor.finding import Findings, error, not_checked, note, ok, warning
from imud.cli.doctor.surroundings import Surroundings
from imud.links.device_node import holders_of
from imud.links.uart.port_list import list_ports
from imud.links.uart.serial_port import read_latency_timer_ms

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
